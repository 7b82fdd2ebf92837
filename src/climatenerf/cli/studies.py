"""The studies of ``climatenerf evaluate``: ablations, and sweeps of weather parameters."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from climatenerf.cli import progress
from climatenerf.cli.render import check_out, parse_size
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.weather.description import read_weather, weather_to_table
from climatenerf.weather.registry import installed_effects
from climatenerf.weather.weather import Weather

if TYPE_CHECKING:
    from climatenerf.studies.shot import Place
    from climatenerf.training.trainer import Report


@dataclass(frozen=True)
class Picture:
    """What a study of weather renders, as flags give it.

    Attributes:
        run: run folder.
        weather: weather file.
        view: name of a photo.
        size: such as "480x270".
    """

    run: Path
    weather: Path | None
    view: str | None
    size: str | None

    def read_weather(self) -> Weather | None:
        """The weather of the file at its beginning; None without a file."""
        if self.weather is None:
            return None
        return read_weather(self.weather, installed_effects()).at(0.0)


def load_place(run: Path, out: Path) -> "Place":
    """Read a run; see `render.check_out`.

    Raises:
        UserError: the folder holds no run, or the report would lie among files of others.
    """
    from climatenerf.api import load_run
    from climatenerf.output.job import hash_of_run
    from climatenerf.studies.shot import Place
    from climatenerf.weather.world import Kept

    fitted = load_run(run)
    check_out(out, run, fitted.scene)
    with progress.StageBars() as bars:
        field = fitted.completed(bars)
    kept = Kept(run, fitted.digest or hash_of_run(run))
    return Place(field, fitted.scene, kept, fitted.style)


def geometry(
    folder: Path, out: Path, minutes: float, downscale: int, seeds: int, rows: tuple[str, ...]
) -> int:
    """Fit and score every row; print the table and the path of the report."""
    if not 0 < minutes < float("inf") or downscale < 1 or seeds < 1:
        raise UserError("--minutes must be above 0, --downscale and --seeds at least 1")
    from climatenerf.scene import read_scene

    scene = read_scene(folder)

    from climatenerf.studies.geometry_ablation import (
        ablate,
        has_relative_depth,
        markdown,
        select_rows,
    )
    from climatenerf.studies.study_folder import TEXT

    selected = select_rows(minutes, rows, has_relative_depth(scene))
    total = len(selected) * seeds
    with progress.Bar("ablation", float(total)) as bar:
        done = 0

        def after_step(name: str, state: "Report") -> None:
            bar.update(done + state.progress, {"row": name, "PSNR": f"{state.psnr:.1f}"})

        def scoring(name: str) -> None:
            nonlocal done
            done += 1
            bar.update(float(done), {"scoring": name})

        extent = (minutes, downscale, seeds)
        data = ablate(scene, out, *extent, after_step, scoring, selected)
    progress.result(markdown(data))
    progress.result(f"report: {out / TEXT}")
    return 0


def ablation(picture: Picture, out: Path, kind: str) -> int:
    """Render the rows of an ablation of weather; print the table and the path of the report."""
    size, weather = parse_size(picture.size), picture.read_weather()
    from climatenerf.studies.study_folder import (
        ABLATION,
        TEXT,
        ablation_files,
        check_folder,
        findings,
        table,
        write_ablation,
    )
    from climatenerf.studies.weather_ablation import STUDIES, about_shot, shot_of

    study = STUDIES[kind]
    files = ablation_files(study.names)
    check_folder(out, ABLATION, kind, files)
    place = load_place(picture.run, out)
    shot = shot_of(study, place, picture.view, size, weather)
    with only_writer(out):
        earlier = check_folder(out, ABLATION, kind, files)
        with progress.Bar(kind, len(study.names)) as bar:
            rows = study.run(shot, lambda name: bar.advance(1, {"row": name}))
        effects = installed_effects()
        tables = weather_to_table(shot.weather.with_sections(effects), effects)
        about = {"run": picture.run.resolve().name, **about_shot(shot, tables)}
        write_ablation(out, kind, about, rows, study.columns, earlier)
    progress.result(table(rows))
    progress.result(f"\n{findings(rows)}")
    progress.result(f"report: {out / TEXT}")
    return 0


def sweep(picture: Picture, out: Path, asked: str) -> int:
    """Render the strips of sweeps; print their responses and the path of each."""
    size, weather, effects = parse_size(picture.size), picture.read_weather(), installed_effects()
    from climatenerf.studies.shot import shot_of_photo
    from climatenerf.studies.study_folder import check_folder
    from climatenerf.studies.sweep import (
        INDEX,
        kind_of,
        line,
        paper_sweeps,
        read_sweep,
        sweep_files,
        write_sweeps,
    )
    from climatenerf.studies.weather_ablation import about_shot

    if asked == "paper":
        if weather is not None:
            raise UserError("--sweep paper has weathers of its own; leave out --weather")
        sweeps = paper_sweeps(effects)
    else:
        sweeps = (read_sweep(asked, weather, effects),)
    kind, files = kind_of(sweeps), sweep_files(sweeps)
    check_folder(out, INDEX, kind, files)
    place = load_place(picture.run, out)
    shot = shot_of_photo(place, picture.view, size, sweeps[0].weathers[0])
    about = {"run": picture.run.resolve().name, **about_shot(shot, None)}
    with only_writer(out):
        earlier = check_folder(out, INDEX, kind, files)
        lines = []
        with progress.Bar("sweep", sum(len(each.texts) for each in sweeps)) as bar:

            def rendering(value: str) -> None:
                bar.advance(1, {"now": value})

            for swept in write_sweeps(sweeps, shot, out, about, rendering, earlier):
                lines.append(f"{line(swept)}: {out / swept.sweep.strip}")
    for text in lines:
        progress.result(text)
    return 0
