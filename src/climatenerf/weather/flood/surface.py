"""Flood water as a surface: where rays meet it, how its shore is antialiased, how it is shaded.

The physics is in `optics`, `fresnel` and `waves`, the search for hits in `ops.wave_tracing`. Rays
from the camera meet crests and troughs. Reflected and refracted rays begin on the mean surface, and
the integrator, which hands itself over as `trace`, follows them through the whole world.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.errors import UserError
from climatenerf.core.samples import MIN_TAU, MIN_WEIGHT
from climatenerf.field.compositing import RENDER_STEP, composited
from climatenerf.field.protocol import device_of, ground_height
from climatenerf.ops.wave_tracing import Heights, first_hits
from climatenerf.scene.scene import Scene
from climatenerf.weather.flood import optics, shore
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.waves import Waves, at_time, make_waves
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import (
    TINY,
    Preparation,
    RaySamples,
    SurfaceHits,
    TraceRadiance,
    World,
)

SKIN = 2e-3  # secondary rays begin this far from the water, m
PARTS = 8  # of a pixel, with a reflected ray each
SHARP = 1e8  # gloss from which on still water is a mirror
ENTRIES = 12  # places at which light enters the water that leaves it at one
MAX_REACH = 1.0  # m; clear water scatters too little to matter
MIN_BOTTOM = 1.0 / 2048  # transmittance below which no bottom is traced: under an 8-bit step


@dataclass(frozen=True)
class Water:
    """A flood at one moment.

    Attributes:
        flood: its parameters.
        level: world height of the surface, m.
        waves: heights and slopes of the surface over the level at this moment.
        irradiance: on level ground in the open, linear.
        sun_elevation: rad; None: light from an even sky.
        mirror_only: reflectance 1 and no gloss: a check against a mirrored camera.
        displaced: whether rays meet crests and troughs, or the mean surface with their slopes.
    """

    flood: Flood
    level: float
    waves: Heights
    irradiance: Float[Tensor, "3"]
    sun_elevation: float | None = None
    mirror_only: bool = False
    displaced: bool = True
    mask = "mask_water"
    extra_layers = ("water_depth",)

    @property
    def calm(self) -> "Water":
        """The surface as further rays meet it: level, with the slopes of its waves."""
        return replace(self, displaced=False)

    def distance(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Ray length to the surface, m; +inf where it is missed."""
        if not self.displaced:
            return optics.plane_distance(rays_o, rays_d, self.level)
        below = self.inside(rays_o)
        return first_hits(self.waves, self.level, rays_o, rays_d, below, pixel_angle).t

    def inside(self, rays_o: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether origins lie under water."""
        over = rays_o[:, 2] - self.level
        if not self.displaced or bool((over.abs() > self.waves.crest()).all()):
            return over < 0
        return over < self.waves.at(rays_o[:, :2], torch.zeros_like(over))[0]

    def fraction_behind(
        self,
        world: World,
        along: RaySamples,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "s"]:
        """Fraction of each sample behind the plane: 0 or 1 but in the pixels of the waterline.

        The soft edge lies on the wet side (0 at the waterline, 1 half a pixel from it), so that
        water under the ground shows nowhere; the visible edge moves by a quarter of a pixel. Its
        width depends on the ground's slope, so the field's normal is found for rays that have
        matter within a pixel of the plane.
        """
        ray = along.ray
        lengths = shore.lengths_on_terrain(world, along, rays_o, rays_d, self.level)
        behind = (lengths > t[ray]).float()
        near = ((along.weights > MIN_WEIGHT) & (t[ray] < torch.inf)).nonzero()[:, 0]
        of = ray[near]
        arguments = (t[of], lengths[near], rays_d[of], pixel_angle[of])
        soft = optics.shore_coverage(*arguments)
        rays = torch.unique(of[(soft > 0) & (soft < 1)])
        if not rays.numel():
            return behind
        x = rays_o[rays] + t[rays, None] * rays_d[rays]
        step = (2 * pixel_angle[rays] * t[rays]).clamp_min(0.02)
        normal = torch.zeros_like(rays_d)
        normal[:, 2] = 1.0
        normal[rays] = _field_normal(world, x, step, rays_d[rays])
        moved = (lengths != along.samples.t)[near, None]
        own = torch.where(moved, normal.new_tensor([0.0, 0.0, 1.0]), normal[of])
        covered = 2 * optics.shore_coverage(*arguments, own) - 1
        return behind.index_copy(0, near, covered.clamp_min(0.0))

    def attenuate(
        self,
        world: World,
        radiance: Float[Tensor, "n 3"],
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Radiance at ray length t (m) as it arrives at an eye under water, with a wet bed."""
        beta = torch.tensor(optics.attenuation(self.flood), device=rays_o.device)
        depth = self.level - rays_o[:, 2] - t.clamp_max(1e6) * rays_d[:, 2]
        eye = self._on_mean_surface(rays_o)
        body = optics.body_colour(self.flood, self._scattered_irradiance(world, eye))
        # What lies no deeper than the troughs may be the surface itself.
        bed = ((depth > self.waves.crest() + SKIN) & t.isfinite())[:, None]
        thick = beta * depth.clamp(0, 1e6)[:, None]
        seen = self._on_mean_surface(rays_o + t.clamp_max(1e6)[:, None] * rays_d)
        given = self.irradiance_at(world, seen), self.flood.ior
        wet = optics.bottom_radiance(radiance, *given, optical_depth=thick, body=body)
        radiance = torch.where(bed, wet, radiance)
        light = optics.light_cosine(self.flood, self.sun_elevation)
        passed = optics.water_transmittance(beta, t, depth, light)
        return radiance * passed + body * (1 - passed)

    def shade(
        self, world: World, hits: SurfaceHits, trace: TraceRadiance
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], dict[str, Float[Tensor, "n"]]]:
        """Reflection of the world, and the bottom seen through the water (Fresnel; Snell)."""
        n, rays_d = hits.t.shape[0], hits.rays_d
        below = self.inside(hits.rays_o)
        vertical = (hits.t_bottom - hits.t).clamp_min(0) * rays_d[:, 2].abs()
        x = self._on_mean_surface(hits.rays_o + hits.t[:, None] * rays_d)
        depth = torch.where(vertical > 0, vertical, self._terrain_depth(world, x))
        depth = torch.where(torch.isfinite(depth) & ~below, depth, torch.zeros_like(depth))
        footprint = optics.footprint(hits.t, rays_d, hits.pixel_angle)
        _, slope, _ = self.waves.at(x[:, :2], footprint)
        normal = optics.normal_of(slope)

        # --- Reflected rays, traced like any other: one from each part of the pixel ---------------
        count = self.reflected_rays()
        parts = optics.subpixels(rays_d, hits.pixel_angle, count)
        origins = hits.rays_o[:, None].expand_as(parts).reshape(-1, 3)
        found = first_hits(
            self.waves,
            self.level,
            origins,
            parts.reshape(-1, 3),
            below.repeat_interleave(count),
            hits.pixel_angle.repeat_interleave(count) * optics.part_width(count),
        )
        # Parts that miss the water, beside its horizon, show what the centre does.
        t = torch.where(found.t < torch.inf, found.t, hits.t.repeat_interleave(count))
        met = self._on_mean_surface(origins + t[:, None] * parts.reshape(-1, 3))
        directions, share = optics.facets(
            parts,
            found.slope.view(n, count, 2),
            found.variance.view(n, count),
            self.flood,
            below,
        )
        if self.mirror_only:
            directions, share = optics.mirror(rays_d, normal)[:, None], torch.ones_like(share)
        # A lump of fitted ground that the terrain puts under water stands over the surface still.
        lump = (hits.t - hits.t_bottom).clamp_min(0) * rays_d[:, 2].abs() * (hits.t_bottom > 0)
        side = torch.where(below, -SKIN, SKIN + 1.5 * lump)
        lift = torch.stack([torch.zeros_like(side), torch.zeros_like(side), side], dim=-1)
        radiance = trace(
            met + lift.repeat_interleave(count, 0),
            directions.reshape(-1, 3),
            hits.pixel_angle.repeat_interleave(count, 0) * 2,
        )
        reflectance = share.sum(1)
        # 1e-6: a surface that reflects nothing.
        share = share / reflectance.clamp_min(1e-6)[:, None]
        reflected = (radiance.view(n, count, 3) * share[..., None]).sum(1)

        # --- What is on the other side ------------------------------------------------------------
        direction, total = optics.refract(rays_d, normal, self.flood.ior, below)
        total |= below & (direction[:, 2] <= 0)  # behind the next crest it would meet water again
        direction = direction * ~total[:, None]  # total reflection: no ray goes on
        start = x - lift.clamp(-SKIN, SKIN)
        background, passed = self._other_side(
            world, start, direction, below, hits.pixel_angle, depth, trace
        )
        # From below, the mean over slopes lets a little light through even where the visible facet
        # reflects all of it.
        reflectance = torch.where(total, torch.ones_like(reflectance), reflectance)
        body = optics.body_colour(self.flood, self._scattered_irradiance(world, x))
        shaded = optics.shade(reflected, reflectance, background, passed, body)
        return shaded, normal, {"water_depth": depth}

    def reflected_rays(self) -> int:
        """Number of reflected rays for a pixel: one for still water, else one for each part."""
        mirror = self.waves.still and self.flood.gloss >= SHARP
        return 1 if self.mirror_only or mirror else PARTS

    def _on_mean_surface(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """The same places on the surface without waves, where further rays begin."""
        return torch.cat([x[:, :2], torch.full_like(x[:, :1], self.level)], dim=-1)

    def _terrain_depth(self, world: World, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Depth of the terrain below the level at positions x (m); 0 where it is not known."""
        ground = ground_height(world.field, x[:, :2])
        return (self.level - ground).clamp_min(0).nan_to_num(0.0)

    def irradiance_at(self, world: World, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Irradiance of the level water at positions x (m)."""
        if world.light is None:
            return self.irradiance.expand(x.shape[0], 3)
        up = torch.zeros_like(x)
        up[:, 2] = 1.0
        return world.light.irradiance(x, up)

    def _scattered_irradiance(self, world: World, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Irradiance that the water's body shows at positions x (m).

        Light leaves scattering water about an attenuation length from where it entered, which
        softens the edges of a hard sun's shadow.
        """
        if world.light is None or world.light.beam() is None:
            return self.irradiance_at(world, x)
        reach = min(1 / max(optics.attenuation(self.flood)[1], 1e-3), MAX_REACH)
        offset = x.new_tensor(_disc(ENTRIES) * reach)
        spread = x[:, None].expand(-1, ENTRIES, 3) + offset
        return self.irradiance_at(world, spread.reshape(-1, 3)).view(-1, ENTRIES, 3).mean(1)

    def _other_side(
        self,
        world: World,
        start: Float[Tensor, "n 3"],
        direction: Float[Tensor, "n 3"],
        below: Bool[Tensor, "n"],
        pixel_angle: Float[Tensor, "n"],
        depth: Float[Tensor, "n"],
        trace: TraceRadiance,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Radiance behind the surface along the refracted ray, and the water's transmittance to it.

        From above: the bottom, converted from dry to wet. From below: the air's light, and 1.
        """
        background, passed = torch.zeros_like(start), torch.zeros_like(start)
        beta = torch.tensor(optics.attenuation(self.flood), device=start.device)
        # Where the water is opaque over the straight ray's depth, no ray is spent on the bottom.
        # Light comes down through this depth and goes up through at least as much.
        shows = torch.exp(-2 * beta.min() * depth) > MIN_BOTTOM
        down = (~below & shows & (direction[:, 2] < 0)).nonzero()[:, 0]
        if down.numel():
            o, d = start[down], direction[down]
            # The bottom is seen directly, so its steps are those of camera rays.
            matter, transmittance, length = composited(
                shore.without_film(world.field),
                o,
                d,
                torch.zeros_like(o[:, 0]),
                RENDER_STEP,
                pruning_threshold=MIN_TAU,
                appearance=world.appearance,
            )
            opacity = (1 - transmittance).clamp_min(TINY)
            dry, path = matter / opacity[:, None], length / opacity
            path = shore.path_to_terrain(world, o, d, path)
            light = optics.light_cosine(self.flood, self.sun_elevation)
            through = optics.water_transmittance(beta, path, path * d[:, 2].abs(), light)
            irradiance = self.irradiance_at(world, o)
            thick = beta * (path * d[:, 2].abs())[:, None]
            body = optics.body_colour(self.flood, irradiance)
            background[down] = optics.bottom_radiance(
                dry, irradiance, self.flood.ior, optical_depth=thick, body=body
            )
            passed[down] = through * (1 - transmittance)[:, None]
        passed[below] = 1.0
        up = (below & (direction[:, 2] > 0)).nonzero()[:, 0]
        if up.numel():
            background[up] = trace(start[up], direction[up], pixel_angle[up])
        return background, passed


@dataclass(frozen=True)
class FloodEntity:
    """A flood in a scene.

    Attributes:
        waves: the random amplitudes of its waves.
        irradiance: on level ground in the open, linear.
        ground_z: world height of the ground datum, m.
        top: height of the scene's top above the ground datum, m.
        highest_eye: world height of the highest camera, m.
    """

    waves: Waves
    irradiance: Float[Tensor, "3"]
    ground_z: float
    top: float
    highest_eye: float = math.inf

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with the flood's surface in it."""
        level = weather.flood.level
        if level is None:
            return world
        check_level(level, self.top)
        light, elevation = world.light, weather.sun.elevation
        if light is not None and elevation is None:
            elevation = light.sun_elevation()
        water = Water(
            weather.flood,
            self.ground_z + level,
            at_time(self.waves, time),
            self.irradiance if light is None else light.open_irradiance(),
            elevation,
        )
        field = world.field
        if weather.flood.wet_band > 0:
            # Crests wet what lies within two deviations of the waves' height.
            band = self.waves.significant_height / 2 + weather.flood.wet_band
            at = partial(water.irradiance_at, world)
            trough = water.waves.crest()
            field = shore.WetField(field, water.level, band, trough, weather.flood.ior, at)
        return replace(world, field=field, surfaces=(*world.surfaces, water))

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Refuse levels above the whole scene; see `check_level`."""
        for moment in moments:
            check_level(moment.flood.level, self.top)
        eye = self.highest_eye - self.ground_z
        if moments and all(_blind(moment.flood, eye) for moment in moments):
            flood = moments[0].flood
            clarity = optics.clarity_of(flood)
            raise UserError(
                f"all cameras are under water at --flood.level {flood.level:g} m (the highest is"
                f" at {eye:.1f} m), deeper than its clarity of {clarity:.2g} m lets them see;"
                " give a lower level, or clearer water"
            )

    def facts(self) -> dict[str, float]:
        """Height of the waves."""
        return {"significant_wave_height_m": self.waves.significant_height}


def prepare(preparation: Preparation) -> FloodEntity:
    """Sample the waves and gather the light. The waves are those of the first flooded moment.

    Raises:
        UserError: a level above the whole scene.
    """
    scene, first = preparation.scene, preparation.moments[0]
    top = scene_top(scene)
    for moment in preparation.moments:
        check_level(moment.flood.level, top)
    waves = make_waves(first.flood, first.seed, device=device_of(preparation.field))
    eye = float(preparation.camera_positions[:, 2].max())
    return FloodEntity(waves, preparation.irradiance(), scene.ground_z, top, eye)


def _blind(flood: Flood, eye: float) -> bool:
    """Whether a camera so high above the ground datum (m) sees nothing but water."""
    level = -math.inf if flood.level is None else flood.level
    return level - eye > optics.clarity_of(flood)


def scene_top(scene: Scene) -> float:
    """Height of the highest camera or sparse point above the ground datum, m."""
    highest = max(scene.c2w_world(view)[2, 3] for view in scene.views)
    points = scene.points_world()
    if points is not None and points.shape[0]:
        highest = max(highest, float(np.quantile(points[:, 2], 0.99)))
    return highest - scene.ground_z


def check_level(level: float, top: float) -> None:
    """Refuse a level (m) above the top of the scene (m): the unit is wrong.

    Raises:
        UserError: the level is higher.
    """
    if level > top:
        raise UserError(
            f"--flood.level {level:g} m is above the whole scene, whose top is {top:.1f} m"
            " over its ground; give a lower level"
        )


def _disc(count: int) -> Float[np.ndarray, "k 3"]:
    """Points spread evenly over the horizontal unit disc (Vogel's spiral)."""
    k = np.arange(count)
    radius, angle = np.sqrt((k + 0.5) / count), k * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * k], axis=-1)


def _field_normal(
    world: World, x: Float[Tensor, "n 3"], step: Float[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Unit normal of the field near x by central differences over `step` (m), towards the eye."""
    gradient = torch.zeros_like(x)
    for axis in range(3):
        offset = torch.zeros_like(x)
        offset[:, axis] = step
        gradient[:, axis] = _opacity(world, x + offset, step) - _opacity(world, x - offset, step)
    length = gradient.norm(dim=-1, keepdim=True)
    # Where the density is constant the surface is taken to face the eye.
    normal = torch.where(length > 1e-9, -gradient / length.clamp_min(1e-9), -rays_d)
    return torch.where((normal * rays_d).sum(-1, keepdim=True) > 0, -rays_d, normal)


def _opacity(world: World, x: Tensor, step: Tensor) -> Float[Tensor, "n"]:
    """Opacity over a step's length: unlike density it does not jump by orders of magnitude."""
    return 1 - torch.exp(-world.field.density(x) * step)
