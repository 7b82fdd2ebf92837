"""A field in the colours of another season. Its shapes, normals, classes and depth stay."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.grouping import shared_lookups
from climatenerf.field.wrapped import RecolouredField
from climatenerf.ops.recolouring import ClassColours, recoloured_samples

SHARED = 0.3  # m along a ray, within which samples share their class


@dataclass(frozen=True)
class StyledField(RecolouredField):
    """A field (`field.protocol.RadianceField`) with the colours of another season.

    Attributes:
        classes: the classes that change.
        patch: size of places that turn alike, m.
        noise: places them, see `recolouring.mottle`.
        white: light that the field is shown in over that of its photos; hues are judged without it.
    """

    classes: ClassColours
    patch: float
    noise: Float[Tensor, "z y x"]
    white: Float[Tensor, "3"]

    def recoloured(
        self,
        colour: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance in the season's colours."""
        if not self.classes.index.shape[0] or not x.shape[0]:
            return colour
        middle = group = torch.arange(x.shape[0], device=x.device)
        along = d
        if ray is not None:
            middle, group = shared_lookups(x, d, ray, SHARED)
            along = d[ray[middle]]
        count = middle.shape[0]
        index = torch.arange(count + 1, device=x.device)
        zero = torch.zeros(count, device=x.device)
        samples = Samples(index, zero, zero, zero)
        _, logits = self.field.surface_heads(x[middle], along, samples, index[:-1])
        return recoloured_samples(
            colour, logits, group, x, self.noise, self.patch, self.white, self.classes
        )
