"""A field in the colours of another season. Its shapes, normals, classes and depth stay."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.grouping import shared_lookups
from climatenerf.field.wrapped import RecolouredField
from climatenerf.weather.season import recolouring

SHARED = 0.3  # m along a ray, within which samples share their class


@dataclass(frozen=True)
class ClassColours:
    """What a season does to one class, as tensors.

    Attributes:
        index: of the class in `core.classes.SOLID`.
        palette: linear colours a.
        matrix: M, see `recolouring`.
        strength: fraction of the change that is made.
        gate: fraction of the change on what is not green.
    """

    index: int
    palette: Float[Tensor, "j 3"]
    matrix: Float[Tensor, "3 3"]
    strength: float
    gate: float


@dataclass(frozen=True)
class StyledField(RecolouredField):
    """A field (`field.protocol.RadianceField`) with the colours of another season.

    Attributes:
        classes: the classes that change.
        patch: size of places that turn alike, m.
        mottle: noise that tells these places apart.
        white: light that the field is shown in over that of its photos; hues are judged without it.
    """

    classes: tuple[ClassColours, ...]
    patch: float
    mottle: Float[Tensor, "z y x"]
    white: Float[Tensor, "3"]

    def recoloured(
        self,
        colour: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance in the season's colours."""
        if not self.classes or not x.shape[0]:
            return colour
        photographed = colour / self.white
        share = self._shares(x, d, ray)
        greenness = recolouring.green(photographed)
        gates = colour.new_tensor([each.gate for each in self.classes])
        share = share * torch.maximum(greenness[:, None], gates)
        rows = (share.sum(-1) > 1e-3).nonzero()[:, 0]
        place = recolouring.mottled(self.mottle, x[rows], self.patch)
        palettes = [recolouring.palette_at(place, each.palette) for each in self.classes]
        palette = torch.stack(palettes, dim=1)
        matrix = torch.stack([each.matrix for each in self.classes])
        new = recolouring.recoloured(photographed[rows], share[rows], palette, matrix)
        return colour.index_copy(0, rows, new * self.white)

    def _shares(
        self, x: Float[Tensor, "s 3"], d: Float[Tensor, "n 3"], ray: Int[Tensor, "s"] | None
    ) -> Float[Tensor, "s k"]:
        """Probability of each changing class at positions, times its strength."""
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
        probability = logits.softmax(-1)[:, [each.index for each in self.classes]]
        return (probability * probability.new_tensor([c.strength for c in self.classes]))[group]
