"""Positions of a PLY point cloud: enough to read sparse points and to write them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError

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
    """Read x, y, z of the vertices of an ASCII or binary PLY file, in the file's units.

    Points that are not finite are left out.

    Raises:
        UserError: The file is missing, damaged, or not a point cloud.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"The points {path} cannot be read ({error.strerror}).") from None
    try:
        points = _parse(raw)
    except (ValueError, KeyError, IndexError) as error:
        raise UserError(
            f"The points {path} are not a readable PLY point cloud ({error}); export them again."
        ) from None
    return points[np.isfinite(points).all(axis=1)]


def _parse(raw: bytes) -> np.ndarray:
    end = raw.find(b"end_header")
    if not raw.startswith(b"ply") or end < 0:
        raise ValueError("no PLY header")
    body = raw.index(b"\n", end) + 1
    style, count, names, seen_vertex = "", 0, [], False
    for line in raw[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            style = words[1]
        elif words[:1] == ["element"]:
            if words[1] == "vertex":
                count, seen_vertex = int(words[2]), True
            elif not seen_vertex:
                raise ValueError("vertices are not the first element")
            else:
                break
        elif words[:1] == ["property"] and seen_vertex:
            names.append((words[2], _TYPES[words[1]]))
    if not {"x", "y", "z"} <= {n for n, _ in names}:
        raise ValueError("vertices without x, y, z")
    if style == "ascii":
        lines = raw[body:].decode("ascii", "replace").splitlines()[:count]
        table = np.array([[float(w) for w in line.split()[: len(names)]] for line in lines])
        if len(table) < count:
            raise ValueError("fewer points than announced")
        columns = [[n for n, _ in names].index(axis) for axis in "xyz"]
        return table.reshape(count, len(names))[:, columns]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[style]
    kind = np.dtype([(n, order + t) for n, t in names])
    if len(raw) - body < count * kind.itemsize:
        raise ValueError("fewer points than announced")
    table = np.frombuffer(raw, kind, count, body)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)


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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(header.encode() + np.ascontiguousarray(points, "<f8").tobytes())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(
            f"{path} cannot be written ({error.strerror}); free some space or choose another "
            "folder."
        ) from None
