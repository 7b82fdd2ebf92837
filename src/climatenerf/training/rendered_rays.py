"""What a training step passes on about its rays: densities with gradients, visible samples."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples


@dataclass(frozen=True)
class RenderedRays:
    """A batch's rays through the field, with gradients to the density."""

    samples: Samples
    t: Float[Tensor, "s"]
    """Ray length of each sample's middle, grid units."""
    dt: Float[Tensor, "s"]
    """Extent of each sample along its ray, grid units."""
    weights: Float[Tensor, "s"]
    """Fraction of the ray's light that each sample absorbs."""
    transmittance: Float[Tensor, "n"]
    """Fraction of the light that passes all samples of a ray."""


@dataclass(frozen=True)
class VisibleSamples:
    """The selected samples that weigh enough for colour, ascending."""

    index: Int[Tensor, "k"]
    """Rows among all samples of the batch."""
    ray: Int[Tensor, "k"]
    u: Float[Tensor, "k 3"]
    """Unit-cube coordinates."""
    weights: Float[Tensor, "k"]
    """Weights over their inclusion probabilities: unbiased sums over all samples."""
    gradient_scale: Float[Tensor, "k"]
    """Factor on gradients, below 1 near cameras."""
