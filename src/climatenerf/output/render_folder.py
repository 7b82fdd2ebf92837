"""Files of a rendered movie: who owns them, which frames are finished, and how they are replaced.

    OUT/frames/0000.png          pictures
    OUT/depth/0000.npz           layers, a folder each
    OUT/movie.mp4, movie.json    written when the frames are joined
    OUT/.frames/render.json      the render that OUT holds
    OUT/.frames/0000.json        one record for each finished frame
    OUT/.frames/next/            a render that will replace a complete one, laid out like OUT

A frame is finished when its record exists. The record is written last, it holds the frame's key and
the sizes of its files, and the picture carries the same key. Files move to their final names under
an advisory lock of the operating system, so a killed process leaves neither a torn file nor a lock.

A complete render stays as it is until the next one, its movie and its sidecar are complete in
`next`. Then `promote` moves them, which needs no space on the disk. A promotion that a kill has
interrupted is finished by the next call, whatever it renders.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.core.locks import in_use
from climatenerf.core.locks import locked as locked_file
from climatenerf.core.storage import (
    atomic_path,
    explain,
    is_abandoned,
    make_folder,
    owned_name,
    read_json,
    remove,
    remove_abandoned,
    write_json,
)

SCHEMA_VERSION = 1
STATE = ".frames"
NEXT = f"{STATE}/next"
MOVIE, SIDECAR, PREVIEW = "movie.mp4", "movie.json", "preview.png"
SCRATCH = "unfinished-"  # prefix of scratch folders


def frame_files(index: int, layers: Sequence[str], formats: Sequence[str]) -> list[str]:
    """Return the paths of a frame's picture and layers, relative to the folder of the render."""
    stem = f"{index:04d}"
    found = [f"{name}/{stem}.{kind}" for name in layers for kind in formats]
    return [f"frames/{stem}.png", *found]


def current_render(folder: Path) -> dict[str, Any] | None:
    """Return the description of the render that a folder holds, or None if there is no sound one.

    The keys are `render` (its hash), `frames` (how many), `layers`, `formats` and `replaces`: files
    of an earlier render, relative to the folder, that are removed when this one is complete.
    """
    try:
        current = read_json(folder / STATE / "render.json")
        wanted = {"render": str, "frames": int, "layers": list, "formats": list, "replaces": list}
        sound = all(isinstance(current.get(name), kind) for name, kind in wanted.items())
        sound = sound and 0 <= current["frames"] <= MAX_FRAMES
    except (UserError, OSError):
        return None
    return current if sound else None


def describe(
    key: str, frames: int, layers: Sequence[str], formats: Sequence[str], replaces: Sequence[str]
) -> dict[str, Any]:
    """Return the content of `render.json`; `current_render` reads it back."""
    return {
        "schema_version": SCHEMA_VERSION,
        "render": key,
        "frames": frames,
        "layers": list(layers),
        "formats": list(formats),
        "replaces": list(replaces),
    }


def files_of_render(out: Path) -> set[Path]:
    """Return the resolved paths of all files that belong to the render in a folder.

    They are named by `render.json`, and by the sidecar of a version that wrote no `render.json`.
    """
    names: list[str] = []
    with contextlib.suppress(UserError, OSError, KeyError, TypeError, AttributeError):
        frames = read_json(out / SIDECAR)["frames"]
        for frame in frames:
            names += [frame["file"], *sum(frame["layers"].values(), [])]
    current = current_render(out)
    if current is not None:
        for index in range(current["frames"]):
            names += frame_files(index, current["layers"], current["formats"])
        names += current["replaces"]
    if names:
        names += [MOVIE, SIDECAR]
    paths = {(out / name).resolve() for name in names}
    return {path for path in paths if path.is_relative_to(out.resolve())}


def check_foreign_files(
    out: Path, planned: Sequence[str], layer_names: Sequence[str], preview: bool = False
) -> None:
    """Refuse a folder in which a render would overwrite files that no render made.

    Args:
        out: the folder; it need not exist.
        planned: files that will be written, relative to `out`.
        layer_names: names of all layers. A numbered file in one of their folders is refused too,
            because a reader could take it for a layer of the new render.
        preview: whether `preview.png` will be written.

    Raises:
        UserError: such a file exists.
    """
    ours = files_of_render(out)
    paths = [out / name for name in (*planned, MOVIE, SIDECAR)]
    paths += [out / PREVIEW] if preview and not is_simulated(out / PREVIEW) else []
    for name in layer_names:
        paths += [path for path in (out / name).glob("*") if path.stem.isdecimal()]
    for path in paths:
        if path.exists() and path.resolve() not in ours:
            raise UserError(
                f"{path} would be overwritten, and {out} does not list it as a file of a render;"
                " choose another folder with -o, or move it away"
            )


def is_simulated(path: Path) -> bool:
    """Return whether a file is a PNG that this program wrote, such as a killed render's preview."""
    return png_text(path, "simulated") is not None


def working_folder(out: Path, key: str) -> Path:
    """Return the folder that receives the frames of a render: `out`, or `next` inside its state.

    A finished render in `out` stays until the new one is complete, so new frames wait in `next`.

    Args:
        out: the folder of the movie.
        key: hash of the render.

    Raises:
        UserError: the folder holds another unfinished render.
    """
    current, waiting = current_render(out), current_render(out / NEXT)
    if current is not None and current["render"] == key:
        return out
    if waiting is not None and waiting["render"] != key:
        raise _unfinished(out, out / NEXT)
    if waiting is None and current is not None and not is_complete(out, current):
        raise _unfinished(out, out)
    return out / NEXT if files_of_render(out) else out


def _unfinished(out: Path, folder: Path) -> UserError:
    return UserError(
        f"{out} holds an unfinished render with other settings, of another state of the run, or of"
        " another version; finish it with the command that began it, choose another folder with"
        f" -o, or remove {folder}"
    )


def is_complete(out: Path, current: Mapping[str, Any]) -> bool:
    """Return whether the frames of a folder's render have all been joined."""
    try:
        sidecar = read_json(out / SIDECAR)
        return (
            sidecar["render"] == current["render"] and len(sidecar["frames"]) == current["frames"]
        )
    except (UserError, OSError, KeyError, TypeError):
        return False


def claim(out: Path, described: Mapping[str, Any]) -> None:
    """Record in a folder which render it holds from now on; call it with the lock held.

    Raises:
        UserError: the folder holds another unfinished render.
    """
    folder = working_folder(out, described["render"])
    if current_render(folder) is None:
        if folder != out:  # files that a process left after the render was complete
            shutil.rmtree(folder, ignore_errors=True)
        write_json(folder / STATE / "render.json", described)


def frame_record(out: Path, index: int, key: str) -> dict[str, Any] | None:
    """Return the record of a finished frame, or None if it is missing, damaged or another's.

    Args:
        out: the folder of the movie.
        index: number of the frame, from 0.
        key: hash of the frame; a frame with another hash does not count.
    """
    for folder in (out, out / NEXT):
        try:
            record = read_json(folder / STATE / f"{index:04d}.json")
            picture, *_ = files = record["files"]
            sizes = [(folder / name).stat().st_size for name in files]
            sound = record["key"] == key and sizes == list(files.values())
        except (UserError, OSError, KeyError, TypeError, ValueError, AttributeError):
            continue
        if sound and png_text(folder / picture, "key") == key:
            return record
    return None


@contextlib.contextmanager
def unfinished_files(out: Path) -> Iterator[Path]:
    """Yield a scratch folder inside `out` that is removed when the block ends."""
    scratch = make_folder(out / STATE / f"{SCRATCH}{owned_name()}")
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def commit_frame(
    out: Path, scratch: Path, index: int, keys: tuple[str, str], record: Mapping[str, Any]
) -> None:
    """Move a frame's files to their final names and write its record, unless it is finished.

    Args:
        out: the folder of the movie.
        scratch: holds the files under the names of `frame_files`.
        index: number of the frame, from 0.
        keys: hash of the render, hash of the frame.
        record: what the sidecar needs; `files` and `key` are added. `files` lists the picture
            first.

    Raises:
        UserError: a disk error, or another render has taken the folder.
    """
    files = {name: (scratch / name).stat().st_size for name in record["files"]}
    with locked(out):
        if frame_record(out, index, keys[1]) is not None:
            return
        folder = working_folder(out, keys[0])
        current = current_render(folder)
        if current is None or current["render"] != keys[0]:
            raise UserError(
                f"another render has replaced this one in {out} meanwhile; choose another folder"
                " with -o"
            )
        for name in files:
            move(scratch / name, folder / name)
        complete = {**record, "key": keys[1], "files": files}
        write_json(folder / STATE / f"{index:04d}.json", complete)


def promote(out: Path, key: str) -> None:
    """Move a complete render from `next` into `out`; call it with the lock held.

    Its `render.json` is written into `out` first. From then on any call finishes the promotion.
    The sidecar is removed before the first file and comes last, so that it never describes files of
    two renders. Ctrl-C takes effect when all is done, which takes less than a second.
    """
    try:
        _promote(out, key)
    except KeyboardInterrupt:
        _promote(out, key)
        raise


def _promote(out: Path, key: str) -> None:
    source = out / NEXT
    waiting = current_render(source)
    if waiting is not None and waiting["render"] == key:
        current = current_render(out)
        if current is None or current["render"] != key:
            root = out.resolve()
            old = sorted(path.relative_to(root).as_posix() for path in files_of_render(out))
            write_json(out / STATE / "render.json", {**waiting, "replaces": old})
        if (source / SIDECAR).exists():
            (out / SIDECAR).unlink(missing_ok=True)
        for name in _names_of(waiting):
            if (source / name).exists():
                move(source / name, out / name)
        shutil.rmtree(source, ignore_errors=True)
    current = current_render(out)
    if current is None or current["render"] != key or not current["replaces"]:
        return
    for name in set(current["replaces"]) - set(_names_of(current)):
        (out / name).unlink(missing_ok=True)
    for path in (out / STATE).glob("*.json"):
        if path.stem.isdecimal() and int(path.stem) >= current["frames"]:
            path.unlink(missing_ok=True)
    write_json(out / STATE / "render.json", {**current, "replaces": []})


def _names_of(current: Mapping[str, Any]) -> list[str]:
    """Return the files of a render, the sidecar last."""
    names = []
    for index in range(current["frames"]):
        names += frame_files(index, current["layers"], current["formats"])
        names.append(f"{STATE}/{index:04d}.json")
    return [*names, MOVIE, SIDECAR]


def continue_promotion(out: Path) -> None:
    """Finish moving a complete render into `out`, if a process was killed while it did so."""

    def begun() -> str | None:
        current, waiting = current_render(out), current_render(out / NEXT)
        if current is None:
            return None
        moving = waiting is not None and waiting["render"] == current["render"]
        return current["render"] if moving or current["replaces"] else None

    if begun():
        with locked(out):
            key = begun()
            if key:
                promote(out, key)


def clear_abandoned(out: Path, layer_names: Sequence[str]) -> None:
    """Remove scratch folders and temporary files of dead processes; call it with the lock held."""
    remove_abandoned(out, (STATE, "frames", *layer_names))
    for path in (out / STATE).glob(f"{SCRATCH}*"):
        if is_abandoned(path):
            remove(path)


def move(source: Path, target: Path) -> None:
    """Rename a file over another atomically, creating the folder of the target.

    Raises:
        UserError: the disk is full, or the target cannot be written.
    """
    make_folder(target.parent)
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise explain(error, target) from error
        with atomic_path(target) as temporary:  # the user has linked the folder to another disk
            shutil.copyfile(source, temporary)
        source.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(out: Path, *, wait: float | None = None) -> Iterator[None]:
    """Hold the folder's lock; the system frees it when a process dies.

    A file system without locks gets none: every file is still replaced atomically, and the frames
    of one render are the same whichever process writes them.

    Args:
        out: the folder of the movie.
        wait: how long to wait for another process, s; None: until it ends.

    Raises:
        UserError: the lock cannot be written, or another process still holds it.
    """
    with locked_file(make_folder(out / STATE) / "lock", wait=wait, busy=in_use(out)):
        yield


def png_text(path: Path, name: str) -> str | None:
    """Return a text chunk of a PNG; None where there is no such file or chunk."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.info.get(name)
    # Pillow refuses to open a picture that is suspiciously large.
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
