"""From a run and a teacher to a run whose appearance grid has learned the style."""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.core.storage import (
    digest,
    hash_of_files,
    make_folder,
    read_json,
    read_safetensors,
    write_json,
    write_safetensors,
)
from climatenerf.field.capabilities import NORMALS
from climatenerf.field.hash_field import Field
from climatenerf.field.protocol import device_of, observed
from climatenerf.output.job import hash_of_run
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.render.photo_rays import trace_photos
from climatenerf.scene.scene import FILE_NAME as SCENE
from climatenerf.scene.scene import Scene
from climatenerf.styling.paper.fine_tune import (
    INTERVAL,
    FineTuning,
    Lesson,
    Score,
    lesson_of,
)
from climatenerf.styling.paper.shots import Shot, joined, march, matter
from climatenerf.styling.paper.teachers import Teacher
from climatenerf.styling.styled_run import UNFINISHED, check_out, write_styled_run
from climatenerf.training.snapshot import FIELD
from climatenerf.weather.light.captured import CapturedLight, UnknownLight
from climatenerf.weather.light.file import FILE_NAME as LIGHT
from climatenerf.weather.light.file import load_light, save_light
from climatenerf.weather.light.find_light import find_light
from climatenerf.weather.light.solar_position import almanac_sun
from climatenerf.weather.style import FineTuned, Style, as_table

PLAN, STATE = "plan.json", "state.safetensors"
OTHERS = 8  # of so many views, one is measured and does not teach
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class PaperSettings:
    """Of a fine-tuning.

    Attributes:
        steps: of the fit.
        views: the most that teach, or are measured.
        width: the most pixels across of their pictures.
        seed: of pixels and rays.
    """

    steps: int = 400
    views: int = 40
    width: int = 480
    seed: int = 0


def write_fine_tuned_run(
    run: tuple[Path, Field, Scene],
    style: Style,
    teacher: Teacher,
    shots: Sequence[Shot],
    settings: PaperSettings,
    out: Path,
    progress: Progress,
) -> list[Score]:
    """Fine-tune a copy of a run. The same call resumes what was interrupted, to the same bytes.

    Args:
        run: folder, field and scene; the field stays as it is.
        style: of which the copy keeps all but the classes, which the field has learned.
        teacher: of the colours.
        shots: the views.
        settings: of the fit.
        out: folder of the copy.
        progress: called with what is being done and the fraction that is done.

    Returns:
        What was measured, the first before the first step.

    Raises:
        UserError: the folder cannot be used or written, or holds an unfinished fit with other
            options.
    """
    folder, field, scene = run
    check_out(folder, out, resumes=True)
    unfinished = out / UNFINISHED
    with only_writer(out, (UNFINISHED,)):
        _check_plan(unfinished, _plan(folder, style, teacher, settings))
        make_folder(unfinished)
        lesson, others = _lessons(field, teacher, shots, unfinished, progress)
        if not len(lesson.rays):
            raise UserError("the training views show nothing but sky; give more with --views")
        tuned = FineTuning(field.recolourable(), settings.steps, settings.seed)
        _restore(tuned, unfinished / STATE)

        def after(state: FineTuning) -> None:
            if state.step % INTERVAL == 0 and not state.finished:
                _save(state.state(), unfinished / STATE)
            progress("colours", state.step / settings.steps)

        tuned.run(lesson, others, after)
        if tuned.step < settings.steps:  # it ended early
            progress("colours", 1.0)
        record = _record(tuned, teacher, shots, to_numpy(scene_irradiance(field, scene)))
        learned = replace(style, classes=(), fine_tuned=record)
        light = _light_of_photos(run)
        write_styled_run(folder, scene, learned, out, tuned.field)
        if light is not None:
            save_light(out / LIGHT, light, hash_of_run(out))
        shutil.rmtree(unfinished, ignore_errors=True)
    return tuned.scores


def _record(
    tuned: FineTuning, teacher: Teacher, shots: Sequence[Shot], light: Float[np.ndarray, "3"]
) -> FineTuned:
    first, last = tuned.scores[0], tuned.scores[-1]
    width = max(shot.camera.width for shot in shots)
    psnr = None if math.isnan(first.others) else (first.others, last.others)
    red, green, blue = map(float, light)
    return FineTuned(teacher.kind, tuned.step, len(shots), width, (red, green, blue), psnr)


def _light_of_photos(run: tuple[Path, Field, Scene]) -> CapturedLight | UnknownLight | None:
    """Return the light of the photos for the copy; in new colours another would be found."""
    folder, field, scene = run
    if NORMALS not in field.capabilities:
        return None
    path = folder / LIGHT
    light, made_from = load_light(path) if path.is_file() else (None, "")
    if light is None or made_from != hash_of_run(folder):
        light = find_light(field, trace_photos(observed(field), scene), almanac_sun(scene))
    return light


def _plan(folder: Path, style: Style, teacher: Teacher, settings: PaperSettings) -> str:
    """Return a text that is the same for the same fit."""
    parts = {
        "run": hash_of_files([folder / FIELD, folder / SCENE]),
        "style": as_table(style),
        "teacher": [teacher.kind, teacher.made_from],
        "settings": asdict(settings),
    }
    return json.dumps(parts, sort_keys=True)


def _check_plan(unfinished: Path, plan: str) -> None:
    """Note what is going to be fitted.

    Raises:
        UserError: the folder holds an unfinished fit of something else.
    """
    path = unfinished / PLAN
    if path.is_file() and read_json(path).get("plan") != plan:
        raise UserError(
            f"{unfinished.parent} holds an unfinished fine-tuning with other options; repeat it"
            " with the same, remove the folder, or choose another -o"
        )
    write_json(path, {"plan": plan})


def _lessons(
    field: Field,
    teacher: Teacher,
    shots: Sequence[Shot],
    unfinished: Path,
    progress: Progress,
) -> tuple[Lesson, Lesson]:
    """Return what teaches, and what is only measured; a view's target is kept for a resumed run."""
    count, device = len(shots), device_of(field)
    apart = set(range(OTHERS // 2, count, OTHERS)) or ({count // 2} if count > 2 else set())
    found: tuple[list[Lesson], list[Lesson]] = ([], [])
    for index, shot in enumerate(shots):
        progress("pictures", index / count)
        rays = march(field, *shot.rays(device))
        path = unfinished / f"target_{index:04d}.safetensors"
        target = _read_target(path, len(rays), device)
        if target is None:
            with torch.no_grad():
                target = teacher.teach(shot, matter(field, rays))
            _save({"target": target}, path)
        found[index in apart].append(lesson_of(rays, target))
    progress("pictures", 1.0)
    taught, measured = found
    return _joined(taught), _joined(measured) if measured else _joined(taught).none()


def _joined(lessons: list[Lesson]) -> Lesson:
    targets = torch.cat([lesson.target for lesson in lessons])
    return Lesson(joined([lesson.rays for lesson in lessons]), targets)


def _save(tensors: dict[str, Tensor], path: Path) -> None:
    write_safetensors(path, tensors, {"digest": str(digest(tensors))})


def _read(path: Path) -> dict[str, Tensor]:
    """Read tensors that `_save` wrote.

    Raises:
        UserError: they are damaged.
    """
    arrays, about = read_safetensors(path, "the unfinished fine-tuning")
    if about.get("digest") != str(digest(arrays)):
        raise _damaged(path)
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _damaged(path: Path) -> UserError:
    return UserError(f"{path} is damaged; remove it, and what it holds is made anew")


def _read_target(path: Path, rays: int, device: torch.device) -> Float[Tensor, "n 3"] | None:
    if not path.is_file():
        return None
    target = _read(path).get("target")
    if target is None or target.shape != (rays, 3):
        raise _damaged(path)
    return target.to(device)


def _restore(tuned: FineTuning, path: Path) -> None:
    if not path.is_file():
        return
    try:
        tuned.load(_read(path))
    except (KeyError, RuntimeError, ValueError) as error:
        raise _damaged(path) from error
