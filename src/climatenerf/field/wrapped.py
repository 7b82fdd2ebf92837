"""A field around another one: it answers as the inner field does, but for what is overridden."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import FUSED
from climatenerf.field.compositing import composited
from climatenerf.field.protocol import RadianceField, ground_height, observed


@dataclass(frozen=True)
class WrappedField:
    """A `RadianceField` that passes every question on. Units and shapes are the protocol's.

    Rays are composited in several launches, since what is overridden is unknown to a fused kernel.
    """

    field: RadianceField

    @property
    def near(self) -> float:
        """Ray length at which camera rays begin, m."""
        return self.field.near

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner of the box that holds all density, m."""
        return self.field.bounds

    @property
    def capabilities(self) -> frozenset[str]:
        """Those of the inner field, but for rendering in one launch."""
        return self.field.capabilities - {FUSED}

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
        """Samples of the inner field."""
        return self.field.march(
            rays_o, rays_d, t_min, t_max, step_scale, stop=stop, pruning_threshold=pruning_threshold
        )

    def colour(
        self,
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None = None,
        *,
        ids: Int[Tensor, "s"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance of the inner field."""
        return self.field.colour(x, d, ray, ids=ids, appearance=appearance)

    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the inner field's sky."""
        return self.field.sky(d, appearance)

    def composite(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        step_scale: float = 1.0,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Radiance, transmittance and weighted sum of ray lengths (m)."""
        given = t_min, step_scale, stop, pruning_threshold, appearance
        return composited(self, rays_o, rays_d, *given)

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction at positions (m), 1/m."""
        return self.field.density(x)

    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Normals and class logits of some samples."""
        return self.field.surface_heads(rays_o, rays_d, samples, selected)

    def ground_height(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Height of the ground, m; NaN where it is not known."""
        return ground_height(self.field, xy)

    def observed_only(self) -> RadianceField:
        """The inner field without density that no photo shows."""
        return self.field.observed_only()

    def photo_appearance(self, index: int) -> Float[Tensor, "1 e"]:
        """Appearance of a training photo."""
        return self.field.photo_appearance(index)


@dataclass(frozen=True)
class RecolouredField(WrappedField, ABC):
    """A field whose colours are changed from sample to sample; all else is the inner field's."""

    @abstractmethod
    def recoloured(
        self,
        colour: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None,
    ) -> Float[Tensor, "s 3"]:
        """Change linear radiance.

        Args:
            colour: of the samples in the inner field.
            x: positions, world m.
            d: unit directions of the rays.
            ray: of each sample; None: one sample a ray.
        """
        ...

    def colour(
        self,
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None = None,
        *,
        ids: Int[Tensor, "s"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance, changed by `recoloured`."""
        colour = self.field.colour(x, d, ray, ids=ids, appearance=appearance)
        return self.recoloured(colour, x, d, ray)

    def observed_only(self) -> Self:
        """The same, without density that no photo shows."""
        return replace(self, field=observed(self.field))
