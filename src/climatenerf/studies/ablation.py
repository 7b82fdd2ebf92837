"""What each part of the fit is good for: the paper's ablation of geometry, against the truth.

Every row leaves one part out, is fitted for the same time with the same sampling, and is measured
like any run (`evaluation.scores`).
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.core.errors import UserError
from climatenerf.core.storage import make_folder, read_json, write_bytes, write_json
from climatenerf.evaluation import geometry
from climatenerf.evaluation.reference import read_reference
from climatenerf.evaluation.scores import (
    Dry,
    Place,
    Tell,
    check_views,
    display_8bit,
    dry_view,
    frame_scores,
    geometry_scores,
    label_scores,
    picture_scores,
    weather_views,
)
from climatenerf.field.checkpoint import load_field
from climatenerf.field.hash_field import Field
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg
from climatenerf.scene import Scene, load_scene
from climatenerf.training.folder import OPTIMISER, check_config
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings, Losses
from climatenerf.training.trainer import Report

SCHEMA_VERSION = 1
FILE_NAME, TEXT_NAME, SHEET = "ablation.json", "ablation.md", "ablation.jpg"
WEATHERS = ("smog-mid", "flood-low", "snow-deep")
CELL = 256  # pixels of a picture's width
MEASURED = {
    "psnr": "clean, dB",
    "depth_abs_rel": "depth",
    "depth_spread": "spread",
    "ground_holes": "holes",
    "open_sky": "upwards",
    "normal_median_deg": "normals, deg",
    "normal_ground_roof_median_deg": "ground, roofs",
    "slope_median_deg": "slope, deg",
    "floater_mass": "floaters",
    "clear_floater_mass": "off edges",
    "sky_empty_fraction": "sky",
    "miou": "mIoU",
    **{name: f"{name}, dB" for name in WEATHERS},
}


def rows(minutes: float) -> dict[str, FitSettings]:
    """Settings of each row; the first fits colours alone, as a plain NGP does."""
    full = FitSettings(minutes=minutes)

    def without(**weights: float) -> FitSettings:
        return dataclasses.replace(full, losses=dataclasses.replace(full.losses, **weights))

    nothing = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    plain = dataclasses.replace(
        full,
        losses=Losses(**nothing),
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
        "no flatness": without(planarity=0.0),
        "no sky": dataclasses.replace(full, sky_labels=False),
        "no depth": without(sparse_depth=0.0, ground_height=0.0, monocular_depth=0.0),
        "full": full,
    }


def chosen_rows(minutes: float, names: tuple[str, ...]) -> dict[str, FitSettings]:
    """The rows of these names; all if none is given.

    Raises:
        UserError: there is no row of a name.
    """
    known = rows(minutes)
    for name in names:
        if name not in known:
            raise UserError(f"there is no row {name!r}; there are: {', '.join(known)}")
    return {name: row for name, row in known.items() if not names or name in names}


def ablate(
    scene: Scene,
    out: Path,
    minutes: float,
    downscale: int,
    seeds: int,
    report: Callable[[str, Report], None],
    tell: Tell,
    chosen: dict[str, FitSettings],
) -> dict[str, Any]:
    """Fits and measures some rows; returns and writes the table.

    What an earlier call has finished in the folder is taken from there.

    Args:
        scene: a capture with a reference set.
        out: folder of the report; the runs go to `out/runs`.
        minutes: of each fit.
        downscale: photos are reduced this many times for the fits.
        seeds: fits of each row.
        report: told the row and where its fit is.
        tell: told what is being measured.
        chosen: settings of the rows, see `chosen_rows`.

    Raises:
        UserError: the capture has no reference set, or the folder holds fits of other settings.
    """
    # All that can be wrong is to be known before hours of fitting.
    reference = read_reference(scene.root)
    check_views(scene, reference)
    check_folder(out, reference.folder, tuple(chosen))
    make_folder(out / "runs")
    table: dict[str, list[dict[str, float]]] = {}
    sheet = []
    for name, settings in chosen.items():
        for seed in range(seeds):
            run = out / "runs" / f"{name.replace(' ', '-')}-{seed}"
            seeded = dataclasses.replace(settings, seed=seed)
            fit_row(scene, run, seeded, downscale, lambda state, name=name: report(name, state))
            tell(f"{name}, seed {seed}")
            place = Place(load_field(run), load_scene(run), read_reference(scene.root))
            scores, pictures = measure_row(place, settings, seed == 0)
            table.setdefault(name, []).append(scores)
            if pictures:
                sheet.append((name, pictures))
    data = {
        "schema_version": SCHEMA_VERSION,
        "capture": scene.root.name,
        "minutes": minutes,
        "downscale": downscale,
        "rows": table,
    }
    write_json(out / FILE_NAME, data)
    write_bytes(out / TEXT_NAME, markdown(data).encode())
    write_jpeg(out / SHEET, contact_sheet(sheet, cell_width=CELL), 150_000)
    return data


def check_folder(out: Path, reference: Path, names: tuple[str, ...]) -> None:
    """Refuses a folder within the reference set, or with a report that these rows do not replace.

    That is one that no ablation wrote, or one of other rows, too.
    """
    if out.resolve().is_relative_to(reference.resolve()):
        raise UserError(f"{out} lies in the reference set; choose another folder with -o")
    ours = (out / FILE_NAME).is_file() and "rows" in read_json(out / FILE_NAME, "an ablation")
    more = set(read_json(out / FILE_NAME, "an ablation")["rows"]) - set(names) if ours else set()
    if more:
        raise UserError(
            f"{out} holds a report of more rows ({', '.join(sorted(more))}); choose another folder"
            " with -o, or ask for these, too"
        )
    for name in (FILE_NAME, TEXT_NAME, SHEET):
        if (out / name).exists() and not ours:
            raise UserError(f"{out / name} would be overwritten; choose another folder with -o")


def fit_row(
    scene: Scene,
    run: Path,
    settings: FitSettings,
    downscale: int,
    report: Callable[[Report], None],
) -> None:
    """One fit, unless the folder holds it finished already."""
    wanted = json.loads(json.dumps(dataclasses.asdict(settings)))
    begun = (run / "config.json").is_file() and (run / OPTIMISER).is_file()
    if begun:
        config = check_config(run)
        if config.get("settings") != wanted or config.get("downscale") != downscale:
            raise UserError(
                f"{run} was fitted with other settings; choose another folder with -o, or remove it"
            )
    if begun and (run / "metrics.json").is_file():
        metrics = read_json(run / "metrics.json", "the run's measurements")
        if metrics.get("interrupted") is False and "views" in metrics:
            return
    metrics = fit_scene(scene, run, settings, downscale, begun, report, lambda done, total: None)
    if metrics["interrupted"]:
        raise KeyboardInterrupt


def measure_row(
    place: Place, settings: FitSettings, pictured: bool
) -> tuple[dict[str, float], list[UInt8[np.ndarray, "h w 3"]]]:
    """Scores of one fit and, if wanted, pictures of its first view."""
    truths = place.reference.truths
    dry = [dry_view(place, truth) for truth in truths]
    clean = [display_8bit(each.linear) for each in dry]
    scale = frame_scores(place)["scale"]
    scores = picture_scores(clean, [display_8bit(truth.clean) for truth in truths])
    scores |= geometry_scores(place, dry, scale)
    slopes = geometry.normal_scores([slope_normals(place.fitted, each) for each in dry], truths)
    scores |= {"slope_median_deg": slopes["normal_median_deg"]}
    if settings.losses.classes:
        scores |= {"miou": label_scores(place)["miou"]}
    scores["ground_holes"] = geometry.ground_holes([each.depth / scale for each in dry], truths)
    pictures = [clean[0], depth_picture(dry[0].depth), normal_picture(dry[0].normal)]
    for kind in place.reference.weathers:
        if kind.name in WEATHERS:
            seen = [display_8bit(linear) for linear, _ in weather_views(place, kind)]
            real = [kind.picture(truth.name) for truth in truths]
            scores[kind.name] = picture_scores(seen, real)["psnr"]
            pictures.append(seen[0])
    return scores, pictures if pictured else []


def slope_normals(field: Field, dry: Dry) -> Float[np.ndarray, "h w 3"]:
    """Normals, in camera axes, as the density's own slope has them at the surfaces of a view.

    What weather would have to do with if nothing smoothed them; 0 where there is no surface.
    """
    hit = np.isfinite(dry.depth)
    x = dry.c2w[:3, 3] + dry.depth[hit][:, None] * dry.rays_d[hit]
    normal = np.zeros(dry.normal.shape)
    q = field.to_grid(torch.from_numpy(x.astype(np.float32)))
    normal[hit] = field.density_normal(q).numpy()
    return normal @ dry.c2w[:3, :3]


def depth_picture(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Grey by inverse distance: near is bright, a metre or nearer is white, the sky black."""
    grey = (255 * np.clip(1.0 / np.maximum(depth, 1.0), 0, 1) ** 0.5 + 0.5).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def normal_picture(normal: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """(n + 1) / 2 as colours; black where there is none."""
    there = (normal != 0).any(-1, keepdims=True)
    return (255 * np.where(there, (normal + 1) / 2, 0) + 0.5).astype(np.uint8)


def markdown(data: dict[str, Any]) -> str:
    """The table, means over the seeds with half the range between them."""
    head = (
        f"{data['minutes']:g} minutes each at 1/{data['downscale']} of the size, {data['capture']}"
    )
    lines = [
        "| row | " + " | ".join(MEASURED.values()) + " |",
        "|---" * (len(MEASURED) + 1) + "|",
    ]
    for name, each in data["rows"].items():
        cells = [cell([one[key] for one in each if key in one]) for key in MEASURED]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return f"# Ablation\n\n{head}\n\n" + "\n".join(lines) + f"\n\n![pictures]({SHEET})\n"


def cell(values: list[float]) -> str:
    """Mean and half the range, or a dash."""
    if not values:
        return "-"
    half = (max(values) - min(values)) / 2
    return f"{np.mean(values):.3g}" + (f" ± {half:.2g}" if len(values) > 1 else "")
