"""The whole street and the camera poses. Does not need Mitsuba."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh
from tools.reference_street.houses import HOUSES, house_meshes
from tools.reference_street.objects import bench, car, fence, lamp, person, table
from tools.reference_street.plants import far_trees, hedge, shrubs, tree
from tools.reference_street.terrain import ground_height, ground_meshes

EYE = 1.6  # m above the ground
FIELD_OF_VIEW = 68.0  # degrees, horizontal
PLAIN = ("asphalt", "lawn", "meadow")  # textures that have a plain version


def build_scene(plain: bool = False) -> list[Mesh]:
    """Return every mesh of the street with texture and class label, world metres.

    `plain` replaces the textures of asphalt and grass by broad tones of one colour.
    """
    meshes = ground_meshes()
    for house in HOUSES:
        meshes += house_meshes(house)
    meshes += tree("tree", (-7.6, 6.6), (2.1, 0.17), (2.3, 1.9), 9000, "leaf-tree", 3)
    meshes += tree("birch", (9.3, -8.6), (1.9, 0.12), (1.6, 1.8), 5500, "leaf-birch", 4)
    meshes += hedge("hedge-a", (-6.1, -5.4), (-12.0, -3.8), 0.95, 7)
    meshes += hedge("hedge-b", (5.65, 6.35), (10.0, 17.0), 1.05, 8)
    meshes += car() + bench() + table() + fence() + lamp() + shrubs() + far_trees()
    if plain:
        meshes = [
            replace(mesh, texture=f"{mesh.texture}-plain") if mesh.texture in PLAIN else mesh
            for mesh in meshes
        ]
    return meshes


def passers_by(view: int) -> list[Mesh]:
    """Return the people in picture `view` (from 0) of the walk; often none.

    One person walks up the left pavement during the first pictures, another crosses the road
    later. Both move between pictures.
    """
    if 2 <= view <= 15:
        y = -6.0 + 1.15 * (view - 2)
        stride = 0.5 * np.sin(2.1 * view)
        return person("walker", (-4.3, y), 0.0, stride, "coat-blue")
    if 24 <= view <= 33:
        x = 2.6 - 0.62 * (view - 24)
        return person("crosser", (x, -2.5), -90.0, 0.55 * np.cos(1.7 * view), "coat-ochre")
    return []


def look(
    position: Float[np.ndarray, "3"], azimuth: float, pitch: float
) -> Float[np.ndarray, "4 4"]:
    """Return an OpenCV camera-to-world pose; azimuth from +y to +x and pitch up, degrees."""
    a, p = np.deg2rad([azimuth, pitch])
    forward = np.array([np.sin(a) * np.cos(p), np.cos(a) * np.cos(p), np.sin(p)])
    right = np.array([np.cos(a), -np.sin(a), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = position
    return pose


def _ease(t):
    return t * t * (3 - 2 * t)


def _walk() -> list[tuple[float, float, float, float, float]]:
    """x, y, height above ground, azimuth, pitch of the 50 views of the walk."""
    views = []

    def add(x, y, azimuth, pitch):
        views.append((x, y, EYE, azimuth, pitch))

    for t in np.linspace(0, 1, 17):  # up the left half of the road, glancing left, then right
        azimuth = -48 * np.sin(2 * np.pi * t)
        add(-1.3 + 0.4 * np.sin(5 * t), -11 + 19 * t, azimuth, -4 + 5 * np.sin(7 * t + 1))
    for t in (0.2, 0.4, 0.6, 0.8):  # across to the right pavement, turning round
        s = _ease(t)
        add(-1.7 + 5.8 * s, 8 + 0.6 * np.sin(np.pi * t), 190 * s, -3)
    for t in np.linspace(0, 1, 14):  # back down the right pavement, looking across
        add(4.1, 8 - 19 * t, 190 + 120 * t + 10 * np.sin(2 * np.pi * t), -4 + 4 * np.sin(6 * t))
    for t in (0.25, 0.5, 0.75):  # across to the left pavement
        s = _ease(t)
        add(4.1 - 7.8 * s, -11 - 0.8 * np.sin(np.pi * t), 310 + 65 * s, -3)
    for t in np.linspace(0, 1, 12):  # up the left pavement, looking across, past the bench
        azimuth = 375 + 62 * t + 22 * np.sin(3 * np.pi * t)
        add(-3.7, -11 + 18 * t, azimuth, -5 + 4 * np.sin(5 * t))
    return views


def _arc() -> list[tuple[float, float, float, float, float]]:
    views = []
    for t in np.linspace(0, 1, 14):
        a = np.deg2rad(112 - 200 * t)
        x, y = 6.5 * np.cos(a), -1 + 10.5 * np.sin(a)
        height = 3.0 + 1.0 * np.sin(np.pi * t)
        azimuth = np.rad2deg(np.arctan2(-0.6 - x, -0.5 - y))
        views.append((x, y, height, azimuth, -12.0))
    return views


def camera_poses() -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Return image name and camera-to-world pose (OpenCV axes, m) of every view, in order."""
    out = []
    for index, (x, y, height, azimuth, pitch) in enumerate(_walk() + _arc(), start=1):
        position = np.array([x, y, float(ground_height(x, y)) + height])
        out.append((f"{index:04d}.jpg", look(position, azimuth, pitch)))
    return out


def heldout_poses() -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Return image name and pose of the six test views, t01.jpg to t06.jpg.

    They show house A and the bench from the road, house B, house A from across the road, bench and
    table from near, the street from above the pavement, and the hollow in the road.
    """
    rows = (
        (-0.6, -7.5, 1.6, -22.0, -5.0),
        (-0.5, 3.0, 1.6, 38.0, -2.0),
        (4.1, -4.0, 1.6, 282.0, -5.0),
        (-3.6, -3.2, 1.6, -22.0, -11.0),
        (4.9, 6.4, 3.4, 206.0, -13.0),
        (0.4, -11.6, 1.6, -7.0, -10.0),
    )
    out = []
    for index, (x, y, height, azimuth, pitch) in enumerate(rows, start=1):
        position = np.array([x, y, float(ground_height(x, y)) + height])
        out.append((f"t{index:02d}.jpg", look(position, azimuth, pitch)))
    return out


def ground_datum() -> tuple[float, float]:
    """Return the median and lowest ground height below the cameras, m."""
    positions = np.array([pose[:3, 3] for _, pose in camera_poses()])
    heights = ground_height(positions[:, 0], positions[:, 1])
    return float(np.median(heights)), float(np.min(heights))
