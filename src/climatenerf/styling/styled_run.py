"""A run in new colours: a copy of a run folder with a style, which weather renders on as on any."""

import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.core.storage import explain, make_folder, read_json, write_json
from climatenerf.scene.scene import FILE_NAME as SCENE
from climatenerf.scene.scene import OBSERVATIONS_NAME, POINTS_NAME, Scene
from climatenerf.training.snapshot import CONFIG, FIELD, identity_of, new_checkpoint, stage_scene
from climatenerf.weather.style import FILE_NAME, Style, write_style

if TYPE_CHECKING:
    from climatenerf.field.hash_field import Field

KEPT = (POINTS_NAME, OBSERVATIONS_NAME)
BESIDE = ("terrain.npz",)
"""Files that were found in the field, and hold for the copy as well."""
ALL = (FIELD, CONFIG, SCENE, "light.json")
"""Files of a finished copy."""
UNFINISHED = ".fine-tuning"
"""Folder in the styled run from which an interrupted fine-tuning resumes."""


def check_out(run: Path, out: Path, resumes: bool = False) -> None:
    """Refuse a folder that cannot become the styled run; write nothing.

    Args:
        run: the run.
        out: the folder.
        resumes: whether an unfinished fine-tuning in it may go on.

    Raises:
        UserError: it is the run itself or lies in it, or it holds anything but an unfinished copy.
    """
    if out.resolve() == run.resolve() or out.resolve().is_relative_to(run.resolve()):
        raise UserError(f"-o {out} is the run itself or lies in it; choose another folder")
    begun = (out / UNFINISHED).exists()
    if begun and not resumes:
        raise UserError(
            f"{out} holds an unfinished fine-tuning; repeat its command, remove the folder, or"
            " choose another -o"
        )
    if (out / FIELD).exists() and not begun:
        raise UserError(f"{out} already holds a run; choose another -o, or remove it")
    ours = {FILE_NAME, ".lock", ".next", UNFINISHED, *(ALL if begun else ()), *BESIDE, *KEPT}
    foreign = sorted({path.name for path in out.iterdir()} - ours) if out.is_dir() else []
    if foreign:
        raise UserError(f"{out} holds other files, such as {foreign[0]}; choose another -o")


def write_styled_run(
    run: Path, scene: Scene, style: Style, out: Path, field: "Field | None" = None
) -> None:
    """Copy a run and give the copy a style.

    Args:
        run: folder of the run.
        scene: its scene.
        style: the new colours.
        out: folder of the copy.
        field: the field in new colours; None: the field's bytes stay.

    Raises:
        UserError: the folder cannot be used or written.
    """
    check_out(run, out, resumes=field is not None)
    make_folder(out)
    with only_writer(out):
        write_style(out, style)
        try:
            for name in BESIDE:
                if (run / name).is_file():
                    shutil.copyfile(run / name, out / name)
            with new_checkpoint(out) as staging:
                identity = identity_of(run / FIELD) or ""
                if field is None:
                    shutil.copyfile(run / FIELD, staging / FIELD)
                    shutil.copyfile(run / CONFIG, staging / CONFIG)
                else:
                    from climatenerf.field.checkpoint import save_field

                    # The shapes are the same, so the terrain, which names the identity, holds.
                    save_field(field, staging, identity)
                    config = read_json(run / CONFIG) | {"field": asdict(field.size)}
                    write_json(staging / CONFIG, config)
                stage_scene(scene, out, staging, identity)
        except OSError as error:
            raise explain(error, Path(os.fsdecode(error.filename or out))) from error
