"""Ablation of the snow's shading, after the paper's.

All rows have the same snow in the paper's light (`Snow.light`): a tint by the ground's brightness,
the sun's shadow, and wrap lighting (n.l + gamma)/(1 + gamma). They differ in colour alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.device import to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.metrics import psnr
from climatenerf.render.frame import FrameOptions, encoded_8bit, see_frame
from climatenerf.studies.shot import Shot
from climatenerf.studies.study_folder import Picture, Row
from climatenerf.studies.sweep import difference
from climatenerf.weather.light.sun import sun_direction
from climatenerf.weather.snow.layer import BakedSnow
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

ROWS = ("pure white", "varying colour only", "diffuse", "full")
WEATHER = "snow-deep"  # of the reference set
SNOWY = 0.999  # fraction of snow from which a pixel counts as snow
MIN_PIXELS = 400
ENDLESS_WRAP = 1e9  # (n.l + gamma)/(1 + gamma) is 1 in float32
LIT = 0.5  # brightness of snow without n.l, over its greatest, from which it is in no shadow
DARKEST, BRIGHTEST = 5.0, 95.0  # percentiles
UNSHADED = 0.05  # change of luma with n.l over its mean: less without n.l, more with wrap lighting
# Darkest over brightest of lit snow. Wrap lighting of gamma 8 leaves .89 on slopes across light.
# Without it level snow has .64 of the brightest under a sun 40 deg high.
SOFT = 0.7  # diffuse below, full above


class WhiteSnow(BakedSnow):
    """Snow of radiance 1 everywhere, white in every photo."""

    def colour(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear radiance: 1."""
        return torch.ones_like(x)

    def colour_towards(
        self, x: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"], width: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance: 1."""
        return torch.ones_like(x)


@dataclass(frozen=True)
class Seen:
    """One row's picture.

    Attributes:
        picture: display values.
        luma: linear.
        snowy: pixels of snow.
        normal: unit normals, world axes.
    """

    picture: Picture
    luma: Float[np.ndarray, "h w"]
    snowy: Bool[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]


def snow_ablation(shot: Shot, progress: Callable[[str], None]) -> list[Row]:
    """Render the rows of a snow cover and measure their faults.

    Args:
        shot: camera, weather with snow, and truth if it is known.
        progress: called with each row as it begins.

    Raises:
        UserError: the picture shows no snow.
    """
    weather = shot.weather.with_value("snow.light", "paper")
    world = shot.session(weather).world(shot.time)
    snow = snow_of(world)
    white = WhiteSnow(**{each.name: getattr(snow, each.name) for each in fields(BakedSnow)})
    changed = {
        "pure white": white,
        "varying colour only": with_wrap(snow, ENDLESS_WRAP),
        "diffuse": with_wrap(snow, 0.0),
        "full": snow,
    }
    rows = {}
    for name, matter in changed.items():
        progress(name)
        rows[name] = see(replace(world, matters=(matter,)), shot)
    if rows["full"].snowy.sum() < MIN_PIXELS:
        raise UserError(
            f"the picture of {shot.view} shows too little snow; choose another photo with --view,"
            " or deeper snow in a weather file with --weather"
        )
    metrics = measured(rows, weather, shot)
    return [Row(name, rows[name].picture, metrics[name], *verdict(name, metrics)) for name in ROWS]


def snow_of(world: World) -> BakedSnow:
    """Return the snow of a world."""
    snow = world.matters[0]
    assert isinstance(snow, BakedSnow), "the caller gives a weather with snow and no other matter"
    return snow


def with_wrap(snow: BakedSnow, wrap: float) -> BakedSnow:
    """Return the same snow with another gamma of its wrap lighting, of any size."""
    return replace(snow, snow=replace(snow.snow, wrap=wrap))


def see(world: World, shot: Shot) -> Seen:
    """Render a world and keep what the numbers need."""
    linear, layers = see_frame(world, shot.camera, shot.c2w, FrameOptions(normals=True))
    grey = to_numpy(linear).astype(np.float64) @ LUMA
    return Seen(encoded_8bit(linear), grey, layers["mask_snow"] > SNOWY, layers["normal"])


def measured(rows: dict[str, Seen], weather: Weather, shot: Shot) -> dict[str, dict[str, float]]:
    """Return the numbers of all rows.

    Args:
        rows: their pictures.
        weather: where the sun stands.
        shot: with the truth, if it is known.
    """
    full, tint = rows["full"], rows["varying colour only"]
    snowy = full.snowy
    sun = sun_direction(weather.sun)
    # As the snow's own shading: without a sun the light comes from above.
    towards = sun if sun is not None and sun[2] > 0 else np.array([0.0, 0.0, 1.0])
    facing = (full.normal @ towards)[snowy]
    brightness = tint.luma[snowy]
    lit = brightness > LIT * np.percentile(brightness, BRIGHTEST)
    found = {}
    for name, row in rows.items():
        own = row.luma[snowy]
        darkest, brightest = np.percentile(own[lit], [DARKEST, BRIGHTEST])
        found[name] = {
            "difference_from_full_255": difference(row.picture, full.picture),
            "luma_deviation_255": float((row.picture @ LUMA)[snowy].std()),
            "correlation_with_facing": correlation(own[lit], facing[lit]),
            "relative_change_with_facing": relative_slope(own[lit], facing[lit]),
            "darkest_over_brightest": float(darkest / max(brightest, 1e-6)),  # black snow: 0/0
        }
        if shot.truth is not None:
            pixels = shot.truth.snow()
            true = shot.truth.picture()[pixels]
            found[name]["psnr_snow_db"] = psnr((row.picture / 255.0)[pixels][None], true[None])
    return found


def correlation(luma: Float[np.ndarray, "n"], facing: Float[np.ndarray, "n"]) -> float:
    """Return Pearson's correlation; 0 for snow of one brightness, or of one slope."""
    if min(luma.std(), facing.std()) < 1e-6:
        return 0.0
    return float(np.corrcoef(luma, facing)[0, 1])


def relative_slope(luma: Float[np.ndarray, "n"], facing: Float[np.ndarray, "n"]) -> float:
    """Return the change of luma with n.l over its mean, by least squares; 0 for one slope.

    Unlike a correlation it is small for colour that hardly varies. Wrap lighting gives about
    1/(n.l + gamma).
    """
    if facing.std() < 1e-6:
        return 0.0
    return float(np.polyfit(facing, luma, 1)[0] / max(luma.mean(), 1e-6))  # black snow: 0/0


def verdict(name: str, metrics: dict[str, dict[str, float]]) -> tuple[str, bool]:
    """Return the sentence with the number that must show a row's fault, and whether it does."""
    own, full = metrics[name], metrics["full"]
    ratio, usual = own["darkest_over_brightest"], full["darkest_over_brightest"]
    if name == "pure white":
        deviation = own["luma_deviation_255"]
        text = f"deviation of luma {deviation:.2g}/255 against {full['luma_deviation_255']:.2g}"
        shown = deviation < 1e-9 < full["luma_deviation_255"]
    elif name == "varying colour only":
        found, other = (each["relative_change_with_facing"] for each in (own, full))
        text = f"change of luma with n.l {found:.3f} of its mean, against {other:.3f}"
        shown = abs(found) < UNSHADED < other
    elif name == "diffuse":
        text = f"darkest 5 % of lit snow {ratio:.2f} of the brightest, against {usual:.2f}"
        shown = ratio < SOFT
    else:
        text = f"darkest 5 % of lit snow {ratio:.2f} of the brightest"
        shown = ratio > SOFT
    if name == "full":
        if "psnr_snow_db" in full:
            better = [n for n in ROWS if metrics[n]["psnr_snow_db"] > full["psnr_snow_db"]]
            text += f"; PSNR on true snow {full['psnr_snow_db']:.2f} dB"
            text += f", which {', '.join(better)} exceeds" if better else ", the best of all rows"
        return text, shown
    if own["difference_from_full_255"] == 0:
        return "the picture equals that of the full row", False
    return text, shown
