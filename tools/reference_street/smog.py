"""Smog over a view, from the ray length and radiance of every path by Beer-Lambert's law."""

import numpy as np
from jaxtyping import Float

from tools.reference_street.layout import FIELD_OF_VIEW

VISIBILITY = {"smog-near": 40.0, "smog-mid": 120.0, "smog-far": 400.0, "haze": 60.0}
"""Distance at which the transmittance is 5 %, m."""
FALLOFF = {"haze": 5.0}  # m, height over which the extinction falls by a factor e
COLOUR = (0.925, 0.906, 0.758)  # infinitely thick smog, display sRGB
STEPS = 400
ALBEDO = (0.97, 0.95, 0.85)  # single-scattering albedo of the scattering smog
ASYMMETRY = 0.75  # of its Henyey-Greenstein phase function
TOP = 30.0  # m, world height of its upper end
SKY = 3000.0  # m, ray length of the sky in haze


def airlight() -> Float[np.ndarray, "3"]:
    """Return the linear radiance of infinitely thick smog."""
    return ((np.array(COLOUR) + 0.055) / 1.055) ** 2.4


def transmittance(
    name: str,
    depth: Float[np.ndarray, "h w"],
    eye_z: float,
    rise: Float[np.ndarray, "h w"],
    base_z: float,
) -> Float[np.ndarray, "h w"]:
    """Return the transmittance of rays through one kind of smog.

    Args:
        name: a key of `VISIBILITY`.
        depth: ray lengths, m; inf in the sky.
        eye_z: height of the camera, m.
        rise: z of the rays' unit directions.
        base_z: height up to which haze is homogeneous, m.
    """
    sigma = -np.log(0.05) / VISIBILITY[name]
    if name not in FALLOFF:
        return np.exp(-sigma * depth)
    length = np.where(np.isinf(depth), SKY, depth)
    total = np.zeros_like(length)
    # Quadratic steps: the haze is densest near the camera.
    edges = np.linspace(0, 1, STEPS + 1) ** 2
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        z = eye_z + 0.5 * (a + b) * length * rise
        total += (b - a) * length * np.exp(-np.maximum(z - base_z, 0) / FALLOFF[name])
    return np.exp(-sigma * total)


def smoggy_view(
    scene,
    pose: Float[np.ndarray, "4 4"],
    base_z: float,
    size: tuple[int, int],
    samples: int,
    seed: int,
) -> Float[np.ndarray, "h w 16"]:
    """Return a view through each kind of smog: for each path its own ray length counts.

    Args:
        scene: Mitsuba scene of the dry street.
        pose: camera to world, OpenCV axes.
        base_z: height up to which haze is homogeneous, m.
        size: width and height, pixels.
        samples: paths per pixel, at random points of its area.
        seed: random seed of rays and paths.

    Returns:
        For each kind, in the order of `VISIBILITY`, the mean linear radiance that passes (three
        channels) and the mean transmittance.
    """
    import mitsuba as mi

    width, height = size
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    rng = np.random.default_rng(seed)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, 1)
    integrator, start = scene.integrator(), mi.Point3f(*pose[:3, 3])
    out = np.zeros((height, width, 4 * len(VISIBILITY)))
    for row in range(height):
        u, v = rng.random((2, width, samples))
        x, y = np.arange(width)[:, None] + u - 0.5 * width, row + v - 0.5 * height
        rays = np.stack([x / focal, y / focal, np.ones_like(x)], -1) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        depth, radiance = np.full(x.shape, np.inf), np.zeros((*x.shape, 3))
        for index in np.ndindex(x.shape):
            towards = mi.Vector3f(*rays[index])
            hit = scene.ray_intersect_preliminary(mi.Ray3f(start, towards))
            depth[index] = float(hit.t) if hit.is_valid() else np.inf
            path = mi.RayDifferential3f(start, towards, 0.0, [])
            radiance[index] = np.array(integrator.sample(scene, sampler, path)[0])
        for k, kind in enumerate(VISIBILITY):
            passed = transmittance(kind, depth, pose[2, 3], rays[..., 2], base_z)
            out[row, :, 4 * k : 4 * k + 3] = (passed[..., None] * radiance).mean(1)
            out[row, :, 4 * k + 3] = passed.mean(1)
    return out


def smoggy(
    through: Float[np.ndarray, "h w 16"], kind: str, exposure: float
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Return the exposed linear picture of one kind of smog and its transmittance.

    `through` is the mean of `smoggy_view`.
    """
    k = 4 * list(VISIBILITY).index(kind)
    passed = through[..., k + 3]
    return exposure * through[..., k : k + 3] + (1 - passed)[..., None] * airlight(), passed


def scattering_air() -> dict:
    """Return Mitsuba's description of forward-scattering, weakly absorbing smog."""
    return {
        "type": "homogeneous",
        "sigma_t": float(-np.log(0.05) / VISIBILITY["smog-mid"]),
        "albedo": {"type": "rgb", "value": list(ALBEDO)},
        "phase": {"type": "hg", "g": ASYMMETRY},
    }


def air_box(air) -> dict:
    """Return a box of a Mitsuba medium, 140 m square, up to `TOP`, without a surface."""
    import mitsuba as mi

    extent = mi.ScalarTransform4f().translate([0, 0, TOP - 17]).scale([70, 70, 17])
    return {"type": "cube", "to_world": extent, "bsdf": {"type": "null"}, "interior": air}
