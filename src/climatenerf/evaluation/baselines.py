"""Weather painted onto single pictures: what one would do without simulating in the place.

All start from our own clean picture, depth and normals, and their free constants are fitted to the
true pictures, which ours never see. They stand for the failures that ClimateNeRF's paper (4.1)
shows of others: fog without air above the ground, water without a reflection, reflections of what
is on the screen alone, snow without thickness, and pictures made one by one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from climatenerf.core.srgb import to_display, to_linear
from climatenerf.evaluation.geometry import nearest_pixels
from climatenerf.scene import Camera

SNOW_EDGE, SNOW_SLOPE = 50.0, np.cos(np.deg2rad(37.0))  # as the paper's snow
REACHES = np.geomspace(0.05, 60.0, 64)  # m along a reflected ray
THICK = 0.5  # m behind a depth that still counts as its surface
NOISE, NOISE_CELLS = 0.08, (9, 16)  # deviation in display values; cells across a picture
FACTORS = np.geomspace(0.25, 4.0, 33)  # of the nominal extinction that fog is tuned over
GAINS = np.linspace(0.7, 1.3, 25)  # of a colour found in linear light
NAMES = ("depth-fog", "flat-plane", "screen-reflection", "white-paint", "frame-noise")


@dataclass(frozen=True)
class Dry:
    """Our clean view: what every baseline is given.

    Attributes:
        linear: radiance.
        depth: ray length, m; +inf in the sky.
        normal: unit, world; 0 in the sky.
        rays_d: unit directions, world.
        c2w: pose, world m.
        camera: intrinsics.
    """

    linear: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    rays_d: Float[np.ndarray, "h w 3"]
    c2w: Float[np.ndarray, "4 4"]
    camera: Camera


def depth_fog(dry: Dry, sigma: float, colour: Float[np.ndarray, "3"]) -> Float[np.ndarray, "h w 3"]:
    """Blend towards a colour by exp(-sigma depth); linear."""
    passed = np.exp(-sigma * dry.depth)[..., None]
    return dry.linear * passed + colour * (1 - passed)


def tuned_sigma(
    views: list[Dry], true: list[UInt8[np.ndarray, "h w 3"]], sigma: float, colour: np.ndarray
) -> float:
    """The extinction near the nominal one whose fog is nearest to the true pictures."""

    def error(factor: float) -> float:
        pictures = [to_display(depth_fog(dry, factor * sigma, colour)) for dry in views]
        return float(
            np.mean([((p - t / 255.0) ** 2).mean() for p, t in zip(pictures, true, strict=True)])
        )

    return sigma * float(min(FACTORS, key=error))


def wet_pixels(dry: Dry, level: float) -> tuple[Bool[np.ndarray, "h w"], np.ndarray]:
    """Where the water's plane lies before what is seen, and its ray length, m."""
    fall = -dry.rays_d[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # 1e-6: rays that do not sink, 0/0.
        t = np.where(fall > 1e-6, (dry.c2w[2, 3] - level) / fall, np.inf)
    return (t > 0) & (t < dry.depth), t


def flat_plane(
    dry: Dry, level: float, colour: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Water as a plane of one colour; linear."""
    return np.where(wet_pixels(dry, level)[0][..., None], colour, dry.linear)


def screen_reflection(
    dry: Dry,
    level: float,
    ior: float,
    slope: Float[np.ndarray, "h w 2"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """What the screen itself can answer of the water's reflection, and the reflectance.

    Reflected rays walk through the depth picture; where they leave the screen or find nothing they
    take the colour of the sky on it (of its own mean where there is none).

    Args:
        dry: our clean view.
        level: of the water, m.
        ior: of the water.
        slope: of the waves, where the pixels' rays meet it.
    """
    _, t = wet_pixels(dry, level)
    t = np.where(np.isfinite(t) & (t > 0), t, 0.0)
    place = dry.c2w[:3, 3] + t[..., None] * dry.rays_d
    normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = np.clip(-(dry.rays_d * normal).sum(-1), 0.0, 1.0)
    reflected = dry.rays_d + 2 * cosine[..., None] * normal
    reflected[..., 2] = np.abs(reflected[..., 2])
    sky = np.isinf(dry.depth)
    mean = dry.linear[sky].mean(0) if sky.any() else dry.linear.mean((0, 1))
    out = np.broadcast_to(mean, dry.linear.shape).copy()
    found = np.zeros(dry.depth.shape, bool)
    for reach in REACHES:
        row, column, inside, distance = _on_screen(dry, place + reach * reflected)
        behind = distance - dry.depth[row, column]
        hit = inside & ~found & (behind > 0) & (behind < THICK + 0.1 * reach)
        out[hit] = dry.linear[row, column][hit]
        found |= hit
    row, column, inside, _ = _on_screen(dry, place + 1e4 * reflected)
    open_sky = inside & ~found & sky[row, column]
    out[open_sky] = dry.linear[row, column][open_sky]
    return out, fresnel(cosine, ior)


def fresnel(cosine: Float[np.ndarray, "*n"], ior: float) -> Float[np.ndarray, "*n"]:
    """Unpolarised reflectance of a smooth surface seen from the air."""
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    s = (cosine - ior * inside) / (cosine + ior * inside)
    p = (inside - ior * cosine) / (inside + ior * cosine)
    return 0.5 * (s**2 + p**2)


def white_paint(dry: Dry) -> Float[np.ndarray, "h w"]:
    """How much snow colour lies on each pixel, from its normal alone, 0 to 1."""
    return 1 / (1 + np.exp(-SNOW_EDGE * (dry.normal[..., 2] - SNOW_SLOPE)))


def painted(
    linear: Float[np.ndarray, "h w 3"],
    share: Float[np.ndarray, "h w"],
    colour: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "h w 3"]:
    """A colour laid over a picture."""
    return linear + share[..., None] * (colour - linear)


def tuned_colour(
    bases: list[Float[np.ndarray, "h w 3"]],
    shares: list[Float[np.ndarray, "h w"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
) -> Float[np.ndarray, "3"]:
    """The colour that, added to linear pictures by `shares`, is nearest to the truth as displayed.

    Least squares in linear light, then a search over `GAINS` of each channel.
    """
    top, bottom = np.zeros(3), 1e-9  # nothing is covered: 0/0
    for base, share, picture in zip(bases, shares, true, strict=True):
        top += (share[..., None] * (linear_of(picture) - base)).sum((0, 1))
        bottom += float((share**2).sum())
    colour = np.clip(top / bottom, 0.0, 1.0)

    def error(gain: float, c: int) -> float:
        return sum(
            float(((to_display(b[..., c] + s * gain * colour[c]) - t[..., c] / 255.0) ** 2).sum())
            for b, s, t in zip(bases, shares, true, strict=True)
        )

    return colour * [min(GAINS, key=lambda gain, c=c: error(gain, c)) for c in range(3)]


def frame_noise(picture: Float[np.ndarray, "h w 3"], seed: int) -> Float[np.ndarray, "h w 3"]:
    """A display picture with a smooth pattern that is another in every frame."""
    rng = np.random.default_rng(seed)
    cells = rng.normal(0.0, NOISE, (NOISE_CELLS[0] + 1, NOISE_CELLS[1] + 1, 3))
    height, width = picture.shape[:2]
    row = np.linspace(0, NOISE_CELLS[0] - 1e-6, height)
    column = np.linspace(0, NOISE_CELLS[1] - 1e-6, width)
    i, j = row.astype(int), column.astype(int)
    v, u = (row - i)[:, None, None], (column - j)[None, :, None]
    upper = (1 - u) * cells[i][:, j] + u * cells[i][:, j + 1]
    lower = (1 - u) * cells[i + 1][:, j] + u * cells[i + 1][:, j + 1]
    return np.clip(picture + (1 - v) * upper + v * lower, 0.0, 1.0)


def linear_of(picture: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear light of 8-bit display values."""
    return to_linear(picture / 255.0)


def _on_screen(dry: Dry, points: Float[np.ndarray, "h w 3"]):
    """Row and column of world points (0 outside), whether inside, and their distance, m."""
    local = (points - dry.c2w[:3, 3]) @ dry.c2w[:3, :3]
    row, column, inside = nearest_pixels(dry.camera, local)
    return row, column, inside, np.linalg.norm(local, axis=-1)
