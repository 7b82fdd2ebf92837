"""A scene for other programs, in the input's own frame: transforms.json and COLMAP text."""

from pathlib import Path
from typing import Any

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.rotations import quaternions
from climatenerf.core.storage import make_folder, write_bytes, write_json
from climatenerf.scene.readers.ply import write_points
from climatenerf.scene.scene import Scene, View


def export_transforms(scene: Scene, folder: Path) -> Path:
    """Writes `transforms.json` (nerfstudio; OpenGL axes) and `points.ply` if there are points.

    Pictures are named where they are, relative to the folder if they lie below it.

    Raises:
        UserError: the folder cannot be written, or already holds a transforms.json.
    """
    path = make_folder(folder) / "transforms.json"
    _refuse(path)
    if scene.points is not None:
        _refuse(folder / "points.ply")
    data: dict[str, Any] = {"camera_model": "OPENCV", "frames": []}
    for view in scene.views:
        c2w = view.c2w.copy()
        c2w[:3, 1:3] *= -1
        frame = {"file_path": _name(view.path, folder), "transform_matrix": c2w.tolist()}
        if view.mask_path is not None:
            frame["mask_path"] = _name(view.mask_path, folder)
        data["frames"].append(frame | _intrinsics(scene.cameras[view.camera]))
    heldout = [f["file_path"] for f, v in _pairs(data, scene) if v.split == "heldout"]
    if heldout:
        data["train_filenames"] = [
            f["file_path"] for f, v in _pairs(data, scene) if v.split == "train"
        ]
        data["val_filenames"] = data["test_filenames"] = heldout
    if scene.points is not None:
        write_points(folder / "points.ply", scene.points)
        data["ply_file_path"] = "points.ply"
    write_json(path, data)
    return path


def export_colmap(scene: Scene, folder: Path) -> Path:
    """Writes `sparse/0/{cameras,images,points3D}.txt`; tracks are those that the scene knows.

    The pictures' names are the scene's; give `--image_path` the folder that they lie in.

    Raises:
        UserError: the folder cannot be written, or already holds a model.
    """
    model = make_folder(folder / "sparse" / "0")
    _refuse(model / "images.txt")
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in enumerate(scene.cameras, 1):
        name, parameters = _colmap_camera(camera)
        numbers = " ".join(map(_text, parameters))
        cameras.append(f"{number} {name} {camera.width} {camera.height} {numbers}")
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID"]
    tracks: dict[int, list[str]] = {}
    for number, view in enumerate(scene.views, 1):
        w2c = np.linalg.inv(view.c2w)
        pose = " ".join(map(_text, [*quaternions(w2c[:3, :3]), *w2c[:3, 3]]))
        images.append(f"{number} {pose} {view.camera + 1} {view.name}")
        marks = []
        if scene.points is not None and view.seen is not None and len(view.seen):
            local = scene.points[view.seen] @ w2c[:3, :3].T + w2c[:3, 3]
            pixels = scene.cameras[view.camera].project(local)
            for index, (point, (x, y)) in enumerate(zip(view.seen, pixels, strict=True)):
                marks.append(f"{_text(x)} {_text(y)} {point + 1}")
                tracks.setdefault(int(point), []).append(f"{number} {index}")
        images.append(" ".join(marks))
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, place in enumerate([] if scene.points is None else scene.points):
        track = " ".join(tracks.get(number, []))
        points.append(f"{number + 1} {' '.join(map(_text, place))} 128 128 128 0 {track}".rstrip())
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_bytes(model / f"{name}.txt", ("\n".join(lines) + "\n").encode())
    return model


def _colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.fisheye:
        return "OPENCV_FISHEYE", [*pinhole, camera.k1, camera.k2, camera.k3, camera.k4]
    if not camera.distorted:
        return "PINHOLE", pinhole
    bent = [*pinhole, camera.k1, camera.k2, camera.p1, camera.p2]
    return ("OPENCV", bent) if camera.k3 == 0 else ("FULL_OPENCV", [*bent, camera.k3, 0, 0, 0])


def _intrinsics(camera: Camera) -> dict[str, Any]:
    found: dict[str, Any] = {"w": camera.width, "h": camera.height}
    found |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    names = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "k3", "p1", "p2")
    found |= {name: getattr(camera, name) for name in names}
    return found | ({"camera_model": "OPENCV_FISHEYE"} if camera.fisheye else {})


def _pairs(data: dict[str, Any], scene: Scene) -> list[tuple[dict, View]]:
    return list(zip(data["frames"], scene.views, strict=True))


def _name(path: Path, folder: Path) -> str:
    folder = folder.absolute()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _text(number: float) -> str:
    return f"{float(number):.12g}"


def _refuse(path: Path) -> None:
    if path.exists():
        raise UserError(f"{path} already exists; choose another folder with -o")
