"""Distances that neighbouring photos agree on: many more points than structure from motion finds.

Windows about random pixels are looked for in neighbouring photos along the pixels' rays (Goesele,
Curless & Seitz 2006, "Multi-View Stereo Revisited"); what two of them show alike at one distance,
and at no other, is kept as a measured point of the photo.
"""

from itertools import islice

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import SKY
from climatenerf.core.device import to_device, to_numpy
from climatenerf.ops.cpu.plane_sweep import TILES, UNSEEN, Pictures, match
from climatenerf.training.dataset import TrainingPixels, in_one_row
from climatenerf.training.evidence.sparse_depth import SparseDepth

WINDOWS = 2**17  # that are looked for, of all photos together, at most,
PIXELS = 8  # of a photo's for one window
NEIGHBOURS = 4
BEST_ANGLE = 6.0  # degrees between the rays to a place from two photos that suit each other best,
ANGLES = (1.0, 25.0)  # and those that do at all
FACING = 0.5  # least cosine between their axes
NEARER = 0.5  # of the nearest point's distance: nothing is looked for before it
MIN_LIKENESS = 0.8
SAME_PLACE = 0.02  # of the distance from a neighbour that finds it too
MIN_LEAD = 0.05  # of it over that at any other distance
MIN_POINTS = 20  # of a photo or a tile, which tell its distances
WIDE = 0.1  # least cosine from a camera's axis: beyond it no pinhole sees a pixel
WEIGHTS = (0.299, 0.587, 0.114)  # of grey (Rec. 601)


def plane_sweep_depth(
    pixels: TrainingPixels,
    points: SparseDepth | None,
    typical: tuple[float, float],
    seed: int,
) -> SparseDepth | None:
    """Rays of random pixels to the places that neighbouring photos show alike.

    Args:
        pixels: the photos.
        points: sparse points, which tell each photo's distances.
        typical: nearest and typical distance (m) where no points do.
        seed: of the pixels that are chosen.
    """
    near, middle = depth_ranges(pixels, points, typical)
    pictures = build_pictures(pixels, near, middle)
    windows = min(WINDOWS, pixels.rgb.shape[0] // PIXELS)
    pixel = pixels.anywhere(windows, torch.Generator().manual_seed(seed))
    if pixels.label is not None:
        pixel = pixel[pixels.label[pixel] != SKY]
    image = torch.searchsorted(pixels.pixel_start, pixel, right=True) - 1
    within, width = pixel - pixels.pixel_start[image], pixels.width[image]
    row = within.div(width, rounding_mode="floor")
    d = pixels.directions.of(pixels.camera[image], within % width, row)
    of, local = to_numpy(image), to_numpy(d).astype(np.float64)
    ahead = local[:, 2] > WIDE
    of, local = of[ahead], local[ahead] / local[ahead, 2:]
    pixel = _pixels(pictures, of, local)
    found = match(pictures, of, pixel)
    sure = _sure(pictures, of, pixel, found)
    of, local, z = of[sure], local[sure], 1 / found[sure, 0]
    kept = confirmed_by_neighbour(pictures, of, local * z[:, None])
    if not kept.any():
        return None
    of, local, z = (
        to_device(of[kept]),
        to_device(local[kept].astype(np.float32)),
        to_device(z[kept]),
    )
    c2w, length = pixels.c2w[of], local.norm(dim=-1)
    return SparseDepth(
        rays_o=c2w[:, :3, 3].contiguous(),
        rays_d=(c2w[:, :3, :3] @ (local / length[:, None])[:, :, None])[:, :, 0].contiguous(),
        depth=z * length,
        image=of,
    )


def confirmed_by_neighbour(
    pictures: Pictures, of: Int[np.ndarray, "n"], x: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Whether a neighbour, searching in its turn, finds places x (in camera frames), too."""
    kept = np.zeros(len(of), bool)
    place = _pixels(pictures, of, x / x[:, 2:]) / pictures.size[of]
    tile = _tiles(place)
    for k in range(2):
        j = pictures.others[of, tile, k]
        turn, shift = pictures.turn[of, tile, k], pictures.shift[of, tile, k]
        there = np.einsum("nij,nj->ni", turn, x) + shift
        some = np.flatnonzero(~kept & (j >= 0) & (there[:, 2] > 0))
        z = there[some, 2]
        pixel = _pixels(pictures, j[some], there[some] / z[:, None])
        found = match(pictures, j[some], pixel)
        again = np.abs(found[:, 0] * z - 1) < SAME_PLACE
        kept[some] = again & _sure(pictures, j[some], pixel, found)
    return kept


def _pixels(
    pictures: Pictures, of: Int[np.ndarray, "n"], local: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 2"]:
    """Where pictures show directions with z = 1."""
    own = pictures.intrinsics[of]
    return (local[:, :2] * own[:, :2] + own[:, 2:]).astype(np.float32)


def _tiles(place: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    """Numbers of the tiles in which places (x, y in [0,1]) of pictures lie."""
    column, row = np.clip((TILES * place).astype(int), 0, TILES - 1).T
    return TILES * row + column


def _tiles_towards(
    pixels: TrainingPixels, image: Int[np.ndarray, "n"], local: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "n"]:
    """The tiles in which undistorted photos show directions; -1 outside."""
    shape = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in pixels.cameras])[image]
    z = np.maximum(local[:, 2:], WIDE)
    place = (local[:, :2] / z * shape[:, :2] + shape[:, 2:4]) / shape[:, 4:]
    inside = (local[:, 2] > WIDE) & ((place >= 0) & (place < 1)).all(-1)
    return np.where(inside, _tiles(place), -1)


def _sure(
    pictures: Pictures,
    of: Int[np.ndarray, "n"],
    pixel: Float32[np.ndarray, "n 2"],
    found: Float32[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "n"]:
    """Whether windows were found alike in one place alone, and not at an end of the search."""
    inverse, likeness, second = found.T
    most = pictures.most[of, _tiles(pixel / pictures.size[of])]
    alike = (likeness > MIN_LIKENESS) & (likeness - second > MIN_LEAD)
    return alike & (inverse > 0) & (inverse < most)


def depth_ranges(
    pixels: TrainingPixels, points: SparseDepth | None, typical: tuple[float, float]
) -> tuple[Float[np.ndarray, "v tiles"], Float[np.ndarray, "v tiles"]]:
    """The nearest z-depth (m) that each tile of the photos may show, and the median ray length."""
    count = pixels.c2w.shape[0]
    near, middle = (np.full((count, TILES**2), each) for each in typical)
    if points is not None:
        image = to_numpy(points.image)
        turn = to_numpy(pixels.c2w).astype(np.float64)[image, :3, :3]
        local = np.einsum("nij,ni->nj", turn, to_numpy(points.rays_d))
        depth = to_numpy(points.depth)
        z = depth * np.maximum(local[:, 2], WIDE)  # behind a fisheye: else 1/0
        tile = _tiles_towards(pixels, image, local)
        near[:], middle[:] = np.quantile(z, 0.02), np.median(depth)
        for i in np.flatnonzero(np.bincount(image, minlength=count) >= MIN_POINTS):
            own = image == i
            near[i], middle[i] = np.quantile(z[own], 0.02), np.median(depth[own])
            for j in range(TILES**2):
                some = own & (tile == j)
                if some.sum() >= MIN_POINTS:
                    near[i, j], middle[i, j] = np.quantile(z[some], 0.02), np.median(depth[some])
        near *= NEARER
    return near, middle


def build_pictures(
    pixels: TrainingPixels,
    near: Float[np.ndarray, "v tiles"],
    middle: Float[np.ndarray, "v tiles"],
) -> Pictures:
    """The photos in grey, without distortion, and how each is seen by its neighbours."""
    c2w = to_numpy(pixels.c2w).astype(np.float64)
    starts = to_numpy(pixels.pixel_start)
    rgb = to_numpy(pixels.rgb)
    usable = None if pixels.usable is None else to_numpy(pixels.usable)
    straight = (
        undistorted_grey(camera, rgb[a:b], None if usable is None else usable[a:b])
        for camera, a, b in zip(pixels.cameras, starts[:-1], starts[1:], strict=True)
    )
    shapes = [(camera.height, camera.width) for camera in pixels.cameras]
    grey, _ = in_one_row(shapes, straight, np.uint8, UNSEEN)
    others = neighbours(c2w, pixels.cameras, middle)
    known = np.maximum(others, 0)
    between = np.linalg.inv(c2w)[known] @ c2w[:, None, None]  # [v tiles k 4 4]
    return Pictures(
        np.asarray(grey),
        starts[:-1],
        np.array([(camera.width, camera.height) for camera in pixels.cameras]),
        np.array([(c.fx, c.fy, c.cx, c.cy) for c in pixels.cameras], np.float32),
        others,
        np.ascontiguousarray(between[..., :3, :3], np.float32),
        np.ascontiguousarray(between[..., :3, 3], np.float32),
        (1 / near).astype(np.float32),
    )


def undistorted_grey(
    camera: Camera, rgb: UInt8[np.ndarray, "hw 3"], usable: Bool[np.ndarray, "hw"] | None
) -> UInt8[np.ndarray, "h w"]:
    """A photo in grey as a pinhole camera of the same size would have it.

    `UNSEEN` outside, and where its mask hides it.
    """
    flat = rgb.astype(np.float32) @ np.array(WEIGHTS, np.float32)
    if usable is not None:
        flat[~usable] = np.nan
    if not camera.distorted:
        return _levels(flat).reshape(camera.height, camera.width)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    place = to_device(camera.project(d).astype(np.float32))
    size = torch.tensor([camera.width, camera.height])
    seen = torch.nn.functional.grid_sample(
        to_device(flat).view(1, 1, camera.height, camera.width),
        (2 * place / size - 1).nan_to_num(9.0)[None],
        align_corners=False,
        padding_mode="border",
    )
    outside = ~((place >= 0) & (place < size)).all(-1)
    return _levels(to_numpy(seen[0, 0].masked_fill(outside, torch.nan)))


def _levels(grey: Float32[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    return np.nan_to_num(np.maximum(grey + 0.5, UNSEEN + 1), nan=UNSEEN).astype(np.uint8)


def neighbours(
    c2w: Float[np.ndarray, "v 4 4"], cameras: list[Camera], middle: Float[np.ndarray, "v tiles"]
) -> Int[np.ndarray, "v tiles k"]:
    """The photos that see the middle of each photo's tiles from the side, best first; -1: none.

    What is far asks for a wider base than what is near, and what a border shows for other photos
    than the middle.
    """
    found = np.full((len(c2w), TILES**2, NEIGHBOURS), -1)
    eyes, axes = c2w[:, :3, 3], c2w[:, :3, 2]
    for i, own in enumerate(cameras):
        same_way = axes @ axes[i] > FACING
        same_way[i] = False
        for tile in range(TILES**2):
            x = (tile % TILES + 0.5) / TILES * own.width
            y = (tile // TILES + 0.5) / TILES * own.height
            local = np.array([(x - own.cx) / own.fx, (y - own.cy) / own.fy, 1.0])
            d = c2w[i, :3, :3] @ local / np.linalg.norm(local)
            place = eyes[i] + middle[i, tile] * d
            to = place - eyes
            cosine = (to @ d) / np.maximum(np.linalg.norm(to, axis=-1), 1e-9)  # right there: 0/0
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            fits = (angle > ANGLES[0]) & (angle < ANGLES[1]) & same_way
            rated = np.abs(np.log(np.maximum(angle, 1e-3) / BEST_ANGLE))  # 0 degrees: log 0
            shown = (j for j in np.argsort(rated) if fits[j] and _shows(cameras[j], c2w[j], place))
            best = list(islice(shown, NEIGHBOURS))
            found[i, tile, : len(best)] = best
    return found


def _shows(camera: Camera, c2w: Float[np.ndarray, "4 4"], place: Float[np.ndarray, "3"]) -> bool:
    pixel = camera.project(((place - c2w[:3, 3]) @ c2w[:3, :3])[None])[0]
    return bool((pixel > 0).all() and (pixel < (camera.width, camera.height)).all())
