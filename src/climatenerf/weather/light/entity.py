"""The light of a scene: found from its photos, then replaced or changed by the weather.

Nothing is done for a frame whose light stays that of the photos. Snow on the ground lights what
stands around it; another sky replaces sky, sun and shadows. Both need the probes of `probes`.
"""

import functools
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA
from climatenerf.field.capabilities import NORMALS
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import RadianceField, device_of, observed
from climatenerf.weather.light import skies
from climatenerf.weather.light.captured import (
    CapturedLight,
    UnknownLight,
    elevation_azimuth,
)
from climatenerf.weather.light.file import light_of_photos_in
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.light.probes import GatheredLight, gather
from climatenerf.weather.light.reference_albedo import ReferenceAlbedo, estimate
from climatenerf.weather.light.relit_field import RelitField, bounded
from climatenerf.weather.light.scene_light import (
    Radiance,
    SceneLight,
    Surfaces,
    between,
    camera_balance,
    light_of_photos,
    plausible_surfaces,
    relit,
    scaled,
    white_balanced,
)
from climatenerf.weather.light.sun import sun_direction
from climatenerf.weather.light.sun_map import SunMap, sun_map
from climatenerf.weather.season.sky import sky_of, under_season
from climatenerf.weather.smog.medium import sigma_of
from climatenerf.weather.smog.scattering import sun_transmittance
from climatenerf.weather.snow.cover import ground_share, slope_share
from climatenerf.weather.snow.optics import albedo_of, slab_reflectance
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Preparation, World

DEFAULT_ELEVATION = math.radians(40)  # of a sun that neither photos nor parameters place
EXPOSED = 3  # of what photos show, one pixel in so many counts for the exposure
DARKEST = 1e-3  # luminance whose logarithm is taken
SNOW_RADIANCE = 0.5, 0.85  # limits of the median radiance of snow on level ground; 1 is white
SUNLIT_RADIANCE = 1.2  # limit of the radiance of the brightest tenth of it: sun between shadows
LEVEL = 0.7  # z of normals of level ground
COUNTRY = 0.75  # fraction of the country around that snow covers if it covers level ground
COVER_STEPS = 20  # of the snow's cover, in which light is computed anew


class LightEntity:
    """Prepares light when a frame first needs it, and keeps it for the next."""

    def __init__(self, preparation: Preparation):
        """Take the preparation; nothing is computed yet."""
        self._given = preparation
        self._reference: tuple[SceneLight, ReferenceAlbedo] | None = None
        self._maps: list[SunMap] = []
        self._new: dict[object, tuple[SceneLight, SceneLight]] = {}
        self._lights: dict[tuple[float, ...], SceneLight] = {}
        self._surfaces: GatheredLight  # what they reflect; known with the light of the photos

    # --- what the scene gives -----------------------------------------------------------------

    @functools.cached_property
    def _found(self) -> CapturedLight | UnknownLight:
        """The light of the photos."""
        given = self._given
        if NORMALS not in given.field.capabilities or given.photo_rays is None:
            return UnknownLight("the field has no normals; fit it without --loss normals=0")
        return light_of_photos_in(given.kept, given.scene, given.field, given.photo_rays)

    @property
    def captured(self) -> CapturedLight | None:
        """The light of the photos; None if they show too little to find it."""
        return self._found if isinstance(self._found, CapturedLight) else None

    @functools.cached_property
    def _gathered(self) -> GatheredLight:
        given = self._given
        views = given.scene.of_split("train")
        eyes = np.stack([given.scene.c2w_world(view)[:3, 3] for view in views])
        middle = to_device(np.median(eyes, axis=0).astype(np.float32), device_of(given.field))
        extent = float(np.abs(eyes[:, :2] - np.median(eyes[:, :2], axis=0)).max())
        return gather(
            observed(given.field),
            middle,
            extent,
            given.scene.lowest_ground_z,
            given.appearance,
            lambda fraction: given.progress("light probes", fraction),
        )

    def _sun_map(self, direction: Float[np.ndarray, "3"]) -> SunMap:
        """Map of a sun; the last two are kept: that of the photos and the new one."""
        for kept in self._maps:
            if np.allclose(kept.direction, direction, atol=1e-9):
                return kept
        given = self._given
        views = given.scene.of_split("train")
        eyes = np.stack([given.scene.c2w_world(view)[:3, 3] for view in views])
        made = sun_map(
            observed(given.field),
            direction,
            np.median(eyes, axis=0),
            lambda fraction: given.progress("shadows", fraction),
        )
        self._maps = [*self._maps, made][-2:]
        return made

    def _photographed(self, sun: Float[np.ndarray, "3"] | None) -> SceneLight:
        """Light of the photos, with the sun of the parameters in place of the found one."""
        captured = self.captured
        assert captured is not None
        if sun is not None and captured.sun is not None:
            captured = replace(captured, sun=sun)
        key = () if captured.sun is None else tuple(captured.sun.tolist())
        if key not in self._lights:
            field, device = self._given.field, device_of(self._given.field)
            radiance = functools.partial(_photographed_sky, captured, field, self._given.appearance)
            shadow, strength = None, torch.zeros(3, device=device)
            if captured.hard and captured.sun is not None:
                shadow = self._sun_map(captured.sun)
                strength = to_device(captured.lobe.astype(np.float32), device)
            light = light_of_photos(self._gathered, radiance, strength, shadow)
            found = light.open_irradiance()
            balance = camera_balance(found)
            self._surfaces = plausible_surfaces(self._gathered, balance * found)
            beam = balance * strength
            light = light_of_photos(self._surfaces, radiance, beam, shadow, balance)
            self._lights = {key: replace(light, captured=captured)}
        return self._lights[key]

    @functools.cached_property
    def _shown(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What photos show: radiance, positions, normals and classes where their rays end."""
        field, given = self._given.field, self._given
        assert given.photo_rays is not None, "the light of the photos was found in them"
        parts = []
        for photo in given.photo_rays():
            ends = np.isfinite(photo.t)
            parts.append([photo.x[ends], photo.d[ends]])
        x, d = (
            to_device(np.concatenate(each).astype(np.float32), device_of(field))
            for each in zip(*parts, strict=True)
        )
        return field.colour(x, d, appearance=given.appearance), x, *normals_at(field, x, d)

    def _albedo(self, old: SceneLight) -> ReferenceAlbedo | None:
        """The usual albedo of surfaces, where photos have a sun that casts shadows."""
        if old.sun is None or self._given.photo_rays is None:
            return None
        if self._reference is None or self._reference[0] is not old:
            radiance, x, normal, kind = self._shown
            (shaded,) = SceneLight.shaded((old,), x, normal)
            sun, lit = old.full_sun(normal), old.visibility(x, normal)
            beam = old.sun_irradiance
            self._reference = old, estimate(radiance, x, kind, shaded, sun, beam, lit)
        return self._reference[1]

    def _sun_of_photos(self, weather: Weather) -> Float[np.ndarray, "3"] | None:
        """The sun of the photos by the parameters; what they leave out is as found."""
        captured, sun = self.captured, weather.sun
        if captured is None or captured.sun is None:
            return None
        if sun.elevation is None and sun.azimuth is None:
            return None
        found = elevation_azimuth(captured.sun)
        elevation = found[0] if sun.elevation is None else sun.elevation
        azimuth = found[1] if sun.azimuth is None else sun.azimuth
        return sun_direction(Sun(elevation, azimuth))

    def _seasonal(self, weather: Weather) -> bool:
        """Whether the season, or the style of the run, brings a sky of its own."""
        return sky_of(weather.season, self._given.style) is not None

    # --- one moment ---------------------------------------------------------------------------

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world in the light of the moment."""
        new_sky = weather.sky.kind != "captured"
        seasonal = not new_sky and self._seasonal(weather)
        snow = weather.snow.depth or 0.0
        if not (
            new_sky or seasonal or snow > 0 or weather.flood.level is not None or _lit_smog(weather)
        ):
            return world
        if self.captured is None:
            return world  # snow, water and smog are lit as in the open
        override = None if new_sky else self._sun_of_photos(weather)
        old = self._photographed(override)
        cover = float(slab_reflectance(torch.tensor(snow, device="cpu"), weather.snow.grain))
        if (
            not (new_sky or seasonal)
            and cover == 0
            and not (old.sun is not None and _lit_smog(weather))
        ):
            return replace(world, light=old)
        # Snow that grows in a movie brightens its place evenly: between two steps of its cover.
        step = math.floor(cover * COVER_STEPS + 1e-3)
        part = max(cover * COVER_STEPS - step, 0.0)
        new = self._in_step(weather, old, step, seasonal)
        if part > 0:
            new = between(new, self._in_step(weather, old, step + 1, seasonal), part)
        received, before = (float(luma(light.open_irradiance())) for light in (new, old))
        shown = new_sky or seasonal
        brighter, white = received / before, received / math.pi
        field = RelitField(world.field, old, new, shown, brighter, white, self._albedo(old))
        return replace(world, field=field, light=new)

    def _in_step(self, weather: Weather, old: SceneLight, step: int, seasonal: bool) -> SceneLight:
        """The new light with the snow's cover of one step; the last two are kept."""
        snow = weather.snow
        covering = (_whiteness(weather), snow.slope, snow.slope_sharpness) if step else ()
        smog = weather.smog if _lit_smog(weather) else None
        season = weather.season if seasonal else None
        key = weather.sky, weather.sun, step, covering, smog, season
        if key not in self._new or self._new[key][0] is not old:
            found = old, self._new_light(weather, old, step / COVER_STEPS)
            self._new = dict([*self._new.items(), (key, found)][-2:])
        return self._new[key][1]

    def _new_light(self, weather: Weather, old: SceneLight, cover: float) -> SceneLight:
        albedo = to_device(np.array(_whiteness(weather), np.float32), device_of(self._given.field))
        hidden = functools.partial(snow_cover, weather.snow, cover)
        surfaces = Surfaces(hidden, albedo) if cover else None
        if weather.sky.kind == "captured":
            changed = under_season(weather.season, self._given.style, old)
            return relit(self._surfaces, old, below_smog(weather, changed), surfaces)
        sky = self._sky(weather, cover)
        direct = torch.tensor(sky.sun_irradiance, device=device_of(self._given.field))
        shadow = self._sun_map(np.array(sky.sun)) if bool((direct > 0).any()) else None

        def under(gain: float) -> SceneLight:
            """The new sky and sun, klx times a gain."""
            return replace(
                old,
                radiance=functools.partial(scaled, gain, sky.radiance),
                sun_irradiance=gain * direct,
                sun=shadow,
                captured=None,
                balance=1.0,
            )

        # First as bright as the old light in the open, since changes of light are bounded.
        level = float(luma(under(1.0).open_irradiance()))
        first = float(luma(old.open_irradiance())) / level
        bare = relit(self._surfaces, old, under(first))
        gain = self._gain(weather, old, bare, first, cover) * 2.0**weather.sky.ev
        lit = replace(under(gain), coefficients=gain / first * bare.coefficients)
        hazy = below_smog(weather, lit)
        if surfaces is None and hazy is lit:
            return self._balanced(lit)
        return self._balanced(relit(self._surfaces, old, hazy, surfaces))

    def _balanced(self, light: SceneLight) -> SceneLight:
        """White balance at the cameras of the photos."""
        views = self._given.scene.of_split("train")
        eyes = np.stack([self._given.scene.c2w_world(view)[:3, 3] for view in views])
        return white_balanced(
            light, to_device(eyes.astype(np.float32), device_of(self._given.field))
        )

    def _sky(self, weather: Weather, cover: float) -> skies.NewSky:
        elevation, azimuth = weather.sun.elevation, weather.sun.azimuth
        captured = self.captured
        if captured is not None and captured.sun is not None:
            found = elevation_azimuth(captured.sun)
            elevation = found[0] if elevation is None else elevation
            azimuth = found[1] if azimuth is None else azimuth
        dusk = weather.sky.kind == "dusk"
        default = skies.DUSK_ELEVATION if dusk else DEFAULT_ELEVATION
        elevation = default if elevation is None or (dusk and elevation > 0) else elevation
        azimuth = 0.0 if azimuth is None else azimuth
        flat = math.cos(elevation)
        sun = (flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation))
        white = float(np.dot(LUMA, _whiteness(weather)))
        ground = skies.USUAL_GROUND + COUNTRY * cover * (white - skies.USUAL_GROUND)
        return skies.NewSky(weather.sky.kind, sun, weather.sky.cover, ground)

    def _gain(
        self, weather: Weather, old: SceneLight, new: SceneLight, gain: float, cover: float
    ) -> float:
        """Factor from klx to the units of the photos; `new` has the factor `gain`.

        Snow on the fraction `cover` of the ground is in it, but its light is not in `new`.
        """
        if weather.sky.exposure == "fixed":
            captured = self.captured
            assert captured is not None
            elevation = DEFAULT_ELEVATION
            if captured.sun is not None:
                elevation = elevation_azimuth(captured.sun)[0]
            klx = skies.daylight(elevation, captured.hard)
            return float(luma(old.open_irradiance())) / klx
        # What photos show keeps its log-average luminance, as photographers expose (Reinhard et al.
        # 2002, Eq. 1): unlike the mean it does not follow a few places in the sun.
        radiance, x, normal, kind = (each[::EXPOSED] for each in self._shown)
        sheet = float(luma(new.open_irradiance())) / math.pi
        shown = RelitField(self._given.field, old, new, True, 1.0, sheet, self._albedo(old))
        ratio, most = shown.change(radiance, x, normal, kind)
        shining = bounded(radiance * ratio, most)
        before, after = (luma(each).clamp_min(DARKEST).log().mean() for each in (radiance, shining))
        kept = gain * math.exp(float(before - after))
        # For snow that is neither grey nor without relief, photographers correct the exposure.
        up = normal[:, 2] > LEVEL
        white = luma(new.irradiance(x[up], normal[up]) if bool(up.any()) else new.open_irradiance())
        # 1e-6: without light 0/0.
        white_at_one = max(float(white.median()), 1e-6) / math.pi / gain
        least, most = (radiance / white_at_one for radiance in SNOW_RADIANCE)
        sunlit_at_one = max(float(white.quantile(0.9)), 1e-6) / math.pi / gain
        most = min(most, SUNLIT_RADIANCE / sunlit_at_one)
        return kept * (min(max(kept, least), most) / kept) ** cover

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Refuse a sun that does not belong to its sky.

        Raises:
            UserError: a clear sky or photos with a sun below the horizon, dusk with one that is not
                just below it, or a new sky over photos that do not tell their light.
        """
        for moment in moments:
            elevation = moment.sun.elevation
            if moment.sky.kind == "captured" and elevation is not None and elevation <= 0:
                raise UserError(
                    "the photos were taken by day; give --sun.elevation above 0 deg, or another"
                    " --sky.kind"
                )
            if moment.sky.kind == "clear" and elevation is not None and elevation <= 0:
                raise UserError(
                    "--sky.kind clear needs the sun above the horizon; give --sun.elevation above"
                    " 0 deg, or --sky.kind dusk"
                )
            dusk = moment.sky.kind == "dusk"
            if dusk and elevation is not None and not skies.NIGHT <= elevation <= 0:
                raise UserError(
                    "--sky.kind dusk needs the sun between 12 deg below the horizon and the"
                    " horizon; give --sun.elevation from -12 deg to 0 deg, or leave it out"
                )

        for kind in {moment.sky.kind for moment in moments} - {"captured"}:
            if isinstance(self._found, UnknownLight):
                raise UserError(
                    f"--sky.kind {kind} needs the light of the photos: {self._found.reason}; or use"
                    " --sky.kind captured"
                )

    def facts(self) -> dict[str, float]:
        """Whether the light of the photos is known, and where their sun stands."""
        if "_found" not in self.__dict__:
            return {}
        captured = self.captured
        found = {"photos_light_known": float(captured is not None)}
        if captured is None:
            return found
        if captured.sun is not None:
            elevation, azimuth = elevation_azimuth(captured.sun)
            found |= {
                "photos_sun_elevation_deg": math.degrees(elevation),
                "photos_sun_azimuth_deg": math.degrees(azimuth),
                "photos_sun_error_deg": math.degrees(captured.sun_error),
                "photos_sun_width_deg": math.degrees(captured.width),
            }
            if captured.almanac_difference is not None:
                difference = math.degrees(captured.almanac_difference)
                found |= {"photos_sun_from_almanac_deg": difference}
        return found


def snow_cover(
    snow: Snow, cover: float, up: Float[Tensor, "*n"], ground: Bool[Tensor, "*n"]
) -> Float[Tensor, "*n"]:
    """Fraction of surfaces that snow hides; `cover` of level ones.

    Args:
        snow: its slopes.
        cover: of level ground.
        up: z of the surfaces' unit normals.
        ground: whether they lie on the ground, where steeper slopes keep snow.
    """
    cosine = to_numpy(up)
    share = np.where(to_numpy(ground), ground_share(cosine, snow), slope_share(cosine, snow))
    return cover * to_device(share.astype(np.float32), up.device)


def below_smog(weather: Weather, light: SceneLight) -> SceneLight:
    """The sky and sun below smog: what it takes from a hard sun it spreads over the whole sky.

    That smog takes light from sky and sun together is left out, as if a camera made up for it.
    """
    sigma = sigma_of(weather.smog) if weather.smog.light == "scene" else None
    if light.sun is None or sigma is None:
        return light
    sine = max(float(light.sun.direction[2]), 0.0)
    passed = sun_transmittance(weather.smog, sigma, math.asin(sine))
    beam = light.sun_irradiance
    kept = beam * beam.new_tensor(passed)
    spread = (beam - kept) / light.balance * sine / math.pi
    radiance = functools.partial(_lighter, light.radiance, spread)
    return replace(light, radiance=radiance, sun_irradiance=kept, captured=None)


# Skies are sent to other processes with the light: no closures, which cannot be pickled.


def _photographed_sky(
    captured: CapturedLight,
    field: RadianceField,
    appearance: Float[Tensor, "1 e"] | None,
    d: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    return captured.sky(d, field.sky(d, appearance))


def _lighter(
    sky: Radiance, spread: Float[Tensor, "3"], d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    return sky(d) + spread


def _whiteness(weather: Weather) -> tuple[float, ...]:
    """Reflectance of the snow in steps of a hundredth, in which light is computed anew."""
    return tuple(np.round(albedo_of(weather.snow), 2).tolist())


def _lit_smog(weather: Weather) -> bool:
    return weather.smog.light == "scene" and bool(sigma_of(weather.smog))


def prepare(preparation: Preparation) -> LightEntity:
    """Light is found when a frame first needs it."""
    return LightEntity(preparation)
