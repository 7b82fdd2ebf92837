"""A scene folder that capture writes and the user adds to: whose file is whose.

A record in the folder lists what capture wrote there, with a digest of each file. What is not in
it, or was changed since, is the user's and is never removed.
"""

import contextlib
import hashlib
import os
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, make_folder, read_json, write_json
from climatenerf.scene import load_scene
from climatenerf.scene.scene import FILE_NAME

WORK = "work"  # folder in the scene: may be deleted when all is well
RECORD = ".made-by-capture.json"  # beside `scene.json`, so that it outlives the work folder
OLD_RECORD = "made-by-capture.json"  # in the work folder; it lists no files
SIDECAR_KINDS = ("labels", "masks", "depth")  # folders that the user may fill too
ENTRIES = (
    "images", "sparse", *SIDECAR_KINDS, FILE_NAME, "points.ply", "points_seen.npz", "report.md",
    "report.png", "mark.html",
)  # fmt: skip
IGNORED_NAMES = {".DS_Store", "Thumbs.db", "desktop.ini"}  # left where folders are looked at

# Path in the scene folder -> digests that a file of capture's may have there: one, or two while a
# new scene takes the place of an old one.
Record = dict[str, tuple[str, ...]]


def is_scene(folder: Path) -> bool:
    """Whether a folder is a scene, or one that capture has begun."""
    return any((folder / name).is_file() for name in (FILE_NAME, RECORD, f"{WORK}/{OLD_RECORD}"))


def walk_once(top: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """`os.walk` through linked folders too, each real folder once; links come last.

    As with `os.walk`, the list of folders may be changed to keep out of some.
    """
    seen = set()
    for place, folders, names in os.walk(top, followlinks=True):
        here = Path(place)
        if here.resolve() in seen:
            folders.clear()
            continue
        seen.add(here.resolve())
        folders.sort(key=lambda name, here=here: ((here / name).is_symlink(), name))
        yield here, folders, names


def check_output(out: Path, given: Collection[str]) -> list[str]:
    """The user's own files that a new scene leaves where they are, as paths in the folder.

    Args:
        out: the scene folder; it may be absent.
        given: the kinds that are to be written anew.

    Raises:
        UserError: something that is not capture's would be lost.
    """
    record = read_record(out)
    if record is None or (out / WORK).is_symlink():
        for name in (*ENTRIES, WORK):
            if os.path.lexists(out / name):
                raise UserError(
                    f"{out} already holds {name}, which no earlier capture made; choose another"
                    " folder with -o"
                )
        return []
    kept = []
    for path in _files(out):
        key = _key(path, out)
        if path.name in IGNORED_NAMES or _digest(path) in record.get(key, ()):
            continue
        kind = key.split("/")[0]
        if kind in given:
            raise UserError(
                f"{path} is yours, and --{kind} would write {out / kind} anew; move it into the"
                f" folder that --{kind} names, or leave --{kind} out"
            )
        if key == kind or kind not in SIDECAR_KINDS:  # a file where a folder should be, too
            how = "was changed since capture wrote it" if key in record else "is not capture's"
            raise UserError(
                f"{path} {how} and would be lost; move it away, or choose another folder with -o"
            )
        kept.append(key)
    return kept


def start_scene(out: Path) -> Path:
    """The folder in which a scene is made before it takes its place, empty."""
    record = read_record(out) or {}
    write_record(out, record)  # first: what is there without it would bar the next run
    new = make_folder(out / WORK) / "new"
    shutil.rmtree(new, ignore_errors=True)
    return make_folder(new)


def discard_scene(out: Path, fresh: bool) -> None:
    """Clears away a scene that did not come to be; all of the folder if it holds nothing of use.

    Args:
        out: the scene folder.
        fresh: whether it was absent before.
    """
    shutil.rmtree(out / WORK / "new", ignore_errors=True)
    if fresh and not any(p.name != RECORD for p in out.rglob("*") if not p.is_dir()):
        shutil.rmtree(out, ignore_errors=True)


def install_scene(out: Path, new: Path, given: Collection[str]) -> list[str]:
    """Moves a finished scene to its place; what an earlier capture made goes, the user's stays.

    Args:
        out: the scene folder.
        new: the finished scene, on the same disk.
        given: the kinds that are written anew.

    Returns:
        The user's files that stay.

    Raises:
        UserError: the user has put something in the way meanwhile, or a file cannot be moved.
    """
    kept = check_output(out, given)
    told = read_json(new / FILE_NAME)
    write_json(new / FILE_NAME, {**told, "root_absolute": str(out.absolute())})
    before = read_record(out) or {}
    record = {_key(path, new): (_digest(path),) for path in _files(new)}
    both = {key: before.get(key, ()) + record.get(key, ()) for key in {**before, **record}}
    write_record(out, both)  # stopped from here on, either file is known for capture's
    try:
        for name in ENTRIES:
            if any(key.startswith(f"{name}/") for key in kept):
                _remove_except(out / name, out, kept)
                continue
            _remove(out / name)
            if (new / name).exists():
                os.replace(new / name, out / name)
        shutil.rmtree(new, ignore_errors=True)
    except OSError as error:
        raise explain(error, out) from error
    with contextlib.suppress(UserError):  # the larger record serves as well
        write_record(out, record)
    return kept


def _remove(place: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)


def _remove_except(place: Path, out: Path, kept: Collection[str]) -> None:
    """Removes what is not kept from a folder; what lies behind a link is not of this folder."""
    for here, folders, names in os.walk(place):
        if Path(here).is_symlink():
            return
        folders[:] = [name for name in folders if not (Path(here) / name).is_symlink()]
        for path in (Path(here) / name for name in names):
            if _key(path, out) not in kept:
                path.unlink()


def read_record(out: Path) -> Record | None:
    """What capture wrote into a folder; None if it never did.

    A record of the former kind has no list: what its scene names and is not younger than the scene
    counts as written by capture.
    """
    if (out / RECORD).is_file():
        with contextlib.suppress(UserError, KeyError, AttributeError, TypeError):
            files = read_json(out / RECORD)["files"]
            return {str(path): tuple(map(str, digests)) for path, digests in files.items()}
        return {}  # damaged: nothing is sure to be capture's
    if (out / WORK / OLD_RECORD).is_file():
        return {_key(path, out): (_digest(path),) for path in _old_record_files(out)}
    return None


def write_record(out: Path, record: Record) -> None:
    """Writes down which files capture wrote.

    Raises:
        UserError: it cannot be written.
    """
    write_json(out / RECORD, {"files": record})


def _old_record_files(out: Path) -> list[Path]:
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
    """All files in the places of a scene, those behind links too."""
    for name in ENTRIES:
        place = folder / name
        if place.is_dir():
            for here, _, names in walk_once(place):
                yield from (here / one for one in sorted(names))
        elif os.path.lexists(place):
            yield place


def _key(path: Path, folder: Path) -> str:
    """A path in a folder as text that JSON can hold, whatever bytes its name is made of."""
    relative = path.relative_to(folder if path.is_relative_to(folder) else folder.absolute())
    return relative.as_posix().encode("utf-8", "backslashreplace").decode()


def _digest(path: Path) -> str:
    """SHA-256 of a file; "" of what cannot be read, which is no file of capture's."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
