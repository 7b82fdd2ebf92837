"""``climatenerf stylize RUN -o RUN2``: a run in the colours of a season, photos or a text."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_seed
from climatenerf.weather.units import LENGTH, quantity

if TYPE_CHECKING:
    from climatenerf.api import Run
    from climatenerf.styling.paper.shots import Shot
    from climatenerf.styling.paper.teachers import Teacher
    from climatenerf.styling.style_photos import Labeller, StylePhotos
    from climatenerf.weather.style import Source, Style


@dataclass(frozen=True)
class Stylize:
    """Give a run the colours of another season, of style photos, or of a text. Shapes and depths
    stay; weather renders on the new run as on any."""

    run: Annotated[tyro.conf.Positional[Path | None], optional("PATH")] = None
    """Run folder made by `climatenerf fit`; none with --measure."""
    out: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH", help_behavior_hint="")
    ] = None
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
    """Random seed of these patches, and of the paper's way."""
    method: Literal["operator", "paper"] = "operator"
    """operator: the field stays, and what is rendered of it changes. paper: the field's colours
    learn from pictures in the style. Shapes, normals and classes stay in both."""
    bake: bool = False
    """Write the operator's colours into the field: --method paper with the operator as teacher."""
    wct: Annotated[Path | None, optional("PATH")] = None
    """With --method paper and --style: folder of WCT weights, which make the pictures."""
    pictures: Annotated[Path | None, optional("PATH")] = None
    """With --method paper: folder of finished pictures, named as the photos."""
    editor: Annotated[Path | None, optional("PATH")] = None
    """With --method paper and --text: local folder of an image-to-image network of diffusers."""
    steps: int = 400
    """Steps of the paper's way; 150 show the look."""
    views: int = 40
    """The most training views that are used."""
    width: int = 480
    """The most pixels across of the pictures that teach."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute. cuda: an NVIDIA GPU under Linux, with a C compiler installed; the current
    GPU kernels were tested without a GPU."""


def run(options: Stylize) -> int:
    """Make the styled run, or the season file; print where it is."""
    asked = {
        "--season": options.season,
        "--style": options.style,
        "--text": options.text,
        "--measure": options.measure,
    }
    given = [name for name, value in asked.items() if value]
    paper = check_method(options)
    check_seed(options.seed)
    if paper and not given and options.pictures is None:
        raise UserError("give one of --season, --style, --text and --pictures; got none")
    if len(given) != 1 and not (options.pictures is not None and not given):
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
    if options.device != "cpu":
        from climatenerf.core.device import resolve_device

        resolve_device(options.device)
    if paper:
        return fine_tune(options, options.run, options.out)
    return stylize(options, options.run, options.out)


def check_method(options: Stylize) -> bool:
    """Return whether the paper's way is asked for.

    Raises:
        UserError: its options contradict one another, or it is not.
    """
    paper = options.method == "paper" or options.bake
    teachers = {
        "--wct": options.wct,
        "--pictures": options.pictures,
        "--editor": options.editor,
    }
    named = [name for name, value in teachers.items() if value is not None]
    if named and (not paper or options.bake):
        raise UserError(f"{named[0]} belongs to --method paper; give that, without --bake")
    if len(named) > 1:
        raise UserError(f"give one of --wct, --pictures and --editor; got {' and '.join(named)}")
    if paper and options.measure:
        raise UserError("--measure makes a season file and no run; leave --method and --bake out")
    if options.wct is not None and not options.style:
        raise UserError("--wct needs style photos; name them with --style")
    if options.editor is not None and options.text is None:
        raise UserError("--editor needs a text; give it with --text")
    if options.pictures is not None and (options.season or options.style or options.text):
        raise UserError("--pictures are the style; leave --season, --style and --text out")
    for name in ("steps", "views", "width"):
        if not paper and getattr(options, name) != getattr(Stylize, name):
            raise UserError(f"--{name} belongs to --method paper; leave it out, or give that")
        least = 16 if name == "width" else 1
        if getattr(options, name) < least:
            raise UserError(f"--{name} must be at least {least}; got {getattr(options, name)}")
    return paper


def stylize(options: Stylize, folder: Path, out: Path) -> int:
    """Make a styled run; print what was assumed and where it is."""
    from climatenerf.styling.styled_run import check_out

    check_out(folder, out)
    make_style = style_maker(options)

    from climatenerf.api import load_run
    from climatenerf.styling.styled_run import write_styled_run

    run = load_run(folder, device=options.device)
    check_colours(run)
    write_styled_run(folder, run.scene, make_style(run), out)
    progress.result(f"run: {out}")
    return 0


def fine_tune(options: Stylize, folder: Path, out: Path) -> int:
    """Make a run whose colours have learned a style; print how near they came, and where it is."""
    from climatenerf.styling.styled_run import check_out

    check_out(folder, out, resumes=True)
    by_operator = options.wct is options.pictures is options.editor is None
    make_style = style_maker(options) if by_operator else None

    from climatenerf.api import load_run
    from climatenerf.styling.paper.paper_run import PaperSettings, write_fine_tuned_run
    from climatenerf.styling.paper.shots import choose_shots
    from climatenerf.styling.paper.teachers import operator_teacher

    run = load_run(folder, device=options.device)
    check_colours(run)
    shots = choose_shots(run.scene, options.views, options.width, options.seed)
    if make_style is not None:
        style = make_style(run)
        teacher = operator_teacher(run.field, style)
    else:
        style, teacher = picture_style(options, run, shots)
    if make_style is None:
        say_licences(style.sources)
    settings = PaperSettings(options.steps, options.views, options.width, options.seed)
    place = folder, run.field, run.scene
    with progress.StageBars() as bars:
        scores = write_fine_tuned_run(place, style, teacher, shots, settings, out, bars)
    first, last = scores[0], scores[-1]
    if last.step < options.steps:
        progress.say(f"ended after {last.step} steps: other views improved no more")
    progress.say(f"training views: {first.taught:.1f} dB before, {last.taught:.1f} dB after")
    if not math.isnan(last.others):  # too few views to set one apart
        progress.say(f"other views: {first.others:.1f} dB before, {last.others:.1f} dB after")
    progress.result(f"run: {out}")
    return 0


def check_colours(run: "Run") -> None:
    """Refuse a run whose field has learned a style: its own colours are lost.

    Raises:
        UserError: it has.
    """
    if run.style is not None and run.style.fine_tuned is not None:
        raise UserError(
            f"the field of {run.folder} has learned a style already; stylize the run that it was"
            " made of"
        )


def picture_style(
    options: Stylize, run: "Run", shots: "tuple[Shot, ...]"
) -> "tuple[Style, Teacher]":
    """Return the style of edited pictures, without classes of its own, and the editor as teacher.

    Raises:
        UserError: weights, pictures or photos are missing or of no use.
    """
    from climatenerf.core.storage import hash_of_files
    from climatenerf.styling.paper import editor, teachers
    from climatenerf.styling.style_photos import (
        label_file,
        parse_region,
        photo_files,
        read_labelled_photo,
        unlabelled_note,
    )
    from climatenerf.weather.style import Source, Style

    def style(name: str, *sources: Source) -> Style:
        return Style(name[:100], (), None, options.patch, options.seed, sources)

    def teacher(kind: str, made_from: str, edit: teachers.Edit) -> teachers.Teacher:
        return teachers.picture_teacher(run.field, kind, made_from, edit, options.strength)

    if options.pictures is not None:
        edit, paths = teachers.folder_editor(options.pictures, shots)
        made_from = hash_of_files(paths)
        source = Source(options.pictures.name, made_from, "")
        return style(options.pictures.name, source), teacher("pictures", made_from, edit)
    if options.editor is not None:
        text = options.text or ""
        edit = editor.diffusion_editor(options.editor, text, options.seed)
        files = sorted(p for p in options.editor.rglob("*") if p.is_file())
        sizes = [f"{p.relative_to(options.editor)} {p.stat().st_size}" for p in files]
        made_from = f"{options.editor.resolve()}: {text} {sizes}"
        return style(text), teacher("editor", made_from, edit)
    assert options.wct is not None
    regions = [parse_region(text) for text in options.style_region]
    labeller = _labeller(options.labels)
    photos = [read_labelled_photo(path, regions, labeller) for path in photo_files(options.style)]
    if unlabelled := sum(not photo.labelled for photo in photos):
        progress.say(unlabelled_note(unlabelled, len(photos)))
    edit = teachers.wct_editor(run.field, options.wct, photos, options.width)
    weights = hash_of_files(sorted(options.wct.glob("*.pth")))
    labels = [label_file(path) for path in photo_files(options.style)]
    labelled = hash_of_files([path for path in labels if path is not None])
    made_from = f"{weights} {labelled} {options.style_region} {options.labels}"
    name = ", ".join(path.name or str(path) for path in options.style)
    sources = (photo.source for photo in photos)
    return style(name, *sources), teacher("wct", made_from, edit)


def style_maker(options: Stylize) -> "Callable[[Run], Style]":
    """Return what makes the style of a run; photos, season files and texts are read at once."""
    palettes, name, photos = None, "", None
    if options.season is not None:
        palettes, name = season_palettes(options.season)
    elif options.text is not None:
        palettes, name = text_palettes(options.text), options.text[:100]
    else:
        photos = read_photos(options, options.style)
        name = ", ".join(path.name or str(path) for path in options.style)

    def make(run: "Run") -> "Style":
        from climatenerf.styling.colour_map import photo_style
        from climatenerf.styling.scene_colours import colours_of_run
        from climatenerf.weather.season.palettes import seasonal_style
        from climatenerf.weather.style import weakened

        with progress.StageBars() as bars:
            ours = colours_of_run(run.field, run.scene, bars)
        if palettes is not None:
            means = {kind: colours.mean(0) for kind, colours in ours.items() if len(colours)}
            style = seasonal_style(name, palettes, means, options.patch, options.seed)
            return weakened(style, options.strength)
        assert photos is not None
        style, notes = photo_style(
            name, ours, photos, options.strength, options.patch, options.seed
        )
        for note in notes:
            progress.say(note)
        if not style.classes and style.sky is None:
            raise UserError(
                "nothing would change: the scene and the style photos share no class; name classes"
                " with --style-region or --labels"
            )
        say_licences(style.sources)
        return style

    return make


def say_licences(sources: "tuple[Source, ...]") -> None:
    """Print the licences of style photos, each once."""
    for licence in sorted({source.licence for source in sources} - {""}):
        progress.say(f"Pictures made with these photos carry their licence: {licence}")


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
