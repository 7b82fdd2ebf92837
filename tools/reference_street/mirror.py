"""Trace the street with a perfect horizontal mirror that does not change its illumination.

A mirror in the path tracer's scene would reflect light onto the houses. Here only camera rays are
reflected at the plane; the reflected rays then see the dry street, like a mirrored camera.
"""

import numpy as np
from jaxtyping import Float

from tools.reference_street.layout import FIELD_OF_VIEW


def mirrored_view(
    scene,
    pose: Float[np.ndarray, "4 4"],
    level: float,
    size: tuple[int, int],
    samples: int,
    seed: int,
) -> Float[np.ndarray, "h w 3"]:
    """Return the linear radiance of one view of a Mitsuba scene with a mirror at z = level.

    Args:
        scene: the dry street.
        pose: camera to world, OpenCV axes.
        level: height of the mirror, m; must be below the camera.
        size: width and height, pixels.
        samples: rays per pixel, at random points of its area.
        seed: random seed of rays and paths.
    """
    import mitsuba as mi

    width, height = size
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    rng = np.random.default_rng(seed)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, 1)
    integrator, eye = scene.integrator(), pose[:3, 3]
    out = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            u, v = rng.random((2, samples))
            x, y = (column + u - 0.5 * width) / focal, (row + v - 0.5 * height) / focal
            rays = np.stack([x, y, np.ones(samples)], -1) @ pose[:3, :3].T
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            for ray in rays:
                start, towards = mi.Point3f(*eye), mi.Vector3f(*ray)
                t = (level - eye[2]) / ray[2] if ray[2] < 0 else np.inf
                if np.isfinite(t) and not scene.ray_test(mi.Ray3f(start, towards, t, 0.0, [])):
                    start = mi.Point3f(*(eye + t * ray))
                    towards = mi.Vector3f(ray[0], ray[1], -ray[2])
                path = mi.RayDifferential3f(start, towards, 0.0, [])
                out[row, column] += np.array(integrator.sample(scene, sampler, path)[0])
    return out / samples
