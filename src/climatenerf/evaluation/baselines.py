"""Weather baselines that edit single pictures instead of simulating weather in the scene.

All start from our own clean render with its depth and normals. Their free constants are fitted to
the true pictures, which our renders never use. They reproduce the failures of other methods that
ClimateNeRF's paper (section 4.1) reports: fog that ignores height, water without reflections,
reflections limited to the screen, snow without thickness, and frames edited one by one.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from climatenerf.core.srgb import to_display, to_linear
from climatenerf.evaluation.geometry import nearest_pixels
from climatenerf.scene import Camera
from climatenerf.weather.flood import fresnel

SNOW_SHARPNESS, SNOW_SLOPE = 50.0, np.cos(np.deg2rad(37.0))  # the paper's snow
RAY_LENGTHS = np.geomspace(0.05, 60.0, 64)  # m, samples of a reflected ray
SURFACE_THICKNESS = 0.5  # m, depth behind a visible surface that still counts as a hit
NOISE, NOISE_CELLS = 0.08, (9, 16)  # standard deviation, display values; cells of a picture
EXTINCTION_FACTORS = np.geomspace(0.25, 4.0, 33)  # of the nominal extinction, for tuning
GAINS = np.linspace(0.7, 1.3, 25)  # of a colour fitted in linear light, for tuning
NAMES = ("depth-fog", "flat-plane", "screen-reflection", "white-paint", "frame-noise")


@dataclass(frozen=True)
class CleanView:
    """A clean render: the input of every baseline.

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


def depth_fog(
    view: CleanView, sigma: float, colour: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Blend a view towards the colour of the fog by exp(-sigma depth); linear radiance."""
    transmittance = np.exp(-sigma * view.depth)[..., None]
    return view.linear * transmittance + colour * (1 - transmittance)


def tuned_sigma(
    views: list[CleanView], true: list[UInt8[np.ndarray, "h w 3"]], sigma: float, colour: np.ndarray
) -> float:
    """Return the extinction, 1/m, whose fog is nearest to the true pictures.

    Args:
        views: clean renders.
        true: display pictures of the same views.
        sigma: nominal extinction, 1/m; multiples of it are searched.
        colour: linear radiance of dense fog.
    """

    def error(factor: float) -> float:
        pictures = [to_display(depth_fog(view, factor * sigma, colour)) for view in views]
        return float(
            np.mean([((p - t / 255.0) ** 2).mean() for p, t in zip(pictures, true, strict=True)])
        )

    return sigma * float(min(EXTINCTION_FACTORS, key=error))


def wet_pixels(
    view: CleanView, level: float
) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Return where the water plane z = level (m) is visible, and the ray length to it, m."""
    descent = -view.rays_d[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # 1e-6: rays that do not descend, 0/0.
        t = np.where(descent > 1e-6, (view.c2w[2, 3] - level) / descent, np.inf)
    return (t > 0) & (t < view.depth), t


def flat_plane(
    view: CleanView, level: float, colour: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Replace wet pixels by one colour; linear radiance."""
    return np.where(wet_pixels(view, level)[0][..., None], colour, view.linear)


def screen_reflection(
    view: CleanView,
    level: float,
    ior: float,
    slope: Float[np.ndarray, "h w 2"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Trace the water's reflection in screen space.

    Reflected rays are marched through the depth picture. Rays that hit no surface get the colour of
    the sky pixel they point to. Rays that leave the screen get the mean colour of the visible sky,
    or of the picture if it shows no sky.

    Args:
        view: the clean render.
        level: height of the water, m.
        ior: refractive index of the water.
        slope: dz/dx and dz/dy of the waves where the pixels' rays meet the water.

    Returns:
        Reflected radiance and Fresnel reflectance of each pixel.
    """
    _, t = wet_pixels(view, level)
    t = np.where(np.isfinite(t) & (t > 0), t, 0.0)
    origin = view.c2w[:3, 3] + t[..., None] * view.rays_d
    normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = np.clip(-(view.rays_d * normal).sum(-1), 0.0, 1.0)
    reflected = view.rays_d + 2 * cosine[..., None] * normal
    reflected[..., 2] = np.abs(reflected[..., 2])
    sky = np.isinf(view.depth)
    mean = view.linear[sky].mean(0) if sky.any() else view.linear.mean((0, 1))
    radiance = np.broadcast_to(mean, view.linear.shape).copy()
    found = np.zeros(view.depth.shape, bool)
    for length in RAY_LENGTHS:
        row, column, inside, distance = _on_screen(view, origin + length * reflected)
        behind = distance - view.depth[row, column]
        hit = inside & ~found & (behind > 0) & (behind < SURFACE_THICKNESS + 0.1 * length)
        radiance[hit] = view.linear[row, column][hit]
        found |= hit
    row, column, inside, _ = _on_screen(view, origin + 1e4 * reflected)
    open_sky = inside & ~found & sky[row, column]
    radiance[open_sky] = view.linear[row, column][open_sky]
    return radiance, fresnel.reflectance(torch.from_numpy(cosine), ior).numpy()


def snow_coverage(view: CleanView) -> Float[np.ndarray, "h w"]:
    """Return the snow coverage of each pixel from its normal alone, [0, 1]."""
    return 1 / (1 + np.exp(-SNOW_SHARPNESS * (view.normal[..., 2] - SNOW_SLOPE)))


def overlay(
    linear: Float[np.ndarray, "h w 3"],
    coverage: Float[np.ndarray, "h w"],
    colour: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "h w 3"]:
    """Blend a colour over a picture by its coverage, [0, 1]."""
    return linear + coverage[..., None] * (colour - linear)


def tuned_colour(
    bases: list[Float[np.ndarray, "h w 3"]],
    coverages: list[Float[np.ndarray, "h w"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
) -> Float[np.ndarray, "3"]:
    """Return the linear colour with which base + coverage colour is nearest to the true pictures.

    Least squares in linear light, then a search over `GAINS` of each channel for the smallest error
    in display values.

    Args:
        bases: linear pictures.
        coverages: fraction of the colour to add to each pixel.
        true: display pictures of the same views.
    """
    numerator, denominator = np.zeros(3), 1e-9  # 1e-9: no pixel is covered, 0/0
    for base, coverage, picture in zip(bases, coverages, true, strict=True):
        numerator += (coverage[..., None] * (linear_of(picture) - base)).sum((0, 1))
        denominator += float((coverage**2).sum())
    colour = np.clip(numerator / denominator, 0.0, 1.0)

    def error(gain: float, c: int) -> float:
        return sum(
            float(((to_display(b[..., c] + s * gain * colour[c]) - t[..., c] / 255.0) ** 2).sum())
            for b, s, t in zip(bases, coverages, true, strict=True)
        )

    return colour * [min(GAINS, key=lambda gain, c=c: error(gain, c)) for c in range(3)]


def frame_noise(picture: Float[np.ndarray, "h w 3"], seed: int) -> Float[np.ndarray, "h w 3"]:
    """Add a smooth random pattern, different for each seed, to a display picture."""
    rng = np.random.default_rng(seed)
    cells = rng.normal(0.0, NOISE, (NOISE_CELLS[0] + 1, NOISE_CELLS[1] + 1, 3))
    height, width = picture.shape[:2]
    row = np.linspace(0, NOISE_CELLS[0] - 1e-6, height)  # 1e-6: the last row lies in the last cell
    column = np.linspace(0, NOISE_CELLS[1] - 1e-6, width)
    i, j = row.astype(int), column.astype(int)
    v, u = (row - i)[:, None, None], (column - j)[None, :, None]
    upper = (1 - u) * cells[i][:, j] + u * cells[i][:, j + 1]
    lower = (1 - u) * cells[i + 1][:, j] + u * cells[i + 1][:, j + 1]
    return np.clip(picture + (1 - v) * upper + v * lower, 0.0, 1.0)


def linear_of(picture: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the linear radiance of 8-bit display values."""
    return to_linear(picture / 255.0)


def _on_screen(
    view: CleanView, points: Float[np.ndarray, "h w 3"]
) -> tuple[
    Int[np.ndarray, "h w"],
    Int[np.ndarray, "h w"],
    Bool[np.ndarray, "h w"],
    Float[np.ndarray, "h w"],
]:
    """Return row and column of world points (0 outside), whether inside, and their distance, m."""
    local = (points - view.c2w[:3, 3]) @ view.c2w[:3, :3]
    row, column, inside = nearest_pixels(view.camera, local)
    return row, column, inside, np.linalg.norm(local, axis=-1)
