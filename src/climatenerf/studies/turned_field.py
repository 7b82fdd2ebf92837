"""A field turned about a point, as a wrong estimate of up turns it."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.protocol import ground_height, observed
from climatenerf.field.wrapped import WrappedField

STEPS = 3  # of the search for the ground on a vertical that is tilted in the inner field


@dataclass(frozen=True)
class Turn:
    """A rotation about a point.

    Attributes:
        rotation: turned from unturned axes.
        pivot: the point that stays, m.
    """

    rotation: Float[np.ndarray, "3 3"]
    pivot: Float[np.ndarray, "3"]

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Turned from unturned positions, m."""
        found = np.eye(4)
        found[:3, :3] = self.rotation
        found[:3, 3] = self.pivot - self.rotation @ self.pivot
        return found


@dataclass(frozen=True)
class TurnedField(WrappedField):
    """A field (`field.protocol.RadianceField`) in a turned world; all lengths stay.

    Attributes:
        turn: of the world.
    """

    turn: Turn

    def _axes(self, like: Tensor) -> Float[Tensor, "3 3"]:
        return like.new_tensor(self.turn.rotation)

    def _position(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Positions in the inner field."""
        pivot = x.new_tensor(self.turn.pivot)
        return (x - pivot) @ self._axes(x) + pivot

    def _direction(self, d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Directions in the inner field."""
        return (d @ self._axes(d)).contiguous()

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Corners of the box about the turned box, m."""
        lower, upper = self.field.bounds
        centre, half = (lower + upper) / 2, (upper - lower) / 2
        pivot = centre.new_tensor(self.turn.pivot)
        turned = self._axes(centre) @ (centre - pivot) + pivot
        reach = self._axes(centre).abs() @ half
        return turned - reach, turned + reach

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
        o, d = self._position(rays_o), self._direction(rays_d)
        return self.field.march(
            o, d, t_min, t_max, step_scale, stop=stop, pruning_threshold=pruning_threshold
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
        x, d = self._position(x), self._direction(d)
        return self.field.colour(x, d, ray, ids=ids, appearance=appearance)

    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the inner field's sky."""
        return self.field.sky(self._direction(d), appearance)

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction at positions (m), 1/m."""
        return self.field.density(self._position(x))

    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Normals and class logits of some samples."""
        o, d = self._position(rays_o), self._direction(rays_d)
        normal, logits = self.field.surface_heads(o, d, samples, selected)
        return normal @ self._axes(normal).T, logits

    def ground_height(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Height of the ground, m; NaN where it is not known."""
        matrix, z = xy.new_tensor(self.turn.matrix()), xy.new_tensor(self.turn.pivot[2])
        found = z.expand(xy.shape[0])
        for _ in range(STEPS):
            # Where no height is known, a NaN would be no position to ask for.
            start = torch.where(found.isnan(), z, found)
            below = self._position(torch.cat([xy, start[:, None]], dim=-1))
            height = ground_height(self.field, below[:, :2])
            on_ground = torch.cat([below[:, :2], height[:, None]], dim=-1)
            found = (on_ground @ matrix[:3, :3].T + matrix[:3, 3])[:, 2]
        return found

    def observed_only(self) -> Self:
        """The same, without density that no photo shows."""
        return replace(self, field=observed(self.field))
