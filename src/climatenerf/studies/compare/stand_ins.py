"""Eight edits of clean frames that need no weights and stand in for classes of other methods.

They are never named after a published model. Five are the baselines of `evaluation.baselines`; the
others recolour: `class-recolour` as 3D stylisation does, `global-mk` by one map for the movie,
`picture-statistics` by a map for each picture. Free constants and target colours are fitted to the
true pictures where the capture has them, else to our own, so that methods differ and not colours.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from climatenerf.core.srgb import to_display
from climatenerf.evaluation import baselines
from climatenerf.evaluation.baseline_rendering import (
    WeatherMoment,
    render_baseline,
    tune,
)
from climatenerf.studies.compare import colours
from climatenerf.studies.compare.material import Kind, Material
from climatenerf.studies.compare.pictures import Picture
from climatenerf.weather.smog.medium import sigma_of

EditFrame = Callable[[int], np.ndarray]
"""Returns the display picture of a frame by its index."""
EVERY = frozenset({"smog", "flood", "snow"})
SHOWN = {
    "depth-fog": frozenset({"smog"}),
    "flat-plane": frozenset({"flood"}),
    "screen-reflection": frozenset({"flood"}),
    "white-paint": frozenset({"snow"}),
    "class-recolour": frozenset({"snow"}),
    "global-mk": EVERY,
    "picture-statistics": EVERY,
    "frame-noise": EVERY,
}
"""Effects that each stand-in can show."""
VERSION = 1
"""Part of the identity of finished frames; change it with each change of what is computed."""
FITTED = 3  # frames, evenly spaced, that constants are fitted to


@dataclass(frozen=True)
class StandIn:
    """One of `SHOWN`; see `material.Method`."""

    name: str
    kind: Kind = "stand-in"
    licence: str = "Apache-2.0, part of climatenerf"

    def shows(self, material: Material) -> bool:
        """Return whether it has the effect, and the run the classes that it needs."""
        known = self.name != "class-recolour" or material.has_labels
        return known and material.effect in SHOWN[self.name]

    def identity(self, material: Material) -> object:
        """Return the version of the code."""
        return VERSION

    def pictures(self, material: Material, indices: Sequence[int], work: Path) -> Iterator[Picture]:
        """Return the edited frames; see `material.Method`."""
        edit = _EDITS[self.name](material)
        return (_rounded(edit(index)) for index in indices)


STAND_INS = tuple(StandIn(name) for name in SHOWN)


def fitted_frames(count: int) -> list[int]:
    """Return the frames that constants are fitted to: the first, the last and one between."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(FITTED, count))})


def _moment(material: Material, index: int) -> WeatherMoment:
    job = material.ours.job
    return WeatherMoment(job.weather, job.time(index))


def _baseline(name: str) -> Callable[[Material], EditFrame]:
    """Return what fits the constants of a baseline of `evaluation.baselines`."""

    def fitted(material: Material) -> EditFrame:
        frames = fitted_frames(len(material))
        moment = _moment(material, frames[len(frames) // 2])
        views = [material.view(i) for i in frames]
        targets = [material.target(i) for i in frames]
        constants = tune(moment, material.ground_z, views, targets)

        def edit(index: int) -> np.ndarray:
            view, ground_z = material.view(index), material.ground_z
            moment = _moment(material, index)
            display = render_baseline(moment, ground_z, view, constants, name, index)
            assert display is not None, "SHOWN lists what each baseline can show"
            return display

        return edit

    return fitted


def _depth_fog(material: Material) -> EditFrame:
    """Fit colour and extinction of a fog that depends on the depth alone.

    `tune` takes the colour of thick smog from the weather, which does not state it where smog
    scatters the light of the place.
    """
    frames = fitted_frames(len(material))
    views, targets = [material.view(i) for i in frames], [material.target(i) for i in frames]
    sigma = sigma_of(_moment(material, frames[0]).weather.at(0.0).smog) or 0.0
    seen = [np.exp(-sigma * view.depth) for view in views]
    bases = [view.linear * t[..., None] for view, t in zip(views, seen, strict=True)]
    colour = baselines.tuned_colour(bases, [1 - t for t in seen], targets)
    sigma = baselines.tuned_sigma(views, targets, sigma, colour)
    return lambda i: to_display(baselines.depth_fog(material.view(i), sigma, colour))


def _frame_noise(material: Material) -> EditFrame:
    """Put noise that is new in each frame over the simplest edit of the effect."""
    simplest = {"smog": "depth-fog", "flood": "flat-plane", "snow": "white-paint"}
    edit = _EDITS[simplest[material.effect]](material)
    return lambda i: baselines.frame_noise(edit(i), material.seed + i)


def _global_mk(material: Material) -> EditFrame:
    every = range(len(material))
    source = colours.moments([_display(material.clean.picture(i)) for i in every])
    target = colours.moments([_display(material.target(i)) for i in every])
    return lambda i: colours.transferred(_display(material.clean.picture(i)), source, target)


def _picture_statistics(material: Material) -> EditFrame:
    """Give each picture the statistics of one target, as a style photo would."""
    target = colours.moments([_display(material.target(len(material) // 2))])

    def edit(index: int) -> np.ndarray:
        picture = _display(material.clean.picture(index))
        return colours.transferred(picture, colours.moments([picture]), target)

    return edit


def _class_recolour(material: Material) -> EditFrame:
    every = range(len(material))
    linear = [baselines.linear_of(material.clean.picture(i)) for i in every]
    means = colours.class_means(linear, [material.label(i) for i in every])

    def edit(index: int) -> np.ndarray:
        picture = baselines.linear_of(material.clean.picture(index))
        return to_display(colours.whitened(picture, material.label(index), means))

    return edit


_EDITS: dict[str, Callable[[Material], EditFrame]] = {
    "depth-fog": _depth_fog,
    "flat-plane": _baseline("flat-plane"),
    "screen-reflection": _baseline("screen-reflection"),
    "white-paint": _baseline("white-paint"),
    "class-recolour": _class_recolour,
    "global-mk": _global_mk,
    "picture-statistics": _picture_statistics,
    "frame-noise": _frame_noise,
}
"""What fits each stand-in to the material."""


def _display(picture: Picture) -> np.ndarray:
    return picture / 255.0


def _rounded(display: np.ndarray) -> Picture:
    return (255 * np.clip(display, 0.0, 1.0) + 0.5).astype(np.uint8)
