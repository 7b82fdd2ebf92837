"""What rendering asks of any radiance field.

Renderer, weather and scores use this protocol alone and never ask for a field's class. A field
states in `capabilities` which of the optional methods it answers; whoever needs one checks that
first. Lengths are world metres, radiance is linear, and no method computes gradients. A field
computes on one device, that of its bounds; rays come and results leave on it.
"""

from typing import Protocol, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.errors import UserError
from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import COMPLETES, OBSERVED


class RadianceField(Protocol):
    """A radiance field in world metres, z up."""

    @property
    def near(self) -> float:
        """Ray length at which camera rays begin, m."""
        ...

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner of the box that holds all density, m."""
        ...

    @property
    def capabilities(self) -> frozenset[str]:
        """Which optional methods this field answers; see `field.capabilities`."""
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
        """Samples along rays, front to back, where there is density.

        Args:
            rays_o: origins, m.
            rays_d: unit directions.
            t_min: ray length at which each ray begins, m.
            t_max: ray length at which it ends, m; may be infinite.
            step_scale: factor on the marching step.
            stop: transmittance at which a ray ends.
            pruning_threshold: samples of a smaller optical depth count as empty; None: the field's
                own threshold.
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
        """Linear radiance at positions x (m) along d, or along d[ray].

        Args:
            x: positions, m.
            d: unit directions from the eye, one a position or (with `ray`) one a ray.
            ray: the row of `d` for each position.
            ids: `Samples.ids` of the positions, where they are samples of `march`; None elsewhere.
            appearance: exposure and light of a photo; None: the mean of all photos.
        """
        ...

    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance from outside all density, in unit directions d."""
        ...

    # --- optional methods, see `capabilities` ---------------------------------------------------

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction at positions (m), 1/m. Needs `DENSITY`."""
        ...

    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Unit normals (world axes) and class logits of some samples. Needs `NORMALS` or `CLASSES`.

        The logits follow `core.classes.SOLID`.
        """
        ...

    def observed_only(self) -> "RadianceField":
        """The same field without density that no photo shows. Needs `OBSERVED`."""
        ...

    def photo_appearance(self, index: int) -> Float[Tensor, "1 e"]:
        """Appearance of a training photo, by its index. Needs `APPEARANCE`."""
        ...

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
        """Radiance, transmittance and weighted sum of ray lengths (m). Needs `FUSED`."""
        ...


class GroundedField(RadianceField, Protocol):
    """A field with `COMPLETES`."""

    def ground_height(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Height of the ground (world m) at horizontal positions (m); NaN where it is not known.

        Matter on the ground, such as a house, does not count.
        """
        ...


def ground_height(field: RadianceField, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Height of the ground (world m) at horizontal positions (m); NaN where it is not known."""
    if COMPLETES in field.capabilities:
        return cast(GroundedField, field).ground_height(xy)
    return torch.full_like(xy[:, 0], torch.nan)


def observed(field: RadianceField) -> RadianceField:
    """The field without density that no photo shows, if it can leave that out; else the field."""
    return field.observed_only() if OBSERVED in field.capabilities else field


def device_of(field: RadianceField) -> torch.device:
    """The device on which a field computes: that of its bounds."""
    return field.bounds[0].device


def require(field: RadianceField, needs: frozenset[str], what: str) -> None:
    """Check that a field answers what an effect needs.

    Raises:
        UserError: a capability is missing; names it and `what` asked for it.
    """
    missing = sorted(needs - field.capabilities)
    if missing:
        offered = ", ".join(sorted(field.capabilities)) or "none"
        raise UserError(
            f"{what} needs a field with {' and '.join(missing)}; this field offers {offered}."
            f" Render without {what}, or use another field"
        )
