"""Smog over a view from its true depth and clean radiance: Beer-Lambert law by quadrature."""

import numpy as np
from jaxtyping import Float

VISIBILITY = {"smog-near": 40.0, "smog-mid": 120.0, "smog-far": 400.0, "haze": 60.0}
"""Distance at which the transmittance is 5 %, m."""
FALLOFF = {"haze": 5.0}  # m, height over which the extinction falls by a factor e
COLOUR = (0.925, 0.906, 0.758)  # infinitely thick smog, display sRGB
STEPS = 400
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


def smoggy(
    clean: Float[np.ndarray, "h w 3"], passed: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Return a linear picture behind smog of transmittance `passed`."""
    return clean * passed[..., None] + airlight() * (1 - passed[..., None])


def scattering_air() -> dict:
    """Return Mitsuba's description of forward-scattering, weakly absorbing smog."""
    return {
        "type": "homogeneous",
        "sigma_t": float(-np.log(0.05) / VISIBILITY["smog-mid"]),
        "albedo": {"type": "rgb", "value": [0.97, 0.95, 0.85]},
        "phase": {"type": "hg", "g": 0.75},
    }


def air_box(air) -> dict:
    """Return a box of a Mitsuba medium, 140 m square and 30 m high, without a surface."""
    import mitsuba as mi

    extent = mi.ScalarTransform4f().translate([0, 0, 13]).scale([70, 70, 17])
    return {"type": "cube", "to_world": extent, "bsdf": {"type": "null"}, "interior": air}
