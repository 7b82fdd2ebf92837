"""Fallen snow: metaballs on upward surfaces, as matter that the renderer can march through.

ClimateNeRF, sections "Snow Simulation" and "Bake Editing": balls of density on a lattice, weighted
by where the field shows surfaces that face the falling snow, summed with a compact kernel; the
surface lies where the sum crosses a threshold. Instead of a trained network there is an explicit
sparse grid (`lattice`), filled by rays along the fall direction (`deposition`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.samples import Samples
from climatenerf.field.protocol import COMPLETES, RadianceField, ground_height, observed
from climatenerf.ops.cpu import metaballs
from climatenerf.ops.cpu.metaballs import HEIGHT_UNIT, Lattice
from climatenerf.weather.light.sun import sun_direction
from climatenerf.weather.snow.cover import HIGHEST_VEIL, slope_share
from climatenerf.weather.snow.deposition import Light, find_deposits
from climatenerf.weather.snow.lattice import SHADE_UNIT, Deposits, SnowGrid, choose_grid, grow
from climatenerf.weather.snow.optics import albedo_of, over_ground, slab_reflectance
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.relief import slopes, tilted
from climatenerf.weather.snow.shadow_masks import ShadowMasks, check_folder
from climatenerf.weather.snow.sparkle import glints
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Light as PlaceLight
from climatenerf.weather.world import Preparation, World

LEVEL_Z, SIDE_Z = 0.5, 0.2  # z of normals of a layer's surface, and of its sides
SIDE = 0.3  # m of snow behind a side
RIM_Z = 0.95, 0.8  # z of normals of the layer, and of its rims
RIM_HEIGHT = 0.9, 0.5  # of the usual height; a tilted layer that is lower is a rim
RIM_SHARE = 0.2  # of the depth, the least usual height
SKIN = 0.15  # sum of the balls half a spacing above a level surface
DUSTING = 0.005, 0.02  # m; between these the steps of stored heights cease to show
SAME, OTHER = 1.0, 1.5  # steps of stored heights, up to which two are the same, and from which not
CONTACT_HEIGHT = 0.1  # m over the ground, where contact shade is known
CONTACT_DECAY = 0.5  # m, over which it falls to 1/e
BURIED = 0.04  # m below the ground, to which roughness reaches
BARE = 0.005  # fraction of a square that carries snow, below which a scene has no ground
LANDING = 0.8  # of the time of the preparation, until all snow has landed
OPAQUE, CLEAN_OPAQUE = 0.95, 0.99
"""Reflectance of a slab from which on the ground below is left out, which then has less than a
hundredth of the light; the second is for snow that is whiter than the first."""


@dataclass(frozen=True)
class BakedSnow:
    """Snow lying on a scene.

    Attributes:
        lattice: the balls' sums, what rays march through.
        deposits: where snow landed, from which other depths grow.
        snow: its parameters.
        light: light of the scene.
        place_light: light at each place; None: that of the open everywhere.
        ground: what thin snow lets through, under the same light, and what gives the paper's snow
            its grey; None: nothing, and black.
        appearance: exposure and light of the ground's colours; None: the mean of all photos.
    """

    lattice: Lattice
    deposits: Deposits
    snow: Snow
    light: Light
    place_light: PlaceLight | None = None
    ground: RadianceField | None = None
    appearance: Float[Tensor, "1 e"] | None = None
    mask = "mask_snow"
    thickness_layer = "snow_thickness"

    def with_depth(self, depth: float) -> "BakedSnow":
        """Another depth of snow (m) on the same deposits; the field is not asked again."""
        snow = replace(self.snow, depth=depth)
        return replace(self, lattice=grow(self.deposits, depth), snow=snow)

    def above(self, floor_z: float | None) -> "BakedSnow":
        """The same snow, without what lies on ground below a height (m): snow melts in water."""
        floor = -math.inf if floor_z is None else float(floor_z)
        return replace(self, lattice=self.lattice._replace(floor=floor))

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
        if self.lattice.floor > -math.inf:
            t_min, t_max = _cut(rays_o, rays_d, t_min, t_max, self.lattice.floor)
        offsets, t, dt, sigma = metaballs.march(
            _array(rays_o), _array(rays_d), _array(t_min), _array(t_max), self.lattice
        )
        return Samples(*(to_device(each, rays_o.device) for each in (offsets, t, dt, sigma)))

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction O of the snow at points (m), 1/m."""
        density = to_device(metaballs.evaluate(_array(x), self.lattice)[2][:, 2], x.device)
        return density * (x[:, 2] >= self.lattice.floor)

    def covers(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether upward surfaces of the field at points (m) are roughness below this snow.

        That is within half a spacing above the snow, which grows with the distance from the
        cameras as the roughness does.
        """
        sums, _, rest = metaballs.evaluate(_array(x), self.lattice)
        near = to_device((sums > SKIN) & (rest[:, 0] > -BURIED), x.device)
        return near & (x[:, 2] - to_device(rest[:, 0], x.device) >= self.lattice.floor)

    def veiled(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether a surface of a ground class that faces up at points (m) stands for snowy ground.

        A fitted field shows far ground in veils above the terrain. What lies on the terrain there
        lies on them; beyond the known terrain all ground is in the open.
        """
        if self.ground is None or self.snow.light != "scene":
            return torch.zeros_like(x[:, 0], dtype=torch.bool)
        terrain = ground_height(self.ground, x[:, :2])
        below = torch.cat([x[:, :2], terrain[:, None]], 1)
        snowy = to_device(metaballs.evaluate(_array(below), self.lattice)[0] > SKIN, x.device)
        veil = snowy & (x[:, 2] > terrain) & (x[:, 2] < terrain + HIGHEST_VEIL)
        beyond = terrain.isnan() & (COMPLETES in self.ground.capabilities)
        floor = self.lattice.floor
        return (veil & (terrain >= floor)) | (beyond & (x[:, 2] >= floor))

    def normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Outward unit normal, from the gradient of the sum; up where there is none."""
        return to_device(metaballs.smooth_surface(_array(x), self.lattice, False)[0], x.device)

    def colour(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear radiance of the snow at points (m), the same in all directions.

        Diffuse snow in the light that its place and its slope receive; thin snow lets the ground
        through. The paper's way (`Snow.light`) lights all snow as in the open, darkens it in the
        sun's shadow, and shades it by wrap lighting (n.l + gamma)/(1 + gamma).
        """
        return self._shaded(x, None)

    def colour_towards(
        self, x: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"], width: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """As `colour`, with the relief that a pixel resolves, and sparkles in a hard sun.

        Args:
            x: positions, m.
            d: unit directions from the eye to these.
            width: of a pixel there, m.
        """
        relief = None if self.snow.relief == 0 else slopes(x, d, width, self.snow.relief)
        return self._shaded(x, relief) + self.glints(x, d, width)

    def _shaded(
        self, x: Float[Tensor, "n 3"], relief: Float[Tensor, "n 2"] | None
    ) -> Float[Tensor, "n 3"]:
        sums, _, rest = metaballs.evaluate(_array(x), self.lattice)
        surface = metaballs.smooth_surface(_array(x), self.lattice)
        normal, height = (to_device(each, x.device) for each in surface)
        if self.snow.light == "scene":
            shade = to_device(rest[:, 1], x.device)
            away = to_device(sums < SKIN, x.device)  # on a veil: as on open level ground
            depth = self.snow.depth or 0.0
            height = torch.where(away, depth, height)
            if depth < DUSTING[1]:
                height = self._without_steps(x, normal, height, depth)
            shade = torch.where(away, SHADE_UNIT, shade)
            if relief is not None:
                normal = tilted(normal, relief, height)
            return self._in_light_of_place(x, normal, height, shade / SHADE_UNIT)
        return self._in_papers_light(x, normal, height, to_device(rest[:, 1], x.device))

    def _in_papers_light(
        self,
        x: Float[Tensor, "n 3"],
        normal: Float[Tensor, "n 3"],
        height: Float[Tensor, "n"],
        lit: Float[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Radiance of snow that is as bright as (g + c0)/(1 + c0) `lit`, with wrap lighting.

        g is the luminance of the ground below over that of a white surface in the open, in the
        colours of the moment: those of a style, where there is one.
        """
        sun = self.light.sun_direction
        towards = sun if sun is not None and sun[2] > 0 else (0.0, 0.0, 1.0)
        towards = torch.tensor(towards, dtype=torch.float32, device=x.device)
        facing = normal @ towards
        # Negative only for a wrap below 1, on the side that faces away.
        wrap = ((facing + self.snow.wrap) / (1 + self.snow.wrap)).clamp(min=0)
        white = self.light.irradiance_over_pi
        white = torch.tensor(white, dtype=torch.float32, device=x.device)
        grey = torch.zeros_like(lit)
        if self.ground is not None:
            here = white
            if self.place_light is not None:  # which the snow around brightens
                here = self.place_light.open_irradiance() / math.pi
            below = luma(self._ground_below(self.ground, x, height))
            grey = (below / luma(here).clamp_min(1e-6)).clamp(0, 1)  # 1e-6: a black scene, 0/0
        offset = self.snow.albedo_offset
        return ((grey + offset) / (1 + offset) * lit * wrap)[:, None] * white

    def _ground_below(
        self, field: RadianceField, x: Float[Tensor, "n 3"], height: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Radiance of what lies the heights (m) below points, seen from straight above."""
        below, down = x.clone(), torch.zeros_like(x)
        below[:, 2] -= height
        down[:, 2] = -1.0
        return field.colour(below, down, appearance=self.appearance)

    def _without_steps(
        self,
        x: Float[Tensor, "n 3"],
        normal: Float[Tensor, "n 3"],
        height: Float[Tensor, "n"],
        depth: float,
    ) -> Float[Tensor, "n"]:
        """Heights of thin snow over the ground (m), without the steps in which they are stored.

        A height as close to what fell on that slope as the lattice can store is what fell. Others
        differ by crowns, drifts and slides.
        """
        share = slope_share(to_numpy(normal[:, 2]), self.snow).astype(np.float32)
        fell = depth * to_device(share, x.device)
        step = HEIGHT_UNIT * to_device(metaballs.spacing_at(_array(x), self.lattice), x.device)
        differs = (((height - fell).abs() / step - SAME) / (OTHER - SAME)).clamp(0, 1)
        deep = min(max((depth - DUSTING[0]) / (DUSTING[1] - DUSTING[0]), 0.0), 1.0)
        return torch.lerp(fell, height, differs.clamp_min(deep))

    def _in_light_of_place(
        self,
        x: Float[Tensor, "n 3"],
        normal: Float[Tensor, "n 3"],
        height: Float[Tensor, "n"],
        contact: Float[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Radiance of snow with unit normals, at heights (m) over the ground below.

        What stands close by leaves the fraction `contact` of the diffuse light of the place, near
        the ground; the top of a heap rises above it.
        """
        contact = 1 - (1 - contact) * torch.exp(
            -(height - CONTACT_HEIGHT).clamp_min(0) / CONTACT_DECAY
        )
        if self.place_light is None:
            white = to_device(self.light.irradiance_over_pi.astype(np.float32), x.device)
            white = white * contact[:, None]
        else:
            white = self.place_light.irradiance(x, normal, contact) / math.pi
        deep = torch.tensor(albedo_of(self.snow), dtype=torch.float32, device=x.device)
        slab = slab_reflectance(self._seen_through(normal, height), self.snow.grain)[:, None]
        reflectance = torch.minimum(slab, deep)
        opaque = OPAQUE if float(deep.max()) < OPAQUE else CLEAN_OPAQUE
        thin = (slab[:, 0] < opaque).nonzero()[:, 0]
        if self.ground is not None and thin.numel():
            seen = self._ground_below(self.ground, x[thin], height[thin])
            # The ground is shown in the light that now falls on the snow. 1e-6: 0/0 in the dark.
            ground = (seen / white[thin].clamp_min(1e-6)).clamp(0, 1)
            reflectance[thin] = over_ground(slab[thin], deep, ground)
        return reflectance * white

    def _seen_through(
        self, normal: Float[Tensor, "n 3"], height: Float[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Thickness of the snow (m) that is seen at heights (m) over the ground below.

        A side shows the snow behind it, however thin the layer is there. So does a rim, where the
        lattice lets the layer end in a slope: it is tilted, and lower than what fell on a slope.
        """
        bent = (normal[:, 2] < RIM_Z[0]).nonzero()[:, 0]
        depth, up, low = self.snow.depth or 0.0, normal[bent, 2], height[bent]
        share = slope_share(to_numpy(up), self.snow).astype(np.float32)
        usual = depth * to_device(share, up.device).clamp_min(RIM_SHARE)
        tilt = ((RIM_Z[0] - up) / (RIM_Z[0] - RIM_Z[1])).clamp(max=1)
        # 1e-6: without depth 0/0.
        lacks = (RIM_HEIGHT[0] - low / usual.clamp_min(1e-6)) / (RIM_HEIGHT[0] - RIM_HEIGHT[1])
        thick = torch.lerp(low, low.clamp_min(depth), tilt * lacks.clamp(0, 1))
        side = ((LEVEL_Z - up) / (LEVEL_Z - SIDE_Z)).clamp(0, 1)
        behind = SIDE * min(depth / DUSTING[1], 1.0)  # a dusting has no sides
        return height.index_copy(0, bent, thick + behind * side)

    def glints(
        self, x: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"], width: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Radiance that crystal faces add in a hard sun; arguments as of `colour_towards`.

        None in the paper's light.
        """
        added = torch.zeros_like(x)
        beam = None if self.place_light is None else self.place_light.beam()
        wanted = self.snow.sparkle > 0 and self.snow.light == "scene"
        if beam is None or self.place_light is None or not wanted:
            return added
        sun, irradiance = beam
        found = glints(x, d, width, sun, self.snow.sparkle)
        lit = (found > 0).nonzero()[:, 0]
        if lit.numel():
            normal = self.normal(x[lit])
            visible = self.place_light.visibility(x[lit], normal) * (normal @ sun > 0)
            added[lit] = (found[lit] * visible)[:, None] * irradiance
        return added

    def thickness(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Height of points (m) over the ground under the snow, m; 0 where no snow is near."""
        sums, _, rest = metaballs.evaluate(_array(x), self.lattice)
        height = to_device(rest[:, 0], x.device).clamp(min=0)
        veil = to_device(sums < SKIN, x.device).nonzero()[:, 0]
        height[veil] = torch.where(self.veiled(x[veil]), self.snow.depth or 0.0, height[veil])
        return height


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
    sunlit: Callable[[np.ndarray], np.ndarray] | None = None,
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
        sunlit: see `Light.sunlit`.

    Returns:
        The snow, over the ground of the field; None where the depth asks for none.
    """
    if snow.depth is None or snow.depth <= 0:
        return None
    cameras = np.asarray(cameras, np.float64).reshape(-1, 3)
    light = Light(np.asarray(irradiance_over_pi, np.float64), sun_direction, sunlit)
    if grid is None:
        lower, upper = (to_numpy(b).astype(np.float64) for b in field.bounds)
        grid = choose_grid(lower, upper, cameras)

    def landing(fraction: float) -> None:
        if progress is not None:
            progress(LANDING * fraction)

    with torch.no_grad():
        deposits = find_deposits(field, snow, grid, light, seed, landing)
    lattice = grow(deposits, snow.depth)
    if progress is not None:
        progress(1.0)
    return BakedSnow(lattice, deposits, snow, light, ground=field, appearance=appearance)


class SnowEntity:
    """Fallen snow in a scene; it keeps the depth that was grown last."""

    def __init__(self, preparation: Preparation):
        """Bake the snow, with the parameters of the last moment that has any."""
        self._preparation = preparation
        self._baked = self._grown = None
        snowy = [moment for moment in preparation.moments if moment.snow.depth > 0]
        for folder in {moment.snow.shadows for moment in snowy if moment.snow.shadows}:
            if any(moment.snow.light != "paper" for moment in snowy):
                raise UserError(
                    "--snow.shadows belongs to the paper's shading; add --snow.light paper"
                )
            check_folder(Path(folder))  # before photos are traced for it
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
            sunlit=self._photographed_shadows(weather.snow),
        )
        if self._baked is not None and _is_bare(self._baked.deposits):
            others = ", or with a smaller --snow.fall-tilt" if weather.snow.fall_tilt > 0 else ""
            others += ", or without --snow.slope" if weather.snow.slope is not None else ""
            raise UserError(
                "no surface of this scene catches snow: all are sheltered, too steep or missing;"
                f" render without --snow.depth{others}"
            )

    def _photographed_shadows(self, snow: Snow) -> Callable[[np.ndarray], np.ndarray] | None:
        if snow.shadows is None:
            return None
        if self._preparation.photo_rays is None:
            raise UserError(
                "--snow.shadows needs a field with normals or classes, which show where photos end;"
                " leave it out, or fit with both"
            )
        photos = self._preparation.photo_rays()
        return ShadowMasks(Path(snow.shadows), photos).sunlight

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
        asked = weather.snow
        look = replace(
            self._grown.snow,
            wrap=asked.wrap,
            albedo_offset=asked.albedo_offset,
            grain=asked.grain,
            soot=asked.soot,
            albedo=asked.albedo,
            sparkle=asked.sparkle,
            relief=asked.relief,
        )
        floor = max((surface.level for surface in world.surfaces), default=None)
        light = self._grown.light
        if world.light is not None and weather.sky.kind != "captured":
            white = to_numpy(world.light.open_irradiance()).astype(np.float64) / math.pi
            light = light._replace(irradiance_over_pi=white)
        snow = replace(
            self._grown.above(floor),
            light=light,
            snow=look,
            place_light=world.light,
            ground=world.field,
            appearance=world.appearance,
        )
        return replace(world, matters=(*world.matters, snow))

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Refuse snow over the heads of all cameras.

        Raises:
            UserError: it is deeper than every camera is high, at all moments.
        """
        given = self._preparation
        eye = float(given.camera_positions[:, 2].max()) - given.scene.ground_z
        depths = [moment.snow.depth or 0.0 for moment in moments]
        if depths and eye > 0 and min(depths) > eye:
            raise UserError(
                f"--snow.depth {min(depths):g} m buries all cameras, whose highest is {eye:.1f} m"
                " above the ground; give a smaller depth"
            )

    def facts(self) -> dict[str, float]:
        """None: thickness is a layer."""
        return {}


def prepare(preparation: Preparation) -> SnowEntity:
    """Let snow fall on the scene."""
    return SnowEntity(preparation)


def _is_bare(deposits: Deposits) -> bool:
    """Whether so little carries snow that it may be stray matter on walls."""
    return deposits.coverage() < BARE


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(to_numpy(x), np.float32)


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
