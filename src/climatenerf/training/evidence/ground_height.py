"""Ground height: one height per horizontal position, found before the fit.

Distant lawns and roads look alike at any height: at grazing angles an error of some decimetres
hardly moves a pixel, but snow, water and smog make it visible. Points labelled ground are few and
some are wrong, but ground bends little between them. A robust spline through them
(`scene.terrain_fit`) therefore determines where rays labelled ground should end, within its error.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import CPU, to_device
from climatenerf.ops.cpu.ground_sweep import GroundPictures
from climatenerf.scene.terrain import HeightRaster, nearest_known
from climatenerf.scene.terrain_fit import Heights, fit_heights
from climatenerf.training.evidence.ground_sweep import sweep_patches

NODES = 193  # of the height raster along a side
HALF_SIDE = 4.0  # grid units, from the scene's centre to the raster's border
MIN_POINTS = 20  # for a fit
PATCH_SIDES = (0.12, 0.07)  # grid units, of the patches that are swept, one after the other
VALID_RADIUS = 0.5  # grid units around a height within which the ground is valid
MAX_ERROR = 0.03  # grid units; ground that is known worse holds nothing
CREST_ERRORS = 4.0  # of the spline, up to which a measured height can be a crest
CREST_RADIUS = 0.625  # grid units; a ball must be above all ground within this distance
SUPPORT_CELLS = 64  # cells along a side of the grid that marks where points support the height
MIN_TOLERANCE = 4e-3  # grid units; kerbs and tufts of grass that the raster cannot resolve
TOLERANCE_FACTOR = 1.5  # smallest tolerance over the median residual of the measured heights


@dataclass(frozen=True)
class GroundHeight:
    """Height of the ground on a square raster about the scene's centre; lengths in grid units."""

    height: Float[Tensor, "nodes nodes"]
    """Height at the raster's nodes; rows along y."""
    tolerance: Float[Tensor, "nodes nodes"]
    """Largest difference between the ground and `height` that is not an error."""
    valid: Bool[Tensor, "nodes nodes"]
    """Nodes within `VALID_RADIUS` of a measured height."""
    holding: Bool[Tensor, "nodes nodes"]
    """Valid nodes whose height is known well enough to hold matter to it."""
    highest: Float[Tensor, "nodes nodes"]
    """Upper bound of `height` and of heights measured there, without outliers: a spline rounds
    crests."""
    supported: Bool[Tensor, "cells cells"]
    """Cells of a coarser grid that contain a point or adjoin a cell that does; rows along y."""

    def is_above_crests(
        self, q: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return which balls are above all ground nearby, so that no crest can hide them.

        False in cells without support: between points the height may miss a step.

        Args:
            q: Ball centres, grid units.
            radius: Ball radii, grid units.
        """
        reach = round(CREST_RADIUS * (NODES - 1) / (2 * HALF_SIDE))
        highest = torch.nn.functional.max_pool2d(
            self.highest[None], 2 * reach + 1, stride=1, padding=reach
        )[0]
        x, y = _nearest_node(q)
        inside = (q[:, :2].abs() < HALF_SIDE).all(-1)
        above = q[:, 2] - radius > highest[y, x]
        x, y = _support_cells(q)
        return inside & above & self.supported[y, x]

    def height_above(self, q: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Return the signed height of positions above the ground, and whether it is valid there.

        Args:
            q: Positions, grid units; beyond the raster the ground continues its border.

        Returns:
            Heights, grid units; and whether the nearest node is valid.
        """
        x, y = _nearest_node(q)
        inside = (q[:, :2].abs() < HALF_SIDE).all(-1)
        return q[:, 2] - _interpolated(self.height, q), inside & self.valid[y, x]

    def holds(self, q: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return at which positions (grid units) matter can be held to the ground."""
        x, y = _nearest_node(q)
        return (q[:, :2].abs() < HALF_SIDE).all(-1) & self.holding[y, x]

    def tolerance_at(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return the tolerance below or above positions (grid units)."""
        return _interpolated(self.tolerance, q)


def fit_ground_height(
    heights: Heights,
    centre: Float[np.ndarray, "3"],
    unit: float,
    pictures: GroundPictures | None = None,
    device: torch.device = CPU,
) -> GroundHeight | None:
    """Fit the ground to measured heights, some of which are wrong.

    Args:
        heights: Of points labelled ground, world m.
        centre: Of the scene, world m.
        unit: Metres per grid unit.
        pictures: The photos, in which ground without texture is matched; None: it is not.
        device: Where the result is kept.

    Returns:
        None if fewer than `MIN_POINTS` points lie inside the raster.
    """
    near = (np.abs(heights.x[:, :2] - centre[:2]) < HALF_SIDE * unit).all(-1)
    heights = Heights(heights.x[near], heights.error[near])
    if len(heights.x) < MIN_POINTS:
        return None
    raster = _fitted(heights, centre, unit)
    patches = Heights(np.empty((0, 3)), np.empty(0))
    for side in PATCH_SIDES if pictures is not None else ():
        assert pictures is not None
        patches = sweep_patches(pictures, raster, side * unit)
        raster = _fitted(heights.with_more(patches), centre, unit)
    x = heights.with_more(patches).x
    residual = np.abs(raster.sample(raster.height, x[:, :2]) - x[:, 2])
    accepted = x[residual < CREST_ERRORS * raster.sample(raster.error, x[:, :2])]
    q = (x - centre)[residual < raster.sample(raster.error, x[:, :2])] / unit
    roughness = float(np.median(residual[: len(heights.x)])) / unit
    valid = to_device(_nodes_near(x, raster, VALID_RADIUS * unit), device)
    spread = to_device(raster.error / np.float32(unit), device)
    height = ((raster.height - centre[2]) / unit).astype(np.float32)
    tolerance = spread.clamp_min(max(MIN_TOLERANCE, TOLERANCE_FACTOR * roughness))
    highest = np.full(height.shape, -np.inf, np.float32)
    crests = ((accepted[:, 2] - centre[2]) / unit).astype(np.float32)
    np.maximum.at(highest, _nodes_of(accepted, raster), crests)
    bound = to_device(np.maximum(highest, height), device) + tolerance
    return GroundHeight(
        height=to_device(height, device),
        tolerance=tolerance,
        valid=valid,
        holding=valid & (spread < MAX_ERROR),
        highest=bound,
        supported=_supported_cells(to_device(q.astype(np.float32), device)),
    )


def _fitted(heights: Heights, centre: Float[np.ndarray, "3"], unit: float) -> HeightRaster:
    """Return the surface through heights, on the raster about the scene's centre."""
    origin = (float(centre[0]) - HALF_SIDE * unit, float(centre[1]) - HALF_SIDE * unit)
    cell = 2 * HALF_SIDE * unit / (NODES - 1)
    return HeightRaster(origin, cell, *fit_heights(heights, origin, cell, (NODES, NODES), True))


def _nodes_of(
    x: Float[np.ndarray, "n 3"], raster: HeightRaster
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return row and column of the node nearest to each point (world m), clamped to the raster."""
    at = np.rint((x[:, :2] - np.array(raster.origin)) / raster.cell).astype(int)
    column, row = at.clip(0, NODES - 1).T
    return row, column


def _nodes_near(
    x: Float[np.ndarray, "n 3"], raster: HeightRaster, radius: float
) -> Bool[np.ndarray, "nodes nodes"]:
    """Return which nodes have a point within a horizontal distance (m), to half a cell."""
    known = np.zeros((NODES, NODES), bool)
    known[_nodes_of(x, raster)] = True
    return nearest_known(known, raster.cell)[0] < radius


def _interpolated(
    values: Float[Tensor, "nodes nodes"], q: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """Interpolate the values of nodes at positions; beyond the raster its border continues."""
    return torch.nn.functional.grid_sample(
        values[None, None],
        (q[:, :2] / HALF_SIDE)[None, None],
        padding_mode="border",
        align_corners=True,
    )[0, 0, 0]


def _nearest_node(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return column and row of the node nearest to each position."""
    at = (q[:, :2] / HALF_SIDE + 1) * ((NODES - 1) / 2)
    x, y = at.clamp(0, NODES - 1).round().long().unbind(-1)
    return x, y


def _supported_cells(q: Float[Tensor, "n 3"]) -> Bool[Tensor, "cells cells"]:
    """Return the cells of the coarser grid that contain a point, and their neighbours."""
    count = q.new_zeros(SUPPORT_CELLS, SUPPORT_CELLS)
    x, y = _support_cells(q)
    count[y, x] = 1
    return torch.nn.functional.max_pool2d(count[None], 3, 1, padding=1)[0] > 0


def _support_cells(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return column and row of positions in the coarser grid, clamped to it."""
    cell = ((q[:, :2] / HALF_SIDE + 1) * (SUPPORT_CELLS / 2)).long().clamp(0, SUPPORT_CELLS - 1)
    return cell[:, 0], cell[:, 1]
