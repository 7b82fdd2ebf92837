"""Write pictures, labels, points and scene.json from the store; write the demo's folder."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from tools.reference_street.layout import FIELD_OF_VIEW, build_scene, camera_poses, ground_datum
from tools.reference_street.render import EXPOSURE, encode, load
from tools.reference_street.store import stored
from tools.reference_street.truth import layers

if TYPE_CHECKING:
    from climatenerf.scene import Scene

JPEG_QUALITY = 92
HOLDOUT_EVERY = 8  # in the demo: the first, ninth, ... view by name is held out
POINTS_PER_VIEW = 48
MAX_POINT_DISTANCE = 120.0  # m
Poses = list[tuple[str, Float[np.ndarray, "4 4"]]]


def write_demo(store: Path, out: Path, width: int, height: int) -> None:
    """Write the 64 views of the walk and the arc, with labels."""
    poses = camera_poses()
    write_pictures(store / "clean", out / "images", poses)
    known = truths(store, poses, width, height)
    for name, truth in known.items():
        save_png(truth["label"], out / "labels" / f"{Path(name).stem}.png")
    heldout = {name for name, _ in poses[::HOLDOUT_EVERY]}
    write_scene(out, poses, heldout, known, width, height)


def write_pictures(means: Path, folder: Path, poses: Poses) -> None:
    """Write JPEGs of the views."""
    for name, _ in poses:
        save_jpeg(EXPOSURE * mean_of(means, name), folder / name)


def mean_of(folder: Path, name: str) -> Float[np.ndarray, "h w 3"]:
    """Return the linear picture of a view in a folder of the store."""
    mean = stored((folder / name).with_suffix(".npz"))[1]
    if mean is None:
        raise SystemExit(
            f"{folder.name} {name} is not traced yet;"
            " run `python -m tools.reference_street.reference`"
        )
    return mean


def truths(store: Path, poses: Poses, width: int, height: int) -> dict[str, dict[str, np.ndarray]]:
    """Return the true layers of views; the store caches them, as each takes seven seconds."""
    folder = store / "layers"
    folder.mkdir(parents=True, exist_ok=True)
    out, scene, meshes = {}, None, build_scene()
    with tempfile.TemporaryDirectory() as scratch:
        for name, pose in poses:
            path = (folder / name).with_suffix(".npz")
            if not path.exists():
                scene = scene or load(meshes, Path(scratch), named=True)
                np.savez(path, **layers(scene, meshes, pose, width, height))
            with np.load(path) as data:
                out[name] = {key: data[key] for key in data.files}
    return out


def sparse_points(
    poses: Poses,
    heldout: set[str],
    known: dict[str, dict[str, np.ndarray]],
    width: int,
    height: int,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Return random surface points (m) like those of structure from motion, and their views.

    Held-out views give no points.
    """
    rng = np.random.default_rng(1)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    points, seen_by = [], []
    for i, (name, pose) in enumerate(poses):
        if name in heldout:
            continue
        row = rng.integers(height, size=POINTS_PER_VIEW)
        column = rng.integers(width, size=POINTS_PER_VIEW)
        depth = known[name]["depth"][row, column]
        pixel = np.stack([column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height], -1) / focal
        ray = np.c_[pixel, np.ones(POINTS_PER_VIEW)] @ pose[:3, :3].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        near = depth < MAX_POINT_DISTANCE
        points.append(pose[:3, 3] + depth[near, None] * ray[near])
        seen_by.append(np.full(int(near.sum()), i))
    return np.concatenate(points), np.concatenate(seen_by)


def write_scene(
    out: Path,
    poses: Poses,
    heldout: set[str],
    known: dict[str, dict[str, np.ndarray]],
    width: int,
    height: int,
    shared: Callable[[str], str] = lambda path: path,
) -> None:
    """Write scene.json and points.ply with climatenerf's own writer.

    `shared` maps a file (`images/0001.jpg`) to its path relative to `out`.
    """
    from climatenerf.scene import Camera, Scene, View

    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
    ground, lowest = ground_datum()
    root = out.resolve()
    points, seen_by = sparse_points(poses, heldout, known, width, height)
    views = tuple(
        View(
            name,
            root / shared(f"images/{name}"),
            0,
            pose,
            "heldout" if name in heldout else "train",
            label_path=root / shared(f"labels/{Path(name).stem}.png"),
            seen=np.flatnonzero(seen_by == i),
        )
        for i, (name, pose) in enumerate(poses)
    )
    scene = Scene(root, "street", (camera,), views, points, ground_z=ground, lowest_ground_z=lowest)
    save_portable(scene)


def save_portable(scene: "Scene", **changes: str) -> None:
    """Write a scene to its root, without that folder's absolute path.

    Args:
        scene: the scene.
        changes: entries of scene.json to set.
    """
    from climatenerf.scene import save_scene

    path = save_scene(scene, scene.root)
    data = json.loads(path.read_text(encoding="utf-8"))
    data.pop("root_absolute", None)
    data |= changes
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")
    os.replace(temporary, path)


def save_png(picture: np.ndarray, path: Path) -> None:
    """Write a picture as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    Image.fromarray(picture).save(temporary, "PNG", optimize=True)
    os.replace(temporary, path)


def save_jpeg(linear: Float[np.ndarray, "h w 3"], path: Path) -> None:
    """Write a linear picture after exposure as JPEG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    picture = Image.fromarray(encode(linear))
    picture.save(temporary, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    os.replace(temporary, path)
