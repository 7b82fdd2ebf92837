"""``climatenerf page RUN -o flood.html``: one HTML page that anyone can open."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import names_of, optional
from climatenerf.cli.render import parse_size
from climatenerf.core.errors import UserError, one_line
from climatenerf.page.languages import LANGUAGES
from climatenerf.page.settings import MAX_STEPS, MAX_VIEWS, PageSettings
from climatenerf.weather.description import read_weather
from climatenerf.weather.season.palettes import SEASONS
from climatenerf.weather.units import LENGTH, parse_quantity
from climatenerf.weather.weather import Weather

MAX_TEXT = 200
"""Characters of a title or another text of the page."""


@dataclass(frozen=True)
class Page:
    """Write one HTML page of a fitted place, which anyone can open: a slider floods it, and snow,
    smog and seasons come in steps. It needs no server and no network."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """HTML file to write."""
    views: str = "6"
    """Number of views, or names of photos with commas between."""
    levels: Annotated[str | None, optional("STR")] = None
    """Water levels to render, such as "0.2 m, 0.5 m, 1 m", above the ground datum. The slider shows
    all levels between. Default: five from the lowest ground in the views."""
    snow: str = "5 cm, 15 cm, 30 cm"
    """Snow depths; "" leaves snow out."""
    smog: str = "200 m, 80 m, 30 m"
    """Visibilities in smog; "" leaves smog out."""
    seasons: str = ",".join(SEASONS)
    """Seasons; "" leaves them out."""
    weather: Annotated[Path | None, optional("PATH")] = None
    """Weather file (TOML) with what all pictures have in common, such as the sky or the colour of
    the water."""
    size: Annotated[str | None, optional("STR")] = None
    """Size of the pictures, such as 960x540. Default: the photos', 640 to 960 wide."""
    title: Annotated[str | None, optional("STR")] = None
    """Title. Default: the name of the capture."""
    source: str = ""
    """Who made the photos or the page."""
    scenario: str = ""
    """What the water levels stand for, such as "flood of once in 100 years: 0.8 m"."""
    datum: str = ""
    """Name of the height of level 0. Default: the ground at the cameras."""
    error: str = "0 m"
    """Standard error of datum and scenario together. That of the scale is added by itself."""
    language: str = "en"
    """Language: en, de, fr or es."""
    objects: bool = True
    """Leave staff gauge and figure out. By default both stand in the scene."""
    complete_ground: bool = True
    """Leave holes where no photo shows the ground. By default a smooth terrain completes it."""


def run(options: Page) -> int:
    """Write the page, and print where it is."""
    settings = settings_of(options)
    film = None if options.weather is None else read_weather(options.weather)
    if film is not None and film.keyframes:
        raise UserError("a page has no movie; give a weather file without keyframes")
    weather = Weather() if film is None else film.base
    if weather.flood.level is not None:
        progress.warn("the level in the weather file is ignored; the page has its own levels")
        weather = weather.with_value("flood.level", None)
    out = options.out
    check_html(out)

    from climatenerf.api import load_run
    from climatenerf.page.write import write_page
    from climatenerf.studies.shot import Place
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    with progress.StageBars() as bars:
        field = fitted.completed(bars) if options.complete_ground else fitted.field
        kept = None if fitted.digest is None else Kept(fitted.folder, fitted.digest)
        place = Place(field, fitted.scene, kept, fitted.style)
        written = write_page(place, out, settings, weather, bars)
    for note in written.notes:
        progress.say(note)
    size = out.stat().st_size / 1e6
    progress.result(
        f"page: {out} ({written.views} view{'s' * (written.views != 1)}, {size:.1f} MB)"
    )
    return 0


def check_html(out: Path) -> None:
    """Check that a file can be written as HTML.

    Raises:
        UserError: it has another suffix, or its folder does not exist or cannot be written.
    """
    if out.is_dir() or out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"-o {out} must name an HTML file, such as flood.html")
    if not os.access(out.parent, os.W_OK):
        raise UserError(f"-o {out}: its folder does not exist or cannot be written; make it first")


def settings_of(options: Page) -> PageSettings:
    """Return the settings that the flags describe.

    Raises:
        UserError: a text has another form than its flag needs, or is too long.
    """
    texts = {
        "title": options.title or "",
        "source": options.source,
        "scenario": options.scenario,
        "datum": options.datum,
    }
    for name, text in texts.items():
        if len(text) > MAX_TEXT or not text.isprintable():
            raise UserError(f"--{name} must be one line of at most {MAX_TEXT} characters")
    if options.language not in LANGUAGES:
        raise UserError(
            f'--language must be one of {", ".join(LANGUAGES)}; got "'
            f'{one_line(options.language, 20)}"'
        )
    names = names_of(options.views)
    count = 6
    if len(names) == 1 and names[0].isdecimal() and len(names[0]) < 4:
        count, names = int(names[0]), ()
    if not 1 <= (len(names) or count) <= MAX_VIEWS:
        raise UserError(f"--views must be 1 to {MAX_VIEWS}, or as many names of photos")
    seasons = names_of(options.seasons)
    unknown = set(seasons) - set(SEASONS)
    if unknown:
        raise UserError(f"there is no season {min(unknown)!r}; use {', '.join(SEASONS)}")
    error = parse_quantity(options.error, LENGTH, "--error")
    if not 0 <= error <= 100:
        raise UserError("--error must be from 0 m to 100 m")
    return PageSettings(
        **texts,
        level_error=error,
        language=options.language,
        views=names,
        view_count=count,
        size=parse_size(options.size),
        levels=_lengths("--levels", options.levels or "", -1e3, 1e3),
        snow_depths=_lengths("--snow", options.snow, 1e-3, 10.0),
        visibilities=_lengths("--smog", options.smog, 0.5, 1e7),
        seasons=tuple(dict.fromkeys(seasons)),
        objects=options.objects,
    )


def _lengths(flag: str, text: str, low: float, high: float) -> tuple[float, ...]:
    """Return lengths given with commas between, in m."""
    values = tuple(parse_quantity(word, LENGTH, f"each of {flag}") for word in names_of(text))
    if len(values) > MAX_STEPS or any(not low <= value <= high for value in values):
        raise UserError(f"{flag} must be at most {MAX_STEPS} lengths from {low:g} m to {high:g} m")
    return tuple(dict.fromkeys(values))
