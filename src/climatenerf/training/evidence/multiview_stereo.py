"""Multi-view stereo by plane sweep: more depth measurements than structure from motion gives.

For windows around random pixels, depth hypotheses along the pixel's ray are compared with
neighbouring photos (Goesele, Curless & Seitz 2006, "Multi-View Stereo Revisited"). A depth is kept
if the window correlates with two neighbours there and clearly less at any other depth.
"""

from itertools import islice

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import SKY
from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.ops.cpu.plane_sweep import TILES, UNSEEN, Pictures, match
from climatenerf.training.dataset import TrainingPixels, in_one_row
from climatenerf.training.evidence.sparse_depth import SparseDepth

MAX_WINDOWS = 2**17  # that are matched, over all photos
PIXELS_PER_WINDOW = 8
NEIGHBOURS = 4  # photos that a tile is compared with
BEST_ANGLE = 6.0  # degrees, triangulation angle of the preferred neighbours
ANGLES = (1.0, 25.0)  # degrees, triangulation angles allowed
MIN_AXIS_COSINE = 0.5  # between the optical axes of neighbours
NEAR_FACTOR = 0.5  # of the nearest point's z-depth, where the sweep begins
MIN_CORRELATION = 0.8
MIN_MARGIN = 0.05  # of the best depth's correlation over that at any other depth
MAX_DEPTH_ERROR = 0.02  # relative, between the depths found from a photo and from its neighbour
MIN_POINTS = 20  # for a depth range of a photo, or of a tile, of its own
NEAR_QUANTILE = 0.02  # of the points' z-depths: the nearest, without outliers
MIN_COSINE = 0.1  # from the optical axis; beyond it a pinhole image does not show a ray
LUMA = (0.299, 0.587, 0.114)  # Rec. 601, on display values


def plane_sweep_depth(
    pixels: TrainingPixels,
    sparse: SparseDepth | None,
    default_range: tuple[float, float],
    seed: int,
) -> SparseDepth | None:
    """Measure the depth of random pixels by multi-view stereo.

    Pixels that are masked or labelled sky are skipped.

    Args:
        pixels: The training photos.
        sparse: Sparse depth, which sets the depth range of each photo.
        default_range: Nearest and median depth (m) of photos without sparse depth.
        seed: Random seed for the choice of pixels.

    Returns:
        None if no depth was found.
    """
    near, median = depth_ranges(pixels, sparse, default_range)
    pictures = build_pictures(pixels, near, median)
    windows = min(MAX_WINDOWS, pixels.rgb.shape[0] // PIXELS_PER_WINDOW)
    chosen = pixels.anywhere(windows, torch.Generator(device="cpu").manual_seed(seed))
    if pixels.label is not None:
        chosen = chosen[pixels.label[chosen] != SKY]
    image = torch.searchsorted(pixels.pixel_start, chosen, right=True) - 1
    within, width = chosen - pixels.pixel_start[image], pixels.width[image]
    row = within.div(width, rounding_mode="floor")
    d = pixels.directions.of(pixels.camera[image], within % width, row)
    view, local = to_numpy(image), to_numpy(d).astype(np.float64)
    ahead = local[:, 2] > MIN_COSINE
    view, local = view[ahead], local[ahead] / local[ahead, 2:]
    pixel = _project(pictures, view, local)
    matches = match(pictures, view, pixel)
    distinct = _is_distinct(pictures, view, pixel, matches)
    view, local, z = view[distinct], local[distinct], 1 / matches[distinct, 0]
    confirmed = confirmed_by_neighbour(pictures, view, local * z[:, None])
    if not confirmed.any():
        return None
    image = to_device(view[confirmed], pixels.device)
    direction = to_device(local[confirmed].astype(np.float32), pixels.device)
    z_depth = to_device(z[confirmed], pixels.device)
    c2w, length = pixels.c2w[image], direction.norm(dim=-1)
    unit = (direction / length[:, None])[:, :, None]
    return SparseDepth(
        rays_o=c2w[:, :3, 3].contiguous(),
        rays_d=(c2w[:, :3, :3] @ unit)[:, :, 0].contiguous(),
        depth=z_depth * length,
        image=image,
    )


def confirmed_by_neighbour(
    pictures: Pictures, view: Int[np.ndarray, "n"], x: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Return which points a neighbour finds at the same depth when it is matched in turn.

    Args:
        pictures: The photos.
        view: Index of the photo of each point.
        x: Points in that photo's camera frame, m.
    """
    confirmed = np.zeros(len(view), bool)
    tile = _tiles(_project(pictures, view, x / x[:, 2:]) / pictures.size[view])
    for k in range(2):
        neighbour = pictures.neighbours[view, tile, k]
        rotation, shift = pictures.rotation[view, tile, k], pictures.shift[view, tile, k]
        there = np.einsum("nij,nj->ni", rotation, x) + shift
        rows = np.flatnonzero(~confirmed & (neighbour >= 0) & (there[:, 2] > 0))
        z = there[rows, 2]
        pixel = _project(pictures, neighbour[rows], there[rows] / z[:, None])
        matches = match(pictures, neighbour[rows], pixel)
        same_depth = np.abs(matches[:, 0] * z - 1) < MAX_DEPTH_ERROR
        confirmed[rows] = same_depth & _is_distinct(pictures, neighbour[rows], pixel, matches)
    return confirmed


def _project(
    pictures: Pictures, view: Int[np.ndarray, "n"], local: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 2"]:
    """Return the pixels (x, y) of camera-frame directions with z = 1."""
    intrinsics = pictures.intrinsics[view]
    return (local[:, :2] * intrinsics[:, :2] + intrinsics[:, 2:]).astype(np.float32)


def _tiles(uv: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    """Return the tile indices of image coordinates (x, y) in [0,1]."""
    column, row = np.clip((TILES * uv).astype(int), 0, TILES - 1).T
    return TILES * row + column


def _tiles_of_directions(
    pixels: TrainingPixels, image: Int[np.ndarray, "n"], local: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "n"]:
    """Return the tile of each camera-frame direction in its undistorted photo; -1 outside."""
    shape = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in pixels.cameras])[image]
    z = np.maximum(local[:, 2:], MIN_COSINE)
    uv = (local[:, :2] / z * shape[:, :2] + shape[:, 2:4]) / shape[:, 4:]
    inside = (local[:, 2] > MIN_COSINE) & ((uv >= 0) & (uv < 1)).all(-1)
    return np.where(inside, _tiles(uv), -1)


def _is_distinct(
    pictures: Pictures,
    view: Int[np.ndarray, "n"],
    pixel: Float32[np.ndarray, "n 2"],
    matches: Float32[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "n"]:
    """Return which windows correlate well at a single depth, inside the range of the sweep.

    Args:
        pictures: The photos.
        view: Index of each window's photo.
        pixel: Centre (x, y) of each window, px.
        matches: From `match`: inverse z-depth, best and second-best correlation.
    """
    inverse, correlation, second = matches.T
    nearest = pictures.max_inverse_depth[view, _tiles(pixel / pictures.size[view])]
    distinct = (correlation > MIN_CORRELATION) & (correlation - second > MIN_MARGIN)
    return distinct & (inverse > 0) & (inverse < nearest)


def depth_ranges(
    pixels: TrainingPixels, sparse: SparseDepth | None, default_range: tuple[float, float]
) -> tuple[Float[np.ndarray, "v tiles"], Float[np.ndarray, "v tiles"]]:
    """Return the nearest z-depth (m) and the median ray length (m) of each tile of each photo.

    A tile with too few points uses its photo's range; a photo with too few, the range of all.

    Args:
        pixels: The training photos.
        sparse: Sparse depth of those photos.
        default_range: Nearest and median depth (m) if there is no sparse depth.
    """
    count = pixels.c2w.shape[0]
    near, median = (np.full((count, TILES**2), each) for each in default_range)
    if sparse is not None:
        image = to_numpy(sparse.image)
        rotation = to_numpy(pixels.c2w).astype(np.float64)[image, :3, :3]
        local = np.einsum("nij,ni->nj", rotation, to_numpy(sparse.rays_d))
        depth = to_numpy(sparse.depth)
        z = depth * np.maximum(local[:, 2], MIN_COSINE)  # a fisheye shows z <= 0: else 1/0
        tile = _tiles_of_directions(pixels, image, local)
        near[:], median[:] = np.quantile(z, NEAR_QUANTILE), np.median(depth)
        for i in np.flatnonzero(np.bincount(image, minlength=count) >= MIN_POINTS):
            in_photo = image == i
            near[i] = np.quantile(z[in_photo], NEAR_QUANTILE)
            median[i] = np.median(depth[in_photo])
            for j in range(TILES**2):
                in_tile = in_photo & (tile == j)
                if in_tile.sum() >= MIN_POINTS:
                    near[i, j] = np.quantile(z[in_tile], NEAR_QUANTILE)
                    median[i, j] = np.median(depth[in_tile])
        near *= NEAR_FACTOR
    return near, median


def build_pictures(
    pixels: TrainingPixels,
    near: Float[np.ndarray, "v tiles"],
    median: Float[np.ndarray, "v tiles"],
) -> Pictures:
    """Return the photos in grey without distortion, each tile with its neighbours.

    Args:
        pixels: The training photos.
        near: Nearest z-depth (m) of each tile, where its sweep begins.
        median: Median ray length (m) of each tile, from which its neighbours are chosen.
    """
    c2w = to_numpy(pixels.c2w).astype(np.float64)
    starts = to_numpy(pixels.pixel_start)
    rgb = to_numpy(pixels.rgb)
    usable = None if pixels.usable is None else to_numpy(pixels.usable)
    undistorted = (
        undistorted_grey(camera, rgb[a:b], None if usable is None else usable[a:b], pixels.device)
        for camera, a, b in zip(pixels.cameras, starts[:-1], starts[1:], strict=True)
    )
    shapes = [(camera.height, camera.width) for camera in pixels.cameras]
    grey, _ = in_one_row(shapes, undistorted, np.uint8, UNSEEN)
    neighbours = select_neighbours(c2w, pixels.cameras, median)
    index = np.maximum(neighbours, 0)
    relative = np.linalg.inv(c2w)[index] @ c2w[:, None, None]  # [v tiles k 4 4]
    return Pictures(
        np.asarray(grey),
        starts[:-1],
        np.array([(camera.width, camera.height) for camera in pixels.cameras]),
        np.array([(c.fx, c.fy, c.cx, c.cy) for c in pixels.cameras], np.float32),
        neighbours,
        np.ascontiguousarray(relative[..., :3, :3], np.float32),
        np.ascontiguousarray(relative[..., :3, 3], np.float32),
        (1 / near).astype(np.float32),
    )


def undistorted_grey(
    camera: Camera,
    rgb: UInt8[np.ndarray, "hw 3"],
    usable: Bool[np.ndarray, "hw"] | None,
    device: torch.device = CPU,
) -> UInt8[np.ndarray, "h w"]:
    """Resample a photo in grey to a pinhole camera of the same size and intrinsics.

    Args:
        camera: Of the photo.
        rgb: 8-bit sRGB, row by row.
        usable: False where the photo is masked; None: nowhere.
        device: Where the photo is resampled.

    Returns:
        8-bit levels; `UNSEEN` outside the photo and where it is masked.
    """
    grey = rgb.astype(np.float32) @ np.array(LUMA, np.float32)
    if usable is not None:
        grey[~usable] = np.nan
    return _to_levels(undistorted(camera, grey, device))


def undistorted(
    camera: Camera,
    values: Float32[np.ndarray, "hw"],
    device: torch.device = CPU,
    mode: str = "bilinear",
) -> Float32[np.ndarray, "h w"]:
    """Resample a picture to a pinhole camera of the same size and intrinsics; NaN outside it.

    Args:
        camera: Of the picture.
        values: Of its pixels, row by row.
        device: Where it is resampled.
        mode: "bilinear" or "nearest".
    """
    if not camera.distorted:
        return values.reshape(camera.height, camera.width)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    pixel = to_device(camera.project(d).astype(np.float32), device)
    size = torch.tensor([camera.width, camera.height], device=device)
    resampled = torch.nn.functional.grid_sample(
        to_device(values, device).view(1, 1, camera.height, camera.width),
        (2 * pixel / size - 1).nan_to_num(9.0)[None],
        mode=mode,
        align_corners=False,
        padding_mode="border",
    )
    outside = ~((pixel >= 0) & (pixel < size)).all(-1)
    return to_numpy(resampled[0, 0].masked_fill(outside, torch.nan))


def _to_levels(grey: Float32[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Round to 8 bits; NaN becomes `UNSEEN`, which no valid level equals."""
    return np.nan_to_num(np.maximum(grey + 0.5, UNSEEN + 1), nan=UNSEEN).astype(np.uint8)


def select_neighbours(
    c2w: Float[np.ndarray, "v 4 4"], cameras: list[Camera], median: Float[np.ndarray, "v tiles"]
) -> Int[np.ndarray, "v tiles k"]:
    """Select the photos that each tile is compared with, by triangulation angle.

    Per tile, because distant surfaces need a wider baseline than near ones, and the border of a
    photo overlaps other photos than its centre.

    Args:
        c2w: Camera poses, world m, OpenCV axes.
        cameras: Of each photo.
        median: Median ray length (m) of each tile: the point at that distance along the ray through
            the tile's centre must be visible in a neighbour.

    Returns:
        Indices of photos, best first; -1 where there are fewer.
    """
    found = np.full((len(c2w), TILES**2, NEIGHBOURS), -1)
    centres, axes = c2w[:, :3, 3], c2w[:, :3, 2]
    for i, camera in enumerate(cameras):
        aligned = axes @ axes[i] > MIN_AXIS_COSINE
        aligned[i] = False
        for tile in range(TILES**2):
            x = (tile % TILES + 0.5) / TILES * camera.width
            y = (tile // TILES + 0.5) / TILES * camera.height
            local = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
            d = c2w[i, :3, :3] @ local / np.linalg.norm(local)
            target = centres[i] + median[i, tile] * d
            ray = target - centres
            cosine = (ray @ d) / np.maximum(np.linalg.norm(ray, axis=-1), 1e-9)  # at target: 0/0
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            suitable = (angle > ANGLES[0]) & (angle < ANGLES[1]) & aligned
            cost = np.abs(np.log(np.maximum(angle, 1e-3) / BEST_ANGLE))  # 0 degrees: log 0
            candidates = (
                j
                for j in np.argsort(cost)
                if suitable[j] and _is_visible(cameras[j], c2w[j], target)
            )
            best = list(islice(candidates, NEIGHBOURS))
            found[i, tile, : len(best)] = best
    return found


def _is_visible(camera: Camera, c2w: Float[np.ndarray, "4 4"], x: Float[np.ndarray, "3"]) -> bool:
    """Return whether a point x (world m) projects into the image; occlusion is ignored."""
    pixel = camera.project(((x - c2w[:3, 3]) @ c2w[:3, :3])[None])[0]
    return bool((pixel > 0).all() and (pixel < (camera.width, camera.height)).all())
