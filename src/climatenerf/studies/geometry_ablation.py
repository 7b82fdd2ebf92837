"""Ablation of the fit on a reference set, after the paper's ablation of geometry.

Each row leaves one part of the method out. All rows are fitted for the same time with the same
sampling, and scored like any run (`evaluation.scores`).
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.core.parsing import read_json
from climatenerf.core.storage import make_folder, write_bytes, write_json
from climatenerf.evaluation import geometry
from climatenerf.evaluation.baselines import CleanView
from climatenerf.evaluation.evaluated_run import (
    EvaluatedRun,
    check_views,
    clean_view,
    display_8bit,
    render_weather,
)
from climatenerf.evaluation.reference import read_reference
from climatenerf.evaluation.scores import (
    Progress,
    frame_scores,
    geometry_scores,
    label_scores,
    picture_scores,
)
from climatenerf.field.checkpoint import load_field
from climatenerf.field.hash_field import Field
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg
from climatenerf.scene import Scene, load_scene
from climatenerf.scene.images import RELATIVE_DEPTH
from climatenerf.studies.study_folder import (
    ABLATION,
    MAX_SHEET,
    SCHEMA_VERSION,
    SHEET,
    TEXT,
    ablation_files,
    file_name,
    remove_left_over,
)
from climatenerf.studies.study_folder import check_folder as check_files
from climatenerf.training.folder import OPTIMISER, check_config, checked_metrics
from climatenerf.training.progress import Report
from climatenerf.training.run import METRICS, fit_scene
from climatenerf.training.settings import FitSettings, Losses, as_config, settings_of

KIND = "geometry"
WEATHERS = ("smog-mid", "flood-low", "snow-deep")
CELL = 256  # width of each picture in the sheet, pixels
RELATIVE_DEPTH_ROWS = ("no monocular depth", "monocular depth alone")
COLUMNS = {
    "psnr": "clean, dB",
    "depth_abs_rel": "depth",
    "depth_spread": "spread",
    "ground_holes": "holes",
    "open_sky": "open sky",
    "normal_median_deg": "normals, deg",
    "normal_ground_roof_median_deg": "ground, roofs",
    "slope_median_deg": "slope, deg",
    "floater_mass": "floaters",
    "clear_floater_mass": "without edges",
    "sky_empty_fraction": "sky",
    "miou": "mIoU",
    **{name: f"{name}, dB" for name in WEATHERS},
}


def rows(minutes: float) -> dict[str, FitSettings]:
    """Return the settings of each row; the first has photometric losses alone, like plain NGP."""
    full = dataclasses.replace(settings_of("cpu"), minutes=minutes)

    def without(**weights: float) -> FitSettings:
        return dataclasses.replace(full, losses=dataclasses.replace(full.losses, **weights))

    zero = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    plain = dataclasses.replace(
        full,
        losses=Losses(**zero),
        appearance=False,
        sky_labels=False,
        free_space=False,
        multiview_stereo=False,
        near_camera_gradient_scaling=0.0,
        warm_up=False,
        pruning_threshold=1e-3,
        decay=0.0,
    )
    return {
        "plain NGP": plain,
        "no appearance": dataclasses.replace(full, appearance=False),
        "no distortion": without(distortion=0.0),
        "no normals": without(normals=0.0),
        "no planarity": without(planarity=0.0),
        "no occlusion": without(occlusion=0.0),
        "no sky": dataclasses.replace(full, sky_labels=False),
        "no monocular depth": without(monocular_depth=0.0),
        "monocular depth alone": without(sparse_depth=0.0, ground_height=0.0),
        "no depth": without(sparse_depth=0.0, ground_height=0.0, monocular_depth=0.0),
        "full": full,
    }


def select_rows(
    minutes: float, names: tuple[str, ...], relative_depth: bool = True
) -> dict[str, FitSettings]:
    """Return the rows of some names, in the order of the table; all rows if no name is given.

    "monocular depth alone" beside "no depth" is the paper's pair with and without monocular depth;
    the paper has no other depth.

    Args:
        minutes: duration of each fit.
        names: of rows.
        relative_depth: whether the capture has what a network for monocular depth makes. Without
            it, rows that differ from others by its use alone are left out.

    Raises:
        UserError: there is no row of a name, or the capture lacks what it needs.
    """
    existing = rows(minutes)
    for name in names:
        if name not in existing:
            raise UserError(f"there is no row {name!r}; choose from: {', '.join(existing)}")
        if name in RELATIVE_DEPTH_ROWS and not relative_depth:
            raise UserError(
                f"the row {name!r} needs a capture with relative depths (folder depth_relative);"
                " leave it out"
            )
    default = [name for name in existing if relative_depth or name not in RELATIVE_DEPTH_ROWS]
    return {name: existing[name] for name in existing if name in (names or default)}


def has_relative_depth(scene: Scene) -> bool:
    """Whether a capture has depths that can stand for those of a network."""
    own = (view.depth_path is not None for view in scene.of_split("train"))
    return (scene.root / RELATIVE_DEPTH).is_dir() or any(own)


def ablate(
    scene: Scene,
    out: Path,
    minutes: float,
    downscale: int,
    seeds: int,
    after_step: Callable[[str, Report], None],
    progress: Progress,
    selected: dict[str, FitSettings],
) -> dict[str, Any]:
    """Fit and score some rows; write and return the table.

    Fits that an earlier call finished in the same folder are reused.

    Args:
        scene: a capture with a reference set.
        out: folder of the report; the runs go to `out/runs`.
        minutes: duration of each fit.
        downscale: factor by which the photos are reduced for the fits.
        seeds: number of fits of each row.
        after_step: called with the row and the state of its fit after each step.
        progress: called with each row and seed as its scoring begins.
        selected: settings of the rows, see `select_rows`.

    Raises:
        UserError: the capture has no reference set, the folder holds fits of other settings, or
            another process writes into it.
    """
    # All checks come before the fits, which take hours.
    reference = read_reference(scene.root)
    check_views(scene, reference)
    check_folder(out, reference.folder, tuple(selected))
    with only_writer(out):
        return _ablate(scene, out, minutes, downscale, seeds, after_step, progress, selected)


def _ablate(
    scene: Scene,
    out: Path,
    minutes: float,
    downscale: int,
    seeds: int,
    after_step: Callable[[str, Report], None],
    progress: Progress,
    selected: dict[str, FitSettings],
) -> dict[str, Any]:
    """Fit, score and write as `ablate` does, in a folder that is checked and locked."""
    make_folder(out / "runs")
    earlier = check_folder(out, read_reference(scene.root).folder, tuple(selected))
    table: dict[str, list[dict[str, float]]] = {}
    sheet = []
    for name, settings in selected.items():
        for seed in range(seeds):
            folder = out / "runs" / f"{name.replace(' ', '-')}-{seed}"
            seeded = dataclasses.replace(settings, seed=seed)
            fit_row(
                scene, folder, seeded, downscale, lambda state, name=name: after_step(name, state)
            )
            progress(f"{name}, seed {seed}")
            run = EvaluatedRun(load_field(folder), load_scene(folder), read_reference(scene.root))
            scores, pictures = score_row(run, settings, seed == 0)
            table.setdefault(name, []).append(scores)
            if pictures:
                sheet.append((name, pictures))
    data = {
        "schema_version": SCHEMA_VERSION,
        "climatenerf": climatenerf.__version__,
        "study": KIND,
        "capture": scene.root.name,
        "minutes": minutes,
        "downscale": downscale,
        "files": ablation_files(table, ".jpg"),
        "rows": [
            {
                "name": name,
                "picture": file_name(name, ".jpg"),
                "metrics": means(each),
                "seeds": each,
            }
            for name, each in table.items()
        ],
    }
    write_json(out / ABLATION, data)  # first: by it the other files are known as those of a study
    for name, pictures in sheet:
        write_jpeg(out / file_name(name, ".jpg"), contact_sheet([(name, pictures)]), MAX_SHEET)
    write_bytes(out / TEXT, markdown(data).encode())
    write_jpeg(out / SHEET, contact_sheet(sheet, cell_width=CELL), 150_000)
    remove_left_over(out, earlier, data["files"])
    return data


def means(seeds: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each score over the fits that have it."""
    names = dict.fromkeys(name for each in seeds for name in each)
    return {name: float(np.mean([e[name] for e in seeds if name in e])) for name in names}


def check_folder(out: Path, reference: Path, names: tuple[str, ...]) -> set[str]:
    """Refuse a folder whose files the report would overwrite.

    Args:
        out: folder for the report.
        reference: folder of the reference set.
        names: the rows of the report.

    Returns:
        Names of the files of an earlier report.

    Raises:
        UserError: the folder lies in the reference set, holds files of the report's names that no
            ablation of geometry wrote, or a report with rows that are not among `names`.
    """
    if out.resolve().is_relative_to(reference.resolve()):
        raise UserError(f"{out} lies in the reference set; choose another folder with -o")
    earlier = check_files(out, ABLATION, KIND, ablation_files(names, ".jpg"))
    more = row_names(read_json(out / ABLATION, "an ablation")) - set(names) if earlier else ()
    if more:
        raise UserError(
            f"{out} holds a report of more rows ({', '.join(sorted(more))}); choose another folder"
            " with -o, or add these rows"
        )
    return earlier


def row_names(data: dict[str, Any]) -> set[str]:
    """Return the names of the rows in an index, also in one of schema 1, a table by name."""
    listed = data.get("rows")
    if isinstance(listed, dict):
        return set(listed)
    entries = listed if isinstance(listed, list) else []
    return {str(each["name"]) for each in entries if isinstance(each, dict) and "name" in each}


def fit_row(
    scene: Scene,
    run: Path,
    settings: FitSettings,
    downscale: int,
    after_step: Callable[[Report], None],
) -> None:
    """Make one fit, resume it, or keep it if the folder holds it finished.

    Args:
        scene: the capture.
        run: run folder.
        settings: of the fit.
        downscale: factor by which the photos are reduced.
        after_step: called with the state of the fit after each step.

    Raises:
        UserError: the folder holds a fit of other settings.
        KeyboardInterrupt: the fit was interrupted; the folder holds what is needed to resume.
    """
    expected = as_config(settings)
    begun = (run / "config.json").is_file() and (run / OPTIMISER).is_file()
    if begun:
        config = check_config(run)
        if config.get("settings") != expected or config.get("downscale") != downscale:
            raise UserError(
                f"{run} was fitted with other settings; choose another folder with -o, or remove it"
            )
    if begun and (run / METRICS).is_file():
        metrics = checked_metrics(run / METRICS)
        if not metrics["interrupted"] and "views" in metrics:
            return
    metrics = fit_scene(scene, run, settings, downscale, begun, after_step, lambda done, n: None)
    if metrics["interrupted"]:
        raise KeyboardInterrupt


def score_row(
    run: EvaluatedRun, settings: FitSettings, with_pictures: bool
) -> tuple[dict[str, float], list[UInt8[np.ndarray, "h w 3"]]]:
    """Score one fit.

    Args:
        run: the fit and its truth.
        settings: of the fit.
        with_pictures: return pictures as well.

    Returns:
        The scores, and pictures of the first view: colours, depth, normals, and each weather.
    """
    truths = run.reference.truths
    views = [clean_view(run, truth) for truth in truths]
    clean = [display_8bit(view.linear) for view in views]
    scale = frame_scores(run)["scale"]
    scores = picture_scores(clean, [display_8bit(truth.clean) for truth in truths])
    scores |= geometry_scores(run, views, scale)
    assert isinstance(run.field, Field), "fits are hash fields"
    normals = [density_normals(run.field, view) for view in views]
    slopes = geometry.normal_scores(normals, truths)
    scores |= {"slope_median_deg": slopes["normal_median_deg"]}
    if settings.losses.classes:
        scores |= {"miou": label_scores(run)["miou"]}
    scores["ground_holes"] = geometry.ground_holes([view.depth / scale for view in views], truths)
    pictures = [clean[0], depth_picture(views[0].depth), normal_picture(views[0].normal)]
    for case in run.reference.weathers:
        if case.name in WEATHERS:
            rendered = [display_8bit(linear) for linear, _ in render_weather(run, case)]
            true = [case.picture(truth.name) for truth in truths]
            scores[case.name] = picture_scores(rendered, true)["psnr"]
            pictures.append(rendered[0])
    return scores, pictures if with_pictures else []


def density_normals(field: Field, view: CleanView) -> Float[np.ndarray, "h w 3"]:
    """Return normals from the gradient of the density at the surfaces of a view.

    They show what weather would use without predicted normals.

    Returns:
        Unit normals in camera axes; 0 where there is no surface.
    """
    hit = np.isfinite(view.depth)
    x = view.c2w[:3, 3] + view.depth[hit][:, None] * view.rays_d[hit]
    normal = np.zeros(view.normal.shape)
    q = field.to_grid(torch.from_numpy(x.astype(np.float32)))
    normal[hit] = field.density_normal(q).numpy()
    return normal @ view.c2w[:3, :3]


def depth_picture(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Show ray lengths (m) as grey values: white up to 1 m, darker with distance, black sky."""
    grey = (255 * np.clip(1.0 / np.maximum(depth, 1.0), 0, 1) ** 0.5 + 0.5).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def normal_picture(normal: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Show unit normals as colours (n + 1) / 2; black where the normal is 0."""
    valid = (normal != 0).any(-1, keepdims=True)
    return (255 * np.where(valid, (normal + 1) / 2, 0) + 0.5).astype(np.uint8)


def markdown(data: dict[str, Any]) -> str:
    """Return the table in Markdown: means over the seeds, and half the range."""
    head = (
        f"{data['minutes']:g} minutes each at 1/{data['downscale']} of the size, {data['capture']}"
    )
    lines = [
        "| row | " + " | ".join(COLUMNS.values()) + " |",
        "|---" * (len(COLUMNS) + 1) + "|",
    ]
    for row in data["rows"]:
        cells = [cell([one[key] for one in row["seeds"] if key in one]) for key in COLUMNS]
        lines.append(f"| {row['name']} | " + " | ".join(cells) + " |")
    return f"# Ablation\n\n{head}\n\n" + "\n".join(lines) + f"\n\n![pictures]({SHEET})\n"


def cell(values: list[float]) -> str:
    """Return mean ± half the range as text; a dash without values."""
    if not values:
        return "-"
    half_range = (max(values) - min(values)) / 2
    return f"{np.mean(values):.3g}" + (f" ± {half_range:.2g}" if len(values) > 1 else "")
