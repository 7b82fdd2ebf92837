"""``climatenerf compare RUN -o OUT``: our weather beside stand-ins and other programs."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import names_of, optional
from climatenerf.cli.render import check_out, parse_size
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_fps, check_seed
from climatenerf.studies.compare.settings import (
    EFFECTS,
    ClimateGanSettings,
    DiffusionSettings,
    UvqSettings,
)


@dataclass(frozen=True)
class Compare:
    """Compare our weather with stand-ins that need no weights, and with models of yours: a movie,
    pictures, time strips and scores of each. Re-run the same command to resume."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the comparison."""
    effects: tuple[str, ...] = EFFECTS
    """Effects to compare: smog, flood, snow."""
    weather: tuple[str, ...] = ()
    """Weather files, such as flood=deep.toml. Default: visibility 80 m, water 0.3 m, snow 10 cm."""
    path: str = "training"
    """Camera path: training, orbit, still, still:NAME, or a nerfstudio camera_path.json."""
    portion: float = 0.2
    """Fraction of the path, in its middle, that the movie shows; a file is taken whole."""
    frames: int = 24
    """Number of frames."""
    fps: float = 12.0
    """Frames per second of the movies."""
    size: Annotated[str | None, optional("STR")] = None
    """Size of the frames, such as 480x270. Default: the photos' shape, 480 pixels wide."""
    folder: tuple[str, ...] = ()
    """Frames of another program, such as arf=PATH with PATH/flood/0000.png; its input is
    OUT/clean/frames."""
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    climategan: ClimateGanSettings = field(default_factory=ClimateGanSettings)
    uvq: UvqSettings = field(default_factory=UvqSettings)
    truth: bool = True
    """For the run of a reference set: also render its test views, for PSNR on true pictures."""
    licence: Annotated[str | None, optional("STR")] = None
    """Licence or source of the photos. Default: the line of the capture's licence file."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute. cuda: an NVIDIA GPU under Linux, with a C compiler installed."""
    seed: int = 0
    """Random seed of waves, snowfall, noise and diffusion; one for the whole movie."""


def run(options: Compare) -> int:
    """Make the comparison; print the licences, the table and the path of the report."""
    check_seed(options.seed)
    size = parse_size(options.size)

    from climatenerf.api import load_run
    from climatenerf.studies.compare import cases, study
    from climatenerf.studies.compare.climategan import climategan_methods
    from climatenerf.studies.compare.diffusion import diffusion_methods
    from climatenerf.studies.compare.folder import frame_folders
    from climatenerf.studies.compare.report import TEXT_NAME, markdown
    from climatenerf.studies.compare.uvq import LICENCE, uvq

    check_fps(options.fps)
    effects = cases.check_effects(names_of(*options.effects))
    weathers = cases.weathers_of(options.weather, effects, options.seed)
    # All adapters are checked before anything is rendered.
    methods = (
        *diffusion_methods(options.diffusion, options.device),
        *climategan_methods(options.climategan),
        *frame_folders(options.folder),
    )
    judge = uvq(options.uvq)
    study.check_methods(methods)
    fitted = load_run(options.run, device=options.device)
    scene = fitted.scene
    check_out(options.out, options.run, scene)
    study.check_folder(options.out)
    path = cases.short_path(options.path, scene, options.frames, size, options.portion)
    for sentence in path.notes:
        progress.say(sentence)
    truth = None
    if options.truth and fitted.style is None:  # the truth has the photos' colours
        try:
            truth = cases.true_views(scene, fitted.field, effects)
        except UserError as error:
            progress.warn(f"no scores on true pictures: {error}")
    for method in methods:
        progress.say(f"licence of {method.name}: {method.licence}")
    if judge is not None:
        progress.say(f"licence of UVQ: {LICENCE}")
    plan = study.Plan(
        path,
        path.fps or options.fps,
        weathers,
        options.seed,
        methods,
        truth,
        judge,
        options.licence or cases.licence_of(scene),
    )
    with progress.StageBars() as bars:
        data = study.compare(
            study.Fitted(
                options.run,
                scene,
                fitted.digest,
                fitted.field.knows_classes,
                fitted.completed,
                fitted.style,
            ),
            options.out,
            plan,
            bars,
            progress.say,
        )
    progress.result(markdown(data))
    progress.result(f"report: {options.out / TEXT_NAME}")
    return 0
