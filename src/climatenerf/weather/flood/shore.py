"""The shore: which ground is under water, and what is wet above it.

Fitted ground is rough where few photos show it. The terrain decides which of it lies under water;
the field decides what is seen. World frame, metres, z up.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.classes import GROUND, SOLID_OF
from climatenerf.core.samples import MIN_WEIGHT
from climatenerf.field.capabilities import CLASSES, COMPLETES
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import RadianceField, ground_height
from climatenerf.field.wrapped import RecolouredField
from climatenerf.weather.flood.optics import bottom_radiance
from climatenerf.weather.world import RaySamples, World

ROUGH = 1.0  # m off the terrain, up to which matter of a ground class is ground
EDGE = 0.05  # m about the water level, within which ground or terrain may soften the waterline
DRYING = 0.5  # fraction of the wet band over which it dries


def lengths_on_terrain(
    world: World,
    along: RaySamples,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    level: float,
) -> Float[Tensor, "s"]:
    """Ray lengths of samples (m), with those of ground where rays reach the terrain's height.

    Lumps of the field that stand out of the water, where the terrain is flooded, come to lie behind
    its surface; and holes in dry ground in front of it. A field without classes or terrain, and
    rays that do not descend, keep their lengths.

    Args:
        world: its field.
        along: samples of rays.
        rays_o: origins, m.
        rays_d: unit directions.
        level: world height of the water, m.
    """
    lengths, ray = along.samples.t, along.ray
    if not {CLASSES, COMPLETES} <= world.field.capabilities:
        return lengths
    z = rays_o[ray, 2] + lengths * rays_d[ray, 2]
    near = (along.weights > MIN_WEIGHT) & ((z - level).abs() < ROUGH) & (rays_d[ray, 2] < 0)
    chosen = near.nonzero()[:, 0]
    x = rays_o[ray[chosen]] + lengths[chosen, None] * rays_d[ray[chosen]]
    ground = ground_height(world.field, x[:, :2])  # NaN compares False
    other_side = (ground < level) != (x[:, 2] < level)
    nearby = torch.minimum((ground - level).abs(), (x[:, 2] - level).abs()) < EDGE
    unsure = (other_side | nearby) & ((ground - x[:, 2]).abs() < ROUGH)
    chosen, x, ground = chosen[unsure], x[unsure], ground[unsure]
    if not chosen.numel():
        return lengths
    _, logits = world.field.surface_heads(rays_o, rays_d, along.samples, chosen)
    of_ground = is_ground(logits.argmax(-1))
    chosen, x, ground = chosen[of_ground], x[of_ground], ground[of_ground]
    # 1e-4: grazing rays would reach the terrain at infinity.
    descent = (-rays_d[ray[chosen], 2]).clamp_min(1e-4)
    return lengths.index_copy(0, chosen, lengths[chosen] + (x[:, 2] - ground) / descent)


def path_to_terrain(
    world: World,
    start: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    path: Float[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Lengths of paths down to the bottom (m); where this is a lump of ground, to the terrain."""
    if not {CLASSES, COMPLETES} <= world.field.capabilities:
        return path
    x = start + path[:, None] * rays_d
    ground = ground_height(world.field, x[:, :2])
    over = x[:, 2] - ground
    lumps = ((over > EDGE / 2) & (over < ROUGH)).nonzero()[:, 0]
    _, kind = normals_at(world.field, x[lumps], rays_d[lumps])
    lumps = lumps[is_ground(kind)]
    descent = (-rays_d[lumps, 2]).clamp_min(1e-4)  # as above
    over = over[lumps] * ((over[lumps] - EDGE / 2) / EDGE).clamp_max(1)
    return path.index_add(0, lumps, over / descent)


def without_film(field: RadianceField) -> RadianceField:
    """The field as rays under water see it: their own optics make it wet."""
    return field.field if isinstance(field, WetField) else field


def is_ground(kind: Int[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Return which indices in `core.classes.SOLID` are classes of ground."""
    return (kind[:, None] == torch.as_tensor(SOLID_OF[list(GROUND)], device=kind.device)).any(-1)


@dataclass(frozen=True)
class WetField(RecolouredField):
    """A field (`field.protocol.RadianceField`) that is wet in a band above the water.

    A film of water darkens what it lies on, since part of the light stays in it (Lekner and Dorf
    1988): `optics.bottom_radiance` under no depth of water. The film's own gloss is left out.
    Ground in the troughs of waves is wet, too. What lies deeper is left to the water's own optics,
    and so is all that refracted rays meet: they see `without_film`.

    Attributes:
        level: world height of the water, m.
        band: height over it up to which all is wet or dries, m.
        trough: depth below it that waves can bare, m.
        ior: refractive index of the water.
        irradiance: at positions (world m), linear.
    """

    level: float
    band: float
    trough: float
    ior: float
    irradiance: Callable[[Float[Tensor, "k 3"]], Float[Tensor, "k 3"]]

    def recoloured(
        self,
        colour: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance, darkened by a film of water near its level."""
        z = x[:, 2]
        holes = ((z < self.level) & (z > self.level - ROUGH)).nonzero()[:, 0]
        if holes.numel():  # ground of a dry terrain, or under a trough: NaN compares False
            ground = ground_height(self.field, x[holes, :2])
            z = z.index_copy(0, holes, torch.where(ground > z[holes], ground, z[holes]))
        height = (z - self.level) / self.band
        wet = ((height < 1) & (z > self.level - self.trough)).nonzero()[:, 0]
        if not wet.numel():
            return colour
        dry = colour[wet]
        film = bottom_radiance(dry, self.irradiance(x[wet]), self.ior)
        wetness = ((1 - height[wet, None]) / DRYING).clamp(0, 1)
        return colour.index_copy(0, wet, dry + wetness * (film - dry))
