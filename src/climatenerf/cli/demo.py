"""``climatenerf demo``: fit and render the street that comes with the package."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.fit import Fit, fit_with_bars, summary
from climatenerf.cli.render import parse_size
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.training.folder import checked_metrics
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

WEATHERS = {
    "clean": Weather(),
    "flood": Weather(flood=Flood(level=0.5)),
    "smog": Weather(smog=Smog(visibility=40.0)),
    "snow": Weather(snow=Snow(depth=0.15)),
}
SHEET_COLUMNS = 4
FPS = 12.0


@dataclass(frozen=True)
class Demo:
    """Fit the street that comes with the package, and render it clean, flooded, in smog and under
    snow. Re-run the same command to resume."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("climatenerf-demo")
    """Folder for the run, the movies and the contact sheet."""
    minutes: float = 3.0
    """Time for fitting, minutes."""
    frames: int = 24
    """Number of frames of each movie."""
    size: str = "320x180"
    """Size of the frames, such as 320x180."""


def run(options: Demo) -> int:
    """Fit, render four movies and a contact sheet, and print where they are."""
    if not 0 < options.minutes < float("inf") or not 1 <= options.frames <= MAX_FRAMES:
        raise UserError(f"--minutes must be above 0, and --frames from 1 to {MAX_FRAMES}")
    size = parse_size(options.size)
    run_folder = options.out / "run"
    with as_file(files("climatenerf") / "assets" / "street") as street:
        from climatenerf.scene import read_scene

        scene = read_scene(street)
        metrics = finished(run_folder)
        begun = (run_folder / "optimiser.safetensors").exists()
        if begun or metrics:
            progress.say(f"Continuing the run in {run_folder}; remove it to begin anew")
        if metrics is None:
            metrics = fit_with_bars(scene, Fit(street, run_folder, options.minutes, resume=begun))
    if metrics["interrupted"]:
        raise UserError(
            f"stopped while fitting; re-run the same command to resume the run in {run_folder}"
        )

    from climatenerf.api import load_run, render_movie
    from climatenerf.output.contact_sheet import contact_sheet, write_jpeg

    fitted, movies, rows = load_run(run_folder), [], []
    for name, weather in WEATHERS.items():
        out = options.out / name
        with progress.StageBars(f"{name}: ") as bars:
            movie = render_movie(
                fitted, out, weather, frames=options.frames, fps=FPS, size=size, progress=bars
            )
        movies.append(movie)
        rows.append((name, _frames(out / "frames")))
    sheet = contact_sheet(rows, SHEET_COLUMNS)
    write_jpeg(options.out / "contact-sheet.jpg", sheet, max_bytes=150_000)
    progress.result(summary(metrics))
    progress.result(f"run: {run_folder}")
    for movie in movies:
        progress.result(f"movie: {movie}")
    progress.result(f"contact sheet: {options.out / 'contact-sheet.jpg'}")
    return 0


def finished(run_folder: Path) -> dict | None:
    """Return the metrics of a complete fit, or None."""
    if not (run_folder / "metrics.json").is_file():
        return None
    metrics = checked_metrics(run_folder / "metrics.json")
    return metrics if "psnr" in metrics and not metrics["interrupted"] else None


def _frames(folder: Path) -> list:
    import numpy as np
    from PIL import Image

    return [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]
