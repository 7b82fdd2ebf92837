"""Trace the ground truth at pixel centres: ray length, normal, class, visible sun."""

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh
from tools.reference_street.layout import FIELD_OF_VIEW
from tools.reference_street.sky import SUN_AZIMUTH, SUN_ELEVATION, SUN_WIDTH, direction

# Cityscapes train ids; the paper's seven classes are merged from them. Objects count as fence.
TRAIN_IDS = {
    "road": 0, "building": 2, "object": 4, "vegetation": 8, "terrain": 9, "sky": 10,
    "person": 11, "vehicle": 13,
}  # fmt: skip
SUN_RAYS = 8
NUDGE = 1e-4  # rad, change of a ray that misses all meshes
LIFT = 1e-3  # m, offset of secondary rays from their surface


def sun_directions() -> Float[np.ndarray, "n 3"]:
    """Return directions that cover the core of the sun (half its width to 1/e)."""
    sun = direction(SUN_AZIMUTH, SUN_ELEVATION)
    east = np.cross([0.0, 0.0, 1.0], sun)
    east /= np.linalg.norm(east)
    north = np.cross(sun, east)
    k = np.arange(SUN_RAYS)
    radius = np.tan(np.deg2rad(0.5 * SUN_WIDTH)) * np.sqrt((k + 0.5) / SUN_RAYS)
    azimuth = k * np.pi * (3 - np.sqrt(5))
    out = sun + radius[:, None] * (
        np.cos(azimuth)[:, None] * east + np.sin(azimuth)[:, None] * north
    )
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def pixel_rays(
    pose: Float[np.ndarray, "4 4"], width: int, height: int
) -> Float[np.ndarray, "h w 3"]:
    """Return the unit directions through the pixel centres, in the world."""
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([(x - 0.5 * width) / focal, (y - 0.5 * height) / focal, np.ones_like(x)], -1)
    rays = local @ pose[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def layers(
    scene, meshes: list[Mesh], pose: Float[np.ndarray, "4 4"], width: int, height: int
) -> dict[str, np.ndarray]:
    """Trace the ground truth of a view with one ray per pixel.

    Args:
        scene: Mitsuba scene of the meshes, loaded with `named`.
        meshes: the meshes, for their classes.
        pose: camera to world, OpenCV axes.
        width: width of the view, pixels.
        height: height of the view, pixels.

    Returns:
        `depth` (m along the ray, inf in the sky), `normal` (world, towards the camera, 0 in the
        sky), `label` (Cityscapes train ids) and `sun` (fraction of unoccluded rays to the sun).
    """
    import mitsuba as mi

    classes = {mesh.name.replace(".", "_"): TRAIN_IDS[mesh.label] for mesh in meshes}
    rays = pixel_rays(pose, width, height).reshape(-1, 3)
    eye, sun = pose[:3, 3], sun_directions()
    depth = np.full(len(rays), np.inf, np.float32)
    normal = np.zeros((len(rays), 3), np.float32)
    label = np.full(len(rays), TRAIN_IDS["sky"], np.uint8)
    lit = np.zeros(len(rays), np.float32)
    start = mi.Point3f(*eye)
    for i, ray in enumerate(rays):
        hit = scene.ray_intersect(mi.Ray3f(start, mi.Vector3f(*ray)))
        if not hit.is_valid() and ray[2] < 0:  # a ray through the seam of two meshes
            ray = ray + [NUDGE, NUDGE, 0.0]
            hit = scene.ray_intersect(mi.Ray3f(start, mi.Vector3f(*ray / np.linalg.norm(ray))))
        if not hit.is_valid():
            continue
        depth[i] = float(hit.t)
        n = np.array(hit.n, float)
        n = n if n @ ray < 0 else -n
        normal[i] = n
        label[i] = classes[hit.shape.id()]
        point = mi.Point3f(*(eye + float(hit.t) * ray + LIFT * n))
        free = [n @ d > 0 and not scene.ray_test(mi.Ray3f(point, mi.Vector3f(*d))) for d in sun]
        lit[i] = np.mean(free)
    shape = (height, width)
    return {
        "depth": depth.reshape(shape),
        "normal": normal.reshape(*shape, 3),
        "label": label.reshape(shape),
        "sun": lit.reshape(shape),
    }


def snow_layers(
    snowy, bare, pose: Float[np.ndarray, "4 4"], width: int, height: int
) -> dict[str, np.ndarray]:
    """Trace the ground truth of a view under snow with one ray per pixel.

    Args:
        snowy: Mitsuba scene with the snow meshes, loaded with `named`.
        bare: the same scene without snow.
        pose: camera to world, OpenCV axes.
        width: width of the view, pixels.
        height: height of the view, pixels.

    Returns:
        `depth` (m along the ray, inf in the sky) and `thickness` (m of snow vertically
        below the visible point; 0 without visible snow).
    """
    import mitsuba as mi

    rays = pixel_rays(pose, width, height).reshape(-1, 3)
    depth = np.full(len(rays), np.inf, np.float32)
    thickness = np.zeros(len(rays), np.float32)
    start, down = mi.Point3f(*pose[:3, 3]), mi.Vector3f(0.0, 0.0, -1.0)
    for i, ray in enumerate(rays):
        hit = snowy.ray_intersect(mi.Ray3f(start, mi.Vector3f(*ray)))
        if not hit.is_valid():
            continue
        depth[i] = float(hit.t)
        if hit.shape.id().startswith("snow"):
            under = bare.ray_intersect(mi.Ray3f(hit.p, down))
            thickness[i] = float(under.t) if under.is_valid() else 0.0
    return {"depth": depth.reshape(height, width), "thickness": thickness.reshape(height, width)}
