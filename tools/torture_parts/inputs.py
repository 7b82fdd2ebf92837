"""Small valid inputs of every kind, made from the embedded street."""

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from tools.torture_parts.zygote import ROOT, Runner

STREET = ROOT / "src" / "climatenerf" / "assets" / "street"
SIZE = (96, 54)  # pixels
EVERY = 7  # photos of the street
STEPS = 12
STILL = ["--path", "still", "--frames", "1", "--size", "32x18"]

WEATHER = """seed = 3
[flood]
level = { "0 s" = "-0.2 m", "3 s" = "0.5 m" }
clarity = "15 cm"
colour = [0.4, 0.4, 0.3]
[smog]
visibility = "200 m"
[sun]
elevation = "35 deg"
"""
CAMERA_PATH = {
    "camera_type": "perspective",
    "render_height": 18,
    "render_width": 32,
    "fps": 24,
    "default_fov": 50,
    "camera_path": [
        {"camera_to_world": [1, 0, 0, x, 0, 0, -1, 0, 0, 1, 0, 1.6, 0, 0, 0, 1], "fov": 50}
        for x in (0.0,)
    ],
}


def build(originals: Path, runner: Runner) -> None:
    """Write `scene/`, `colmap-text/`, `colmap/`, `transforms/`, `run/` and single files.

    Args:
        originals: an empty folder.
        runner: runs the verbs that make the derived inputs.

    Raises:
        RuntimeError: a verb fails on them.
    """
    _write_scene(originals / "scene")
    for format_ in ("transforms", "colmap"):
        out = originals / f"exported-{format_}"
        _valid(runner, "export", originals / "scene", "-o", out, "--format", format_)
    _with_photos(originals, "exported-colmap", "colmap-text")
    _with_photos(originals, "exported-transforms", "transforms")
    _with_photos(originals, "exported-colmap", "colmap")
    _to_binary(originals / "colmap" / "sparse" / "0")
    data = json.loads((originals / "transforms" / "transforms.json").read_text())
    for frame in data["frames"]:
        del frame["mask_path"]
    text = json.dumps(data).replace(f"{originals / 'scene'}/", "")
    (originals / "transforms" / "transforms.json").write_text(text)
    _valid(runner, "fit", originals / "scene", "-o", originals / "run", "--steps", STEPS)
    (originals / "weather.toml").write_text(WEATHER)
    (originals / "path").mkdir()
    (originals / "path" / "camera_path.json").write_text(json.dumps(CAMERA_PATH))
    moved = {"transform": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0.5}
    (originals / "path" / "dataparser_transforms.json").write_text(json.dumps(moved))


def _valid(runner: Runner, *args: object) -> None:
    done = runner.run(*args)
    if done.status:
        raise RuntimeError(f"the valid input fails: {args}: {done.err}")


def _write_scene(folder: Path) -> None:
    data = json.loads((STREET / "scene.json").read_text())
    data["views"] = data["views"][::EVERY]
    data |= {"points_seen": None, "root": ".", "root_absolute": None}
    data["cameras"] = [{k: v for k, v in data["cameras"][0].items()}]
    for name in ("images", "labels", "masks", "depth"):
        (folder / name).mkdir(parents=True)
    for number, view in enumerate(data["views"]):
        source = STREET / view["path"]
        with Image.open(source) as photo:
            suffix = ".png" if number % 2 else ".jpg"
            target = folder / "images" / f"{source.stem}{suffix}"
            photo.convert("RGB").resize(SIZE).save(target)
        with Image.open(STREET / view["label_path"]) as label:
            label.resize(SIZE, Image.Resampling.NEAREST).save(folder / "labels" / label_name(view))
        Image.fromarray(np.full(SIZE[::-1], 255, np.uint8)).save(
            folder / "masks" / f"{source.stem}.png"
        )
        depth = np.full(SIZE[::-1], 6.0, np.float32)
        stem = folder / "depth" / source.stem
        if number % 3 == 0:
            np.save(stem.with_suffix(".npy"), depth)
        elif number % 3 == 1:
            np.savez_compressed(stem.with_suffix(".npz"), depth=depth)
        else:
            Image.fromarray((depth * 1000).astype(np.uint16)).save(stem.with_suffix(".png"))
        view |= {"name": target.name, "path": f"images/{target.name}"}
        view |= {"label_path": f"labels/{label_name(view)}", "mask_path": None, "depth_path": None}
    (folder / "points.ply").write_bytes((STREET / "points.ply").read_bytes())
    del data["root_absolute"]
    (folder / "scene.json").write_text(json.dumps(data))


def label_name(view: dict) -> str:
    """Return the name of the label file of a view."""
    return f"{Path(view['name']).stem}.png"


def _with_photos(originals: Path, exported: str, name: str) -> None:
    """Copy exported poses beside copies of the photos."""
    folder = originals / name
    for base, target in (
        (originals / exported, folder),
        (originals / "scene" / "images", folder / "images"),
    ):
        for path in base.rglob("*"):
            if path.is_file():
                copy = target / path.relative_to(base)
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(path.read_bytes())


def _to_binary(model: Path) -> None:
    """Convert a COLMAP model of pinholes from text to binary."""
    lines = {
        stem: [
            line
            for line in (model / f"{stem}.txt").read_text().splitlines()
            if not line.startswith("#")
        ]
        for stem in ("cameras", "images", "points3D")
    }
    data = struct.pack("<Q", len(lines["cameras"]))
    for line in lines["cameras"]:
        key, _, width, height, *numbers = line.split()
        data += struct.pack("<IiQQ", int(key), 1, int(width), int(height))
        data += struct.pack("<4d", *map(float, numbers))
    (model / "cameras.bin").write_bytes(data)
    images = lines["images"][::2]
    data = struct.pack("<Q", len(images))
    for line in images:
        key, *pose, camera, name = line.split()
        data += struct.pack("<I7dI", int(key), *map(float, pose), int(camera))
        data += name.encode() + b"\0" + struct.pack("<Q", 1) + struct.pack("<ddq", 3.0, 4.0, -1)
    (model / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(lines["points3D"]))
    for line in lines["points3D"]:
        key, x, y, z, *_ = line.split()
        data += struct.pack("<Q3d3BdQ", int(key), float(x), float(y), float(z), 1, 2, 3, 0.5, 1)
        data += struct.pack("<2I", 1, 0)
    (model / "points3D.bin").write_bytes(data)
    for stem in lines:
        (model / f"{stem}.txt").unlink()
