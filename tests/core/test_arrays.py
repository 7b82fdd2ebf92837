import io
import struct
import zipfile

import numpy as np
import pytest

from climatenerf.core import arrays

DEPTH = np.linspace(1, 9, 12, dtype=np.float32).reshape(3, 4)


def header(shape, kind="<f8"):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text = text.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def zipped(path, *members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def test_arrays_are_read(tmp_path):
    np.save(tmp_path / "a.npy", DEPTH)
    assert np.array_equal(arrays.read_npy(tmp_path / "a.npy"), DEPTH)
    np.savez_compressed(tmp_path / "a.npz", depth=DEPTH, other=np.arange(3))
    found = arrays.read_npz(tmp_path / "a.npz")
    assert list(found) == ["depth", "other"] and np.array_equal(found["depth"], DEPTH)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x93NUMPY",
        b"\x93NUMPY\x09\x00" + bytes(200),
        header("(1000000, 1000000)") + bytes(12),
        header("(100000, 100000)") + bytes(12),
        header("(3, 4)") + bytes(95),
        header("(-1, 4)") + bytes(96),
        header("(3, 4)", "|O") + bytes(96),
        header("(1, 1)", "|V999999999") + bytes(96),
        header("(3, 4") + bytes(96),
        header("('x', 4)") + bytes(96),
    ],
)
def test_headers_that_contradict_the_content_are_refused(tmp_path, data, monkeypatch):
    path = tmp_path / "a.npy"
    path.write_bytes(data)
    monkeypatch.setattr(np, "load", None)  # nothing is read
    with pytest.raises(arrays.ERRORS):
        arrays.read_npy(path)
    packed = zipped(tmp_path / "a.npz", ("depth.npy", data))
    with pytest.raises(arrays.ERRORS):
        arrays.read_npz(packed)


def test_archives_above_the_size_limit_are_refused(tmp_path, monkeypatch):
    body = header("(2000000, 1)") + bytes(16_000_000)
    path = zipped(tmp_path / "bomb.npz", ("depth.npy", body))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(np, "load", None)
    with pytest.raises(ValueError, match="claims"):
        arrays.read_npz(path, max_bytes=10_000_000)
    many = zipped(tmp_path / "many.npz", *((f"{i}.npy", b"") for i in range(1001)))
    with pytest.raises(ValueError, match="arrays"):
        arrays.read_npz(many)


def test_files_of_the_other_kind_are_refused(tmp_path):
    buffer = io.BytesIO()
    np.save(buffer, DEPTH)
    (tmp_path / "a.npz").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="no NPZ"):
        arrays.read_npz(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", DEPTH)
    with pytest.raises(ValueError, match="no NPY"):
        arrays.read_npy(tmp_path / "b.npz")


def test_any_damaged_byte_of_an_archive_is_a_known_error(tmp_path):
    """Among them unknown compressions and versions, for which `zipfile` has its own error."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, depth=DEPTH)
    data = path.read_bytes()
    kinds = set()
    for at in range(len(data)):
        for byte in (0, 20, 99, 255):
            path.write_bytes(data[:at] + bytes([byte]) + data[at + 1 :])
            try:
                arrays.read_npz(path)
            except arrays.ERRORS as error:
                kinds.add(type(error))
    assert {zipfile.BadZipFile, NotImplementedError} <= kinds
