"""The colours that a fitted scene has, by class."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from climatenerf.field.capabilities import CLASSES
from climatenerf.field.protocol import RadianceField, observed
from climatenerf.render.photo_rays import trace_photos
from climatenerf.scene.scene import Scene
from climatenerf.weather.season.entity import no_classes, photographed_colours


def colours_of_run(
    field: RadianceField, scene: Scene, progress: Callable[[str, float], None] | None = None
) -> dict[int, Float[np.ndarray, "n 3"]]:
    """Return linear colours of each class where the photos' rays end.

    Args:
        field: the fitted field.
        scene: its capture.
        progress: called with "photos" and the fraction that is done.

    Raises:
        UserError: the field has no classes.
    """
    if CLASSES not in field.capabilities:
        raise no_classes("a style")
    report = None if progress is None else lambda fraction: progress("photos", fraction)
    photos = trace_photos(observed(field), scene, report)
    if report is not None:
        report(1.0)
    return photographed_colours(field, photos, None)
