"""The paper's four panels: a place as it is, with snow, in another season, and in both."""

from collections.abc import Callable

import numpy as np

from climatenerf.core.device import to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA
from climatenerf.render.session import Frame
from climatenerf.studies.shot import Shot
from climatenerf.studies.study_folder import Row
from climatenerf.studies.sweep import difference

ROWS = ("original", "+ snow", "styled", "styled + snow")
SEEN = 2.0  # RMS difference in 1/255 that an eye can see


def season_panels(shot: Shot, progress: Callable[[str], None]) -> list[Row]:
    """Render the four panels and measure what changes between them.

    Args:
        shot: camera, and a weather with snow and a season.
        progress: called with each panel as it begins.

    Raises:
        UserError: the weather has no snow, or no season.
    """
    weather = shot.weather
    if not weather.snow.depth or weather.season.kind == "captured":
        raise UserError(
            "the four panels need snow and a season; give snow.depth and season.kind in the weather"
            " file, or leave --weather out"
        )
    bare = weather.with_value("snow.depth", None)
    weathers = (
        bare.with_value("season.kind", "captured"),
        weather.with_value("season.kind", "captured"),
        bare,
        weather,
    )
    session = shot.session(weather)
    frames: dict[str, Frame] = {}
    for name, each in zip(ROWS, weathers, strict=True):
        progress(name)
        session.change(each)
        frames[name] = session.frame(shot.camera, shot.c2w, shot.time)
    rows = []
    for name in ROWS:
        metrics = measured(frames[name], frames["original"])
        rows.append(Row(name, frames[name].picture, metrics, *verdict(name, frames)))
    return rows


def measured(frame: Frame, original: Frame) -> dict[str, float]:
    """Return the numbers of a panel."""
    display = frame.picture.astype(np.float64)
    return {
        "difference_from_original_255": difference(frame.picture, original.picture),
        "snow_share": float(frame.layers["mask_snow"].mean()),
        "mean_luma": float((to_numpy(frame.linear) @ LUMA).mean()),
        "colourfulness_255": float((display.max(-1) - display.min(-1)).mean()),
    }


def verdict(name: str, frames: dict[str, Frame]) -> tuple[str, bool | None]:
    """Return the sentence with what a panel must show, and whether it does."""
    own, original = frames[name], frames["original"]
    change = difference(own.picture, original.picture)
    if name == "original":
        return "", None
    if name == "+ snow":
        share = float(own.layers["mask_snow"].mean())
        text = f"snow on {100 * share:.0f} % of the picture, which changes by {change:.1f}/255"
        return text, share > 0 and change > SEEN
    if name == "styled":
        same = np.array_equal(own.layers["depth"], original.layers["depth"])
        text = (
            f"the picture changes by {change:.1f}/255, and depth {'stays' if same else 'changes'}"
        )
        return text, same and change > SEEN
    snow = frames["+ snow"]
    where = np.array_equal(own.layers["mask_snow"], snow.layers["mask_snow"])
    further = difference(own.picture, snow.picture)
    text = f"snow lies {'where it lies' if where else 'elsewhere than'} without the season"
    return f"{text}; the season changes the picture by {further:.1f}/255", where and further > SEEN
