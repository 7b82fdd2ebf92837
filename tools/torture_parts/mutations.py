"""Mutations of files, each determined by a seed."""

import io
import json
import random
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

DIGITS = "9" * 400
WEIRD: tuple[Any, ...] = (
    None, True, 0, -1, 5, 2**31, 2**63, 2**200, int(DIGITS), 1e300, -1e38, 1e-320, float("nan"),
    float("inf"), "", "x", "1e400", "x" * 300, "../../../../tmp/x", "a\0b", "\udce9",
    "\u202e\x1b[2J", [], {}, [1], [[[1]]], {"a": 1}, [None] * 20, "NaN",
)  # fmt: skip
DOUBLES = (float("nan"), float("inf"), 1e300, -1e38, 1e-320, 0.0, -1.0)
WHOLE = (0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1)


def mutate(path: Path, rng: random.Random) -> str:
    """Change a file on disk in one of the ways that suit it, and return what was done."""
    suffix = path.suffix.lower()
    ways = [_flip, _flip, _truncate, _block, _words, _encode, _rename]
    special = {
        ".json": [_json, _json, _json, _json, _deep],
        ".toml": [_toml, _toml, _toml, _deep],
        ".txt": [_text, _text, _text],
        ".npy": [_npy_header, _npy_values],
        ".npz": [_npz_bomb, _npz_values],
        ".png": [_png_size, _png_size],
        ".ply": [_text_header, _text_header],
        ".safetensors": [_tensor_header, _tensor_values, _tensor_values],
    }.get(suffix, [])
    way = rng.choice([*ways, *special, *special])
    return f"{way.__name__.strip('_')} {path.name}: {way(path, rng)}"


def _flip(path: Path, rng: random.Random) -> str:
    data = bytearray(path.read_bytes())
    count = rng.choice((1, 1, 3, 20))
    for _ in range(count if data else 0):
        position = rng.randrange(len(data))
        if rng.random() < 0.5:  # headers are more interesting than bodies
            position = rng.randrange(min(len(data), 256))
        data[position] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
    return f"{count} bits"


def _truncate(path: Path, rng: random.Random) -> str:
    data = path.read_bytes()
    length = int(len(data) * rng.choice((0.0, 0.01, 0.5, 0.99, rng.random())))
    path.write_bytes(data[:length])
    return f"to {length} bytes"


def _block(path: Path, rng: random.Random) -> str:
    data = bytearray(path.read_bytes())
    size = rng.choice((1, 8, 64, 1000))
    start = rng.randrange(max(1, len(data)))
    fill = rng.choice((b"\0", b"\xff", b"9", b"["))
    if rng.random() < 0.5:
        data[start : start + size] = fill * size
        path.write_bytes(data)
        return f"{size} bytes {fill!r} at {start}"
    data[start:start] = fill * size
    path.write_bytes(data)
    return f"{size} bytes {fill!r} inserted at {start}"


def _words(path: Path, rng: random.Random) -> str:
    """Overwrite four or eight bytes with an extreme number."""
    data = bytearray(path.read_bytes())
    value = rng.choice(DOUBLES)
    packed = struct.pack("<d", value)
    if rng.random() < 0.4:
        value = rng.choice(WHOLE)
        packed = struct.pack("<Q", value)
    elif rng.random() < 0.3:
        value = rng.choice((float("nan"), 1e38, -1e38))
        packed = struct.pack("<f", value)
    start = rng.randrange(max(1, len(data) // 4)) * 4
    start = min(start, rng.choice((8, 64, 10**9)))
    data[start : start + len(packed)] = packed
    path.write_bytes(data)
    return f"{value} at {start}"


def _encode(path: Path, rng: random.Random) -> str:
    data = path.read_bytes()
    way = rng.choice(("utf-16", "bom", "latin", "crlf", "nul"))
    if way == "utf-16":
        data = data.decode("latin-1").encode("utf-16")
    elif way == "bom":
        data = b"\xef\xbb\xbf" + data
    elif way == "latin":
        data = data.replace(b"e", b"\xe9", 3)
    elif way == "crlf":
        data = data.replace(b"\n", b"\r\n")
    else:
        data = data.replace(b" ", b"\0", 2)
    path.write_bytes(data)
    return way


def _rename(path: Path, rng: random.Random) -> str:
    way = rng.choice(("remove", "folder", "loop", "case", "long", "bytes"))
    data = path.read_bytes()
    path.unlink()
    if way == "folder":
        path.mkdir()
    elif way == "loop":
        path.symlink_to(path)
    elif way == "case":
        path.with_name(path.name.upper()).write_bytes(data)
    elif way == "long":
        path.with_name("n" * 240 + path.suffix).write_bytes(data)
    elif way == "bytes":
        path.with_name(f"caf\udce9{path.suffix}").write_bytes(data)
    return way


def _json(path: Path, rng: random.Random) -> str:
    """Replace, remove or repeat one value of a tree, chosen by kind of key."""
    tree = json.loads(path.read_text())
    return _written(path, _changed_tree(tree, rng), tree)


def _written(path: Path, done: str, tree: Any) -> str:
    path.write_text(dumped(tree))
    return done


def dumped(tree: Any) -> str:
    """Return JSON of a tree, also of integers beyond Python's limit of digits."""
    text = json.dumps(tree)
    return text.replace('"1e400"', "1e400")


def _changed_tree(tree: Any, rng: random.Random) -> str:
    node, key, where = tree, None, []
    parent = tree
    while isinstance(node, dict | list) and node and (key is None or rng.random() < 0.75):
        parent = node
        key = rng.choice(sorted(node)) if isinstance(node, dict) else rng.randrange(len(node))
        where.append(str(key))
        node = node[key]
    if key is None:
        return "nothing"
    value = rng.choice(WEIRD)
    if rng.random() < 0.15:
        del parent[key]
        return f"{'.'.join(where)} removed"
    if rng.random() < 0.1 and isinstance(node, list):
        parent[key] = node * 50
        return f"{'.'.join(where)} repeated"
    parent[key] = value
    return f"{'.'.join(where)} = {str(value)[:20]!r}"


def _deep(path: Path, rng: random.Random) -> str:
    count = rng.choice((101, 1000, 20_000))
    opening = rng.choice(("[", '{"a":', "{a="))
    text = path.read_text()
    if path.suffix == ".toml":
        path.write_text(f"deep = {opening * count}\n{text}")
    elif rng.random() < 0.5:
        path.write_text(opening * count)
    else:
        path.write_text(text.rstrip().removesuffix("}") + f', "deep": {"[" * count}{"]" * count}}}')
    return f"{count} times {opening}"


def _toml(path: Path, rng: random.Random) -> str:
    text = path.read_text()
    found = list(re.finditer(r"=\s*([^\n]+)", text))
    place = rng.choice(found)
    values = ("5", "nan", "-inf", DIGITS, "9" * 5000, "true", '"x"', '"1e400 m"', '"-1e300 m"')
    values += ("[]", "{}", '{ "0 s" = "1e300 m" }', '{ "nan s" = "1 m" }', "1979-05-27", '"""')
    values += ("[[1]]", "0x" + "f" * 300, '"' + "9" * 5000 + ' m"', "{ a = 1, a = 2 }", '"3 kg"')
    value = rng.choice(values)
    path.write_text(text[: place.start(1)] + value + text[place.end(1) :])
    return value[:30]


def _text(path: Path, rng: random.Random) -> str:
    lines = path.read_text().splitlines()
    rows = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
    row = rng.choice(rows)
    words = lines[row].split()
    values = ("nan", "inf", "1e300", "-1", "0", "x", DIGITS, "9" * 5000, "é", "1e-320", "")
    if rng.random() < 0.2:
        del lines[row]
        done = "line removed"
    else:
        column, value = rng.randrange(len(words)), rng.choice(values)
        words[column] = value
        lines[row] = " ".join(words)
        done = f"word {column} = {value[:20]}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"line {row}: {done}"


def _npy_header(path: Path, rng: random.Random) -> str:
    claims = ("(1000000, 1000000)", "(-1, 5)", "()", "(54,)", "(54, 96, 10**9)", "(2, 0)")
    kinds = ("<f8", "|O", "<U9", "<c8", "<f4", "|V99999999", "?")
    shape, kind = rng.choice(claims), rng.choice(kinds)
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    packed = header.encode().ljust(118) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(packed)) + packed + b"\0" * 999)
    return f"{shape} of {kind}"


def _npy_values(path: Path, rng: random.Random) -> str:
    value = rng.choice(DOUBLES)
    array = np.load(path)
    with np.errstate(all="ignore"):
        array[: rng.choice((1, 10, 10**6))] = value
    np.save(path, array)
    return str(value)


def _npz_bomb(path: Path, rng: random.Random) -> str:
    count = rng.choice((10**6, 5 * 10**8))
    buffer = io.BytesIO()
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({count}, 2), }}"
    packed = b"\x93NUMPY\x01\x00" + struct.pack("<H", 119) + header.encode().ljust(118) + b"\n"
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", packed + b"\0" * min(count, 10**7))
    path.write_bytes(buffer.getvalue())
    return f"{count} rows"


def _npz_values(path: Path, rng: random.Random) -> str:
    value = rng.choice(DOUBLES)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    name = rng.choice(sorted(arrays))
    shape = arrays[name].shape
    arrays[name] = rng.choice(
        (np.full(shape, value), np.full((*shape, 2), 1.0), np.zeros(0), np.array(["x"] * 3))
    )
    np.savez(path, **arrays)
    return f"{name} of {value}"


def _png_size(path: Path, rng: random.Random) -> str:
    data = bytearray(path.read_bytes())
    width, height = rng.choice(
        ((12_000, 10_000), (96, 2**31 - 1), (0, 0), (48, 27), (30_000, 30_000), (54, 96))
    )
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    return f"{width}x{height}"


def _text_header(path: Path, rng: random.Random) -> str:
    """Replace one word of the text before a binary body."""
    data = path.read_bytes()
    end = data.find(b"end_header")
    lines = data[:end].decode().splitlines()
    row = rng.randrange(len(lines))
    words = lines[row].split()
    column = rng.randrange(len(words))
    words[column] = rng.choice(("99999999999", "-5", "ascii", "list", "double", "9" * 5000, "x"))
    lines[row] = " ".join(words)
    path.write_bytes("\n".join(lines).encode() + b"\n" + data[end:])
    return f"{lines[row][:40]}"


def _tensor_header(path: Path, rng: random.Random) -> str:
    data = path.read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    about = header.get("__metadata__", {}).get("climatenerf")
    if about and rng.random() < 0.5:
        tree = json.loads(about)
        done = _changed_tree(tree, rng)
        header["__metadata__"]["climatenerf"] = dumped(tree)
    else:
        done = _changed_tree(header, rng)
    packed = dumped(header).encode()
    path.write_bytes(struct.pack("<Q", len(packed)) + packed + data[8 + size :])
    return done


def _tensor_values(path: Path, rng: random.Random) -> str:
    """Overwrite numbers of one tensor, in some trials with a right checksum."""
    from safetensors import safe_open
    from safetensors.numpy import save_file

    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata() or {}
        arrays = {name: file.get_tensor(name).copy() for name in file.keys()}  # noqa: SIM118
    name = rng.choice(sorted(n for n, a in arrays.items() if a.size))
    value = rng.choice((float("nan"), float("inf"), -1e38, 1e38, 0.0, -1.0, 1e300))
    flat = arrays[name].reshape(-1)
    with np.errstate(all="ignore"):
        flat[: rng.choice((1, 5, flat.size))] = np.array(value).astype(flat.dtype)
    if rng.random() < 0.6 and "climatenerf" in metadata:
        from climatenerf.core.storage import digest

        about = json.loads(metadata["climatenerf"])
        metadata["climatenerf"] = json.dumps({**about, "digest": digest(arrays)})
    save_file(arrays, path, metadata)
    return f"{name} of {value}"
