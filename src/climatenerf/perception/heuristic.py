"""Heuristic class labels without a network: sky and leaves by colour, the rest by sparse points.

The fall-back for captures without class labels. Sky is bright or blue, smooth, above the horizon,
and connected to the top of the photo. A false positive makes a hole in the scene, while missed sky
costs little, so every doubtful pixel becomes 255, the unknown class, and a room should get no sky
at all. Ground cannot be segmented by colour, because paving, moss and walls look alike; see
`heuristic_ground`. What stands on it is vegetation or solid; see `heuristic_standing`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.core.morphology import connected_to, dilated
from climatenerf.perception.heuristic_ground import (
    GroundPoints,
    observed_pixels,
    segment_ground,
)
from climatenerf.perception.heuristic_standing import (
    is_solid,
    segment_standing,
    segment_vegetation,
)
from climatenerf.scene.images import load_image
from climatenerf.scene.label_spaces import UNKNOWN
from climatenerf.scene.scene import Scene, View

BUILDING, VEGETATION, GROUND, SKY = 2, 8, 9, 10
"""Cityscapes train ids. Ground is labelled terrain, because paving is not recognised."""
WORKING_SIZE = 800
"""Photos are processed with at most this many pixels on the longer side."""
SAMPLE = 16
"""Photos examined to decide whether a capture is outdoors."""
MIN_FRACTION = 0.25
"""Fraction of them that must show sky."""

_EDGE = 3  # px of the working size, margin removed from the sky's border
_GAP = 4  # px of the working size, width of wires and twigs across which sky continues
_MAX_STEP = 0.035  # between neighbouring pixels of smooth sky, display values in [0,1]
_MAX_RESIDUAL = 0.06  # from the polynomial fitted to a photo's sky, display values
_MAX_FIT_PIXELS = 4000  # that the polynomial is fitted to
_MIN_AREA = 0.004  # of the photo
_HORIZON = np.sin(np.radians(1.5))  # gravity alignment is good to a few degrees
_BELOW_HORIZON = np.sin(np.radians(-4.0))
_MAX_BELOW = 0.05  # fraction of candidate sky below that
_MAX_MATTER = 0.3  # fraction of candidate sky near sparse points
_GRID_NODES = 33  # along a side, where ray directions are computed exactly
_POINT_MARGIN = 0.02  # of the photo's longer side, around a sparse point, that is not sky


def heuristic_labels(
    view: View, scene: Scene, ground: GroundPoints | None
) -> UInt8[np.ndarray, "h w"]:
    """Return class ids of a photo, and 255 where it is in doubt.

    Sky is 10, ground 9, vegetation 8, and what else stands on the ground 2.

    Args:
        view: The photo.
        scene: The capture with z up; its horizon and sparse points bound the sky.
        ground: From `classify_ground_points`; None to label sky only, for without ground a green
            surface may be anything.

    Raises:
        UserError: The photo cannot be read.
    """
    camera = scene.cameras[view.camera]
    scale = min(1.0, WORKING_SIZE / max(camera.width, camera.height))
    small = camera.resized(
        max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    )
    photo = Image.fromarray(load_image(view, scene))
    picture = photo.resize((small.width, small.height), Image.Resampling.BOX)
    picture = np.asarray(picture)
    rays = _ray_directions(small, scene.c2w_world(view)[:3, :3])
    sky = segment_sky(picture, rays[..., 2], _near_points(scene, view, small))
    labels = np.where(sky, np.uint8(SKY), np.uint8(UNKNOWN))
    if ground is not None:
        values = picture.astype(np.float32) / 255
        pixels, seen = observed_pixels(view, scene, small, ground.points)
        stands = ground.stands[seen]
        standing = segment_standing(values, pixels[stands], pixels[~stands])
        # Below the horizon what is green and does not stand is a lawn, or in doubt.
        leaves = segment_vegetation(values) & (standing | (rays[..., 2] > 0))
        for label, region in (
            (BUILDING, standing & is_solid(values)),
            (VEGETATION, leaves),
            (GROUND, segment_ground(view, scene, small, ground, rays, values)),
        ):
            labels[region & ~sky] = label
    full = Image.fromarray(labels).resize(photo.size, Image.Resampling.NEAREST)
    return np.asarray(full)


def is_outdoors(scene: Scene) -> bool:
    """Return whether a capture is certainly outdoors: enough of its photos show sky.

    Raises:
        UserError: A photo cannot be read.
    """
    step = max(1, len(scene.views) // SAMPLE)
    sample = scene.views[step // 2 :: step][:SAMPLE]
    found = [bool((heuristic_labels(view, scene, None) == SKY).any()) for view in sample]
    return sum(found) >= max(2, MIN_FRACTION * len(found))


def segment_sky(
    picture: UInt8[np.ndarray, "h w 3"],
    upward: Float[np.ndarray, "h w"],
    matter: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return where a picture certainly shows sky.

    Args:
        picture: 8-bit sRGB.
        upward: Sine of the elevation of each pixel's ray.
        matter: True near sparse points, which are matter.
    """
    values = picture.astype(np.float32) / 255
    coloured = _has_sky_colour(values)
    smooth = _max_step(values) < _MAX_STEP
    seeds = coloured & smooth & _top_border(upward) & (upward > _HORIZON)
    nothing = np.zeros_like(matter)
    if not seeds.any():
        return nothing
    # Not stopped at the horizon: a region that continues below it is a wall or a road.
    sky = connected_to(seeds, coloured & smooth)
    if sky.mean() < _MIN_AREA:
        return nothing
    for _ in range(2):  # the second fit includes the sky behind wires and twigs
        similar = coloured & _fits_polynomial(values, sky)
        sky = connected_to(sky & similar, dilated(similar, _GAP)) & similar
    if not sky.any() or (upward[sky] < _BELOW_HORIZON).mean() > _MAX_BELOW:
        return nothing
    if not _is_blue_or_brightest(values, sky):
        return nothing
    # Clouds and birds: regions enclosed by sky, or by sky and the photo's top.
    outside = connected_to(_border(sky.shape) & ~_top_border(upward), ~sky)
    sky |= coloured & ~outside
    sky &= upward > _HORIZON
    if (matter & sky).sum() > _MAX_MATTER * sky.sum():
        return nothing
    sky = ~dilated(~sky, _EDGE) & ~matter
    return sky if sky.mean() >= _MIN_AREA else nothing


def _has_sky_colour(values: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return which pixels are blue, or bright and neutral; warm colours are excluded."""
    red, green, blue = np.moveaxis(values, -1, 0)
    bluer = blue - red
    cool = (bluer > -0.025) & (blue >= green - 0.025) & (green >= red - 0.06)
    is_blue = (bluer > 0.1) & (blue > 0.5) & (green > 0.25)
    is_pale = green > 0.78
    return cool & (is_blue | is_pale)


def _max_step(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Return the largest difference of any channel to the four neighbours."""
    step = np.zeros(values.shape[:2], np.float32)
    across = np.abs(np.diff(values, axis=1)).max(axis=-1)
    down = np.abs(np.diff(values, axis=0)).max(axis=-1)
    step[:, 1:] = across
    step[:, :-1] = np.maximum(step[:, :-1], across)
    step[1:] = np.maximum(step[1:], down)
    step[:-1] = np.maximum(step[:-1], down)
    return step


def _ray_directions(
    camera: Camera, rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Return the direction of every pixel's ray, interpolated from a coarse grid.

    To undo lens distortion at every pixel would take longer than everything else.

    Args:
        camera: The intrinsics.
        rotation: Camera to world.
    """
    x = np.linspace(0.5, camera.width - 0.5, _GRID_NODES)
    y = np.linspace(0.5, camera.height - 0.5, _GRID_NODES)
    grid = camera.directions(np.stack(np.meshgrid(x, y), axis=-1)) @ rotation.T
    tall = _interpolate(grid, y, np.arange(camera.height) + 0.5)
    wide = _interpolate(tall.swapaxes(0, 1), x, np.arange(camera.width) + 0.5)
    return np.ascontiguousarray(wide.swapaxes(0, 1), np.float32)


def _interpolate(
    values: Float[np.ndarray, "k n c"], at: Float[np.ndarray, " k"], x: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m n c"]:
    """Interpolate values at nodes `at` linearly along the first axis."""
    index = np.interp(x, at, np.arange(len(at)))
    low = np.minimum(index.astype(np.int64), len(at) - 2)
    fraction = (index - low)[:, None, None].astype(np.float32)
    return values[low] * (1 - fraction) + values[low + 1] * fraction


def _border(shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """Return the outermost pixels of an image."""
    border = np.ones(shape, bool)
    border[1:-1, 1:-1] = False
    return border


def _top_border(upward: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the border pixels beyond which elevation increases, for any roll of the camera."""
    down, right = np.gradient(upward)
    steep = 0.7 * np.hypot(down, right)  # within 45 degrees of straight up
    top = np.zeros(upward.shape, bool)
    top[0] = -down[0] > steep[0]
    top[-1] = down[-1] > steep[-1]
    top[:, 0] |= -right[:, 0] > steep[:, 0]
    top[:, -1] |= right[:, -1] > steep[:, -1]
    return top


def _fits_polynomial(
    values: Float[np.ndarray, "h w 3"], sky: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return where a picture is close to a quadratic polynomial fitted to its sky's colour."""
    height, width = sky.shape
    y, x = np.meshgrid(
        np.linspace(-1, 1, height, dtype=np.float32),
        np.linspace(-1, 1, width, dtype=np.float32),
        indexing="ij",
    )
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    pixels = np.flatnonzero(sky)
    pixels = pixels[:: max(1, len(pixels) // _MAX_FIT_PIXELS)]
    design, colours = terms.reshape(-1, 6)[pixels], values.reshape(-1, 3)[pixels]
    # Ridge term towards a constant colour: a small patch does not determine the gradients.
    ridge = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]) * 1e-3 * len(pixels)
    # 1e-6: with fewer pixels than terms the system is singular.
    weights = np.linalg.solve(design.T @ design + ridge + 1e-6 * np.eye(6), design.T @ colours)
    expected = terms @ weights.astype(np.float32)
    return np.abs(values - expected).max(axis=-1) < _MAX_RESIDUAL


def _is_blue_or_brightest(values: Float[np.ndarray, "h w 3"], sky: Bool[np.ndarray, "h w"]) -> bool:
    """Return whether the sky is blue, or brighter than nine tenths of the other pixels."""
    colour = np.median(values[sky], axis=0)
    if colour[2] - colour[0] > 0.1:
        return True
    rest = values[~sky][:, 1]
    return not len(rest) or bool(colour[1] > np.quantile(rest, 0.9))


def _near_points(scene: Scene, view: View, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """Return the pixels around the sparse points that a view observes: matter, not sky."""
    marked = np.zeros((camera.height, camera.width), bool)
    points = scene.points_world()
    if points is not None:
        pixels, _ = observed_pixels(view, scene, camera, points)
        marked[pixels[:, 1], pixels[:, 0]] = True
    return dilated(marked, round(_POINT_MARGIN * max(camera.width, camera.height) / 2))
