"""What every pixel's middle really shows: distance, normal, class, and how much sun."""

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh
from tools.reference_street.layout import FIELD_OF_VIEW
from tools.reference_street.sky import SUN_AZIMUTH, SUN_ELEVATION, SUN_WIDTH, direction

# Cityscapes train ids, of which the paper's seven classes are merged; street furniture is "fence".
TRAIN_IDS = {
    "road": 0, "building": 2, "object": 4, "vegetation": 8, "terrain": 9, "sky": 10,
    "person": 11, "vehicle": 13,
}  # fmt: skip
SUN_RAYS = 8
NUDGE = 1e-4  # rad
LIFT = 1e-3  # m: rays begin beside the surface that they leave


def sun_directions() -> Float[np.ndarray, "n 3"]:
    """Directions over the bright place of the sky, in its core (half its width to 1/e)."""
    sun = direction(SUN_AZIMUTH, SUN_ELEVATION)
    east = np.cross([0.0, 0.0, 1.0], sun)
    east /= np.linalg.norm(east)
    north = np.cross(sun, east)
    k = np.arange(SUN_RAYS)
    away = np.tan(np.deg2rad(0.5 * SUN_WIDTH)) * np.sqrt((k + 0.5) / SUN_RAYS)
    turn = k * np.pi * (3 - np.sqrt(5))
    out = sun + away[:, None] * (np.cos(turn)[:, None] * east + np.sin(turn)[:, None] * north)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def pixel_rays(
    pose: Float[np.ndarray, "4 4"], width: int, height: int
) -> Float[np.ndarray, "h w 3"]:
    """Unit directions through the middles of the pixels, in the world."""
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([(x - 0.5 * width) / focal, (y - 0.5 * height) / focal, np.ones_like(x)], -1)
    rays = local @ pose[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def layers(
    scene, meshes: list[Mesh], pose: Float[np.ndarray, "4 4"], width: int, height: int
) -> dict[str, np.ndarray]:
    """Truth of a view, one ray a pixel.

    Args:
        scene: Mitsuba's scene of the meshes, loaded with their names.
        meshes: for the classes of its shapes.
        pose: camera to world, OpenCV axes.
        width: pixels; height likewise.

    Returns:
        `depth` (m along the ray, inf in the sky), `normal` (world, towards the camera, 0 in the
        sky), `label` (Cityscapes train ids) and `sun` (share of the sun's rays that arrive).
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
        if not hit.is_valid() and ray[2] < 0:  # through the seam of two meshes: no ray looks under
            ray = ray + [NUDGE, NUDGE, 0.0]
            hit = scene.ray_intersect(mi.Ray3f(start, mi.Vector3f(*ray / np.linalg.norm(ray))))
        if not hit.is_valid():
            continue
        depth[i] = float(hit.t)
        n = np.array(hit.n, float)
        n = n if n @ ray < 0 else -n
        normal[i] = n
        label[i] = classes[hit.shape.id()]
        place = mi.Point3f(*(eye + float(hit.t) * ray + LIFT * n))
        free = [n @ d > 0 and not scene.ray_test(mi.Ray3f(place, mi.Vector3f(*d))) for d in sun]
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
    """Truth of a view under snow, one ray a pixel.

    Args:
        snowy: Mitsuba's scene with the snow's meshes, loaded with their names.
        bare: the same scene without them.
        pose: camera to world, OpenCV axes.
        width: pixels; height likewise.

    Returns:
        `depth` (m along the ray, inf in the sky) and `thickness` (m of snow straight below the
        place that is seen, to what lies under it; 0 where no snow is seen).
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
