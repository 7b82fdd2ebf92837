"""Checks of a user's own run, from one of its cameras.

The geometry of a fitted field is not known in closed form. What holds whatever it is, is checked
with a threshold; other figures are information.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from torch import Tensor

from climatenerf.field.hash_field import Field
from climatenerf.render.session import Frame, RenderSession
from climatenerf.scene.scene import Scene
from climatenerf.verification import invariance
from climatenerf.verification.check import Check
from climatenerf.verification.closed_forms import linear_from_display
from climatenerf.verification.setting import Viewpoint, clear_fraction, radiance, sky_of
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

LEVELS = (0.1, 0.3, 0.5)  # fractions of the camera's height over the datum
OPTICAL_DEPTH = 1.0  # of the smog, at the median depth
SNOW_DEPTH = 0.15  # m
LEVEL_NORMAL = 0.95  # cosine of the slope below which ground counts as level


def checks(field: Field, scene: Scene, viewpoint: Viewpoint) -> Iterator[Check]:
    """Render the run clean and in each weather, and compare.

    Args:
        field: the fitted field.
        scene: its capture.
        viewpoint: a small camera in a place of the capture.
    """
    yield stored_numbers(field.state_dict())

    def seen(weather: Weather, layers: tuple[str, ...] = ()) -> Frame:
        session = RenderSession(field, scene, weather, viewpoint.eye[None], effects=EFFECTS)
        return session.frame(viewpoint.camera, viewpoint.c2w, layers=layers)

    clean = seen(Weather())
    yield finite(clean)
    solid = np.isfinite(clean.layers["depth"])
    distance = float(np.median(clean.layers["depth"][solid])) if solid.any() else 1.0
    smog = Smog(sigma=OPTICAL_DEPTH / distance)
    hazy = seen(Weather(smog=smog))
    yield transmittance(hazy, OPTICAL_DEPTH / distance)
    yield airlight(clean, hazy, OPTICAL_DEPTH / distance, smog.colour)

    height = float(viewpoint.eye[2]) - scene.ground_z
    reach = max(height, 1.0)
    wet = [
        Weather(seed=1, smog=smog, flood=Flood(level=height - reach * (1 - fraction)))
        for fraction in LEVELS
    ]
    frames = [seen(weather) for weather in wet]
    coverage = [frame.layers["mask_water"] for frame in frames]
    yield invariance.nested(coverage, "run flood levels nested")
    yield invariance.coverage_loss(coverage, "run flood coverage", None)
    yield invariance.same_seed(frames[-1], seen(wet[-1]), "run same seed")
    yield invariance.other_seed(frames[-1], seen(wet[-1].with_value("seed", 2)), "run other seed")

    nothing = seen(Weather(**invariance.NOTHING))
    yield invariance.no_effect(clean, nothing, "run no effect")
    yield invariance.no_effect_on_layers(clean, nothing, "run no effect on layers")
    sky, clear = sky_of(field, viewpoint), clear_fraction(field, viewpoint)
    hidden = seen(Weather(**invariance.FAINT))
    yield invariance.faint_smog(clean, hidden, sky, clear, "run no effect of faint smog")
    yield snow_depth(seen(Weather(snow=Snow(depth=SNOW_DEPTH)), ("normal",)))


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


def airlight(clean: Frame, hazy: Frame, sigma: float, colour: tuple[float, float, float]) -> Check:
    """Compare the frame in smog with T J + (1 - T) c of the clean one J and its depth.

    Only information for a single pixel: the matter along a ray of a fitted field lies at several
    depths, while J and the mean depth have one. So the median is compared.
    """
    depth = clean.layers["depth"].astype(np.float64)
    passed = np.exp(-sigma * depth)[..., None]
    air = np.array([linear_from_display(each) for each in colour])
    expected = passed * radiance(clean) + (1 - passed) * air
    error = float(np.median(np.abs(radiance(hazy) - expected)))
    compares = "radiance in smog with T J + (1 - T) c of the clean frame, median"
    return Check("run smog airlight", compares, error, 0.02, "1", "Koschmieder 1924")


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
