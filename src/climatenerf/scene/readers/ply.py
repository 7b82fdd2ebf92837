"""Positions of PLY point clouds: reading and writing of sparse points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError, explain, one_line
from climatenerf.core.regular_files import check_regular
from climatenerf.core.storage import write_bytes

MAX_POSITION = 1e9
"""Input units. 32 bits resolve a hundredth part of a scene of a millionth of that."""

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the vertex positions of an ASCII or binary PLY file, in the units of the file.

    Points that are not finite or beyond `MAX_POSITION` are left out.

    Raises:
        UserError: The file is missing, damaged, or not a point cloud.
    """
    try:
        check_regular(path)
        raw = path.read_bytes()
    except OSError as error:
        if not isinstance(error, FileNotFoundError):
            raise explain(error, path) from None
        raise UserError(
            f"The points {path} cannot be read ({error.strerror}); restore the file."
        ) from None
    try:
        points = _parse(raw)
    except (ValueError, KeyError, IndexError, OverflowError) as error:
        raise UserError(
            f"The points {path} are not a readable PLY point cloud"
            f" ({one_line(str(error), 100)}); export them again."
        ) from None
    return points[(np.abs(points) <= MAX_POSITION).all(axis=1)]  # NaN is not


def write_points(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    """Write positions as a binary PLY file of doubles, atomically.

    Raises:
        UserError: The file cannot be written.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\n"
        "property double x\nproperty double y\nproperty double z\nend_header\n"
    )
    write_bytes(path, header.encode() + np.ascontiguousarray(points, "<f8").tobytes())


def _parse(raw: bytes) -> Float[np.ndarray, "n 3"]:
    end = raw.find(b"end_header")
    if not raw.startswith(b"ply") or end < 0:
        raise ValueError("no PLY header")
    body = raw.index(b"\n", end) + 1
    encoding, count, properties = _parse_header(raw[:end].decode("ascii", "replace"))
    names = [name for name, _ in properties]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError("vertices without x, y, z")
    if encoding == "ascii":
        lines = raw[body:].decode("ascii", "replace").splitlines()[:count]
        table = np.array([[float(w) for w in line.split()[: len(names)]] for line in lines])
        if len(table) < count:
            raise ValueError("fewer points than the header declares")
        return table.reshape(count, len(names))[:, [names.index(axis) for axis in "xyz"]]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    kind = np.dtype([(name, order + type_) for name, type_ in properties])
    if len(raw) - body < count * kind.itemsize:
        raise ValueError("fewer points than the header declares")
    table = np.frombuffer(raw, kind, count, body)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _parse_header(header: str) -> tuple[str, int, list[tuple[str, str]]]:
    """Return the encoding, the number of vertices, and their properties as (name, NumPy type)."""
    encoding, count, properties, in_vertex = "", 0, [], False
    for line in header.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            encoding = words[1]
        elif words[:1] == ["element"]:
            if in_vertex:
                break
            if words[1] != "vertex":
                raise ValueError("vertices are not the first element")
            count, in_vertex = int(words[2]), True
            if count < 0:
                raise ValueError("a negative number of points")
        elif words[:1] == ["property"] and in_vertex:
            properties.append((words[2], _TYPES[words[1]]))
    return encoding, count, properties
