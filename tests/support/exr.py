"""A reader of OpenEXR files from the format's description, independent of the library that writes.

Single-part scanline files with float32 channels, uncompressed or compressed by ZIP: what the
program writes.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

MAGIC = 20000630
LINES = {0: 1, 2: 1, 3: 16}
"""Scanlines of a block by compression: none, ZIPS, ZIP."""
FLOAT = 2


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, bytes]]:
    """Return float32 channels by name, (h, w) each, and the raw attributes by name."""
    data = path.read_bytes()
    magic, version = struct.unpack_from("<II", data)
    assert magic == MAGIC and version & 0xFF == 2 and not version & ~0x4FF, "no plain scanline file"
    attributes, offset = _attributes(data, 8)
    names = _channels(attributes["channels"])
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    lines = LINES[attributes["compression"][0]]
    picture = np.full((height, len(names), width), np.nan, np.float32)
    for (start,) in struct.iter_unpack("<Q", data[offset : offset + 8 * -(-height // lines)]):
        row, size = struct.unpack_from("<iI", data, start)
        rows = slice(row - top, min(row - top + lines, height))
        block = data[start + 8 : start + 8 + size]
        raw = 4 * picture[rows].size
        block = block if size == raw else _unpacked(block)
        picture[rows] = np.frombuffer(block, "<f4").reshape(picture[rows].shape)
    return {name: picture[:, index] for index, name in enumerate(names)}, attributes


def _attributes(data: bytes, offset: int) -> tuple[dict[str, bytes], int]:
    found = {}
    while data[offset]:
        name, offset = _text(data, offset)
        _, offset = _text(data, offset)
        (size,) = struct.unpack_from("<I", data, offset)
        found[name] = data[offset + 4 : offset + 4 + size]
        offset += 4 + size
    return found, offset + 1


def _channels(data: bytes) -> list[str]:
    names, offset = [], 0
    while data[offset]:
        name, offset = _text(data, offset)
        kind, _, x, y = struct.unpack_from("<iIii", data, offset)
        assert (kind, x, y) == (FLOAT, 1, 1), "channels of float32 in full resolution"
        names.append(name)
        offset += 16
    return names


def _text(data: bytes, offset: int) -> tuple[str, int]:
    end = data.index(b"\0", offset)
    return data[offset:end].decode(), end + 1


def _unpacked(block: bytes) -> bytes:
    """Undo ZIP: inflate, add up differences of bytes, and interleave the two halves."""
    steps = np.frombuffer(zlib.decompress(block), np.uint8).astype(np.int64)
    steps[1:] -= 128
    mixed = (np.cumsum(steps) % 256).astype(np.uint8)
    half = (len(mixed) + 1) // 2
    out = np.empty_like(mixed)
    out[0::2], out[1::2] = mixed[:half], mixed[half:]
    return out.tobytes()
