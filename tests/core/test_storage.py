import errno
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.permissions import as_another_user, open_folder

from climatenerf.core import storage
from climatenerf.core.errors import UserError


def file_names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_json_round_trip_of_supported_types(tmp_path):
    @dataclass(frozen=True)
    class Length:
        metres: float

    storage.write_json(
        tmp_path / "deep" / "a.json",
        {"x": np.float32(0.5), "m": np.eye(2), "p": Path("b"), "l": Length(1.0), "inf": np.inf},
    )
    assert storage.read_json(tmp_path / "deep" / "a.json") == {
        "x": 0.5,
        "m": [[1.0, 0.0], [0.0, 1.0]],
        "p": "b",
        "l": {"metres": 1.0},
        "inf": None,
    }
    assert file_names(tmp_path / "deep") == ["a.json"]


def test_a_failure_or_interrupt_keeps_the_old_file_and_leaves_no_temporary_file(tmp_path):
    path = tmp_path / "a.json"
    storage.write_json(path, {"old": 1})
    with pytest.raises(KeyboardInterrupt), storage.atomic_path(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".json"
        temporary.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(TypeError):
        storage.write_json(path, {"bad": object()})
    assert json.loads(path.read_text()) == {"old": 1}
    assert file_names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk_raises_and_keeps_the_old_file(tmp_path, monkeypatch, code):
    path = tmp_path / "a.bin"
    storage.write_bytes(path, b"old")

    def full(self, data):
        self.touch()
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match="disk is full"):
        storage.write_bytes(path, b"new")
    assert path.read_bytes() == b"old" and file_names(tmp_path) == ["a.bin"]


def test_full_disk_in_safetensors_raises(tmp_path, monkeypatch):
    import safetensors.numpy
    from safetensors import SafetensorError

    def full(*_):
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(safetensors.numpy, "save_file", full)
    with pytest.raises(UserError, match="disk is full"):
        storage.write_safetensors(tmp_path / "f.safetensors", {"a": np.zeros(3)})
    assert file_names(tmp_path) == []


def test_unwritable_paths_raise(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file, not a folder"):
        storage.write_bytes(tmp_path / "file" / "a.bin", b"")
    with pytest.raises(UserError, match="is a file, not a folder"):
        storage.make_folder(tmp_path / "file")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="folder"):
        storage.write_bytes(tmp_path / "folder", b"")
    assert "no permission" in str(storage.explain(PermissionError(errno.EACCES, "x"), tmp_path))


def test_safetensors_round_trip(tmp_path):
    import torch

    path = tmp_path / "f.safetensors"
    storage.write_safetensors(path, {"a": torch.arange(6.0).reshape(2, 3).T}, {"schema": "1"})
    arrays, metadata = storage.read_safetensors(path)
    assert np.array_equal(arrays["a"], np.arange(6.0).reshape(2, 3).T) and metadata["schema"] == "1"
    storage.write_safetensors(path, {"b": np.ones((2, 2), np.float32)})
    assert storage.read_safetensors(path)[0].keys() == {"b"}
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(UserError, match="damaged"):
        storage.read_safetensors(path, "run")
    with pytest.raises(UserError, match="does not exist"):
        storage.read_safetensors(tmp_path / "none.safetensors", "run")


@pytest.mark.parametrize(
    "content, message",
    [(b'{"a": 1', "line 1, column"), (b"[1]", "object"), (b"\xff\xfe\x00", "encoding UTF-16")],
)
def test_read_json_error_names_file_and_cause(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message) as caught:
        storage.read_json(path, "run")
    assert str(path) in str(caught.value) and str(caught.value).startswith("run")
    with pytest.raises(UserError, match="does not exist"):
        storage.read_json(tmp_path / "b.json")


def test_check_schema():
    storage.check_schema(1, 2, "run x")
    with pytest.raises(UserError, match="version 3.*up to 2.*upgrade"):
        storage.check_schema(3, 2, "run x")
    for bad in (None, "1", True, 0):
        with pytest.raises(UserError, match="no schema"):
            storage.check_schema(bad, 2, "run x")


def test_new_files_have_default_permissions(tmp_path):
    storage.write_bytes(tmp_path / "a", b"")
    (tmp_path / "b").write_bytes(b"")
    storage.write_safetensors(tmp_path / "c", {"a": np.zeros(2)})
    assert len({(tmp_path / name).stat().st_mode for name in "abc"}) == 1


def test_a_forbidden_file_is_reported_as_such():
    with open_folder() as folder:
        storage.write_safetensors(folder / "f.safetensors", {"a": np.zeros(2)})
        storage.write_json(folder / "a.json", {})
        for name, read in (
            ("f.safetensors", storage.read_safetensors),
            ("a.json", storage.read_json),
        ):
            (folder / name).chmod(0)
            with as_another_user(), pytest.raises(UserError, match="no permission") as caught:
                read(folder / name, "the run")
            assert str(folder / name) in str(caught.value)
            assert "damaged" not in str(caught.value)
