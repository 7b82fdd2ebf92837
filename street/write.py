"""The reference set and the demo's subset of it on disk, from the store of linear pictures."""

import hashlib
import json
import os
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from street.layout import FIELD_OF_VIEW, build_scene, camera_poses, ground_datum, measuring_poses
from street.render import EXPOSURE, encode, load
from street.store import stored
from street.truth import layers

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
        _save_png(label, out / "labels" / f"{Path(name).stem}.png")
    heldout = {name for name, _ in poses[::HOLDOUT_EVERY]}
    write_scene(out, poses, heldout, known, width, height)


def write_reference(store: Path, out: Path, width: int, height: int) -> None:
    """All views with their classes; for the test views depth, normals, sun, and the weather."""
    poses = camera_poses() + measuring_poses()
    write_pictures(store / "clean", out / "images", poses)
    known = truths(store, poses, width, height)
    for name, truth in known.items():
        _save_png(truth["label"], out / "labels" / f"{Path(name).stem}.png")
    tests = [name for name, _ in measuring_poses()]
    for name in tests:
        linear = stored((store / "clean" / name).with_suffix(".npz"))[1]
        assert linear is not None
        path = out / "truth" / f"{Path(name).stem}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            path,
            depth=known[name]["depth"],
            normal=known[name]["normal"].astype(np.float16),
            sun=known[name]["sun"].astype(np.float16),
            clean=(EXPOSURE * linear).astype(np.float16),
        )
    for group in sorted(path.name for path in store.iterdir() if path.name not in OWN):
        for picture in sorted((store / group).glob("*.npz")):
            mean = stored(picture)[1]
            assert mean is not None
            _save_png(encode(EXPOSURE * mean), out / group / f"{picture.stem}.png")
    write_scene(out, poses, set(tests), known, width, height)
    write_sums(out)


OWN = ("clean", "layers")  # folders of the store that are no weather


def write_pictures(means: Path, folder: Path, poses: Poses) -> None:
    """JPEGs of the views."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, _ in poses:
        mean = stored((means / name).with_suffix(".npz"))[1]
        if mean is None:
            raise SystemExit(f"{name} is not traced yet; run `python -m street.reference` first")
        temporary = (folder / name).with_suffix(".tmp")
        picture = Image.fromarray(encode(EXPOSURE * mean))
        picture.save(temporary, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        os.replace(temporary, folder / name)


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
    poses: Poses, known: dict[str, dict[str, np.ndarray]], width: int, height: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Surface points as structure from motion would give them, metres, and the view of each."""
    rng = np.random.default_rng(1)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    points, seen_by = [], []
    for i, (name, pose) in enumerate(poses):
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
) -> None:
    """Write scene.json (and points.ply) beside the pictures with climatenerf's own writer.

    Sparse points come from the views that are fitted to alone.
    """
    from climatenerf.scene import Camera, Scene, View, save_scene

    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
    ground, lowest = ground_datum()
    root = out.resolve()
    points, seen_by = sparse_points(poses, known, width, height)
    views = tuple(
        View(
            name,
            root / "images" / name,
            0,
            pose,
            "heldout" if name in heldout else "train",
            label_path=root / "labels" / Path(name).with_suffix(".png"),
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


def write_sums(out: Path) -> None:
    """SHA256SUMS of all files, as sha256sum writes it."""
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}"
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "SHA256SUMS"
    ]
    (out / "SHA256SUMS").write_text("\n".join(lines) + "\n")


def _save_png(picture: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    Image.fromarray(picture).save(temporary, "PNG", optimize=True)
    os.replace(temporary, path)
