"""Small captures written to disk by the tests themselves."""

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from climatenerf.core.cameras import Camera

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def look_at(position, target, up=(0.0, 0.0, 1.0)):
    """c2w with OpenCV axes."""
    position, target = np.asarray(position, float), np.asarray(target, float)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=-1)
    return pose


def ring(count=9, radius=4.0, height=1.6, target=(0.0, 0.0, 1.2)):
    """Cameras on a circle around the z axis."""
    turns = np.arange(count) / count * 2 * np.pi
    return [
        look_at((radius * np.cos(t), radius * np.sin(t), height + 0.05 * np.sin(5 * t)), target)
        for t in turns
    ]


def quaternion(rotation):
    """(w, x, y, z) by the eigenvector method, so not the reader's formula backwards."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k / 3, UPLO="L")[1][:, -1]
    return np.array([w, x, y, z])


def write_images(folder: Path, names, size=(32, 24)):
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, (10 * i % 256, 100, 50)).save(path)


def names_of(count):
    return [f"{i:03}.png" for i in range(count)]


PINHOLE = (1, "PINHOLE", 32, 24, (30.0, 31.0, 16.0, 12.0))


def write_colmap(model: Path, poses, names, cameras=(PINHOLE,), points=(), binary=True):
    """A sparse model; `cameras` are (id or name number, model name, w, h, params)."""
    model.mkdir(parents=True, exist_ok=True)
    numbers = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4}
    numbers |= {"OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7, "EUCM": 16}
    rows = []
    for i, (pose, name) in enumerate(zip(poses, names, strict=True)):
        w2c = np.linalg.inv(pose)
        rows.append((i + 1, quaternion(w2c[:3, :3]), w2c[:3, 3], cameras[0][0], name))
    if binary:
        data = struct.pack("<Q", len(cameras))
        for key, kind, w, h, params in cameras:
            data += struct.pack("<IiQQ", key, numbers[kind], w, h)
            data += struct.pack(f"<{len(params)}d", *params)
        (model / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(rows))
        for key, q, t, camera, name in rows:
            data += struct.pack("<I7dI", key, *q, *t, camera) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddQddQ", 1, 2, 3, 4, 5, 2**64 - 1)
        (model / "images.bin").write_bytes(data)
        data = struct.pack("<Q", len(points))
        for i, p in enumerate(points):
            data += struct.pack("<Q3d3BdQ", i, *p, 9, 8, 7, 0.5, 2) + struct.pack("<4I", 1, 0, 2, 0)
        (model / "points3D.bin").write_bytes(data)
        return
    text = "# Camera list\n"
    for key, kind, w, h, params in cameras:
        text += f"{key} {kind} {w} {h} {' '.join(map(repr, params))}\n"
    (model / "cameras.txt").write_text(text)
    text = "# Image list\n# two lines each\n"
    for i, (key, q, t, camera, name) in enumerate(rows):
        numbers_text = " ".join(repr(float(v)) for v in (*q, *t))
        # Every other picture without features: its second line is empty.
        text += f"{key} {numbers_text} {camera} {name}\n{'' if i % 2 else '1.0 2.0 3 4.0 5.0 -1'}\n"
    (model / "images.txt").write_text(text)
    text = "# Points\n"
    for i, p in enumerate(points):
        text += f"{i} {' '.join(repr(float(v)) for v in p)} 9 8 7 0.5 1 0 2 0\n"
    (model / "points3D.txt").write_text(text)


def write_transforms(path: Path, poses, names, **top):
    """Poses are given with OpenCV axes and written with OpenGL's."""
    frames = [
        {"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()}
        for pose, name in zip(poses, names, strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**top, "frames": frames}))


def posts_picture(camera: Camera, pose, posts, scale=4):
    """Dark upright posts (lower and upper end, n 2 3) on a light ground, anti-aliased."""
    size = (camera.width * scale, camera.height * scale)
    image = Image.new("L", size, 210)
    draw = ImageDraw.Draw(image)
    w2c = np.linalg.inv(pose)
    for ends in posts:
        local = ends @ w2c[:3, :3].T + w2c[:3, 3]
        if (local[:, 2] > 0.3).all():
            pixels = camera.project(local) * scale
            draw.line([tuple(p) for p in pixels], fill=60, width=5 * scale)
    return image.resize((camera.width, camera.height), Image.Resampling.BOX).convert("RGB")


def seen_at(scene, view, point):
    """(x, y) of a point of the input frame in a view, pixels."""
    local = np.linalg.inv(view.c2w) @ np.append(point, 1.0)
    return scene.cameras[view.camera].project(local[:3])


def pinhole(matrix, c2w, point):
    """(x, y) of a point by the textbook: K [R | t] X, c2w with OpenCV axes."""
    x, y, w = np.asarray(matrix)[:3, :3] @ (np.linalg.inv(c2w) @ np.append(point, 1.0))[:3]
    return np.array([x / w, y / w])
