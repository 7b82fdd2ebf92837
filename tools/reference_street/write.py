"""Pictures, labels, points and scene.json on disk, from the store; the demo's folder of them."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from tools.reference_street.layout import FIELD_OF_VIEW, build_scene, camera_poses, ground_datum
from tools.reference_street.render import EXPOSURE, encode, load
from tools.reference_street.store import stored
from tools.reference_street.truth import layers

JPEG_QUALITY = 92
SKY, UNKNOWN = 10, 255  # Cityscapes train ids
HOLDOUT_EVERY = 8  # of the demo: the first, ninth, ... view by name is held out
PER_VIEW = 48  # sparse points
FARTHEST = 120.0  # m, of a sparse point
Poses = list[tuple[str, Float[np.ndarray, "4 4"]]]


def write_demo(store: Path, out: Path, width: int, height: int) -> None:
    """The 64 views of the walk and the arc, with labels that tell the sky from all else."""
    poses = camera_poses()
    write_pictures(store / "clean", out / "images", poses)
    known = truths(store, poses, width, height)
    for name, truth in known.items():
        label = np.where(truth["label"] == SKY, SKY, UNKNOWN).astype(np.uint8)
        save_png(label, out / "labels" / f"{Path(name).stem}.png")
    heldout = {name for name, _ in poses[::HOLDOUT_EVERY]}
    write_scene(out, poses, heldout, known, width, height)


def write_pictures(means: Path, folder: Path, poses: Poses) -> None:
    """JPEGs of the views."""
    for name, _ in poses:
        save_jpeg(EXPOSURE * mean_of(means, name), folder / name)


def mean_of(folder: Path, name: str) -> Float[np.ndarray, "h w 3"]:
    """The linear picture of a view in a folder of the store."""
    mean = stored((folder / name).with_suffix(".npz"))[1]
    if mean is None:
        raise SystemExit(
            f"{folder.name} {name} is not traced yet;"
            " run `python -m tools.reference_street.reference`"
        )
    return mean


def truths(store: Path, poses: Poses, width: int, height: int) -> dict[str, dict[str, np.ndarray]]:
    """The true layers of views, kept in the store: they take seven seconds each."""
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
    """Surface points as structure from motion would give them, metres, and the view of each.

    They come from the views alone that are fitted to: what is measured is told to nobody.
    """
    rng = np.random.default_rng(1)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    points, seen_by = [], []
    for i, (name, pose) in enumerate(poses):
        if name in heldout:
            continue
        row, column = rng.integers(height, size=PER_VIEW), rng.integers(width, size=PER_VIEW)
        depth = known[name]["depth"][row, column]
        pixel = np.stack([column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height], -1) / focal
        ray = np.c_[pixel, np.ones(PER_VIEW)] @ pose[:3, :3].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        near = depth < FARTHEST
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
    """Write scene.json (and points.ply) beside the pictures with climatenerf's own writer.

    `shared` may say that a file (`images/0001.jpg`) lies elsewhere, as a path from `out`.
    """
    from climatenerf.scene import Camera, Scene, View, save_scene

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
    path = save_scene(scene, root)
    # The folder travels with its scene.json, so where it was made is nobody's business.
    data = json.loads(path.read_text(encoding="utf-8"))
    data.pop("root_absolute", None)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")
    os.replace(temporary, path)


def save_png(picture: np.ndarray, path: Path) -> None:
    """A picture without loss."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    Image.fromarray(picture).save(temporary, "PNG", optimize=True)
    os.replace(temporary, path)


def save_jpeg(linear: Float[np.ndarray, "h w 3"], path: Path) -> None:
    """An exposed linear picture as a photo."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    picture = Image.fromarray(encode(linear))
    picture.save(temporary, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    os.replace(temporary, path)
