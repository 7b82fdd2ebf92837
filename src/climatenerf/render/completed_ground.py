"""A field whose ground has no holes: where no photo shows the ground, the terrain stands in.

Photos look ahead, so a fitted field often has no ground below the cameras, and snow, water and
shadows have nothing to lie on. Rays that pass from above to below the terrain at one of its
completed nodes end there, in the colour of the ground around.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from climatenerf.core.classes import SOLID, TERRAIN, UNKNOWN
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.samples import COMPLETED
from climatenerf.field.capabilities import COMPLETES
from climatenerf.field.inserted import FieldWithSurface
from climatenerf.field.protocol import observed
from climatenerf.ops import heightfield
from climatenerf.ops.heightfield_reference import bilinear
from climatenerf.scene.terrain import Terrain, nearest_known

THICKNESS = 0.04  # m, of the completed ground
ON_GROUND = 0.05  # m; a position this near to the completed ground has its colour
DROP = 0.1  # m, by which the raster passes below the edge of the ground that the field holds
OVERLAP = 3  # nodes
BRIDGED = 1.5  # m into a gap of the ground, up to which the terrain is used
SMOOTHING = 20  # steps of diffusion at each level of a continuation


@dataclass(frozen=True)
class CompletedField(FieldWithSurface):
    """A field (`field.protocol.RadianceField`) with completed ground."""

    surface_id = COMPLETED
    extent = THICKNESS
    terrain: Terrain
    """The ground; its `completed` nodes are what this class adds."""

    # --- the terrain as tensors -----------------------------------------------------------------

    @cached_property
    def _height(self) -> Float[Tensor, "rows columns"]:
        """Heights in cells above the world's origin, lowered where the field holds the ground."""
        lowered = self.terrain.height - DROP * self.terrain.seen.astype(np.float32)
        return self._tensor((lowered / self.terrain.cell).astype(np.float32))

    @cached_property
    def _slope(self) -> float:
        return heightfield.steepest_slope(self._height)

    @cached_property
    def _surface(self) -> Float[Tensor, "rows columns"]:
        """Heights in cells above the world's origin."""
        return self._tensor((self.terrain.height / self.terrain.cell).astype(np.float32))

    @cached_property
    def _completed(self) -> Float[Tensor, "rows columns"]:
        # Overlaps the field's ground by some nodes, below it, so that no gap is left between them.
        widened = ndimage.binary_dilation(self.terrain.completed, iterations=OVERLAP)
        return self._tensor(widened.astype(np.float32))

    @cached_property
    def _bridged(self) -> Float[Tensor, "rows columns"]:
        """1 where the ground is known, or lies in a narrow gap of what is known."""
        distance, _ = nearest_known(~self.terrain.open, self.terrain.cell)
        return self._tensor((distance < BRIDGED).astype(np.float32))

    @cached_property
    def _origin(self) -> Float[Tensor, "3"]:
        return self._tensor(np.array([*self.terrain.origin, 0.0], np.float32))

    @cached_property
    def _label(self) -> Int[Tensor, "rows columns"]:
        """Index in `SOLID` of each node's class, continued from the nearest known node."""
        known = self.terrain.label != UNKNOWN
        label = np.full(known.shape, TERRAIN)
        if known.any():
            label = self.terrain.label[nearest_known(known)[1]]
        return self._tensor(np.searchsorted(SOLID, label))

    @cached_property
    def _colours(self) -> dict[bytes, Float[Tensor, "rows columns 3"]]:
        """Colours of the ground by appearance, computed when first asked for."""
        return {}

    def _tensor(self, values: np.ndarray) -> Tensor:
        return to_device(values, self.field.bounds[0].device)

    def _cells(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Convert positions (world m) to cells of the raster."""
        return (x - self._origin) / self.terrain.cell

    def on_surface(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions (world m) lie on completed ground."""
        at = self._cells(x)
        height = bilinear(self._height, at[:, :2])
        side = torch.tensor(self._height.shape[::-1], device=x.device) - 1
        inside = ((at[:, :2] >= 0) & (at[:, :2] <= side)).all(-1)
        near = (at[:, 2] - height).abs() * self.terrain.cell < ON_GROUND
        return inside & near & (bilinear(self._completed, at[:, :2]) > 0.5)

    def crossing(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Return the ray lengths (m) at which rays meet completed ground; +inf elsewhere."""
        cell = self.terrain.cell
        span = torch.stack([t_min, t_max], dim=-1) / cell
        o = self._cells(rays_o)
        t = heightfield.first_crossing(self._height, o, rays_d.contiguous(), span, self._slope)
        met = t.isfinite().nonzero()[:, 0]
        at = o[met, :2] + t[met, None] * rays_d[met, :2]
        whole = bilinear(self._completed, at) <= 0.5
        t[met[whole]] = torch.inf
        return t * cell

    # --- the protocol ---------------------------------------------------------------------------

    @property
    def capabilities(self) -> frozenset[str]:
        """Those of the field, but for rendering in one launch; and `COMPLETES`."""
        return super().capabilities | {COMPLETES}

    def solid(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions (world m) lie on completed ground."""
        return self.on_surface(x)

    def surface_radiance(
        self, x: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None
    ) -> Float[Tensor, "n 3"]:
        """Return linear radiance of completed ground at positions (world m)."""
        at, raster = self._cells(x)[:, :2], self._colour_raster(appearance)
        return torch.stack([bilinear(raster[..., k], at) for k in range(3)], dim=-1)

    def ground_height(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Height of the terrain (world m) at horizontal positions (m).

        NaN beyond the raster, and where the photos contradict it over more than `BRIDGED`.
        """
        at = (xy - self._origin[:2]) / self.terrain.cell
        side = torch.tensor(self._surface.shape[::-1], device=xy.device) - 1
        known = ((at >= 0) & (at <= side)).all(-1) & (bilinear(self._bridged, at) > 0.5)
        return torch.where(known, bilinear(self._surface, at) * self.terrain.cell, torch.nan)

    def surface_class(self, x: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Return classes of the raster at positions (world m), as indices in `SOLID`."""
        at = self._cells(x)
        rows, columns = self._label.shape
        column = at[:, 0].round().long().clamp(0, columns - 1)
        row = at[:, 1].round().long().clamp(0, rows - 1)
        return self._label[row, column]

    def surface_normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return unit normals of the raster at positions (world m)."""
        at, step = self._cells(x)[:, :2], torch.eye(2, device=x.device)
        slope = [
            bilinear(self._surface, at + step[k]) - bilinear(self._surface, at - step[k])
            for k in range(2)
        ]
        normal = torch.stack([-slope[0] / 2, -slope[1] / 2, torch.ones_like(slope[0])], dim=-1)
        return torch.nn.functional.normalize(normal, dim=-1)

    def observed_only(self) -> "CompletedField":
        """The same, without density that no photo shows; completed ground stays."""
        return CompletedField(observed(self.field), self.terrain)

    # --- colours --------------------------------------------------------------------------------

    @torch.no_grad()
    def _colour_raster(
        self, appearance: Float[Tensor, "1 e"] | None
    ) -> Float[Tensor, "rows columns 3"]:
        """Return the linear radiance of the ground: the field's, continued over completed nodes."""
        key = b"" if appearance is None else to_numpy(appearance).tobytes()
        if key not in self._colours:
            x = self._tensor(self.terrain.nodes().reshape(-1, 3).astype(np.float32))
            seen = self._tensor(self.terrain.seen.reshape(-1)).nonzero()[:, 0]
            down = torch.tensor([0.0, 0.0, -1.0], device=x.device).expand(len(seen), 3)
            colour = torch.zeros_like(x)
            colour[seen] = self.field.colour(x[seen], down.contiguous(), appearance=appearance)
            raster = to_numpy(colour).reshape(*self.terrain.height.shape, 3)
            self._colours[key] = self._tensor(continued(raster, self.terrain.seen))
        return self._colours[key]


def continued(
    values: Float[np.ndarray, "rows columns c"], known: Bool[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "rows columns c"]:
    """Continue known node values smoothly over the others; known ones are kept.

    Averages of the known values go up a pyramid of halved rasters and come down interpolated
    ("pull-push", Gortler et al. 1996); `SMOOTHING` steps of diffusion then remove the pyramid's
    pattern.
    """
    weight = known.astype(np.float32)[..., None]
    result = np.where(known[..., None], values, 0.0).astype(np.float32)
    if max(known.shape) > 1:
        rows, columns = known.shape
        odd = ((0, rows % 2), (0, columns % 2), (0, 0))

        def halved(x: np.ndarray) -> np.ndarray:
            x = np.pad(x, odd)
            return x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]

        total, count = halved(result * weight), halved(weight)
        # 1: four nodes of which none is known, 0/0; they are filled from the next level.
        coarse = continued(total / np.maximum(count, 1), count[..., 0] > 0)
        at = np.meshgrid(np.arange(rows) / 2 - 0.25, np.arange(columns) / 2 - 0.25, indexing="ij")
        finer = [
            ndimage.map_coordinates(coarse[..., k], at, order=1, mode="nearest")
            for k in range(values.shape[-1])
        ]
        result = np.where(known[..., None], result, np.stack(finer, axis=-1))
    for _ in range(SMOOTHING):
        blurred = ndimage.uniform_filter(result, 3, mode="nearest", axes=(0, 1))
        result = np.where(known[..., None], result, blurred)
    return result
