"""Ground with a hole in it, and terrain for the hole: fields whose completion is known exactly."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from climatenerf.core.classes import BUILDING, ROAD, SOLID, UNKNOWN
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace, Solid
from climatenerf.field.capabilities import CLASSES, DENSITY, NORMALS, OBSERVED
from climatenerf.scene.terrain import Terrain

GREY = (0.3, 0.33, 0.2)
POST = Box((4.0, 4.0, -1.0), (5.0, 5.0, 2.0), (0.6, 0.2, 0.1))
WIDE = ((-12.0, -12.0, -3.0), (12.0, 12.0, 6.0))
HALF = 2.0
"""Half the side of the hole, m."""


@dataclass(frozen=True)
class LabelledField(AnalyticField):
    """An analytic field that knows normals and classes, and what no photo shows."""

    box: tuple = WIDE
    capabilities: frozenset[str] = frozenset({DENSITY, NORMALS, CLASSES, OBSERVED})
    classes: Sequence[int] = ()
    """Class of each solid; without one: road."""
    unobserved: Sequence[Solid] = ()
    """Solids that no photo shows, before the others."""

    def __post_init__(self):
        if self.unobserved:
            object.__setattr__(self, "solids", [*self.unobserved, *self.solids])
            classes = [*[BUILDING] * len(self.unobserved), *self.classes]
            object.__setattr__(self, "classes", classes)

    def surface_heads(self, rays_o, rays_d, samples, selected):
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        nearest = self._distances(x).abs().argmin(-1)
        step = 1e-3
        slopes = [
            self._distances(x + step * axis) - self._distances(x - step * axis)
            for axis in torch.eye(3)
        ]
        slope = torch.stack([each.gather(1, nearest[:, None])[:, 0] for each in slopes], dim=-1)
        classes = [*self.classes, *[ROAD] * len(self.solids)][: len(self.solids)]
        place = torch.from_numpy(np.searchsorted(SOLID, classes))[nearest]
        logits = 10.0 * torch.nn.functional.one_hot(place, len(SOLID)).float()
        return torch.nn.functional.normalize(slope, dim=-1), logits

    def observed_only(self):
        rest = len(self.unobserved)
        return replace(
            self, unobserved=(), solids=self.solids[rest:], classes=tuple(self.classes)[rest:]
        )


def slabs(half=HALF, colours=(GREY, GREY), top=0.0):
    """Ground around a square hole: left of it, right of it, before and behind it."""
    low = top - 1.0
    return [
        Box((-12.0, -12.0, low), (-half, 12.0, top), colours[0]),
        Box((half, -12.0, low), (12.0, 12.0, top), colours[1]),
        Box((-half, -12.0, low), (half, -half, top), colours[0]),
        Box((-half, half, low), (half, 12.0, top), colours[1]),
    ]


def holed(half=HALF, colours=(GREY, GREY), **changes):
    """A field whose ground at z = 0 has a hole, with a post beside it."""
    classes = [*[ROAD] * 4, BUILDING]
    return LabelledField([*slabs(half, colours), POST], classes=classes, **changes)


def whole(**changes):
    """The same without the hole."""
    return LabelledField([HalfSpace(colour=GREY), POST], classes=[ROAD, BUILDING], **changes)


def terrain_of(height=None, half=HALF, cell=0.25, side=8.0, **changes):
    """Terrain of such a field: `height(x, y)`, or 0; seen around the hole."""
    n = round(2 * side / cell) + 1
    x, y = np.meshgrid(np.linspace(-side, side, n), np.linspace(-side, side, n))
    z = np.zeros_like(x) if height is None else height(x, y)
    seen = (np.abs(x) >= half) | (np.abs(y) >= half)
    label = np.where(seen, ROAD, UNKNOWN).astype(np.uint8)
    none, error = np.zeros_like(seen), np.full(z.shape, 0.02, np.float32)
    made = Terrain((-side, -side), cell, z.astype(np.float32), error, label, seen, none)
    return replace(made, **changes)
