"""Checks of smog against the Beer-Lambert law, along rays from an eye to level ground and sky."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.render.session import Frame
from climatenerf.verification.check import Check
from climatenerf.verification.closed_forms import (
    linear_from_display,
    plane_distance,
    sky_optical_depth,
    stratified_optical_depth,
)
from climatenerf.verification.setting import Viewpoint, frame_in, looking, radiance
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather

EYE_Z, SIGMA, VISIBILITY, FALLOFF, BASE = 1.6, 0.05, 30.0, 2.0, 0.5
GROUND, SKY, COLOUR = (0.3, 0.25, 0.2), (0.5, 0.6, 0.9), (0.8, 0.7, 0.6)
FARTHEST = 60.0  # m; farther ground is not compared
MIN_RISE = 0.05  # of sky rays, per length
VIEW = Viewpoint(
    Camera(48, 36, 30.0, 30.0, 24.0, 18.0), looking((0.0, 0.0, EYE_Z), (0.0, 1.0, -0.1))
)
BEER_LAMBERT = "Beer-Lambert law: T = exp(-sigma s)"


def checks(device: torch.device = CPU) -> Iterator[Check]:
    """Render the scene in several kinds of smog, and compare."""
    length = plane_distance(VIEW.eye, VIEW.directions())
    length = np.where(length < FARTHEST, length, np.inf)
    even = _seen(Smog(sigma=SIGMA, colour=COLOUR), device)
    yield transmittance(even.layers["transmittance"], length)
    yield airlight(radiance(even), length)
    yield visibility(_seen(Smog(visibility=VISIBILITY), device).layers["transmittance"], length)
    stratified = _seen(Smog(sigma=SIGMA, height_falloff=FALLOFF, base=BASE), device)
    yield falloff_to_ground(stratified.layers["transmittance"], length)
    yield falloff_to_sky(stratified.layers["transmittance"], VIEW.directions()[..., 2])


def transmittance(measured: Float[np.ndarray, "h w"], length: Float[np.ndarray, "h w"]) -> Check:
    """Compare the layer `transmittance` with exp(-sigma s) (Bouguer 1729, Lambert 1760)."""
    near = np.isfinite(length)
    error = _depth_error(measured[near], SIGMA * length[near])
    compares = "optical depth of even smog with sigma s, on ground 2 to 60 m away"
    return Check("smog transmittance", compares, error, 0.1, "%", BEER_LAMBERT)


def airlight(measured: Float[np.ndarray, "h w 3"], length: Float[np.ndarray, "h w"]) -> Check:
    """Compare radiance with T J + (1 - T) c of the ground's own J (Koschmieder 1924)."""
    directions = VIEW.directions()
    known = np.isfinite(length) | (directions[..., 2] > 0)
    passed = np.exp(-SIGMA * length)[..., None]
    colour = np.array([linear_from_display(each) for each in COLOUR])
    expected = passed * np.array(GROUND) + (1 - passed) * colour
    error = float(np.abs(measured - expected)[known].max())
    compares = "radiance with T J + (1 - T) c, on ground and sky"
    return Check("smog airlight", compares, error, 1e-3, "1", "Koschmieder 1924")


def visibility(measured: Float[np.ndarray, "h w"], length: Float[np.ndarray, "h w"]) -> Check:
    """Compare the contrast left over one visibility with 5 % (WMO-No. 8, 9.1)."""
    near = np.isfinite(length)
    contrast = measured[near].astype(np.float64) ** (VISIBILITY / length[near])
    error = 100 * float(np.abs(contrast / 0.05 - 1).max())
    compares = "contrast that is left over one visibility with 0.05"
    source = "meteorological optical range, WMO-No. 8"
    return Check("smog visibility", compares, error, 0.5, "%", source)


def falloff_to_ground(
    measured: Float[np.ndarray, "h w"], length: Float[np.ndarray, "h w"]
) -> Check:
    """Compare the optical depth down to the ground, across the base of the fall-off.

    The integral of the Beer-Lambert law over sigma exp(-(z - base)/H), see
    `closed_forms.stratified_optical_depth`.
    """
    near = np.isfinite(length)
    end = np.zeros(int(near.sum()))
    expected = stratified_optical_depth(SIGMA, FALLOFF, BASE, EYE_Z, end, length[near])
    error = _depth_error(measured[near], expected)
    compares = "optical depth with its integral, sigma falling with height, to the ground"
    return Check("smog fall-off to ground", compares, error, 0.1, "%", BEER_LAMBERT)


def falloff_to_sky(measured: Float[np.ndarray, "h w"], rise: Float[np.ndarray, "h w"]) -> Check:
    """Compare the optical depth up to the sky with sigma H exp(-z/H)/sin(elevation)."""
    sky = rise > MIN_RISE
    expected = sky_optical_depth(SIGMA, FALLOFF, BASE, EYE_Z, rise[sky])
    error = _depth_error(measured[sky], expected)
    compares = "optical depth with its integral, sigma falling with height, to the sky"
    return Check("smog fall-off to sky", compares, error, 0.1, "%", BEER_LAMBERT)


def _depth_error(measured: Float[np.ndarray, "n"], expected: Float[np.ndarray, "n"]) -> float:
    """Largest relative error of the optical depth -ln T, %."""
    depth = -np.log(np.maximum(measured.astype(np.float64), 1e-300))
    return 100 * float(np.abs(depth / expected - 1).max())


def _seen(smog: Smog, device: torch.device) -> Frame:
    ground = HalfSpace(colour=GROUND)
    box = ((-200.0, -200.0, -2.0), (200.0, 200.0, 6.0))
    field = AnalyticField([ground], 2e4, zenith=SKY, horizon=SKY, box=box, device=device)
    return frame_in(field, Weather(smog=smog), VIEW)
