"""Ownership of files in a scene folder that capture writes and the user may add to.

A record in the folder lists the files that capture wrote, each with a digest. Files that are not in
the record, or have changed since, belong to the user and are never removed.
"""

import contextlib
import hashlib
import os
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.listing import is_system_file
from climatenerf.core.locks import LOCK, only_writer
from climatenerf.core.storage import explain, make_folder, read_json, write_json
from climatenerf.scene import load_scene
from climatenerf.scene.scene import FILE_NAME

WORK = "work"  # subfolder for intermediate results; may be deleted after a complete capture
RECORD = ".made-by-capture.json"  # beside `scene.json`, so that it survives deletion of `work`
OLD_RECORD = "made-by-capture.json"  # record of earlier versions in `work`, without a list of files
SIDECAR_KINDS = ("labels", "masks", "depth")  # subfolders to which the user may add files
ENTRIES = (
    "images", "sparse", *SIDECAR_KINDS, FILE_NAME, "points.ply", "points_seen.npz", "report.md",
    "report.png", "mark.html",
)  # fmt: skip

# Path in the scene folder -> valid digests of capture's file: one, or two while a new scene
# replaces an old one.
Record = dict[str, tuple[str, ...]]


def is_scene(folder: Path) -> bool:
    """Return True for a scene folder, complete or started by capture."""
    return any((folder / name).is_file() for name in (FILE_NAME, RECORD, f"{WORK}/{OLD_RECORD}"))


def walk_once(top: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Iterate like `os.walk`, but follow links and visit each real folder once; links come last.

    As with `os.walk`, the caller may edit the list of folders to skip some.
    """
    visited = set()
    for root, folders, names in os.walk(top, followlinks=True):
        here = Path(root)
        if here.resolve() in visited:
            folders.clear()
            continue
        visited.add(here.resolve())
        folders.sort(key=lambda name, here=here: ((here / name).is_symlink(), name))
        yield here, folders, names


def check_output(out: Path, given: Collection[str]) -> list[str]:
    """Return the user's files that a new scene keeps, as paths relative to the folder.

    Args:
        out: the scene folder; it may be missing.
        given: the kinds of sidecars that capture will write.

    Raises:
        UserError: a file of the user would be lost.
    """
    record = read_record(out)
    if record is None or (out / WORK).is_symlink():
        for name in (*ENTRIES, WORK):
            if os.path.lexists(out / name):
                raise UserError(
                    f"{out} already contains {name}, which capture did not write; choose another"
                    " folder with -o"
                )
        return []
    user_files = []
    for path in _files(out):
        key = _key(path, out)
        if is_system_file(path.name) or _digest(path) in record.get(key, ()):
            continue
        kind = key.split("/")[0]
        if kind in given:
            raise UserError(
                f"{path} is your file, and --{kind} replaces all of {out / kind}; move it into the"
                f" folder that --{kind} names, or omit --{kind}"
            )
        if key == kind or kind not in SIDECAR_KINDS:  # also a file in place of a folder
            if not os.access(path, os.R_OK) and path.exists():
                raise UserError(
                    f"{path} may not be read, so it is not certain to be capture's; change its"
                    " permissions, or choose another folder with -o"
                )
            reason = (
                "has changed since capture wrote it"
                if key in record
                else "was not written by capture"
            )
            raise UserError(
                f"{path} {reason} and would be lost; move it away, or choose another folder with -o"
            )
        user_files.append(key)
    return user_files


@contextlib.contextmanager
def writing_scene(out: Path) -> Iterator[None]:
    """Hold the lock of a scene folder, which no other capture may then write.

    Raises:
        UserError: another capture holds it, or the folder cannot be written.
    """
    with only_writer(out, (*ENTRIES, WORK)):
        yield


def start_scene(out: Path) -> Path:
    """Create and return an empty folder in which a scene is built before it is installed."""
    record = read_record(out) or {}
    write_record(out, record)  # first: without it the next run would refuse the other files
    new = make_folder(out / WORK) / "new"
    shutil.rmtree(new, ignore_errors=True)
    return make_folder(new)


def discard_scene(out: Path, fresh: bool) -> None:
    """Delete an unfinished scene; also the whole folder if it contains nothing else.

    Args:
        out: the scene folder.
        fresh: True if the folder did not exist before.
    """
    shutil.rmtree(out / WORK / "new", ignore_errors=True)
    files = (path.name for path in out.rglob("*") if not path.is_dir())
    if fresh and not any(name not in (RECORD, LOCK) for name in files):
        shutil.rmtree(out, ignore_errors=True)


def install_scene(out: Path, new: Path, given: Collection[str]) -> list[str]:
    """Move a finished scene into its folder; replace capture's old files and keep the user's.

    Args:
        out: the scene folder.
        new: the finished scene, on the same disk.
        given: the kinds of sidecars that capture writes.

    Returns:
        The user's files that are kept, as paths relative to the folder.

    Raises:
        UserError: the user has added a file that would be lost, or a file cannot be moved.
    """
    user_files = check_output(out, given)
    description = read_json(new / FILE_NAME)
    write_json(new / FILE_NAME, {**description, "root_absolute": str(out.absolute())})
    before = read_record(out) or {}
    record = {_key(path, new): (_digest(path),) for path in _files(new)}
    both = {key: before.get(key, ()) + record.get(key, ()) for key in {**before, **record}}
    write_record(out, both)  # if interrupted from here on, old and new files are both valid
    try:
        for name in ENTRIES:
            if any(key.startswith(f"{name}/") for key in user_files):
                _remove_except(out / name, out, user_files)
                continue
            _remove(out / name)
            if (new / name).exists():
                os.replace(new / name, out / name)
        shutil.rmtree(new, ignore_errors=True)
    except OSError as error:
        raise explain(error, out) from error
    with contextlib.suppress(UserError):  # the record of both is valid, too
        write_record(out, record)
    return user_files


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _remove_except(folder: Path, out: Path, user_files: Collection[str]) -> None:
    """Remove all files of a folder but the user's; do not follow links."""
    for here, folders, names in os.walk(folder):
        if Path(here).is_symlink():
            return
        folders[:] = [name for name in folders if not (Path(here) / name).is_symlink()]
        for path in (Path(here) / name for name in names):
            if _key(path, out) not in user_files:
                path.unlink()


def read_record(out: Path) -> Record | None:
    """Return the record of a folder; None if capture never wrote to it.

    The record of earlier versions has no list of files. For these, the files that the scene names
    and that are not newer than the scene count as written by capture.
    """
    if (out / RECORD).is_file():
        with contextlib.suppress(UserError, KeyError, AttributeError, TypeError):
            files = read_json(out / RECORD)["files"]
            return {str(path): tuple(map(str, digests)) for path, digests in files.items()}
        return {}  # damaged: no file is certain to be capture's
    if (out / WORK / OLD_RECORD).is_file():
        return {_key(path, out): (_digest(path),) for path in _old_record_files(out)}
    return None


def write_record(out: Path, record: Record) -> None:
    """Write the record of the files that capture wrote.

    Raises:
        UserError: the record cannot be written.
    """
    write_json(out / RECORD, {"files": record})


def _old_record_files(out: Path) -> list[Path]:
    """Return the files that count as written by an earlier version of capture."""
    try:
        scene, when = load_scene(out), (out / FILE_NAME).stat().st_mtime_ns
    except (UserError, OSError):
        return []
    named = {
        path
        for view in scene.views
        for path in (view.path, view.label_path, view.mask_path, view.depth_path)
        if path is not None
    }
    root = out.absolute()
    return [
        path
        for path in _files(root)
        if path.is_file()
        and path.stat().st_mtime_ns <= when
        and (path in named or path.parent == root or (root / "sparse") in path.parents)
    ]


def _files(folder: Path) -> Iterator[Path]:
    """Yield all files of the scene's entries in a folder, through links too."""
    for name in ENTRIES:
        entry = folder / name
        if entry.is_dir():
            for here, _, names in walk_once(entry):
                yield from (here / file_name for file_name in sorted(names))
        elif os.path.lexists(entry):
            yield entry


def _key(path: Path, folder: Path) -> str:
    """Return a path relative to a folder as text for JSON; other bytes than UTF-8 are escaped."""
    relative = path.relative_to(folder if path.is_relative_to(folder) else folder.absolute())
    return relative.as_posix().encode("utf-8", "backslashreplace").decode()


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; "" if it cannot be read (then it is not capture's)."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
