"""Checks of a user's own run, from one of its cameras.

The geometry of a fitted field is not known in closed form. What holds whatever it is, is checked
with a threshold; other figures are information.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.device import to_numpy
from climatenerf.field.compositing import RENDER_STEP
from climatenerf.field.hash_field import Field
from climatenerf.field.protocol import device_of
from climatenerf.ops import compositing
from climatenerf.render.session import Frame, RenderSession
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene
from climatenerf.verification import invariance
from climatenerf.verification.check import Check
from climatenerf.verification.closed_forms import linear_from_display
from climatenerf.verification.setting import Viewpoint, clear_fraction, radiance, sky_of
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.medium import PAPER_COLOUR
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

LEVELS = (0.1, 0.3, 0.5)  # fractions of the camera's height over the datum
OPTICAL_DEPTH = 1.0  # of the smog, at the median depth
SNOW_DEPTH = 0.15  # m
MAX_SPREAD = 0.02  # standard deviation of depths along a ray over the median depth: one surface
MAX_CLEAR = 0.01  # light from behind a surface that counts as opaque
MIN_SURFACES = 0.02  # fraction of the pixels with a surface below which snow is not measured
LEVEL_NORMAL = 0.95  # cosine of the slope below which ground counts as level


def checks(field: Field, scene: Scene, viewpoint: Viewpoint) -> Iterator[Check]:
    """Render the run clean and in each weather, and compare.

    Args:
        field: the fitted field.
        scene: its capture.
        viewpoint: a small camera in a place of the capture.
    """
    yield stored_numbers(field.state_dict())

    session = RenderSession(field, scene, Weather(), viewpoint.eye[None], effects=EFFECTS)

    def seen(weather: Weather, layers: tuple[str, ...] = ()) -> Frame:
        session.change(weather)
        return session.frame(viewpoint.camera, viewpoint.c2w, layers=layers)

    clean = seen(Weather())
    yield finite(clean)
    solid = np.isfinite(clean.layers["depth"])
    distance = float(np.median(clean.layers["depth"][solid])) if solid.any() else 1.0
    smog = Smog(sigma=OPTICAL_DEPTH / distance, light="paper", colour=PAPER_COLOUR)
    hazy = seen(Weather(smog=smog))
    yield transmittance(hazy, OPTICAL_DEPTH / distance)
    single = single_surface(field, viewpoint, MAX_SPREAD * distance)
    yield airlight(clean, hazy, OPTICAL_DEPTH / distance, PAPER_COLOUR, single)

    height = float(viewpoint.eye[2]) - scene.ground_z
    reach = max(height, 1.0)
    wet = [
        Weather(seed=1, smog=smog, flood=Flood(level=height - reach * (1 - fraction)))
        for fraction in LEVELS
    ]
    frames = [seen(weather) for weather in wet]
    coverage = [frame.layers["mask_water"] for frame in frames]
    yield nested(coverage, single)
    yield invariance.coverage_loss(coverage, "run flood coverage", None)
    yield invariance.same_seed(frames[-1], seen(wet[-1]), "run same seed")
    yield invariance.other_seed(frames[-1], seen(wet[-1].with_value("seed", 2)), "run other seed")

    nothing = seen(Weather(**invariance.NOTHING))
    yield invariance.no_effect(clean, nothing, "run no effect")
    yield invariance.no_effect_on_layers(clean, nothing, "run no effect on layers")
    sky, clear = sky_of(field, viewpoint), clear_fraction(field, viewpoint)
    hidden = seen(Weather(**invariance.FAINT))
    yield invariance.faint_smog(clean, hidden, sky, clear, "run no effect of faint smog")
    # In fog without surfaces the search for ground takes minutes and finds none.
    if single.mean() >= MIN_SURFACES:
        yield snow_depth(seen(Weather(snow=Snow(depth=SNOW_DEPTH)), ("normal",)))


def single_surface(
    field: Field, viewpoint: Viewpoint, max_spread: float
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose ray meets opaque matter in one narrow range of depth.

    Only there has a fitted field what the formulas speak of: one surface at the depth of the layer
    `depth`. The rays of a blurred field have none.

    Args:
        field: the field.
        viewpoint: the camera.
        max_spread: greatest standard deviation of the depth of what a ray meets, m.
    """
    camera, device = viewpoint.camera, device_of(field)
    rays_o, rays_d = camera_rays(camera, viewpoint.c2w, device)
    near = torch.full((rays_o.shape[0],), field.near, device=device)
    with torch.no_grad():
        samples = field.march(rays_o, rays_d, near, torch.full_like(near, 1e9), RENDER_STEP)
        weights, clear = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        powers = torch.stack([torch.ones_like(samples.t), samples.t, samples.t**2], dim=-1)
        sums = compositing.accumulate(weights, powers, samples.offsets)
    total, first, second = to_numpy(sums).astype(np.float64).T
    total = np.maximum(total, 1e-9)  # of a ray that meets nothing
    spread = np.sqrt(np.maximum(second / total - (first / total) ** 2, 0.0))
    single = (to_numpy(clear) < MAX_CLEAR) & (spread <= max_spread)
    return single.reshape(camera.height, camera.width)


def nested(coverage: Sequence[Float[np.ndarray, "h w"]], single: Bool[np.ndarray, "h w"]) -> Check:
    """Count the pixels with a single surface that fall dry as the level rises.

    In fog, the soft shore follows from normals that differ from level to level.
    """
    name = "run flood levels nested"
    found = invariance.nested([each[single] for each in coverage], name)
    return found if single.any() else replace(found, figure=math.nan, threshold=None)


def stored_numbers(tensors: dict[str, Tensor]) -> Check:
    """Count the numbers of the field's files that are not finite."""
    bad = sum(int((~value.isfinite()).sum()) for value in tensors.values())
    compares = f"stored numbers of {len(tensors)} arrays that are not finite"
    return Check("run files", compares, float(bad), 0.0, "numbers", "definition")


def finite(clean: Frame) -> Check:
    """Count the radiances of a clean frame that are not finite or below 0."""
    values = radiance(clean)
    bad = int((~np.isfinite(values) | (values < 0)).sum())
    compares = "radiances of the clean frame that are not finite, or below 0"
    return Check("run clean frame", compares, float(bad), 0.0, "numbers", "definition")


def transmittance(hazy: Frame, sigma: float) -> Check:
    """Compare the layer `transmittance` with exp(-sigma s) of the layer `depth`."""
    depth = hazy.layers["depth"].astype(np.float64)
    # Beyond an optical depth of 20 hardly anything is transmitted.
    near = np.isfinite(depth) & (sigma * depth < 20)
    found = -np.log(np.maximum(hazy.layers["transmittance"][near].astype(np.float64), 1e-300))
    error = 100 * float(np.abs(found / (sigma * depth[near]) - 1).max()) if near.any() else math.nan
    compares = "optical depth of smog with sigma s of the run's own depth"
    threshold = 0.5 if near.any() else None
    return Check("run smog transmittance", compares, error, threshold, "%", "Beer-Lambert law")


def airlight(
    clean: Frame,
    hazy: Frame,
    sigma: float,
    colour: tuple[float, float, float],
    single: Bool[np.ndarray, "h w"],
) -> Check:
    """Compare the frame in smog with T J + (1 - T) c of the clean one J and its depth.

    Only pixels with a single surface: matter at several depths has no single T. Of these the median
    is compared.
    """
    depth = clean.layers["depth"].astype(np.float64)
    passed = np.exp(-sigma * depth)[..., None]
    air = np.array([linear_from_display(each) for each in colour])
    expected = passed * radiance(clean) + (1 - passed) * air
    error = np.abs(radiance(hazy) - expected)[single]
    figure = float(np.median(error)) if single.any() else math.nan
    compares = f"radiance in smog with T J + (1 - T) c, {single.mean():.0%} of pixels, median"
    threshold = 0.02 if single.any() else None
    return Check("run smog airlight", compares, figure, threshold, "1", "Koschmieder 1924")


def snow_depth(snowy: Frame) -> Check:
    """Compare snow on ground that looks level with the depth that was asked: information.

    Sheltered ground, steps and rough ground have less or more.
    """
    normal: Float[np.ndarray, "h w 3"] = snowy.layers["normal"]
    level = (snowy.layers["mask_snow"] > 0.9) & (normal[..., 2] > LEVEL_NORMAL)
    thickness = snowy.layers["snow_thickness"][level]
    error = 100 * abs(float(np.median(thickness)) / SNOW_DEPTH - 1) if level.any() else math.nan
    compares = f"snow on level ground with 15 cm, median over {100 * level.mean():.0f} % of pixels"
    return Check("run snow depth", compares, error, None, "%", "definition")
