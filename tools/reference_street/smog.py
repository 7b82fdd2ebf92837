"""Smog over a view, from its true depth and clean radiance: Beer and Lambert, summed in steps."""

import numpy as np
from jaxtyping import Float

VISIBILITY = {"smog-near": 40.0, "smog-mid": 120.0, "smog-far": 400.0, "haze": 60.0}  # m, to 5 %
FALLOFF = {"haze": 5.0}  # m of height over which there is e times less of it
COLOUR = (0.925, 0.906, 0.758)  # of thick smog, display sRGB
STEPS = 400
SKY = 3000.0  # m: a ray into the sky is followed this far


def airlight() -> Float[np.ndarray, "3"]:
    """Linear radiance of smog without end."""
    return ((np.array(COLOUR) + 0.055) / 1.055) ** 2.4


def transmittance(
    name: str,
    depth: Float[np.ndarray, "h w"],
    eye_z: float,
    rise: Float[np.ndarray, "h w"],
    base_z: float,
) -> Float[np.ndarray, "h w"]:
    """Share of the light that passes, for one of `VISIBILITY`.

    Args:
        name: which smog.
        depth: ray lengths, m; inf in the sky.
        eye_z: height of the camera, m.
        rise: z of the rays' unit directions.
        base_z: height up to which haze is even.
    """
    sigma = -np.log(0.05) / VISIBILITY[name]
    if name not in FALLOFF:
        return np.exp(-sigma * depth)
    length = np.where(np.isinf(depth), SKY, depth)
    total = np.zeros_like(length)
    # Steps grow along the ray, as the square: the eye stands in what is thickest.
    edges = np.linspace(0, 1, STEPS + 1) ** 2
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        z = eye_z + 0.5 * (a + b) * length * rise
        total += (b - a) * length * np.exp(-np.maximum(z - base_z, 0) / FALLOFF[name])
    return np.exp(-sigma * total)


def smoggy(
    clean: Float[np.ndarray, "h w 3"], passed: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Linear picture behind smog that lets `passed` through."""
    return clean * passed[..., None] + airlight() * (1 - passed[..., None])


def scattering_air() -> dict:
    """Mitsuba's description of real smog: droplets that scatter forwards, hardly absorbing."""
    return {
        "type": "homogeneous",
        "sigma_t": float(-np.log(0.05) / VISIBILITY["smog-mid"]),
        "albedo": {"type": "rgb", "value": [0.97, 0.95, 0.85]},
        "phase": {"type": "hg", "g": 0.75},
    }


def air_box(air) -> dict:
    """The air, 140 m square and 30 m high, of a medium made by Mitsuba; light enters freely."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0, 13]).scale([70, 70, 17])
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": air}
