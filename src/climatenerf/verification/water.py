"""Checks of flood water: Fresnel's and Snell's laws, absorption, and the image in a mirror.

A fan of rays from straight down to 85 degrees meets still water at z = 0. Most parts of the scenes
are black or white, so that a picture shows one quantity alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.verification.check import Check
from climatenerf.verification.closed_forms import (
    brewster_reflectance,
    fresnel,
    normal_reflectance,
    refraction_angle,
    returned_light,
    wet_radiance,
)
from climatenerf.verification.setting import IOR, Vector, Viewpoint, frame_in, looking, radiance
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.weather import Weather

EYE_Z, DEPTH = 1.0, 2.0
DOWN = looking((0.0, 0.0, EYE_Z), (0.0, 0.0, -1.0))
FAN = Viewpoint(Camera(1441, 1, 63.0, 63.0, 720.5, 0.5), DOWN)
# Its only pixel has tan(i) = n exactly.
BREWSTER = Viewpoint(Camera(1, 1, 63.0, 63.0, 0.5 - 63.0 * IOR, 0.5), DOWN)
WIDE = ((-60.0, -60.0, -5.0), (60.0, 60.0, 6.0))
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
OPAQUE = (1e3, 1e3, 1e3)  # attenuation, 1/m
BETA = (0.2, 0.5, 1.0)
DRY = 0.3  # radiance and albedo of a diffuse bottom under a white sky
RULE = 40.0  # m over which the ruled bottom's red rises by 1
MIRROR_LEVEL, FACE = 0.3, (0.6, 0.2, 1.0)
MIRROR_VIEW = Viewpoint(
    Camera(64, 36, 40.0, 40.0, 32.0, 18.0), looking((0.0, -3.0, 1.6), (0.0, 1.0, -0.2))
)
BORN_WOLF = "Born and Wolf 1999, 1.5.2"


@dataclass(frozen=True)
class RuledField(AnalyticField):
    """Red is .5 + x/RULE everywhere, and the other channels are 1: a ray shows where it landed."""

    def colour(self, x: Float[Tensor, "s 3"], *_: object, **__: object) -> Float[Tensor, "s 3"]:
        """Linear radiance at positions (m)."""
        one = torch.ones_like(x[:, 0])
        return torch.stack([0.5 + x[:, 0] / RULE, one, one], dim=-1)


def checks(device: torch.device = CPU) -> Iterator[Check]:
    """Render the scenes, and compare."""
    black = AnalyticField(
        [HalfSpace(offset=-DEPTH, colour=BLACK)],
        zenith=WHITE,
        horizon=WHITE,
        box=WIDE,
        device=device,
    )
    reflected = _seen(black, _still(attenuation=OPAQUE))
    yield reflectance(reflected)
    yield normal_incidence(reflected[FAN.camera.width // 2])
    yield brewster(_seen(black, _still(attenuation=OPAQUE), BREWSTER)[0])

    # A black sky has no irradiance, so that the bottom counts as white and keeps its radiance.
    ruled = RuledField(
        [HalfSpace(offset=-DEPTH)], 2e5, zenith=BLACK, horizon=BLACK, box=WIDE, device=device
    )
    clear = _seen(ruled, _still(attenuation=BLACK))
    yield energy(reflected, clear[:, 1])
    landed = RULE * (clear[:, 0] / clear[:, 1] - 0.5)
    yield refraction(landed)
    yield apparent_depth(landed)
    zenith = Sun(elevation=np.pi / 2, azimuth=0.0)
    yield absorption(_seen(ruled, _still(attenuation=BETA), sun=zenith) / clear)

    grey = AnalyticField(
        [HalfSpace(offset=-DEPTH, colour=(DRY, DRY, DRY))],
        zenith=WHITE,
        horizon=WHITE,
        box=WIDE,
        device=device,
    )
    yield wet_bottom(_seen(grey, _still(attenuation=BLACK))[FAN.camera.width // 2])

    scene = _floating_boxes(device)
    still = _still(level=MIRROR_LEVEL, attenuation=OPAQUE, gloss=1e9)
    water_picture = frame_in(scene, Weather(flood=still), MIRROR_VIEW)
    image = frame_in(scene, Weather(), MIRROR_VIEW.mirrored(MIRROR_LEVEL))
    yield mirror(radiance(water_picture), radiance(image), water_picture.layers["mask_water"])


def incidence() -> Float[np.ndarray, "n"]:
    """Return the angles of incidence of the fan, rad."""
    return np.arccos(-FAN.directions()[0, :, 2])


def reflectance(measured: Float[np.ndarray, "n 3"]) -> Check:
    """Compare the white sky in black water with (R_s + R_p)/2 (Fresnel 1823)."""
    expected = fresnel(incidence(), IOR)[:, None]
    error = 100 * float(np.abs(measured / expected - 1).max())
    compares = "unpolarised reflectance with (R_s + R_p)/2, 0 to 85 degrees"
    return Check("Fresnel reflectance", compares, error, 0.1, "%", BORN_WOLF)


def normal_incidence(measured: Float[np.ndarray, "3"]) -> Check:
    """Compare the reflectance straight down with ((n - 1)/(n + 1))^2."""
    error = 100 * float(np.abs(measured / normal_reflectance(IOR) - 1).max())
    compares = "reflectance straight down with ((n - 1)/(n + 1))^2"
    return Check("Fresnel normal incidence", compares, error, 0.1, "%", BORN_WOLF)


def brewster(measured: Float[np.ndarray, "3"]) -> Check:
    """Compare the reflectance at Brewster's angle, where R_p = 0, with R_s/2."""
    error = 100 * float(np.abs(measured / brewster_reflectance(IOR) - 1).max())
    compares = "reflectance at tan(i) = n with ((n^2 - 1)/(n^2 + 1))^2 / 2"
    return Check("Fresnel at Brewster's angle", compares, error, 0.1, "%", "Brewster 1815")


def energy(reflected: Float[np.ndarray, "n 3"], transmitted: Float[np.ndarray, "n"]) -> Check:
    """Compare the sum of reflected and transmitted light with 1, at each angle.

    The two are seen in two scenes: a white sky over black water, and a white bottom under clear
    water and a black sky. Both are basic radiance L/n^2, which a flat interface conserves.
    """
    error = float(np.abs(reflected[:, 0] + transmitted - 1).max())
    compares = "R + T of clear water with 1, 0 to 85 degrees"
    return Check("Fresnel energy", compares, error, 1e-3, "1", "conservation of energy")


def refraction(landed: Float[np.ndarray, "n"]) -> Check:
    """Compare the direction of refracted rays with Snell's law, by where they meet the bottom."""
    angle = incidence()
    entry = EYE_Z * np.tan(angle)
    measured = np.arctan2(np.abs(landed) - entry, DEPTH)
    error = np.degrees(np.abs(measured - refraction_angle(angle, IOR)).max())
    compares = "angle of refracted rays with asin(sin(i)/n), 0 to 85 degrees"
    return Check("Snell direction", compares, float(error), 0.1, "deg", "Born and Wolf 1999, 1.5.1")


def apparent_depth(landed: Float[np.ndarray, "n"]) -> Check:
    """Compare the depth at which the bottom appears near straight down with d/n.

    The straight ray through what is seen reaches its place on the bottom at the apparent depth;
    for small angles Snell's law is i = n t.
    """
    angle = incidence()
    small = (angle > 0.02) & (angle < np.radians(10))
    # The apparent depth at an angle i is d tan(t)/tan(i): extrapolated to i = 0 by its even terms.
    apparent = np.abs(landed[small]) / np.tan(angle[small]) - EYE_Z
    at_zero = np.polyfit(angle[small] ** 2, apparent, 1)[1]
    error = 100 * float(abs(at_zero / (DEPTH / IOR) - 1))
    compares = "apparent depth of the bottom, near straight down, with d/n"
    return Check("Snell apparent depth", compares, error, 0.5, "%", "Born and Wolf 1999, 4.4")


def absorption(measured: Float[np.ndarray, "n 3"]) -> Check:
    """Compare the light left with exp(-beta (d + d/cos t)): down from the zenith, and up the ray.

    Beer-Lambert law in water, for each channel's beta. The white bottom receives less light from
    the surface above it, too: 1/(1 - R) of its own, R after absorption.
    """
    angle = incidence()
    steep = angle < np.radians(60)
    path = DEPTH + DEPTH / np.cos(refraction_angle(angle[steep], IOR))
    clear, absorbing = (1 - returned_light(np.array(b) * DEPTH, IOR) for b in (BLACK, BETA))
    left = measured[steep] * absorbing / clear
    found = -np.log(np.maximum(left, 1e-300)) / path[:, None]
    error = 100 * float(np.abs(found / np.array(BETA) - 1).max())
    compares = "attenuation of each channel with what was asked, 0 to 60 degrees"
    return Check("water absorption", compares, error, 0.5, "%", "Beer-Lambert law")


def wet_bottom(measured: Float[np.ndarray, "3"]) -> Check:
    """Compare a grey bottom under clear water with multiple reflection (Lekner and Dorf 1988).

    The surface's reflectance for diffuse light is Walsh's closed form (1926).
    """
    mirrored = normal_reflectance(IOR)
    expected = mirrored + (1 - mirrored) * wet_radiance(DRY, DRY, IOR)
    error = 100 * float(np.abs(measured / expected - 1).max())
    compares = "radiance of a grey bottom under clear water with multiple reflection"
    return Check("water wet bottom", compares, error, 0.5, "%", "Lekner and Dorf 1988, Walsh 1926")


def mirror(
    water_picture: Float[np.ndarray, "h w 3"],
    image: Float[np.ndarray, "h w 3"],
    water: Float[np.ndarray, "h w"],
) -> Check:
    """Compare still water with the picture of the camera mirrored in it (law of reflection).

    Everything has the same blue, 1, so the blue of the water is its reflectance, and red and green
    over blue are what it reflects. 0.001 is 60 dB.
    """
    wet = water > 0.999
    reflected = water_picture[wet][:, :2] / np.maximum(water_picture[wet][:, 2:], 1e-9)
    error = float(np.sqrt(np.mean((reflected - image[wet][:, :2]) ** 2)))
    compares = "what still water reflects with the mirrored camera's picture, RMS"
    return Check("mirror image", compares, error, 1e-3, "1", "law of reflection")


def _still(attenuation: Vector, level: float = 0.0, gloss: float = Flood.gloss) -> Flood:
    return Flood(level, wind_speed=0.0, colour=BLACK, attenuation=attenuation, ior=IOR, gloss=gloss)


def _seen(
    field: AnalyticField, flood: Flood, viewpoint: Viewpoint = FAN, sun: Sun | None = None
) -> Float[np.ndarray, "n 3"]:
    """Radiance along the fan."""
    weather = Weather(flood=flood, sun=sun or Sun())
    return radiance(frame_in(field, weather, viewpoint))[0]


def _floating_boxes(device: torch.device) -> AnalyticField:
    """Boxes over bottomless water; everything has the same blue."""
    red, green = (FACE[0], FACE[1], 1.0), (FACE[1], FACE[0], 1.0)
    return AnalyticField(
        [
            Box((-2.0, 3.0, 0.5), (0.2, 5.0, 2.5), red),
            Box((0.9, 1.0, 0.4), (1.8, 2.0, 1.0), green),
        ],
        zenith=(0.2, 0.4, 1.0),
        horizon=(0.8, 0.7, 1.0),
        box=WIDE,
        device=device,
    )
