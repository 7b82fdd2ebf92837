"""``climatenerf fit SCENE -o RUN``: a radiance field from posed photographs."""

import shlex
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_seed
from climatenerf.scene import Scene, read_scene
from climatenerf.scene.alignment.known_length import (
    FILE_NAME,
    apply_known_lengths,
    measure,
    read_marks,
)
from climatenerf.scene.alignment.scale import scale_findings, scale_summary
from climatenerf.scene.scene import checked_world
from climatenerf.training.folder import check_folder, check_resumable
from climatenerf.training.settings import RENAMED_LOSSES, FitSettings, Losses, settings_of
from climatenerf.training.snapshot import writing_run
from climatenerf.weather.units import LENGTH, OptionalLength, parse_quantity

MAX_LENGTH = 1e6  # m: of a known length
MAX_LIMIT = 1e12  # minutes or steps


@dataclass(frozen=True)
class Fit:
    """Fit a radiance field to posed photographs."""

    scene: tyro.conf.Positional[Path]
    """Folder of the capture: COLMAP, transforms.json, a scene folder, Tanks and Temples (NSVF),
    mip-NeRF 360, KITTI-360 or Mega-NeRF."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Run folder to make."""
    minutes: Annotated[float | None, optional("FLOAT")] = None
    """Time for fitting steps, minutes; reading, previews, saving and measuring are not counted.
    Default: 5, or no limit if --steps is given."""
    steps: Annotated[int | None, optional("INT")] = None
    """Stop after this many steps. With --minutes, the limit that is reached first counts."""
    downscale: int = 1
    """Factor by which the photos are reduced in width and height."""
    holdout: Annotated[str | None, optional("STR")] = None
    """Photos held out for measuring: names separated by commas, or 0 for none. Default: the
    capture's own split, else every 8th photo by name."""
    resume: bool = False
    """Resume the run in the folder. --minutes counts from the beginning of the run."""
    preset: Annotated[Literal["cpu", "gpu", "paper"] | None, optional("{cpu,gpu,paper}")] = None
    """Size of the field. gpu: larger tables. paper: the sizes and loss weights of the paper
    (docs/physics.md lists the differences); its sky is opaque according to the labels of each
    photo, and keeps snow away. Default: gpu with --device cuda, else cpu."""
    loss: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Weight of a loss, such as sky=0, which switches it off. Repeat the flag for other losses:
    distortion, opacity_entropy, below_horizon_opacity, sky, sky_prior, occlusion, planarity,
    sparse_depth, ground_height, monocular_depth, classes, normals, normal_consistency, transient
    (docs/physics.md)."""
    refine_poses: bool = False
    """Refine the camera poses while fitting."""
    camera_height: OptionalLength = None
    """Height of the cameras above the ground, which sets the scale."""
    known_length: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Lengths that set the scale, such as "DOOR=2.0 m", marked in pictures (see --marks)."""
    marks: Annotated[Path | None, optional("PATH")] = None
    """File of the marks at which known lengths end. Default: marks.toml in the scene folder."""
    metric_input: bool = False
    """The poses are already in metres with z up."""
    frames: Annotated[str | None, optional("STR")] = None
    """First and last frame of a KITTI-360 drive, such as 1538:1601."""
    label_space: Annotated[str | None, optional("STR")] = None
    """Meaning of the numbers in label files: cityscapes-train-ids, cityscapes-ids or seven.
    Default: what the capture states."""
    labels: Annotated[str | None, optional("STR")] = None
    """Class labels: none, heuristic (without a network), or a network's name or
    folder. Default: the capture's label files, else heuristic if the photos clearly show sky."""
    mono_depth: Annotated[str | None, optional("STR")] = None
    """Relative depth: none, depth-anything, or a Depth Anything's name or folder. Default: the
    capture's depth_relative files, else its depth files; none ignores both."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute. cuda: an NVIDIA GPU under Linux, with a C compiler installed, in larger
    steps; the current GPU kernels were tested without a GPU."""
    seed: int = 0
    """Random seed."""


def run(options: Fit) -> int:
    """Read the capture, fit, and print where the run is and how good it is."""
    settings = fit_settings(options)  # reports wrong flags before photos are read
    limits = [each for each in (settings.minutes, settings.steps) if each is not None]
    if not all(0 < limit < MAX_LIMIT for limit in limits):
        raise UserError(
            f"--minutes and --steps must be numbers above 0 and below {MAX_LIMIT:g}; try"
            " --minutes 5"
        )
    check_seed(options.seed)
    if options.downscale < 1:
        raise UserError(f"--downscale must be 1 or more; got {options.downscale}")
    given = options.camera_height is not None or options.metric_input or options.known_length
    if options.resume and given:
        raise UserError(
            "a resumed run keeps its scale; leave --camera-height, --known-length and"
            " --metric-input out, or fit anew"
        )
    check_device(options.device)
    scene = read_scene(
        options.scene,
        holdout=options.holdout,
        camera_height=options.camera_height,
        metric_input=options.metric_input,
        frames=options.frames,
        label_space=options.label_space,
    )
    scene = with_known_lengths(scene, options.known_length, options.marks)
    progress.report_findings((*scene.findings, *scale_findings(scene)))
    progress.say(frame_line(scene))
    # Checked before labels, which may take minutes.
    check_folder(scene, options.out, options.resume)
    if options.resume:
        check_resumable(options.out, settings)
    with writing_run(options.out):  # labels may be written into the run folder
        scene = with_perception(scene, options)
        metrics = fit_with_bars(scene, options)
    if metrics["interrupted"]:
        progress.say(f"Stopped early; resume with: {resuming(options)}")
    progress.result(summary(metrics))
    for line in (geometry_line(metrics), ground_line(metrics), datum_line(metrics)):
        if line:
            progress.say(line)
    progress.result(f"run: {options.out}")
    return 0


def check_device(device: str) -> None:
    """Refuse a device that is absent; torch is imported only for devices other than the CPU."""
    if device != "cpu":
        from climatenerf.core.device import resolve_device

        resolve_device(device)


def with_perception(scene: Scene, options: Fit) -> Scene:
    """Return the scene with the requested labels, after writing relative depths if requested."""
    from climatenerf.perception import check_depth_model, prepare_depth, prepare_labels

    if options.mono_depth not in (None, "none"):
        check_depth_model(options.mono_depth)  # before minutes of labelling
    scene = prepare_labels(scene, options.labels, options.out, progress.track, progress.say)
    if options.mono_depth not in (None, "none"):
        prepare_depth(scene, options.mono_depth, progress.track, progress.say)
    return scene


def with_known_lengths(scene: Scene, lengths: tuple[str, ...], marks: Path | None) -> Scene:
    """Return the scene in the metres of lengths given as "NAME=2.0 m"."""
    if not lengths:
        return scene
    known = parse_known_lengths(lengths)
    marked = read_marks(marks or scene.root / FILE_NAME)
    scaled = apply_known_lengths(scene, [measure(scene, marked, *each) for each in known])
    return checked_world(scaled, str(scene.root))


def parse_known_lengths(lengths: tuple[str, ...]) -> list[tuple[str, float]]:
    """Return names and lengths, m, given as "NAME=2.0 m".

    Raises:
        UserError: one is not of this form, not above 0, or given twice.
    """
    known: dict[str, float] = {}
    for text in lengths:
        name, equals, length = text.partition("=")
        if not equals:
            raise UserError(f'--known-length needs a name and a length, "DOOR=2.0 m"; got "{text}"')
        metres = parse_quantity(length, LENGTH, "--known-length")
        if not 0 < metres <= MAX_LENGTH:
            raise UserError(
                f'--known-length must be above 0 and at most {MAX_LENGTH:g} m; got "{text}"'
            )
        if name.strip() in known:
            raise UserError(f"--known-length gives {name.strip()} twice; give it once")
        known[name.strip()] = metres
    return list(known.items())


def check_known_lengths(lengths: tuple[str, ...], marks: Path | None, default: Path) -> None:
    """Refuse known lengths or marks that cannot be used, as far as that shows without a scene.

    Raises:
        UserError: lengths or marks that cannot be used.
    """
    if marks is not None and not lengths:
        raise UserError(
            '--marks needs --known-length "NAME=2.0 m", the length between the marks; add it'
        )
    if not lengths:
        return
    marked = read_marks(marks or default)
    for name, _ in parse_known_lengths(lengths):
        if name not in marked:
            raise UserError(f"the marks hold no {name!r}; they hold: {', '.join(marked) or 'none'}")


def frame_line(scene: Scene) -> str:
    """Return one line about up direction, scale and heights of a scene."""
    views = scene.of_split("train")
    heights = sorted(float(scene.c2w_world(view)[2, 3]) - scene.ground_z for view in views)
    up = scene.up_report.get("used", "the scene file")
    others = {k: v for k, v in scene.up_report.items() if isinstance(v, int | float)}
    if others:
        up += f" ({', '.join(f'{name} {angle:.1f} deg' for name, angle in others.items())} from it)"
    return (
        f"Scene: {len(scene.views)} photos; up from {up}; {scale_summary(scene)}; cameras"
        f" {heights[len(heights) // 2]:.1f} m above the ground datum, lowest ground"
        f" {scene.lowest_ground_z - scene.ground_z:+.1f} m from it"
    )


def resuming(options: Fit) -> str:
    """Return the command that resumes a run, with the flags of its first command."""
    words = ["climatenerf", "fit", str(options.scene), "-o", str(options.out), "--resume"]
    for option in fields(Fit)[2:]:
        value = getattr(options, option.name)
        # The run folder holds the scale.
        stored = ("resume", "camera_height", "metric_input", "known_length", "marks")
        if option.name in stored or value == option.default:
            continue
        flag = f"--{option.name.replace('_', '-')}"
        if isinstance(value, bool):
            words += [flag]
        else:
            words += [word for each in _each(value) for word in (flag, str(each))]
    return shlex.join(words)


def _each(value: object) -> tuple:
    return value if isinstance(value, tuple) else (value,)


def fit_with_bars(scene, options: Fit) -> dict:
    """Fit with progress bars, and return the metrics."""
    # torch is imported here, so that help and input errors do not wait for it.
    progress.say(
        "Preparing: matching photos takes up to half a minute; compiling kernels takes as long,"
        " once per machine"
    )
    from climatenerf.core.device import resolve_device
    from climatenerf.training.run import fit_scene
    from climatenerf.training.trainer import Report

    settings, device = fit_settings(options), resolve_device(options.device)
    with progress.Bar("fit", 1.0) as bar:
        begun = False

        def report(state: Report) -> None:
            nonlocal begun
            if not begun:  # the kernels are compiled
                bar.prepared(state.progress)
                begun = True
            bar.update(
                state.progress,
                {
                    "step": str(state.step),
                    "rays/s": progress.rate(state.rays_per_second),
                    "samples/ray": f"{state.samples_per_ray:.0f}",
                    "PSNR": f"{state.psnr:.1f}",
                },
            )

        def evaluated(done: int, total: int) -> None:
            bar.update(1.0, {"held-out": f"{done}/{total}"})

        return fit_scene(
            scene,
            options.out,
            settings,
            options.downscale,
            options.resume,
            report,
            evaluated,
            device,
        )


def fit_settings(options: Fit) -> FitSettings:
    """Return the settings of the preset, replaced by those that flags give."""
    settings = settings_of(
        options.preset or ("gpu" if options.device == "cuda" else "cpu"), options.device
    )
    weights = parse_losses(options.loss)
    if weights.get("normal_consistency") and weights.get("normals") == 0:
        raise UserError(
            "--loss normal_consistency needs predicted normals; leave --loss normals=0 out"
        )
    if options.mono_depth == "none":
        weights["monocular_depth"] = 0.0
    return replace(
        settings,
        losses=replace(settings.losses, **weights),
        minutes=5.0 if options.minutes is None and options.steps is None else options.minutes,
        steps=options.steps,
        refine_poses=options.refine_poses,
        seed=options.seed,
    )


def parse_losses(given: tuple[str, ...]) -> dict[str, float]:
    """Return weights of losses given as "sky=0".

    Raises:
        UserError: a word has another form, an unknown loss, or a weight below 0.
    """
    names = [each.name for each in fields(Losses)]
    weights = {}
    for text in given:
        name, _, number = text.partition("=")
        name = RENAMED_LOSSES.get(name, name)
        try:
            weight = float(number)
        except ValueError:
            weight = -1.0
        if name not in names or not 0 <= weight < 1e6:
            raise UserError(
                f'--loss needs a name and a weight of 0 or more, such as sky=0; got "{text}".'
                f" Names: {', '.join(names)}"
            )
        weights[name] = weight
    return weights


def geometry_line(metrics: dict) -> str:
    """Return one line with the scores that need no reference; "" without any."""
    forms = {
        "ground.present": "the fit holds {:.0%} of the ground",
        "ground.roughness_cm": "its roughness is {:.1f} cm",
        "neighbours.psnr": "neighbouring photos agree to {:.1f} dB",
        "floating.share": "{:.2%} of the pixels show floating matter",
        "sky.empty": "{:.1%} of the sky is empty",
        "points.abs_rel": "depth errs by {:.1%} at points that were withheld",
    }
    known = {name: metrics[name] for name in forms if metrics.get(name) is not None}
    parts = [forms[name].format(value) for name, value in known.items()]
    return f"Geometry: {'; '.join(parts)}" if parts else ""


def ground_line(metrics: dict) -> str:
    """Return one line if no terrain was found; "" if one was, or none was looked for."""
    from climatenerf.evaluation.no_reference import TOO_LITTLE_GROUND

    reason = (metrics.get("score_reasons") or {}).get("ground.present")
    if reason != TOO_LITTLE_GROUND:
        return ""
    return (
        f"Ground: not found, since {reason}; water and snow will have holes. Add photos that look"
        " down at the ground"
    )


def datum_line(metrics: dict) -> str:
    """Return one line if the fit moved the ground datum; "" if not."""
    moved = metrics.get("datum_moved_m")  # runs of earlier versions have none
    if not moved:
        return ""
    return (
        f"Datum: moved by {moved:+.2f} m to the ground that the fit found below the cameras; water"
        " levels count from there. If the camera height was assumed, give --camera-height"
    )


def summary(metrics: dict) -> str:
    """Return one line with quality, cost, and the masked fraction of the photos."""
    cost = f"{metrics['steps']} steps, {metrics['seconds']:.0f} s of fitting"
    if metrics.get("masked_fraction"):  # runs of earlier versions have none
        cost += f"; {metrics['masked_fraction']:.1%} of the photos masked as passers-by"
    if metrics["psnr"] is None and metrics["interrupted"]:
        return f"held-out photos are not measured after a stop; {cost}"
    if metrics["psnr"] is None:
        return f"no held-out photos to measure; {cost}"
    return (
        f"held-out PSNR {metrics['psnr']:.2f} dB (colour-corrected {metrics['psnr_cc']:.2f}),"
        f" SSIM {metrics['ssim']:.3f}; {cost}"
    )
