"""What renders the frames of a job: a session with everything that is prepared once.

A source can be pickled, prepared as it is, so that other processes render with what one prepared.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.field.capabilities import APPEARANCE
from climatenerf.scene import Scene
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import COMPLETED_GROUND, EFFECTS, MEAN_TRANSMITTANCE

if TYPE_CHECKING:
    from climatenerf.field.protocol import RadianceField
    from climatenerf.output.job import RenderJob
    from climatenerf.render.session import RenderSession
    from climatenerf.weather.world import Kept

Preview = Callable[[UInt8[np.ndarray, "h w 3"]], None]


@dataclass(frozen=True)
class RenderedFrame:
    """One rendered frame.

    Attributes:
        picture: 8-bit sRGB.
        layers: all measured layers, (h, w) or (h, w, 3) each; the layer table gives their units.
        facts: numbers about the whole render, for the sidecar.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    layers: dict[str, Float[np.ndarray, "h w *c"]]
    facts: dict[str, float] = field(default_factory=dict)


FrameSource = Callable[[int, Preview | None], RenderedFrame]
"""Renders the frame of an index; a preview is called with coarser pictures first."""


def frame_source(
    job: "RenderJob",
    field: "RadianceField",
    scene: Scene,
    progress: Callable[[str, float], None] | None = None,
    kept: "Kept | None" = None,
) -> FrameSource:
    """Prepare light, waves and snow for a job, and return what renders its frames.

    Args:
        job: the job.
        field: the fitted field of its run.
        scene: the capture of its run.
        progress: called with what is being prepared and the fraction that is done.
        kept: the run folder, where what is found in the field is kept; None: nowhere.

    Raises:
        UserError: the weather does not fit the scene.
    """
    from climatenerf.field.protocol import require
    from climatenerf.render.session import RenderSession

    appearance = None
    if job.appearance is not None:
        require(field, frozenset({APPEARANCE}), "the appearance of a photo")
        appearance = field.photo_appearance(job.appearance)
    times = np.array([job.time(index) for index in range(len(job))])
    session = RenderSession(
        field,
        scene,
        job.weather,
        job.path.c2w[:, :3, 3],
        times,
        appearance,
        progress,
        job.effects,
        kept,
        job.style,
    )
    session.world(
        float(times[0])
    )  # prepares what is put off until it is seen, such as light probes
    return functools.partial(_render, job, session)


def _render(
    job: "RenderJob", session: "RenderSession", index: int, preview: Preview | None
) -> RenderedFrame:
    frame = session.frame(
        job.path.cameras[index],
        job.path.c2w[index],
        job.time(index),
        supersample=job.supersample,
        layers=job.layers,
        preview=preview,
    )
    return RenderedFrame(frame.picture, frame.layers, session.facts)


def measured(
    layers: dict[str, Float[np.ndarray, "h w *c"]], effects: Sequence[Effect] = EFFECTS
) -> dict[str, float]:
    """Return the means over a frame that its effects name; see `Effect.measures`."""
    found = {
        MEAN_TRANSMITTANCE: float(layers["transmittance"].mean()),
        COMPLETED_GROUND: 1.0 - float(layers["seen"].mean()),
    }
    for measure in (measure for effect in effects for measure in effect.measures):
        values = layers[measure.layer]
        where = np.ones(values.shape, bool) if measure.mask is None else layers[measure.mask] > 0.5
        found[measure.name] = _mean(values, where)
    return found


def _mean(values: np.ndarray, where: np.ndarray) -> float:
    return float(values[where].mean()) if where.any() else 0.0
