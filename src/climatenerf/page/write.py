"""Write the page of a run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core.storage import write_bytes
from climatenerf.page.document import document, page_data, still_text
from climatenerf.page.languages import LANGUAGES
from climatenerf.page.pictures import page_pictures
from climatenerf.page.settings import PageSettings
from climatenerf.studies.shot import Place
from climatenerf.weather.weather import Weather


@dataclass(frozen=True)
class WrittenPage:
    """What `write_page` wrote.

    Attributes:
        views: how many the page has.
        notes: sentences about what was left out.
    """

    views: int
    notes: tuple[str, ...]


def write_page(
    place: Place,
    out: Path,
    settings: PageSettings,
    weather: Weather,
    progress: Callable[[str, float], None] | None = None,
) -> WrittenPage:
    """Render the pictures of a page, and write it.

    Args:
        place: the fitted place.
        out: HTML file.
        settings: what the page shows.
        weather: what all pictures have in common, without water.
        progress: called with what is done and the fraction that is done.

    Raises:
        UserError: an unknown photo, a level outside the scene, views without ground, or the file
            cannot be written.
    """
    report = progress or (lambda what, fraction: None)
    pictures = page_pictures(place, settings, weather, report)
    title = settings.title or place.scene.root.resolve().name
    words = LANGUAGES[settings.language]
    data = page_data(pictures, settings, title, place.scene.scale_error)
    write_bytes(out, document(data, still_text(pictures, words, title)))
    return WrittenPage(len(pictures.views), pictures.notes)
