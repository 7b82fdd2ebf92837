"""Small captures and scenes for tests, written to disk."""

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from climatenerf.core.cameras import Camera
from climatenerf.scene.scene import Scene, View

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
STREET_CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


def look_at(position, target, up=(0.0, 0.0, 1.0)):
    """Camera-to-world pose with OpenCV axes."""
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
    """(w, x, y, z) by the eigenvector method, independent of the formula of the reader."""
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
    """Write a sparse model; `cameras` are tuples of (id, model name, width, height, parameters)."""
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
        # Every other image has no features, so its second line is empty.
        text += f"{key} {numbers_text} {camera} {name}\n{'' if i % 2 else '1.0 2.0 3 4.0 5.0 -1'}\n"
    (model / "images.txt").write_text(text)
    text = "# Points\n"
    for i, p in enumerate(points):
        text += f"{i} {' '.join(repr(float(v)) for v in p)} 9 8 7 0.5 1 0 2 0\n"
    (model / "points3D.txt").write_text(text)


def write_transforms(path: Path, poses, names, **top):
    """Write transforms.json; poses are given with OpenCV axes and written with OpenGL axes."""
    frames = [
        {"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()}
        for pose, name in zip(poses, names, strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**top, "frames": frames}))


def posts_image(camera: Camera, pose, posts, scale=4):
    """Render dark vertical posts (lower and upper end, [n, 2, 3]) on a light background."""
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


def pixel_of(scene, view, point):
    """(x, y) of a point of the input frame in a view, pixels."""
    local = np.linalg.inv(view.c2w) @ np.append(point, 1.0)
    return scene.cameras[view.camera].project(local[:3])


def pinhole(matrix, c2w, point):
    """(x, y) of a point by the pinhole equation K [R | t] X; c2w has OpenCV axes."""
    x, y, w = np.asarray(matrix)[:3, :3] @ (np.linalg.inv(c2w) @ np.append(point, 1.0))[:3]
    return np.array([x / w, y / w])


def angle(a, b):
    """Angle between two vectors, degrees."""
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def random_rotation(seed):
    """A 3x3 rotation matrix."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def tilted(pose, roll, pitch):
    """The pose after a rotation about the camera's z and x axes, degrees."""
    r, p = np.radians([roll, pitch])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ about_x @ about_z
    return out


def street(seed=0):
    """Points of a ground z = 0 with clutter up to 1 m, and vertical posts; metres."""
    random = np.random.default_rng(seed)
    ground = np.c_[random.uniform(-8, 8, (3000, 2)), random.normal(0, 0.02, 3000)]
    clutter = np.c_[random.uniform(-8, 8, (600, 2)), random.uniform(0, 1, 600)]
    stray = np.c_[random.uniform(-8, 8, (15, 2)), random.uniform(-6, -1, 15)]
    turns = random.uniform(0, 2 * np.pi, 14)
    feet = np.stack([6 * np.cos(turns), 6 * np.sin(turns), 0 * turns], axis=-1)
    posts = np.stack([feet, feet + (0, 0, 3.0)], axis=1)
    return np.concatenate([ground, clutter, stray]), posts


def street_scene(folder, poses, points, posts, seed=0, scale=1.0, exif=None):
    """The street in a rotated, scaled and shifted input frame, and the up direction there."""
    rotation, shift = random_rotation(seed), np.array([3.0, -5.0, 7.0])
    views = []
    for i, pose in enumerate(poses):
        path = folder / f"{i:03}.png"
        image = posts_image(STREET_CAMERA, pose, posts)
        image.save(path, **({"exif": exif} if exif else {}))
        moved = np.eye(4)
        moved[:3, :3] = rotation @ pose[:3, :3]
        moved[:3, 3] = scale * rotation @ pose[:3, 3] + shift
        views.append(View(path.name, path, 0, moved))
    points = None if points is None else scale * points @ rotation.T + shift
    return Scene(folder, "test", (STREET_CAMERA,), tuple(views), points), rotation[:, 2]


def up_of(scene):
    """Up direction of an aligned scene in its input frame, unit vector."""
    return scene.world_from_input[2, :3] / scene.scale
