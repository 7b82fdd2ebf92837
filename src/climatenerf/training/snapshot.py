"""Checkpoints on disk: files that belong together, replaced and read as one. Does not import torch.

A writer makes all files of a checkpoint in `RUN/.next`, the field first, and then moves them into
the run folder, again the field first. All state one identity. A reader takes the field of the run
folder, and of every other file the one with the field's identity: it is in the run folder or still
in `.next`. So readers take no lock, and see no mixture of two checkpoints, neither while files move
nor after a kill that stopped the moves. The next writer finishes them.
"""

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.core.parsing import parse_json
from climatenerf.core.regular_files import check_regular
from climatenerf.core.storage import explain, make_folder, read_json, write_bytes
from climatenerf.scene.scene import FILE_NAME as SCENE
from climatenerf.scene.scene import OBSERVATIONS_NAME, POINTS_NAME, Scene, save_scene

STAGING = ".next"
FIELD, OPTIMISER = "field.safetensors", "optimiser.safetensors"
CONFIG, METRICS = "config.json", "metrics.json"
FILES = (FIELD, CONFIG, OPTIMISER, SCENE, POINTS_NAME, OBSERVATIONS_NAME)
"""In the order in which they move. Where the scene is, its points are or come next."""
SUBFOLDERS = (STAGING, "previews", "labels")
"""Subfolders of a run folder into which a fit writes."""
ATTEMPTS, PAUSE = 40, 0.05
"""How often a reader tries to read files that are being replaced; the pause in between, s."""

T = TypeVar("T")


@contextlib.contextmanager
def writing_run(run: Path) -> Iterator[None]:
    """Hold the lock of a run folder, and finish the checkpoint that a killed writer left.

    Raises:
        UserError: another process holds it, or the folder cannot be written.
    """
    with only_writer(run, SUBFOLDERS):
        finish_checkpoint(run)
        yield


@contextlib.contextmanager
def new_checkpoint(run: Path) -> Iterator[Path]:
    """Yield an empty folder for the files of a checkpoint, then move them into the run folder.

    The field is to be written first. `metrics.json`, which describes the earlier checkpoint, is
    removed. If the block fails, the run folder is unchanged.

    Raises:
        UserError: the disk is full, or the folder cannot be written.
    """
    finish_checkpoint(run)
    staging = make_folder(run / STAGING)
    try:
        yield staging
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
    try:
        (run / METRICS).unlink(missing_ok=True)
        os.replace(staging / FIELD, run / FIELD)
    except OSError as error:
        raise explain(error, run) from error
    finish_checkpoint(run)


def finish_checkpoint(run: Path) -> None:
    """Move the rest of a checkpoint whose field has moved; remove one that was never complete.

    Raises:
        UserError: a file cannot be moved.
    """
    staging = run / STAGING
    try:
        if staging.is_dir() and not (staging / FIELD).exists():
            for name in FILES:
                if (staging / name).exists():
                    os.replace(staging / name, run / name)
    except OSError as error:
        raise explain(error, run) from error
    shutil.rmtree(staging, ignore_errors=True)


def finish_after_kill(run: Path) -> None:
    """Finish a checkpoint that a killed writer left.

    Raises:
        UserError: the writer is alive.
    """
    if (run / STAGING).is_dir():
        with writing_run(run):
            pass


def stage_scene(scene: Scene, run: Path, staging: Path, identity: str) -> None:
    """Write a scene into the folder of a checkpoint, as it is to lie in the run folder."""
    path = save_scene(scene, staging)
    root = os.path.relpath(scene.root, run.absolute())
    data = read_json(path) | {"root": root, "checkpoint": identity}
    write_bytes(path, json.dumps(data, indent=1).encode())


def identity_of(path: Path) -> str | None:
    """Return the identity that a file of a checkpoint states.

    Returns:
        "" if it states none, as those of earlier versions; None if it cannot be read.
    """
    try:
        about = _metadata(path) if path.suffix == ".safetensors" else read_json(path)
    except (UserError, OSError, ValueError, TypeError, AttributeError, RecursionError):
        return None
    return str(about.get("checkpoint", ""))


def read_together(run: Path, read: Callable[[Mapping[str, Path]], T]) -> T:
    """Read files of one checkpoint, although a fit may replace them meanwhile.

    Args:
        run: the run folder.
        read: reads what it needs, given the paths of `FIELD`, `SCENE` and `CONFIG`. It is called
            again if a file was replaced while it ran.

    Raises:
        UserError: those of `read`; or the files are of different checkpoints.
    """
    for _ in range(ATTEMPTS):
        before, paths = _versions(run), _paths(run)
        if paths is not None:
            try:
                found = read(paths)
            except UserError:
                if _versions(run) == before:
                    raise
            else:
                if _versions(run) == before:
                    return found
        time.sleep(PAUSE)
    raise UserError(
        f"{run} holds {FIELD}, {SCENE} and {CONFIG} of different checkpoints; copy the whole run"
        " folder again, or resume the fit with `climatenerf fit --resume`"
    )


def _paths(run: Path) -> dict[str, Path] | None:
    """Return the files that belong to the field of a run folder; None if one is missing."""
    paths = {FIELD: run / FIELD}
    wanted = identity_of(paths[FIELD])
    for name in (SCENE, CONFIG):
        here = identity_of(run / name)
        if not wanted or here in ("", wanted):
            paths[name] = run / name
        elif identity_of(run / STAGING / name) == wanted:
            paths[name] = run / STAGING / name
        elif here is None:  # `read` tells what is wrong with it
            paths[name] = run / name
        else:
            return None
    return paths


def _versions(run: Path) -> list[tuple[int, int, int] | None]:
    """Return what changes when a file of the run folder is replaced, also by one of `.next`."""
    return [_version(run / name) for name in FILES]


def _version(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def _metadata(path: Path) -> dict[str, Any]:
    """Return what a safetensors file states about itself, without reading its tensors."""
    check_regular(path)
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        header = parse_json(file.read(min(length, 2**24)), str(path))
    about = header.get("__metadata__", {})
    return about | parse_json(about.get("climatenerf", "{}"), str(path))
