"""``climatenerf stylize RUN -o RUN2``: a run in the colours of a season, photos or a text."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.weather.units import LENGTH, quantity

if TYPE_CHECKING:
    from climatenerf.styling.style_photos import Labeller, StylePhotos


@dataclass(frozen=True)
class Stylize:
    """Give a run the colours of another season, of style photos, or of a text. Shapes and depths
    stay; weather renders on the new run as on any."""

    run: Annotated[tyro.conf.Positional[Path | None], optional("PATH")] = None
    """Run folder made by `climatenerf fit`; none with --measure."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """Folder of the new run; with --measure the season file (TOML)."""
    season: Annotated[str | None, optional("STR")] = None
    """autumn, winter, drought, wildfire, or a season file (TOML)."""
    style: tuple[Path, ...] = ()
    """Style photos, or a folder of them: each class takes the colours that it has there."""
    text: Annotated[str | None, optional("STR")] = None
    """A season in words, such as "late autumn, dry lawns"."""
    measure: tuple[Path, ...] = ()
    """Photos, or a folder of them, to make a season file from."""
    style_region: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Rectangle of the style photos that shows one class, such as vegetation=0,0.5,1,1: left, top,
    right, bottom as fractions. Repeat it for more."""
    labels: Annotated[str | None, optional("STR")] = None
    """A network's name or folder that finds classes in style photos without label files."""
    strength: float = 1.0
    """How far the colours change, 0 to 1."""
    patch: Annotated[float, quantity(LENGTH, 0.1, 1e3)] = 4.0
    """Size of the patches in which leaves turn alike."""
    seed: int = 0
    """Random seed of these patches."""


def run(options: Stylize) -> int:
    """Make the styled run, or the season file; print where it is."""
    asked = {
        "--season": options.season,
        "--style": options.style,
        "--text": options.text,
        "--measure": options.measure,
    }
    given = [name for name, value in asked.items() if value]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        raise UserError(f"give one of --season, --style, --text and --measure; got {got}")
    if options.out is None:
        raise UserError("name with -o what to make: the folder of the new run, or the season file")
    if not 0 <= options.strength <= 1:
        raise UserError(f"--strength must be from 0 to 1; got {options.strength:g}")
    photos_flags = options.style_region or options.labels
    if photos_flags and not (options.style or options.measure):
        raise UserError(
            "--style-region and --labels belong to --style or --measure; leave them out"
        )
    if options.measure:
        return measure(options, options.out)
    if options.run is None:
        raise UserError("name the run to stylize: climatenerf stylize RUN -o RUN2")
    return stylize(options, options.run, options.out)


def stylize(options: Stylize, folder: Path, out: Path) -> int:
    """Make a styled run; print what was assumed and where it is."""
    from climatenerf.styling.styled_run import check_out

    check_out(folder, out)
    palettes, name, photos = None, "", None
    if options.season is not None:
        palettes, name = season_palettes(options.season)
    elif options.text is not None:
        palettes, name = text_palettes(options.text), options.text[:100]
    else:
        photos = read_photos(options, options.style)
        name = ", ".join(path.name or str(path) for path in options.style)

    from climatenerf.api import load_run
    from climatenerf.styling.scene_colours import colours_of_run
    from climatenerf.styling.styled_run import write_styled_run
    from climatenerf.weather.season.palettes import seasonal_style
    from climatenerf.weather.style import weakened

    run = load_run(folder)
    with progress.StageBars() as bars:
        ours = colours_of_run(run.field, run.scene, bars)
    if photos is not None:
        from climatenerf.styling.colour_map import photo_style

        style, notes = photo_style(
            name, ours, photos, options.strength, options.patch, options.seed
        )
        for note in notes:
            progress.say(note)
        for licence in {source.licence for source in style.sources} - {""}:
            progress.say(f"Pictures made with these photos carry their licence: {licence}")
    else:
        assert palettes is not None
        means = {kind: colours.mean(0) for kind, colours in ours.items() if len(colours)}
        style = seasonal_style(name, palettes, means, options.patch, options.seed)
        style = weakened(style, options.strength)
    write_styled_run(folder, run.scene, style, out)
    progress.result(f"run: {out}")
    return 0


def measure(options: Stylize, out: Path) -> int:
    """Write a season file from photos; print where it is."""
    import tomli_w

    from climatenerf.core.storage import write_bytes
    from climatenerf.styling.measure import season_of_photos

    if options.run is not None:
        raise UserError("--measure reads photos, no run; leave the run out")
    if out.exists():
        raise UserError(f"{out} exists already; choose another file with -o")
    if out.suffix != ".toml":
        raise UserError(f"-o {out} must be a season file that ends in .toml")
    photos = read_photos(options, options.measure)
    tables = season_of_photos(photos)
    for note in photos.notes:
        progress.say(note)
    write_bytes(out, tomli_w.dumps(tables).encode())
    progress.result(f"season file: {out}")
    return 0


def season_palettes(season: str):
    """Return the palettes of a season or a season file, and their name.

    Raises:
        UserError: there is no such season, or the file cannot be read.
    """
    from climatenerf.core.parsing import read_toml
    from climatenerf.weather.season.palettes import SEASONS, palettes_of, read_palettes

    if season in SEASONS:
        return palettes_of(season), season
    path = Path(season)
    if path.suffix != ".toml" and not path.is_file():
        raise UserError(
            f'there is no season "{season[:60]}"; give {", ".join(SEASONS)}, or a season file'
        )
    return read_palettes(read_toml(path, "the season file"), str(path)), path.stem


def text_palettes(text: str):
    """Return the palettes that a text describes; print what was understood, and what was not."""
    from climatenerf.styling.words import read_text

    reading = read_text(text)
    for sentence in reading.understood:
        progress.say(sentence)
    for word in reading.unknown:
        progress.warn(f'no rule for "{word}"')
    return reading.palettes


def read_photos(options: Stylize, paths: tuple[Path, ...]) -> "StylePhotos":
    """Read style photos with the classes that the options name."""
    from climatenerf.styling.style_photos import parse_region, read_style_photos

    regions = [parse_region(text) for text in options.style_region]
    return read_style_photos(paths, regions, _labeller(options.labels))


def _labeller(name: str | None) -> "Labeller | None":
    if name is None:
        return None
    from climatenerf.perception.models import check_name
    from climatenerf.perception.segmentation import load_segmentation

    check_name(name)
    return load_segmentation(name).predict
