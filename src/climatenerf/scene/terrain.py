"""The ground of a scene as a raster of heights, each with its error, class and evidence.

World frame: metres, z up. Values belong to the nodes of a square lattice, rows along +y and columns
along +x; between nodes they are bilinear. The raster continues under ground that no photo shows,
with an error that grows with the distance from what is known. It is saved with the run, as
`terrain.npz`.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy import ndimage

from climatenerf.core import arrays
from climatenerf.core.classes import GROUND, UNKNOWN
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.storage import write_bytes

FILE_NAME = "terrain.npz"
SCHEMA_VERSION = 2
REMADE = 1  # files up to this version are of another method, and are made again
MAX_NODES = 2048  # along a side
MAX_LENGTH = 1e7  # m from the world's origin


@dataclass(frozen=True)
class HeightRaster:
    """Ground heights on a lattice; every array has one value a node."""

    origin: tuple[float, float]
    """World x and y of the first node, m."""
    cell: float
    """Distance between neighbouring nodes, m."""
    height: Float32[np.ndarray, "rows columns"]
    """World z of the ground, m."""
    error: Float32[np.ndarray, "rows columns"]
    """Standard error of the height, m."""

    def sample(
        self, values: Float[np.ndarray, "rows columns"], xy: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n"]:
        """Interpolate node values at positions (world m); beyond the raster its border continues.

        Args:
            values: one of the arrays, or any other with one value a node.
            xy: horizontal positions.
        """
        rows, columns = values.shape
        at = (xy - np.array(self.origin)) / self.cell
        at = np.clip(at, 0, (columns - 1, rows - 1))
        low = np.minimum(at.astype(np.int64), (columns - 2, rows - 2))
        (x, y), (u, v) = low.T, (at - low).T
        lower = values[y, x] * (1 - u) + values[y, x + 1] * u
        upper = values[y + 1, x] * (1 - u) + values[y + 1, x + 1] * u
        return lower * (1 - v) + upper * v

    def contains(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return which positions (world m) lie on the raster."""
        rows, columns = self.height.shape
        at = (xy - np.array(self.origin)) / self.cell
        return np.all((at >= 0) & (at <= (columns - 1, rows - 1)), axis=-1)

    def nodes(self) -> Float[np.ndarray, "rows columns 3"]:
        """Return the positions of the nodes on the ground, world m."""
        rows, columns = self.height.shape
        x = self.origin[0] + self.cell * np.arange(columns)
        y = self.origin[1] + self.cell * np.arange(rows)
        return np.stack([*np.meshgrid(x, y), self.height.astype(np.float64)], axis=-1)


@dataclass(frozen=True)
class Terrain(HeightRaster):
    """The ground of a run: heights with class and evidence."""

    label: UInt8[np.ndarray, "rows columns"]
    """Road, terrain, or `UNKNOWN` where it is not seen."""
    seen: Bool[np.ndarray, "rows columns"]
    """Whether the field holds the ground."""
    open: Bool[np.ndarray, "rows columns"]
    """Where the field holds no ground although photos show the place, or the error is too large."""

    @property
    def completed(self) -> Bool[np.ndarray, "rows columns"]:
        """Nodes at which the raster is the only evidence of ground."""
        return ~(self.seen | self.open)


def nearest_known(
    known: Bool[np.ndarray, "rows columns"], cell: float = 1.0
) -> tuple[Float[np.ndarray, "rows columns"], tuple[Int[np.ndarray, "rows columns"], ...]]:
    """Return each node's distance to the nearest known node, and that node's row and column.

    Args:
        known: at least one node is.
        cell: distance between nodes.
    """
    found: Any = ndimage.distance_transform_edt(~known, cell, return_indices=True)
    return found[0], tuple(found[1])


def save_terrain(terrain: Terrain | None, folder: Path, checkpoint: str = "") -> Path:
    """Write the raster into a run folder, atomically, and return its path.

    Args:
        terrain: the raster; None records that photos show too little ground for one.
        folder: the run folder.
        checkpoint: identity of the field that it was made from.

    Raises:
        UserError: the folder cannot be written.
    """
    path = folder / FILE_NAME
    values = {} if terrain is None else vars(terrain)
    arrays_by_name: dict[str, Any] = {
        "schema_version": np.array(SCHEMA_VERSION),
        "checkpoint": np.array(checkpoint),
        **{name: np.array(each) for name, each in values.items()},
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays_by_name)
    write_bytes(path, file.getvalue())
    return path


def load_terrain(path: Path) -> tuple[Terrain | None, str]:
    """Read a raster, and the identity of the field that it was made from.

    The raster is None if photos showed too little ground for one. A file of an earlier method
    names no field.

    Raises:
        UserError: the file is absent, damaged, or of a newer version.
    """
    try:
        found = arrays.read_npz(path)
        version = int(found["schema_version"])
        if version > SCHEMA_VERSION:
            raise UserError(
                f"{path} was written by a newer version of climatenerf; update climatenerf, or"
                " delete the file"
            )
        checkpoint = "" if version <= REMADE else str(found["checkpoint"])
        if "height" not in found:
            return None, checkpoint
        terrain = Terrain(
            origin=(float(found["origin"][0]), float(found["origin"][1])),
            cell=float(found["cell"]),
            height=_array(found, "height", np.float32),
            error=_array(found, "error", np.float32),
            label=_array(found, "label", np.uint8),
            seen=_array(found, "seen", np.bool_),
            open=_array(found, "open", np.bool_),
        )
        _check(terrain)
    except (*arrays.ERRORS, TypeError, OverflowError) as error:
        raise UserError(
            f"{path} is damaged ({one_line(str(error), 200)}); delete it, and the next render makes"
            " it again"
        ) from error
    return terrain, checkpoint


def _array(found: dict[str, np.ndarray], name: str, dtype: type[np.generic]) -> np.ndarray:
    """Return an array of a file.

    Raises:
        ValueError: its numbers are of another type, so that a conversion would change them.
    """
    if found[name].dtype != dtype:
        raise ValueError(f"{name} holds {found[name].dtype} in place of {dtype.__name__}")
    return found[name]


def _check(terrain: Terrain) -> None:
    """Check shapes and ranges.

    Raises:
        ValueError: one is wrong.
    """
    shape = terrain.height.shape
    if len(shape) != 2 or min(shape) < 2 or max(shape) > MAX_NODES:
        raise ValueError(f"a raster of {shape} nodes")
    others = (terrain.error, terrain.label, terrain.seen, terrain.open)
    if any(each.shape != shape for each in others):
        raise ValueError("its arrays differ in size")
    lengths = np.abs([*terrain.origin, terrain.cell])
    if not (np.isfinite(lengths).all() and lengths.max() < MAX_LENGTH and terrain.cell > 0):
        raise ValueError("its position or cell is out of range")
    for each in (terrain.height, terrain.error):
        if not (np.isfinite(each).all() and np.abs(each).max() < MAX_LENGTH):
            raise ValueError("heights or errors are out of range")
    if (terrain.error < 0).any() or not np.isin(terrain.label, (*GROUND, UNKNOWN)).all():
        raise ValueError("errors or classes are out of range")
