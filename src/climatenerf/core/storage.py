"""Files written so that a failure never harms what was there before, and read with clear errors.

Everything is written to a temporary name in the same folder and then renamed over the old file:
a reader sees the old file or the new one, never half of one. A temporary name holds the host and
the process that uses it, so that `remove_abandoned` can tell what a dead process has left.
"""

import contextlib
import dataclasses
import errno
import hashlib
import itertools
import json
import math
import os
import re
import secrets
import shutil
import socket
import sys
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError, excerpt, explain, one_line
from climatenerf.core.parsing import read_json
from climatenerf.core.regular_files import check_regular

__all__ = [
    "atomic_path",
    "check_finite",
    "check_schema",
    "digest",
    "explain",
    "is_abandoned",
    "is_temporary",
    "make_folder",
    "owned_name",
    "plain",
    "read_json",
    "read_safetensors",
    "remove",
    "remove_abandoned",
    "write_bytes",
    "write_json",
    "write_safetensors",
]

ABANDONED_AFTER = 86400.0
"""Seconds after which a temporary file counts as abandoned where its process cannot be asked."""
_HOST = f"{zlib.crc32(socket.gethostname().encode()):08x}"
_PROCESS = secrets.token_hex(3)  # tells this process from a dead one of the same number
_OWNED = re.compile(r"([0-9a-f]{8})-(\d+)-([0-9a-f]{6})-[0-9a-f]{8}")
_TEMPORARY = re.compile(rf"\.({_OWNED.pattern}|[0-9a-f]{{12}})\.tmp(\..*)?")


def make_folder(path: Path | str) -> Path:
    """Creates a folder and its parents if they are absent, and returns its path.

    Raises:
        UserError: a file is in the way, or permission or space is lacking.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise explain(error, folder) from error
    return folder


@contextlib.contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path beside ``path``; it becomes ``path`` when the block succeeds.

    The temporary name keeps the suffix, because many writers choose their format by it. When the
    block fails (also by Ctrl-C) the temporary file is removed and an old ``path`` stays as it was.

    Raises:
        UserError: the disk is full, or the place cannot be written.
    """
    # Through a symbolic link the file it points at is replaced, not the link.
    final = Path(os.path.realpath(path))
    make_folder(final.parent)
    temporary = final.with_name(f".{owned_name()}.tmp{final.suffix}")
    try:
        yield temporary
        # Before the rename: network disks report a full disk only here, and after a power cut an
        # unflushed file may be empty under its final name.
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, final)
    except OSError as error:
        raise explain(error, final) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def owned_name() -> str:
    """Return a new name for something temporary; it states the host and the process."""
    return f"{_HOST}-{os.getpid()}-{_PROCESS}-{secrets.token_hex(4)}"


def is_temporary(name: str) -> bool:
    """Return whether a file has a name of `atomic_path`, of this version or an earlier one."""
    return _TEMPORARY.fullmatch(name) is not None


def is_abandoned(path: Path) -> bool:
    """Return whether the process that made something temporary has ended.

    A process on another host cannot be asked, and names of earlier versions state none. Such a file
    counts as abandoned after a day.
    """
    owner = _OWNED.search(path.name)
    if owner is not None and owner[1] == _HOST and sys.platform != "win32":
        number = int(owner[2])
        if number == os.getpid():
            return owner[3] != _PROCESS
        try:
            os.kill(number, 0)  # sends nothing
        except (ProcessLookupError, OverflowError):
            return True
        except OSError:  # it runs under another user
            return False
        return False
    try:
        return time.time() - path.stat().st_mtime > ABANDONED_AFTER
    except OSError:
        return False


def remove_abandoned(folder: Path, within: Iterable[str] = ()) -> None:
    """Remove temporary files that dead processes left in a folder; call it as its only writer.

    Args:
        folder: the folder; its subfolders are not searched.
        within: names of subfolders that are searched with all that they hold. Links are skipped.
    """
    walks = [itertools.islice(os.walk(folder), 1)]  # the folder alone
    walks += [os.walk(folder / name) for name in within if not (folder / name).is_symlink()]
    for here, _, names in itertools.chain.from_iterable(walks):
        for path in (Path(here) / name for name in names if is_temporary(name)):
            if is_abandoned(path):
                remove(path)


def remove(path: Path) -> None:
    """Remove a file or a folder as far as that is possible; a link is removed, not its target."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def write_bytes(path: Path | str, data: bytes) -> None:
    """Writes ``data`` to ``path`` atomically.

    Raises:
        UserError: the disk is full, or the place cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path | str, value: Any) -> None:
    """Writes ``value`` as indented JSON, atomically.

    Dataclasses, paths, numpy scalars and arrays (torch tensors too) are converted. Numbers that
    are not finite become ``null``, since JSON has none.

    Raises:
        UserError: the disk is full, or the place cannot be written.
    """
    value = plain(value)
    try:
        text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False).encode()
    except UnicodeEncodeError:  # a file name that is not UTF-8, which JSON holds as an escape
        text = json.dumps(value, indent=1, allow_nan=False).encode()
    write_bytes(path, text + b"\n")


def plain(value: Any) -> Any:
    """``value`` as the dicts, lists, numbers and strings that JSON knows."""
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    to_list = getattr(value, "tolist", None)  # numpy scalars and arrays, torch tensors
    if to_list is not None:
        return plain(to_list())
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def write_safetensors(
    path: Path | str, tensors: Mapping[str, Any], metadata: Mapping[str, str] | None = None
) -> None:
    """Writes named torch tensors, or named numpy arrays, as one safetensors file, atomically.

    Raises:
        UserError: the disk is full, or the place cannot be written.
    """
    from safetensors import SafetensorError

    ready: dict[str, Any]
    if any(hasattr(tensor, "detach") for tensor in tensors.values()):
        from safetensors import torch as library

        ready = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    else:
        import numpy as np
        from safetensors import numpy as library

        ready = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    with atomic_path(path) as temporary:
        # Created here first: that reports a forbidden folder by errno, and shows the permissions
        # that an ordinary new file has (the library makes its own readable by the owner alone).
        temporary.touch()
        mode = temporary.stat().st_mode
        try:
            library.save_file(ready, temporary, dict(metadata or {}))
            temporary.chmod(mode)
        except SafetensorError as error:
            if f"os error {errno.ENOSPC}" in str(error):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
            raise UserError(f"could not write {path}: {error}; check the disk") from error


def read_safetensors(path: Path | str, what: str = "file") -> tuple[dict[str, Any], dict[str, str]]:
    """Reads a safetensors file as numpy arrays by name, with its metadata.

    Raises:
        UserError: absent, unreadable, or damaged.
    """
    from safetensors import SafetensorError, safe_open

    check_regular(path, what)
    if not Path(path).is_file():
        raise UserError(f"{what}: {path} does not exist; check the path")
    try:
        with open(path, "rb"):  # the library does not tell a forbidden file from a damaged one
            pass
        # The library maps the file, and compares sizes in its header with the file's.
        with safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except OSError as error:
        raise explain(error, Path(path)) from error
    except (SafetensorError, ValueError, TypeError, KeyError) as error:
        reason = one_line(str(error), 100)
        raise UserError(f"{what}: {path} is damaged ({reason}); restore or recreate it") from error


def hash_of_files(paths: Iterable[Path]) -> str:
    """Return the hash of the contents of files.

    Raises:
        UserError: one cannot be read.
    """
    found = hashlib.sha256()
    for path in paths:
        try:
            with path.open("rb") as file:
                found.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise explain(error, path) from error
    return found.hexdigest()


def digest(tensors: Mapping[str, Any]) -> int:
    """Return a checksum (CRC-32) of named torch tensors or numpy arrays: names, types, values."""
    import numpy as np

    value = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        array = tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else tensor
        head = f"{name} {array.dtype.str} {array.shape};"
        value = zlib.crc32(head.encode("utf-8", "backslashreplace"), value)
        flat = np.ascontiguousarray(array).reshape(-1)
        if flat.size:
            value = zlib.crc32(memoryview(flat.view(np.uint8)), value)  # type: ignore[arg-type]
    return value


def check_finite(arrays: Mapping[str, Any], limit: float = math.inf) -> None:
    """Check that arrays hold finite numbers up to a limit.

    Raises:
        ValueError: one does not.
    """
    import numpy as np

    for name, array in arrays.items():
        if array.size and np.issubdtype(array.dtype, np.floating):
            low, high = float(array.min()), float(array.max())  # NaN if one number is
            if not (-limit <= low and high <= limit) or math.isinf(low) or math.isinf(high):
                raise ValueError(f"{name} holds a number that is not finite or far too large")


def check_schema(found: object, supported: int, what: str) -> None:
    """Refuses a file whose schema version is newer than this program's.

    Args:
        found: the version read from the file.
        supported: the newest version this program reads.
        what: what was read, with its path ("run /data/run1").

    Raises:
        UserError: ``found`` is newer, or is no version number.
    """
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        raise UserError(
            f"{what} has no schema version ({excerpt(found)}); it is damaged, recreate it"
        )
    if found > supported:
        raise UserError(
            f"{what} has schema version {found}, and this climatenerf reads up to {supported};"
            " it was written by a newer climatenerf, upgrade this one to use it"
        )
