"""Labels without a network: sky by its looks, and ground by the capture's points.

The fall-back where nobody gives class labels. Sky is bright or blue, smooth, above the horizon, and
open to the photo's top. What is called sky should be sky: a piece of matter that is wrongly taken
for it becomes a hole in the scene, whereas sky that is missed costs little. So every doubt leads to
255, the unknown class, and indoors there is to be no sky at all. Ground is not found by its looks,
as paving, moss and a house's wall look alike: see `simple_ground`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.core.morphology import connected_to, dilated
from climatenerf.perception.heuristic_ground import GroundPoints, find_ground_in
from climatenerf.scene.images import load_image
from climatenerf.scene.label_spaces import UNKNOWN
from climatenerf.scene.scene import Scene, View

SKY, GROUND = 10, 9
"""Ground is called terrain: whether it is paved is not known."""
WORKING_SIZE = 800
"""Photos are looked at with at most this many pixels on the longer side."""
SAMPLE = 16
"""Photos by which a capture is judged to be outdoors."""
MIN_SHARE = 0.25
"""Of these, the share that must show sky."""

_EDGE = 3  # pixels of the working size between sky and what is not
_GAP = 4  # width of wires and twigs over which sky goes on, working pixels
_SMOOTH = 0.035  # largest step to a neighbour, of display values 0 to 1
_FIT = 0.06  # from the smooth colour of a photo's sky, display values
_MIN_AREA = 0.004  # of the photo
_HORIZON = np.sin(np.radians(1.5))  # levelling is good to a few degrees
_BELOW = np.sin(np.radians(-4.0))
_KNOTS = 33
_POINT_SPACE = 0.02  # of the photo's longer side: what a triangulated point keeps free of sky


def simple_labels(
    view: View, scene: Scene, ground: GroundPoints | None
) -> UInt8[np.ndarray, "h w"]:
    """Class ids of a photo: 10 where it surely shows sky, 9 for ground, 255 elsewhere.

    Args:
        view: Which photo.
        scene: The levelled capture; its horizon and sparse points bound the sky.
        ground: Its `ground_points`; None to look for sky alone.

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
    rays = _rays(small, scene.c2w_world(view)[:3, :3])
    sky = find_sky(picture, rays[..., 2], _solid(scene, view, small))
    labels = np.where(sky, np.uint8(SKY), np.uint8(UNKNOWN))
    if ground is not None:
        values = picture.astype(np.float32) / 255
        labels[find_ground_in(view, scene, small, ground, rays, values) & ~sky] = GROUND
    full = Image.fromarray(labels).resize(photo.size, Image.Resampling.NEAREST)
    return np.asarray(full)


def shows_sky(scene: Scene) -> bool:
    """Whether a capture is surely outdoors: enough of its photos show sky.

    Raises:
        UserError: A photo cannot be read.
    """
    every = max(1, len(scene.views) // SAMPLE)
    sample = scene.views[every // 2 :: every][:SAMPLE]
    found = [bool((simple_labels(view, scene, None) == SKY).any()) for view in sample]
    return sum(found) >= max(2, MIN_SHARE * len(found))


def find_sky(
    picture: UInt8[np.ndarray, "h w 3"],
    upward: Float[np.ndarray, "h w"],
    solid: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """True where a picture surely shows sky.

    Args:
        picture: 8-bit sRGB.
        upward: Sine of each pixel's ray above the horizon.
        solid: True near points that are known to be matter.
    """
    values = picture.astype(np.float32) / 255
    coloured = _sky_coloured(values)
    smooth = _roughness(values) < _SMOOTH
    seeds = coloured & smooth & _top_border(upward) & (upward > _HORIZON)
    nothing = np.zeros_like(solid)
    if not seeds.any():
        return nothing
    # Not stopped at the horizon: what looks like sky and goes on below it is a wall or a road.
    sky = connected_to(seeds, coloured & smooth)
    if sky.mean() < _MIN_AREA:
        return nothing
    for _ in range(2):  # the second time knowing how the sky goes on behind wires and twigs
        alike = coloured & _fits(values, sky)
        sky = connected_to(sky & alike, dilated(alike, _GAP)) & alike
    if not sky.any() or (upward[sky] < _BELOW).mean() > 0.05 or not _outshines(values, sky):
        return nothing
    # Clouds and birds: what sky surrounds, or sky and the photo's top.
    outside = connected_to(_border(sky.shape) & ~_top_border(upward), ~sky)
    sky |= coloured & ~outside
    sky &= upward > _HORIZON
    if (solid & sky).sum() > 0.3 * sky.sum():
        return nothing
    sky = ~dilated(~sky, _EDGE) & ~solid
    return sky if sky.mean() >= _MIN_AREA else nothing


def _sky_coloured(values: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Blue, or bright and without colour: never warmer than white."""
    red, green, blue = np.moveaxis(values, -1, 0)
    bluer = blue - red
    cool = (bluer > -0.025) & (blue >= green - 0.025) & (green >= red - 0.06)
    is_blue = (bluer > 0.1) & (blue > 0.5) & (green > 0.25)
    is_pale = green > 0.78
    return cool & (is_blue | is_pale)


def _roughness(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Largest step of any channel to the four neighbours."""
    rough = np.zeros(values.shape[:2], np.float32)
    across = np.abs(np.diff(values, axis=1)).max(axis=-1)
    down = np.abs(np.diff(values, axis=0)).max(axis=-1)
    rough[:, 1:] = across
    rough[:, :-1] = np.maximum(rough[:, :-1], across)
    rough[1:] = np.maximum(rough[1:], down)
    rough[:-1] = np.maximum(rough[:-1], down)
    return rough


def _rays(camera: Camera, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "h w 3"]:
    """Directions of every pixel's ray, between the knots of a coarse net of rays.

    Args:
        camera: The intrinsics.
        rotation: From the camera's axes to the world's.
    """
    x = np.linspace(0.5, camera.width - 0.5, _KNOTS)
    y = np.linspace(0.5, camera.height - 0.5, _KNOTS)
    # To undo a lens's distortion at every pixel would take longer than all the rest.
    net = camera.directions(np.stack(np.meshgrid(x, y), axis=-1)) @ rotation.T
    tall = _between(net, y, np.arange(camera.height) + 0.5)
    wide = _between(tall.swapaxes(0, 1), x, np.arange(camera.width) + 0.5)
    return np.ascontiguousarray(wide.swapaxes(0, 1), np.float32)


def _between(
    knots: Float[np.ndarray, "k n c"], at: Float[np.ndarray, " k"], places: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m n c"]:
    """Values between knots along the first axis."""
    share = np.interp(places, at, np.arange(len(at)))
    low = np.minimum(share.astype(np.int64), len(at) - 2)
    share = (share - low)[:, None, None].astype(np.float32)
    return knots[low] * (1 - share) + knots[low + 1] * share


def _border(shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    border = np.ones(shape, bool)
    border[1:-1, 1:-1] = False
    return border


def _top_border(upward: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The border pixels over which one looks upwards out of the picture, however it is rolled."""
    down, right = np.gradient(upward)
    steep = 0.7 * np.hypot(down, right)  # within 45 degrees of straight up
    top = np.zeros(upward.shape, bool)
    top[0] = -down[0] > steep[0]
    top[-1] = down[-1] > steep[-1]
    top[:, 0] |= -right[:, 0] > steep[:, 0]
    top[:, -1] |= right[:, -1] > steep[:, -1]
    return top


def _fits(
    values: Float[np.ndarray, "h w 3"], sky: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Where a picture is near the colour that its sky has there: a quadratic over the picture."""
    height, width = sky.shape
    y, x = np.meshgrid(
        np.linspace(-1, 1, height, dtype=np.float32),
        np.linspace(-1, 1, width, dtype=np.float32),
        indexing="ij",
    )
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    some = np.flatnonzero(sky)
    some = some[:: max(1, len(some) // 4000)]
    known, colours = terms.reshape(-1, 6)[some], values.reshape(-1, 3)[some]
    # A light pull to a constant colour: a small patch does not tell how the sky goes on.
    pull = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]) * 1e-3 * len(some)
    # 1e-6: of fewer pixels than terms the equations are singular.
    weights = np.linalg.solve(known.T @ known + pull + 1e-6 * np.eye(6), known.T @ colours)
    expected = terms @ weights.astype(np.float32)
    return np.abs(values - expected).max(axis=-1) < _FIT


def _outshines(values: Float[np.ndarray, "h w 3"], sky: Bool[np.ndarray, "h w"]) -> bool:
    """Whether what looks like sky is blue, or brighter than nearly all the rest."""
    colour = np.median(values[sky], axis=0)
    if colour[2] - colour[0] > 0.1:
        return True
    rest = values[~sky][:, 1]
    return not len(rest) or bool(colour[1] > np.quantile(rest, 0.9))


def _solid(scene: Scene, view: View, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """True around the sparse points that a view shows: they are matter, not sky."""
    near = np.zeros((camera.height, camera.width), bool)
    if scene.points is None or view.seen is None or not len(view.seen):
        return near
    w2c = np.linalg.inv(view.c2w)
    pixels = camera.project(scene.points[view.seen] @ w2c[:3, :3].T + w2c[:3, 3])
    pixels = pixels[np.isfinite(pixels).all(axis=-1)].astype(np.int64)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=-1)
    near[pixels[inside, 1], pixels[inside, 0]] = True
    return dilated(near, round(_POINT_SPACE * max(camera.width, camera.height) / 2))
