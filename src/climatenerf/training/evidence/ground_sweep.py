"""Heights of the ground where it has little texture, by a sweep over heights of large patches.

Sparse points and matched windows need texture. Asphalt and lawn have little, but a patch of one or
two metres averages many pixels of many photos.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from climatenerf.core.device import to_numpy
from climatenerf.ops.cpu.ground_sweep import LEVELS, UNSEEN, GroundPictures, sweep_heights
from climatenerf.scene.terrain import HeightRaster
from climatenerf.scene.terrain_fit import Heights
from climatenerf.training.dataset import TrainingPixels, in_one_row, is_ground
from climatenerf.training.evidence.multiview_stereo import undistorted, undistorted_grey

STEPS = 20  # heights tried on either side of the expected one
RANGE = (0.12, 0.3)  # of a patch's side: smallest and largest offset that is tried
RANGE_ERRORS = 2.0  # standard errors of the expected height that are tried
SPACING = 0.5  # of a patch's side, between the centres of patches
MIN_AGREEMENT = 0.8
ERROR_FACTOR = 0.6  # of a height's error over the width of its peak, measured on reference/street
MIN_ERROR = 0.015  # m


def ground_pictures(pixels: TrainingPixels) -> GroundPictures | None:
    """Return the photos in grey without distortion, with pyramids; None without labels."""
    if pixels.label is None:
        return None
    label, rgb = pixels.label, to_numpy(pixels.rgb)
    usable = None if pixels.usable is None else to_numpy(pixels.usable)
    starts = to_numpy(pixels.pixel_start).tolist()
    spans = list(zip(pixels.cameras, starts[:-1], starts[1:], strict=True))

    def levels() -> Iterator[np.ndarray]:
        for camera, a, b in spans:
            mask = None if usable is None else usable[a:b]
            yield from _pyramid(undistorted_grey(camera, rgb[a:b], mask, pixels.device))

    def labelled() -> Iterator[np.ndarray]:
        for camera, a, b in spans:
            flags = to_numpy(is_ground(label[a:b])).astype(np.float32)
            yield undistorted(camera, flags, pixels.device, "nearest") == 1  # NaN: not

    full = np.array([(camera.height, camera.width) for camera, _, _ in spans])
    shapes = full[:, None] // 2 ** np.arange(LEVELS)[:, None]  # [v levels 2]
    sizes = [(int(h), int(w)) for h, w in shapes.reshape(-1, 2)]
    grey, _ = in_one_row(sizes, levels(), np.uint8, UNSEEN)
    sizes = [(int(h), int(w)) for h, w in full]
    ground, _ = in_one_row(sizes, labelled(), np.bool_, False)
    areas, counts = shapes.prod(-1).ravel(), full.prod(-1)
    c2w = to_numpy(pixels.c2w).astype(np.float64)
    return GroundPictures(
        grey=np.asarray(grey),
        start=(np.cumsum(areas) - areas).reshape(-1, LEVELS),
        ground=np.asarray(ground),
        ground_start=np.cumsum(counts) - counts,
        size=np.ascontiguousarray(shapes[..., ::-1]),
        intrinsics=np.array([(c.fx, c.fy, c.cx, c.cy) for c in pixels.cameras]),
        rotation=np.ascontiguousarray(c2w[:, :3, :3].transpose(0, 2, 1)),
        centre=np.ascontiguousarray(c2w[:, :3, 3]),
    )


def _pyramid(grey: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a picture and its reductions by two; a pixel is invalid if any below it is."""
    yield grey
    level = np.where(grey == UNSEEN, np.nan, grey.astype(np.float32))
    for _ in range(1, LEVELS):
        rows, columns = (n // 2 for n in level.shape)
        cut = level[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
        level = cut.mean((1, 3))
        yield np.nan_to_num(np.rint(level), nan=UNSEEN).astype(np.uint8)


def sweep_patches(pictures: GroundPictures, ground: HeightRaster, side: float) -> Heights:
    """Return heights of patches of the ground at which the photos agree.

    Args:
        pictures: the photos.
        ground: the expected heights.
        side: of a patch, m.
    """
    axes = (
        first + np.arange(0.0, (nodes - 1) * ground.cell, SPACING * side)
        for first, nodes in zip(ground.origin, ground.height.shape[::-1], strict=True)
    )
    lattice = np.meshgrid(*axes)
    xy = np.stack(lattice, axis=-1).reshape(-1, 2)
    uphill: Any = np.gradient(ground.height.astype(np.float64), ground.cell)
    height, error, dy, dx = (
        ground.sample(each, xy) for each in (ground.height, ground.error, *uphill)
    )
    expected = error * RANGE_ERRORS < 2 * RANGE[1] * side  # beyond, the sweep misses the ground
    centre = np.column_stack([xy, height])[expected]
    slope = np.ascontiguousarray(np.column_stack([dx, dy])[expected])
    reach = np.clip(RANGE_ERRORS * error[expected], RANGE[0] * side, RANGE[1] * side)
    offset, agreement, _, bend = sweep_heights(
        pictures, centre, slope, side / 2, reach, STEPS
    ).T.astype(np.float64)
    found = (agreement > MIN_AGREEMENT) & (bend < 0)
    centre, offset, bend, lack = centre[found], offset[found], bend[found], 1 - agreement[found]
    width = np.sqrt(lack / -bend)
    return Heights(
        centre + np.array([0.0, 0.0, 1.0]) * offset[:, None],
        np.maximum(ERROR_FACTOR * width, MIN_ERROR),
    )
