"""Fallen snow: metaballs on upward surfaces, as matter that the renderer can march through.

ClimateNeRF, sections "Snow Simulation" and "Bake Editing": balls of density on a lattice, weighted
by where the field shows surfaces that face the falling snow, summed with a compact kernel; the
surface lies where the sum crosses a threshold. Instead of a trained network there is an explicit
sparse grid (`lattice`), filled by rays along the fall direction (`deposition`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.samples import Samples
from climatenerf.field.protocol import RadianceField, observed
from climatenerf.ops.cpu import metaballs
from climatenerf.ops.cpu.metaballs import Lattice
from climatenerf.weather.light.sun import sun_direction
from climatenerf.weather.snow.deposition import Light, find_deposits
from climatenerf.weather.snow.lattice import Deposits, SnowGrid, choose_grid, grow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Light as PlaceLight
from climatenerf.weather.world import Preparation, World


@dataclass(frozen=True)
class BakedSnow:
    """Snow lying on a scene.

    Attributes:
        lattice: the balls' sums, what rays march through.
        deposits: where snow landed, from which other depths grow.
        snow: its parameters.
        light: light of the scene.
        floor_z: height below which there is no snow (a water level), m.
        place_light: light at each place; None: that of the open everywhere.
    """

    lattice: Lattice
    deposits: Deposits
    snow: Snow
    light: Light
    floor_z: float | None = None
    place_light: PlaceLight | None = None
    mask = "mask_snow"
    thickness_layer = "snow_thickness"

    def with_depth(self, depth: float) -> "BakedSnow":
        """Another depth of snow (m) on the same deposits; the field is not asked again."""
        snow = replace(self.snow, depth=depth)
        return replace(self, lattice=grow(self.deposits, depth), snow=snow)

    def above(self, floor_z: float | None) -> "BakedSnow":
        """The same snow, removed below a height (m)."""
        return replace(self, floor_z=floor_z)

    @property
    def nbytes(self) -> int:
        """Memory of the lattice, bytes."""
        return sum(part.nbytes for part in self.lattice)

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
    ) -> Samples:
        """Samples of the snow along rays, until they are opaque.

        Args:
            rays_o: origins, m.
            rays_d: unit directions.
            t_min: where each ray begins, m.
            t_max: where it ends, m; may be infinite.

        Returns:
            Samples with extinction in 1/m; a handful a ray.
        """
        if self.floor_z is not None:
            t_min, t_max = _cut(rays_o, rays_d, t_min, t_max, self.floor_z)
        offsets, t, dt, sigma = metaballs.march(
            _array(rays_o), _array(rays_d), _array(t_min), _array(t_max), self.lattice
        )
        return Samples(*(to_device(each, rays_o.device) for each in (offsets, t, dt, sigma)))

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction O of the snow at points (m), 1/m."""
        density = to_device(metaballs.evaluate(_array(x), self.lattice)[2][:, 2], x.device)
        return density if self.floor_z is None else density * (x[:, 2] >= self.floor_z)

    def normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Outward unit normal, from the analytic gradient of the sum; up where there is none."""
        gradient = to_device(metaballs.evaluate(_array(x), self.lattice)[1], x.device)
        return _normal(gradient)

    def colour(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear radiance of the snow at points (m), the same in all directions.

        Diffuse snow in the light that its place and its slope receive, a little darker over dark
        ground. The paper's way (`Snow.light`) lights all snow as in the open, darkens it in the
        sun's shadow, and shades it by wrap lighting (n.l + gamma)/(1 + gamma).
        """
        _, gradient, rest = metaballs.evaluate(_array(x), self.lattice)
        if self.snow.light == "scene" and self.place_light is not None:
            reflectance = to_device(rest[:, 1], x.device)[:, None] / math.pi
            return reflectance * self.place_light.irradiance(
                x, _normal(to_device(gradient, x.device))
            )
        sun = self.light.sun_direction
        towards = sun if sun is not None and sun[2] > 0 else (0.0, 0.0, 1.0)
        towards = torch.tensor(towards, dtype=torch.float32, device=x.device)
        facing = _normal(to_device(gradient, x.device)) @ towards
        # Negative only for a wrap below 1, on the side that faces away.
        wrap = ((facing + self.snow.wrap) / (1 + self.snow.wrap)).clamp(min=0)
        shade = to_device(rest[:, 1], x.device)
        white = self.light.irradiance_over_pi
        white = torch.tensor(white, dtype=torch.float32, device=x.device)
        return (shade * wrap)[:, None] * white

    def thickness(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Height of points (m) over the ground under the snow, m; 0 where no snow is near."""
        height = metaballs.evaluate(_array(x), self.lattice)[2][:, 0]
        return to_device(height, x.device).clamp(min=0)


def bake_snow(
    field: RadianceField,
    snow: Snow,
    cameras: Float[np.ndarray, "m 3"],
    irradiance_over_pi: Float[np.ndarray, "3"],
    sun_direction: Float[np.ndarray, "3"] | None = None,
    seed: int = 0,
    grid: SnowGrid | None = None,
    progress: Callable[[float], None] | None = None,
    appearance: Float[Tensor, "1 e"] | None = None,
) -> BakedSnow | None:
    """Let snow fall on a scene. World frame: metres, z up.

    Args:
        field: the fitted field (unstylised), without unobserved geometry.
        snow: depth, fall direction, slope, colour.
        cameras: camera positions of the path, m; the snow is finest around them.
        irradiance_over_pi: linear radiance that a white horizontal surface in the open would have.
        sun_direction: unit vector towards the sun; None: diffuse light only.
        seed: of the fall direction's spread.
        grid: where snow is simulated and how finely; None: chosen from bounds and cameras.
        progress: called with the fraction that is done, 0 to 1.
        appearance: exposure and light of the field's colours; None: the mean of all photos.

    Returns:
        The snow; None where the depth asks for none.
    """
    if snow.depth is None or snow.depth <= 0:
        return None
    cameras = np.asarray(cameras, np.float64).reshape(-1, 3)
    light = Light(np.asarray(irradiance_over_pi, np.float64), sun_direction)
    if grid is None:
        lower, upper = (to_numpy(b).astype(np.float64) for b in field.bounds)
        grid = choose_grid(lower, upper, cameras)
    with torch.no_grad():
        deposits = find_deposits(field, snow, grid, light, cameras, seed, progress, appearance)
    return BakedSnow(grow(deposits, snow.depth), deposits, snow, light)


class SnowEntity:
    """Fallen snow in a scene; it keeps the depth that was grown last."""

    def __init__(self, preparation: Preparation):
        """Bake the snow, with the parameters of the last moment that has any."""
        self._preparation = preparation
        self._baked = self._grown = None
        snowy = [moment for moment in preparation.moments if moment.snow.depth > 0]
        if snowy:
            self._bake(snowy[-1])

    def _bake(self, weather: Weather) -> None:
        given = self._preparation
        self._baked = self._grown = bake_snow(
            observed(given.field),
            weather.snow,
            given.camera_positions,
            to_numpy(given.irradiance() / math.pi),
            sun_direction(weather.sun) if weather.snow.light == "paper" else None,
            weather.seed,
            progress=lambda fraction: given.progress("snowfall", fraction),
            appearance=given.appearance,
        )

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with snow on it, down to the highest water level."""
        depth = weather.snow.depth
        if not depth:
            return world
        if self._baked is None:
            self._bake(weather)
        assert self._baked is not None and self._grown is not None
        if depth != self._grown.snow.depth:
            same = depth == self._baked.snow.depth
            self._grown = self._baked if same else self._baked.with_depth(depth)
        look = replace(self._grown.snow, wrap=weather.snow.wrap)
        floor = max((surface.level for surface in world.surfaces), default=None)
        snow = replace(self._grown, snow=look, floor_z=floor, place_light=world.light)
        return replace(world, matters=(*world.matters, snow))

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Any parameters fit any scene."""

    def facts(self) -> dict[str, float]:
        """None: thickness is a layer."""
        return {}


def prepare(preparation: Preparation) -> SnowEntity:
    """Let snow fall on the scene."""
    return SnowEntity(preparation)


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(to_numpy(x), np.float32)


def _normal(gradient: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    length = gradient.norm(dim=-1, keepdim=True)
    up = torch.tensor([0.0, 0.0, 1.0], device=gradient.device)
    return torch.where(length > 1e-6, -gradient / length.clamp(min=1e-6), up)


def _cut(
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t_min: Float[Tensor, "n"],
    t_max: Float[Tensor, "n"],
    floor_z: float,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """The part of each ray that lies above a height."""
    slope = rays_d[:, 2]
    over = rays_o[:, 2] - floor_z
    level = slope.abs() < 1e-9  # a level ray crosses nowhere: division by 0
    crossing = -over / torch.where(level, torch.ones_like(slope), slope)
    t_max = torch.where(~level & (slope < 0), torch.minimum(t_max, crossing), t_max)
    t_min = torch.where(~level & (slope > 0), torch.maximum(t_min, crossing), t_min)
    t_max = torch.where(level & (over < 0), t_min, t_max)
    return t_min, t_max
