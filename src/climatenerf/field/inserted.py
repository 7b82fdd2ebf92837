"""A field with an opaque surface put into it: completed ground, or objects of known size."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.wrapped import WrappedField
from climatenerf.ops import compositing

OPTICAL_DEPTH = 14.0  # of one inserted sample: 1e-6 of the light passes
NO_ID = -1
"""Id of the samples of a field that gives none."""
SURE = 10.0  # logit of the surface's class against 0, as sure as a trained head


@dataclass(frozen=True)
class FieldWithSurface(WrappedField, ABC):
    """A field (`field.protocol.RadianceField`) whose rays end on a further, opaque surface.

    Each ray that meets it has one sample on it, with the id `surface_id`. Positions are tensors
    [n, 3] in world metres.
    """

    surface_id: ClassVar[int]
    """Id of the samples on the surface; see `core.samples`."""
    extent: ClassVar[float]
    """Length of such a sample along the ray, m."""

    @abstractmethod
    def crossing(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Return the ray lengths (m) at which rays meet the surface; +inf elsewhere."""
        ...

    @abstractmethod
    def on_surface(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions lie on the surface."""
        ...

    @abstractmethod
    def solid(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return at which positions there is matter of the surface."""
        ...

    @abstractmethod
    def surface_radiance(
        self, x: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None
    ) -> Float[Tensor, "n 3"]:
        """Return linear radiance at positions on the surface, the same in all directions."""
        ...

    @abstractmethod
    def surface_normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return unit normals at positions on the surface."""
        ...

    @abstractmethod
    def surface_class(self, x: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Return classes at positions on the surface, as indices in `core.classes.SOLID`."""
        ...

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
        step_scale: float = 1.0,
        *,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
    ) -> Samples:
        """Samples of the field up to the surface, and one on it."""
        t = self.crossing(rays_o, rays_d, t_min, t_max)
        hit = (t < t_max).nonzero()[:, 0]
        inner = self.field.march(
            rays_o,
            rays_d,
            t_min,
            torch.minimum(t_max, t),
            step_scale,
            stop=stop,
            pruning_threshold=pruning_threshold,
        )
        if not hit.numel():
            return inner
        counts = torch.zeros(t.shape[0] + 1, dtype=torch.long, device=t.device)
        counts[hit + 1] = 1
        order, offsets = compositing.merge_order(inner.t, inner.offsets, t[hit], counts.cumsum(0))
        lengths = torch.full_like(t[hit], self.extent)
        values = {
            "t": (inner.t, t[hit]),
            "dt": (inner.dt, lengths),
            "sigma": (inner.sigma, OPTICAL_DEPTH / lengths),
        }
        ids = order.new_full(inner.t.shape, NO_ID) if inner.ids is None else inner.ids
        ids = torch.cat([ids, ids.new_full(hit.shape, self.surface_id)])[order]
        return Samples(offsets, **{k: torch.cat(v)[order] for k, v in values.items()}, ids=ids)

    def colour(
        self,
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None = None,
        *,
        ids: Int[Tensor, "s"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance of the field and of the surface."""
        own = self.on_surface(x) if ids is None else ids == self.surface_id
        # Samples of a field without ids have `NO_ID`.
        inner_ids = ids if ids is None or not bool((ids[~own] == NO_ID).any()) else None
        if not bool(own.any()):
            return self.field.colour(x, d, ray, ids=inner_ids, appearance=appearance)
        rows = torch.arange(x.shape[0], device=x.device) if ray is None else ray
        colour = torch.empty(x.shape[0], 3, device=x.device)
        rest = ~own
        inner_ids = None if inner_ids is None else inner_ids[rest]
        colour[rest] = self.field.colour(
            x[rest], d, rows[rest], ids=inner_ids, appearance=appearance
        )
        colour[own] = self.surface_radiance(x[own], appearance)
        return colour

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction at positions (m), 1/m."""
        return torch.where(self.solid(x), OPTICAL_DEPTH / self.extent, self.field.density(x))

    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Normals and class logits of some samples of the field and of the surface."""
        normal, logits = self.field.surface_heads(rays_o, rays_d, samples, selected)
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        if samples.ids is None:
            met = self.on_surface(x)
        else:
            met = samples.ids[selected] == self.surface_id
        own = met.nonzero()[:, 0]
        normal[own] = self.surface_normal(x[own])
        if CLASSES in self.field.capabilities:
            kind = self.surface_class(x[own])
            classes = torch.nn.functional.one_hot(kind, logits.shape[1])
            logits[own] = SURE * classes.to(logits)
        return normal, logits
