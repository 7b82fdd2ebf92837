"""The terrain of a fitted run: what its photos' rays meet, as heights of ground.

Rays of the photos end on the fitted field. Ends that can be ground by normal and class, and that
lie near the lower envelope of all ends, are heights with an error. A smooth surface is fitted to
them (`scene.terrain_fit`). Then two things are found for each node: whether the field holds ground
there, and whether any photo shows it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage, spatial

from climatenerf.core.classes import BUILDING, GROUND, PERSON, SKY, UNKNOWN, VEHICLE
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.samples import MIN_TAU
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.compositing import chunks
from climatenerf.field.protocol import RadianceField, device_of, observed
from climatenerf.ops import compositing
from climatenerf.render.photo_rays import trace_photos
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.scene.terrain import Terrain, nearest_known
from climatenerf.scene.terrain_fit import Heights, fit_heights

MIN_GROUND = 200  # ends on the ground, for a terrain
MIN_HELD = 1.5  # area of ground that the field holds, over the squared height of the cameras
MAX_NODES = 700  # along the raster's longer side
STRAY = 0.002  # of the ends, on each side of the ground, that may lie outside of the raster
MIN_CELL = 0.05  # m
MARGIN = 6.0  # m around the cameras and around what they show
FAR = 30.0  # camera heights; ground further away is known too badly
LOW = 0.7  # m below the camera; what is labelled building may be ground there
MIN_UP = 0.5  # z of a normal that may be ground
DEPTH_ERROR = 0.01  # of a ray length
SURFACE_ERROR = 0.02  # m
ENVELOPE_CELL = 0.6  # m, cells whose lowest ends begin the search for ground
BAND = 0.35  # m above the lower envelope in which ends count as ground
STEEPEST = np.tan(np.radians(40.0))
CLEARANCE = (0.2, 0.5)  # m above and below the terrain in which the field's ground is looked for
LIFT = 0.05  # m; nodes are looked at so much above the ground
MAX_ANGLE = 0.2  # rad between a node that a pixel shows and the pixel's ray
BELOW_RADIUS = 0.75  # m around the place below a camera, where ends are looked for
MIN_BELOW = 5  # ends there, for ground below a camera
MIN_CAMERAS = 5  # with ground below them, for a height at which cameras are carried
MAX_SPREAD = 0.2  # m, of that height
CARRIED_ERROR = 0.1  # m; steps and hollows under a camera
MAX_ERROR = 1.0  # m; where the ground is known worse it is not completed


def find_terrain(
    field: RadianceField, scene: Scene, progress: Callable[[float], None] | None = None
) -> Terrain | None:
    """Return the ground of a run; None if its photos show too little ground.

    Args:
        field: fitted to the scene.
        scene: the capture, z up.
        progress: called with the fraction that is done.
    """
    if not field.capabilities & {NORMALS, CLASSES}:
        return None
    report = progress or (lambda fraction: None)
    photos = trace_photos(observed(field), scene, lambda fraction: report(0.8 * fraction))
    report(0.8)
    return terrain_below(field, photos)


@torch.no_grad()
def terrain_below(field: RadianceField, photos: list[PhotoRays]) -> Terrain | None:
    """Return the ground below photos; None if they show too little of it.

    Args:
        field: fitted to the photos; z is up.
        photos: their rays on the field without unobserved density, from `trace_photos`.
    """
    field = observed(field)
    ground = np.concatenate([_possible_ground(each, field.capabilities) for each in photos])
    x, t, label = (
        np.concatenate([getattr(each, name).reshape(-1, *shape) for each in photos])[ground]
        for name, shape in (("x", (3,)), ("t", ()), ("label", ()))
    )
    slope = np.concatenate([np.abs(each.d[..., 2]).ravel() for each in photos])[ground]
    eyes = np.stack([each.c2w[:3, 3] for each in photos])
    low = _near_lowest(x, label)
    if low.any():
        low &= t < FAR * max(float(np.median(eyes[:, 2]) - np.median(x[low, 2])), 0.5)
    if low.sum() < MIN_GROUND:
        return None
    x, t, label, slope = x[low], t[low], label[low], slope[low]
    origin, cell, shape = _raster(x, eyes)
    error = np.hypot(SURFACE_ERROR, DEPTH_ERROR * t * slope)
    below = heights_below_cameras(eyes, x)
    heights = Heights(np.concatenate([x, below.x]), np.concatenate([error, below.error]))
    height, spread = fit_heights(heights, origin, cell, shape)
    unknown, nothing = np.full(shape, UNKNOWN, np.uint8), np.zeros(shape, bool)
    terrain = Terrain(origin, cell, height, spread, unknown, nothing, nothing)
    seen = _holds_ground(field, terrain)
    above = float(np.median(eyes[:, 2] - terrain.sample(height, eyes[:, :2])))
    if seen.sum() * cell**2 < MIN_HELD * above**2:  # what was taken for ground is something else
        return None
    photographed = _photographed(terrain, photos)
    label = np.where(seen, _classes(terrain, x, label), UNKNOWN).astype(np.uint8)
    opened = ~seen & (photographed | (spread > MAX_ERROR))
    return replace(terrain, label=label, seen=seen, open=opened)


def heights_below_cameras(
    eyes: Float[np.ndarray, "m 3"], ground: Float[np.ndarray, "n 3"]
) -> Heights:
    """Return heights of the ground below cameras that have few ends near, from the other cameras.

    Cameras are often carried at one height: on a car, on a pole, by hand. If those with ground
    below them agree on it, the ground below the rest is as far down, unless it would be steeper
    than ground can be.

    Args:
        eyes: cameras, world m.
        ground: ends on the ground, world m.

    Returns:
        One height for each such camera; none if too few cameras have ground below them, or if
        their heights differ.
    """
    none = Heights(np.zeros((0, 3)), np.zeros(0))
    tree = spatial.KDTree(ground[:, :2])
    near = tree.query_ball_point(eyes[:, :2], BELOW_RADIUS)
    known = np.array([len(rows) >= MIN_BELOW for rows in near])
    if known.sum() < MIN_CAMERAS or known.all():
        return none
    below = np.array([np.median(ground[near[i], 2]) for i in np.flatnonzero(known)])
    carried = eyes[known, 2] - below
    height = float(np.median(carried))
    spread = 1.48 * float(np.median(np.abs(carried - height)))  # a standard deviation
    if spread > MAX_SPREAD:
        return none
    x = eyes[~known] - (0.0, 0.0, height)
    # A camera on a balcony or a drone is not carried at that height.
    distance, nearest = tree.query(x[:, :2])
    x = x[np.abs(x[:, 2] - ground[nearest, 2]) < BAND + STEEPEST * distance]
    return Heights(x, np.full(len(x), np.hypot(spread, CARRIED_ERROR)))


def _raster(
    x: Float[np.ndarray, "n 3"], eyes: Float[np.ndarray, "m 3"]
) -> tuple[tuple[float, float], float, tuple[int, int]]:
    """Return origin, cell (m) and shape of a raster around ground and cameras."""
    low, high = np.quantile(x[:, :2], (STRAY, 1 - STRAY), axis=0)
    low = np.minimum(low, eyes[:, :2].min(0)) - MARGIN
    high = np.maximum(high, eyes[:, :2].max(0)) + MARGIN
    cell = max(float((high - low).max()) / (MAX_NODES - 1), MIN_CELL)
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    return (float(low[0]), float(low[1])), cell, (rows, columns)


def _possible_ground(photo: PhotoRays, capabilities: frozenset[str]) -> Bool[np.ndarray, "hw"]:
    """Return which ends can be ground by class and slope."""
    possible = np.isfinite(photo.t) & (photo.label != SKY)
    if NORMALS in capabilities:
        possible &= photo.normal[..., 2] > MIN_UP
    if CLASSES in capabilities:
        # Litter, sand and banks are often labelled vegetation, and concrete is labelled building.
        low = photo.c2w[2, 3] - photo.x[..., 2] > LOW
        possible &= ~np.isin(photo.label, (PERSON, VEHICLE))
        possible &= (photo.label != BUILDING) | low
    return possible.ravel()


def _near_lowest(
    x: Float[np.ndarray, "n 3"], label: UInt8[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """Return which ends lie near the lower envelope of all, no steeper than ground can be.

    Ends classified as road or terrain may lie twice as far above it as others.
    """
    if not len(x):
        return np.zeros(0, bool)
    low = x[:, :2].min(0)
    # Larger cells where ends are kilometres apart, which bounds the memory.
    cell = max(ENVELOPE_CELL, float((x[:, :2].max(0) - low).max()) / (4 * MAX_NODES))
    at = ((x[:, :2] - low) / cell).astype(np.int64)
    columns, rows = (at.max(0) + 1).tolist()
    row = at[:, 1] * columns + at[:, 0]
    order = np.lexsort((x[:, 2], row))
    nodes, start, count = np.unique(row[order], return_index=True, return_counts=True)
    # The 5 % quantile of each cell: single ends below the ground are errors.
    lowest = np.full(rows * columns, np.inf)
    lowest[nodes] = x[order, 2][start + (0.05 * count).astype(int)]
    lowest = lowest.reshape(rows, columns)
    # No ground is higher than the ground nearby allows at the steepest slope.
    radius = 6
    envelope = lowest.copy()
    span = np.arange(-radius, radius + 1)
    for dy in span:
        for dx in span:
            rise = STEEPEST * cell * np.hypot(dx, dy)
            shifted = ndimage.shift(lowest, (dy, dx), order=0, cval=np.inf, prefilter=False)
            envelope = np.minimum(envelope, shifted + rise)
    above = x[:, 2] - envelope.reshape(-1)[row]
    labelled = np.isin(label, GROUND)
    return above < np.where(labelled, 2 * BAND, BAND)


@torch.no_grad()
def _holds_ground(field: RadianceField, terrain: Terrain) -> Bool[np.ndarray, "rows columns"]:
    """Return at which nodes vertical rays meet opaque ground near the terrain."""
    device = device_of(field)
    x = terrain.nodes().reshape(-1, 3)
    band = np.clip(2 * terrain.error.reshape(-1), *CLEARANCE)
    start = x + np.stack([0 * band, 0 * band, band], axis=-1)
    o = to_device(start.astype(np.float32), device)
    d = torch.tensor([0.0, 0.0, -1.0], device=device).expand(len(o), 3).contiguous()
    far = to_device((2 * band).astype(np.float32), device)
    found = []
    for chunk in chunks(o):
        zero = torch.zeros_like(far[chunk])
        samples = field.march(o[chunk], d[chunk], zero, far[chunk], 0.5, pruning_threshold=MIN_TAU)
        _, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        found.append(to_numpy(transmittance < 0.5))
    held = np.concatenate(found).reshape(terrain.height.shape)
    # A pinhole of a node is no hole in the ground; nor is one node of matter ground.
    return ndimage.median_filter(held.astype(np.uint8), 3).astype(bool)


def _photographed(terrain: Terrain, photos: list[PhotoRays]) -> Bool[np.ndarray, "rows columns"]:
    """Return which nodes some photo shows: inside its frame, with nothing in front."""
    nodes = terrain.nodes().reshape(-1, 3) + (0.0, 0.0, LIFT)
    shown = np.zeros(len(nodes), bool)
    for photo in photos:
        rest = np.flatnonzero(~shown)
        local = (nodes[rest] - photo.c2w[:3, 3]) @ photo.c2w[:3, :3]
        pixel = photo.camera.project(local)
        height, width = photo.t.shape
        inside = ((pixel >= 0) & (pixel < (width, height))).all(-1)  # NaN behind: False
        rest, local, pixel = rest[inside], local[inside], pixel[inside].astype(int)
        distance = np.linalg.norm(local, axis=-1)
        column, row = pixel.T
        # A strong distortion folds what lies beside the frame into it.
        along = ((local @ photo.c2w[:3, :3].T) * photo.d[row, column]).sum(-1)
        # The furthest of the neighbouring pixels: an edge hides nothing for certain.
        furthest = ndimage.maximum_filter(photo.t, 3)[row, column]
        clear = distance < furthest * (1 + DEPTH_ERROR) + LIFT
        shown[rest] = clear & (along > np.cos(MAX_ANGLE) * distance)
    return shown.reshape(terrain.height.shape)


def _classes(
    terrain: Terrain, x: Float[np.ndarray, "n 3"], label: UInt8[np.ndarray, "n"]
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the class of ground that most ends near each node have, continued to all nodes."""
    rows, columns = terrain.height.shape
    at = np.rint((x[:, :2] - np.array(terrain.origin)) / terrain.cell).astype(int)
    inside = ((at >= 0) & (at < (columns, rows))).all(-1)
    votes = np.zeros((len(GROUND), rows, columns))
    for k, kind in enumerate(GROUND):
        mine = inside & (label == kind)
        np.add.at(votes[k], (at[mine, 1], at[mine, 0]), 1)
        votes[k] = ndimage.uniform_filter(votes[k], 5)
    known = votes.sum(0) > 1e-6
    if not known.any():
        return np.full((rows, columns), GROUND[-1], np.uint8)
    best = np.array(GROUND, np.uint8)[votes.argmax(0)]
    return best[nearest_known(known)[1]]
