"""What weather will look wrong in a fitted place, and why. Does not import torch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

FEW_PHOTOS = 30
LOW_PSNR = 22.0  # dB; below it pictures are blurred
FAR_BELOW_MEAN = 4.0  # dB, of a photo
UNSEEN_GROUND = 0.15  # fraction of the ground near the cameras
ROUGH_GROUND = 6.0  # cm
FLOATING = 0.002  # fraction of the ends of rays
SKY_EMPTY = 0.95
SCALE_ERROR = 0.1
LITTLE_SKY, MUCH_SKY = 0.03, 0.5
DEPTH_ERROR = 0.05


@dataclass(frozen=True)
class WeakPoint:
    """One thing that weather shows.

    Attributes:
        title: what is weak.
        evidence: the number that says so.
        consequence: what will look wrong in which weather.
        remedy: what helps.
    """

    title: str
    evidence: str
    consequence: str
    remedy: str


@dataclass(frozen=True)
class Evidence:
    """What is known of a fit.

    Attributes:
        metrics: of `metrics.json`.
        photos: number of training photos.
        scale_source: what sets the scale.
        scale_error: its relative standard error.
        ground_seen: fraction of the ground near the cameras that photos show; None: unknown.
        sky: fraction of the photos' pixels that show the sky.
        light: whether the light of the photos was found.
        classes: whether the field knows classes.
    """

    metrics: Mapping[str, Any]
    photos: int
    scale_source: str
    scale_error: float
    ground_seen: float | None
    sky: float
    light: bool
    classes: bool


def weak_points(given: Evidence) -> list[WeakPoint]:
    """Return the weak points of a fit, those of the geometry first."""
    return [*_ground(given), *_geometry(given), *_pictures(given), *_light(given)]


def _ground(given: Evidence) -> list[WeakPoint]:
    found = []
    if given.ground_seen is None:
        found.append(
            WeakPoint(
                "No terrain",
                "the photos show too little ground for a height raster",
                "water, snow and puddles have nothing to lie on where the field has holes",
                "take photos that look down at the ground, and fit again",
            )
        )
    elif given.ground_seen < 1 - UNSEEN_GROUND:
        found.append(
            WeakPoint(
                "Ground that no photo shows",
                f"{percent(1 - given.ground_seen)} of the ground within 10 m of the cameras",
                "snow and water lie there on a smooth guess in blurred colours",
                "add photos that look down, from the same path",
            )
        )
    rough = given.metrics.get("ground.roughness_cm")
    if rough is not None and rough > ROUGH_GROUND:
        found.append(
            WeakPoint(
                "Rough ground",
                f"{rough:.0f} cm about a plane",
                "a shallow flood has a ragged waterline, thin snow is uneven",
                "fit for longer; photos of untextured ground need more light or more overlap",
            )
        )
    return found


def _geometry(given: Evidence) -> list[WeakPoint]:
    found, metrics = [], given.metrics
    floating = metrics.get("floating.share")
    if floating is not None and floating > FLOATING:
        found.append(
            WeakPoint(
                "Floating matter",
                f"{percent(floating)} of the photos' rays end on it",
                "dark specks in smog and in front of the sky; snow on nothing",
                "fit for longer; leave out blurred photos",
            )
        )
    empty = metrics.get("sky.empty")
    if empty is not None and empty < SKY_EMPTY:
        found.append(
            WeakPoint(
                "Sky that is not empty",
                f"{percent(1 - empty)} of the sky holds matter",
                "specks in smog, dirty reflections of the sky in water",
                "give labels with the class sky",
            )
        )
    error = metrics.get("points.abs_rel")
    if error is not None and error > DEPTH_ERROR:
        found.append(
            WeakPoint(
                "Inexact depth",
                f"{percent(error)} at sparse points that the fit has not used",
                "smog is too thick or too thin, waterlines on walls are at the wrong place",
                "check the poses with `climatenerf check`; fit for longer",
            )
        )
    if given.scale_error >= SCALE_ERROR:
        found.append(
            WeakPoint(
                "Uncertain scale",
                f"{percent(given.scale_error)} by {given.scale_source.replace('-', ' ')}",
                "levels, depths and visibilities in metres are off by as much",
                "mark a known length, or give --camera-height",
            )
        )
    return found


def _pictures(given: Evidence) -> list[WeakPoint]:
    found, metrics = [], given.metrics
    if given.photos < FEW_PHOTOS:
        found.append(
            WeakPoint(
                "Few photos",
                f"{given.photos} photos were fitted",
                "away from the photos' own positions, things tear or blur",
                f"take {FEW_PHOTOS} or more, with most of each in the next one too",
            )
        )
    psnr = metrics.get("psnr")
    if psnr is not None and psnr < LOW_PSNR:
        found.append(
            WeakPoint(
                "Blurred pictures",
                f"{psnr:.1f} dB in held-out photos",
                "all weather lies on a blurred place",
                "fit for longer, in full resolution; check the poses with `climatenerf check`",
            )
        )
    worst = far_below(metrics)
    if worst:
        names = ", ".join(f"{name} ({value:.1f} dB)" for name, value in worst[:3])
        found.append(
            WeakPoint(
                "Held-out photos that fit badly",
                f"{names}; the mean is {psnr:.1f} dB",
                "views from there are worse than the rest",
                "add photos around them, or leave them out of camera paths",
            )
        )
    if not given.classes:
        found.append(
            WeakPoint(
                "No classes",
                "the run was fitted without class labels of the ground and what stands on it",
                "seasons are refused; roofs, crowns and ground are distinguished by shape alone",
                "give labels by --labels",
            )
        )
    return found


def _light(given: Evidence) -> list[WeakPoint]:
    found = []
    if not given.light:
        found.append(
            WeakPoint(
                "Unknown light",
                "the light of the photos could not be found",
                "snow, mud and smog are lit as in the open; another sky is refused",
                "take photos that show more sky and sunlit ground",
            )
        )
    elif given.sky < LITTLE_SKY:
        found.append(
            WeakPoint(
                "Little sky",
                f"{percent(given.sky)} of the photos' pixels",
                "the sky that water mirrors is a guess above what the photos show",
                "add some photos that look up",
            )
        )
    if given.sky > MUCH_SKY:
        found.append(
            WeakPoint(
                "Mostly sky",
                f"{percent(given.sky)} of the photos' pixels",
                "little is left that carries weather",
                "point the camera lower",
            )
        )
    return found


def far_below(metrics: Mapping[str, Any]) -> Sequence[tuple[str, float]]:
    """Return held-out photos far below the mean PSNR, the worst first."""
    mean, views = metrics.get("psnr"), metrics.get("views") or {}
    if mean is None:
        return []
    values = sorted((row["psnr"], name) for name, row in views.items())
    return [(name, value) for value, name in values if value < mean - FAR_BELOW_MEAN]


def percent(value: float) -> str:
    """Write a fraction as a percentage."""
    return f"{100 * value:.0f} %" if value >= 0.0995 else f"{100 * value:.1f} %"
