"""Rays that meet no weather."""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.samples import MIN_WEIGHT
from climatenerf.field.compositing import composited
from climatenerf.weather.world import SKY_OPACITY, TINY, RenderOutput, World


def radiance_alone(rgb: Float[Tensor, "n 3"]) -> RenderOutput:
    """Output of secondary rays, of which only the radiance is used."""
    nothing = torch.zeros(rgb.shape[0], device=rgb.device)
    return RenderOutput(rgb, nothing, torch.zeros_like(rgb), nothing)


def trace_field(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t_min: Float[Tensor, "n"],
    step_scale: float,
    measured: bool,
) -> RenderOutput:
    """What rays see of the scene without weather: as `integrator.trace`, in one launch on a GPU.

    Args:
        world: its weather is ignored.
        rays_o: origins, m.
        rays_d: unit directions.
        t_min: ray lengths at which marching begins, m.
        step_scale: factor on the length of marching steps.
        measured: whether depth and layers are wanted besides the radiance.
    """
    rgb, transmittance, length = composited(
        world.field, rays_o, rays_d, t_min, step_scale, appearance=world.appearance
    )
    skyward = (transmittance > MIN_WEIGHT).nonzero()[:, 0]
    sky = world.field.sky(rays_d[skyward], world.appearance)
    if not measured and world.light is not None:
        sky = world.light.reflected_sky(rays_d[skyward], sky)
    rgb = rgb.index_add(0, skyward, transmittance[skyward, None] * sky)
    if not measured:
        return radiance_alone(rgb)
    depth = length / (1 - transmittance).clamp_min(TINY)
    nothing = torch.zeros_like(depth)
    return RenderOutput(
        rgb,
        torch.where(transmittance < SKY_OPACITY, depth, torch.full_like(depth, torch.inf)),
        torch.zeros_like(rgb),
        torch.ones_like(depth),
        dict.fromkeys(world.layer_names, nothing) | {"seen": torch.ones_like(depth)},
    )
