"""A radiance field in closed form, for tests of the weather and of the renderer.

Solids with sharp faces: half-spaces (ground, slopes) and upright boxes (roofs, tables, posts). It
implements the protocol of fields (`march`, `density`, `colour`, `sky`, `bounds`) exactly: samples
begin where a ray enters a solid.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import DENSITY

_OPAQUE = 8.0  # optical depth at which samples of a solid end: exp(-8) < 1e-3
_PIECES = 4  # samples of a solid up to that depth


@dataclass(frozen=True)
class HalfSpace:
    """All points with normal . x <= offset."""

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit length."""
    offset: float = 0.0
    colour: tuple[float, float, float] = (0.3, 0.3, 0.3)
    checker: float = 0.0
    """Side of the squares of a checker pattern in x and y, m; every other one is black; 0: none."""

    def interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        normal = origins.new_tensor(self.normal)
        height = origins @ normal - self.offset
        slope = directions @ normal
        crossing = -height / torch.where(slope == 0, torch.ones_like(slope), slope)
        never, always = torch.full_like(height, torch.inf), torch.full_like(height, -torch.inf)
        inside = height <= 0
        enter = torch.where(slope < 0, crossing, torch.where(inside, always, never))
        leave = torch.where(slope > 0, crossing, torch.where((slope < 0) | inside, never, always))
        return enter, leave

    def distance(self, x: Tensor) -> Tensor:
        return x @ x.new_tensor(self.normal) - self.offset


@dataclass(frozen=True)
class Box:
    """An upright box with faces along the axes."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    colour: tuple[float, float, float] = (0.5, 0.2, 0.1)
    checker: float = 0.0

    def interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        lower, upper = origins.new_tensor(self.lower), origins.new_tensor(self.upper)
        # A zero component would give 0 * inf = NaN for an origin on the face.
        tiny = torch.full_like(directions, 1e-12)
        inverse = 1 / torch.where(directions.abs() < 1e-12, tiny, directions)
        first, second = (lower - origins) * inverse, (upper - origins) * inverse
        enter = torch.minimum(first, second).amax(-1)
        leave = torch.maximum(first, second).amin(-1)
        return enter, leave

    def distance(self, x: Tensor) -> Tensor:
        lower, upper = x.new_tensor(self.lower), x.new_tensor(self.upper)
        outside = (x - (lower + upper) / 2).abs() - (upper - lower) / 2
        return outside.clamp(min=0).norm(dim=-1) + outside.amax(-1).clamp(max=0)


Solid = HalfSpace | Box


@dataclass(frozen=True)
class AnalyticField:
    """Solids in front of a sky."""

    solids: Sequence[Solid]
    extinction: float = 2000.0
    """Inside the solids, 1/m; 2000: opaque within 4 mm."""
    zenith: tuple[float, float, float] = (0.5, 0.6, 0.9)
    horizon: tuple[float, float, float] = (0.5, 0.6, 0.9)
    box: tuple[tuple[float, float, float], tuple[float, float, float]] = field(
        default=((-10.0, -10.0, -2.0), (10.0, 10.0, 6.0))
    )

    near: float = 0.0
    capabilities: frozenset[str] = frozenset({DENSITY})

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        lower, upper = torch.tensor(self.box, dtype=torch.float32)
        return lower, upper

    def march(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        t_min: Tensor,
        t_max: Tensor,
        step_scale: float = 1.0,
        *,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
    ) -> Samples:
        """Samples from the entry of each ray into a solid (inside `bounds`) until it is opaque.

        `pruning_threshold` is ignored, since no solid is translucent.
        """
        lower, upper = self.bounds
        limits = Box(tuple(lower.tolist()), tuple(upper.tolist())).interval(rays_o, rays_d)
        low = torch.maximum(t_min, limits[0])
        high = torch.minimum(t_max, limits[1])
        # Overlapping solids have the density of one. The faces of all solids divide the ray into
        # intervals; an interval is filled if its middle is inside any solid.
        intervals = [solid.interval(rays_o, rays_d) for solid in self.solids]
        edges = torch.stack([low, high, *(t for pair in intervals for t in pair)], -1)
        edges = edges.clamp(low[:, None], torch.maximum(low, high)[:, None]).sort(-1).values
        start, end = edges[:, :-1], edges[:, 1:]
        middle = (start + end) / 2
        filled = torch.zeros_like(middle, dtype=torch.bool)
        for enter, leave in intervals:
            filled |= (middle > enter[:, None]) & (middle < leave[:, None])
        filled &= end > start
        length = torch.where(filled, (end - start).clamp(max=_OPAQUE / self.extinction), 0)
        before = (length.cumsum(-1) - length) * self.extinction
        filled &= before < 7.0  # transmittance below 1e-3
        dt = (length / _PIECES)[..., None].expand(*length.shape, _PIECES)
        t = start[..., None] + dt * (torch.arange(_PIECES).to(dt) + 0.5)
        keep = filled[..., None].expand_as(t).flatten(1)
        offsets = torch.zeros(rays_o.shape[0] + 1, dtype=torch.int64)
        offsets[1:] = keep.sum(1).cumsum(0)
        kept_t, kept_dt = t.flatten(1)[keep], dt.flatten(1)[keep]
        return Samples(offsets, kept_t, kept_dt, torch.full_like(kept_t, self.extinction))

    def density(self, x: Tensor) -> Tensor:
        """Extinction at points, 1/m."""
        lower, upper = (b.to(x) for b in self.bounds)
        inside = ((x >= lower) & (x <= upper)).all(-1) & (self._distances(x).amin(-1) <= 0)
        return torch.where(inside, self.extinction, 0.0).to(x)

    def colour(
        self,
        x: Tensor,
        d: Tensor,
        ray: Tensor | None = None,
        *,
        ids: Tensor | None = None,
        appearance: Tensor | None = None,
    ) -> Tensor:
        """Colour of the nearest solid, the same in all directions."""
        nearest = self._distances(x).abs().argmin(-1)
        colours = x.new_tensor([solid.colour for solid in self.solids])
        sides = x.new_tensor([solid.checker for solid in self.solids])[nearest][:, None]
        cells = torch.floor(x[:, :2] / sides.clamp(min=1e-6)).sum(-1, keepdim=True)
        black = (sides > 0) & (cells.remainder(2) == 1)
        return torch.where(black, 0.0, colours[nearest])

    def sky(self, d: Tensor, appearance: Tensor | None = None) -> Tensor:
        """Interpolate between horizon and zenith, linearly in the sine of the elevation."""
        weight = d[:, 2:].clamp(0, 1)
        return (1 - weight) * d.new_tensor(self.horizon) + weight * d.new_tensor(self.zenith)

    def _distances(self, x: Tensor) -> Tensor:
        if not self.solids:
            return torch.full((x.shape[0], 1), torch.inf)
        return torch.stack([solid.distance(x) for solid in self.solids], -1)


def ground(tilt: float = 0.0, heading: float = 0.0, height: float = 0.0) -> HalfSpace:
    """Ground through (0, 0, height), tilted by `tilt` rad and rising towards `heading` rad."""
    angle, turn = torch.tensor(tilt), torch.tensor(heading)
    normal = torch.stack([-angle.sin() * turn.cos(), -angle.sin() * turn.sin(), angle.cos()])
    return HalfSpace(tuple(normal.tolist()), height * float(angle.cos()))


def table(height: float = 0.75, half: float = 0.6, thickness: float = 0.05) -> list[Box]:
    """A table around the z axis: a top whose upper face is at `height`, on four posts."""
    under = height - thickness
    top = Box((-half, -half, under), (half, half, height))
    posts = [
        Box((x - 0.04, y - 0.04, -0.5), (x + 0.04, y + 0.04, under))
        for x in (-half + 0.1, half - 0.1)
        for y in (-half + 0.1, half - 0.1)
    ]
    return [top, *posts]
