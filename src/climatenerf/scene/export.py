"""Export of a scene in its input frame: `transforms.json` and COLMAP text models."""

from pathlib import Path
from typing import Any

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.rotations import quaternions
from climatenerf.core.storage import make_folder, write_bytes, write_json
from climatenerf.scene.readers.ply import write_points
from climatenerf.scene.scene import Scene


def export_transforms(scene: Scene, folder: Path) -> Path:
    """Write `transforms.json` (nerfstudio; OpenGL axes), and `points.ply` if there are points.

    Image paths are relative to the folder if the images lie in it, otherwise absolute.

    Returns:
        Path of `transforms.json`.

    Raises:
        UserError: The folder cannot be written, or already contains one of the files.
    """
    path = make_folder(folder) / "transforms.json"
    _require_absent(path)
    if scene.points is not None:
        _require_absent(folder / "points.ply")
    frames: list[dict[str, Any]] = []
    paths: dict[str, list[str]] = {"train": [], "heldout": []}
    for view in scene.views:
        c2w = view.c2w.copy()
        c2w[:3, 1:3] *= -1
        frame = {
            "file_path": _relative_name(view.path, folder),
            "transform_matrix": c2w.tolist(),
        }
        if view.mask_path is not None:
            frame["mask_path"] = _relative_name(view.mask_path, folder)
        frames.append(frame | _intrinsics(scene.cameras[view.camera]))
        paths[view.split].append(frame["file_path"])
    data: dict[str, Any] = {"camera_model": "OPENCV", "frames": frames}
    if paths["heldout"]:
        data["train_filenames"] = paths["train"]
        data["val_filenames"] = data["test_filenames"] = paths["heldout"]
    if scene.points is not None:
        write_points(folder / "points.ply", scene.points)
        data["ply_file_path"] = "points.ply"
    write_json(path, data)
    return path


def export_colmap(scene: Scene, folder: Path) -> Path:
    """Write `sparse/0/{cameras,images,points3D}.txt`, with tracks where the scene has observations.

    Image names are those of the scene; pass the folder of the images to COLMAP as `--image_path`.

    Returns:
        The model folder, `sparse/0`.

    Raises:
        UserError: The folder cannot be written, or already contains a model.
    """
    model = make_folder(folder / "sparse" / "0")
    _require_absent(model / "images.txt")
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in enumerate(scene.cameras, 1):
        name, parameters = _colmap_camera(camera)
        cameras.append(f"{number} {name} {camera.width} {camera.height} {_join(parameters)}")
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID"]
    tracks: dict[int, list[str]] = {}
    for number, view in enumerate(scene.views, 1):
        w2c = np.linalg.inv(view.c2w)
        pose = _join([*quaternions(w2c[:3, :3]), *w2c[:3, 3]])
        images.append(f"{number} {pose} {view.camera + 1} {view.name}")
        features = []
        if scene.points is not None and view.seen is not None and len(view.seen):
            local = scene.points[view.seen] @ w2c[:3, :3].T + w2c[:3, 3]
            pixels = scene.cameras[view.camera].project(local)
            for index, (point, pixel) in enumerate(zip(view.seen, pixels, strict=True)):
                features.append(f"{_join(pixel)} {point + 1}")
                tracks.setdefault(int(point), []).append(f"{number} {index}")
        images.append(" ".join(features))
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for index, position in enumerate([] if scene.points is None else scene.points):
        track = " ".join(tracks.get(index, []))
        points.append(f"{index + 1} {_join(position)} 128 128 128 0 {track}".rstrip())
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        text = "\n".join(lines) + "\n"
        # Names that are not UTF-8 keep their bytes.
        write_bytes(model / f"{name}.txt", text.encode("utf-8", "surrogateescape"))
    return model


def _colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's model name and parameters of a camera."""
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.fisheye:
        return "OPENCV_FISHEYE", [*pinhole, camera.k1, camera.k2, camera.k3, camera.k4]
    if not camera.distorted:
        return "PINHOLE", pinhole
    opencv = [*pinhole, camera.k1, camera.k2, camera.p1, camera.p2]
    return ("OPENCV", opencv) if camera.k3 == 0 else ("FULL_OPENCV", [*opencv, camera.k3, 0, 0, 0])


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics of a camera as keys of `transforms.json`."""
    out: dict[str, Any] = {"w": camera.width, "h": camera.height}
    out |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    names = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "k3", "p1", "p2")
    out |= {name: getattr(camera, name) for name in names}
    return out | ({"camera_model": "OPENCV_FISHEYE"} if camera.fisheye else {})


def _relative_name(path: Path, folder: Path) -> str:
    folder = folder.absolute()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _join(numbers) -> str:
    return " ".join(f"{float(number):.12g}" for number in numbers)


def _require_absent(path: Path) -> None:
    if path.exists():
        raise UserError(f"{path} already exists; choose another folder with -o.")
