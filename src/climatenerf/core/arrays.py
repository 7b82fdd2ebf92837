"""Reading of NPY and NPZ files whose headers may claim any size.

NumPy takes memory for what a header claims before it reads. Here the claim is first compared with
the size of the file and with a bound on the size of an array.
"""

import math
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from climatenerf.core.regular_files import check_regular

MAX_BYTES = 2**30
"""Bytes of one array: depths of 100 megapixels in 64 bits have 0.8 GB."""
MAX_MEMBERS = 1000
MAX_HEADER = 10_000
"""Bytes of an array's header, as in NumPy."""

ERRORS = (
    OSError,
    ValueError,
    EOFError,
    IndexError,
    KeyError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What the functions below raise for a file that is absent or damaged.

`zipfile` raises NotImplementedError where a damaged header claims an unknown compression.
"""


def read_npy(path: Path, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """Return the array of an NPY file.

    Args:
        path: the file.
        max_bytes: greatest size of the array, bytes.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no NPY file, is cut off, is too large, or holds objects.
    """
    check_regular(path)
    with path.open("rb") as file:
        _check_claim(file, path.stat().st_size, max_bytes)
        file.seek(0)
        return np.load(file, allow_pickle=False)


def shape_of(path: Path, max_bytes: int = MAX_BYTES) -> tuple[int, ...]:
    """Return the shape of the array of an NPY file, or of the first array of an NPZ file.

    Raises:
        OSError, ValueError, zipfile.BadZipFile, zlib.error, EOFError: as for `read_npy` and
            `read_npz`.
    """
    check_regular(path)
    if path.suffix != ".npz":
        with path.open("rb") as file:
            return _check_claim(file, path.stat().st_size, max_bytes)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if not members:
            raise ValueError("it holds no array")
        with archive.open(members[0]) as file:
            return _check_claim(file, members[0].file_size, max_bytes)


def read_npz(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file by name; all together have at most `max_bytes`.

    Raises:
        OSError: the file cannot be read.
        ValueError, zipfile.BadZipFile, zlib.error, EOFError: it is no NPZ file, or is damaged, too
            large, or holds objects.
    """
    path.stat()
    check_regular(path)
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no NPZ file")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if len(members) > MAX_MEMBERS or total > max_bytes:
            raise ValueError(f"it claims {total / 1e9:.3g} GB in {len(members)} arrays")
        if any(member.flag_bits & 1 for member in members):
            raise ValueError("it is encrypted")
        for member in members:
            with archive.open(member) as file:
                _check_claim(file, member.file_size, max_bytes)
    with np.load(path, allow_pickle=False) as data:
        if not hasattr(data, "files"):
            raise ValueError("it is no NPZ")
        return {name: data[name] for name in data.files}


def _check_claim(file: IO[bytes], size: int, max_bytes: int) -> tuple[int, ...]:
    """Return the shape in the header at the beginning of a file, if the file holds as much.

    Args:
        file: at its beginning.
        size: bytes of the whole file.
        max_bytes: greatest size of the array, bytes.
    """
    try:
        version = np.lib.format.read_magic(file)  # type: ignore[arg-type]
    except ValueError as error:
        raise ValueError("it is no NPY file") from error
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"its format {version[0]}.{version[1]} is unknown")
    try:
        shape, _, kind = read(file, max_header_size=MAX_HEADER)  # type: ignore[arg-type]
    except Exception as error:  # the parser of Python's syntax raises errors of its own
        raise ValueError("its header is damaged") from error
    if kind.hasobject:
        raise ValueError("it holds no numbers")
    claimed = math.prod(shape) * kind.itemsize
    if any(n < 0 for n in shape) or claimed > max_bytes:
        raise ValueError(f"its header claims {claimed / 1e9:.3g} GB")
    if claimed > size - file.tell():
        raise ValueError("it is cut off: its header claims more than the file holds")
    return shape
