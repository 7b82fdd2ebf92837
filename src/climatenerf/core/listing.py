"""Names in folders that are never input: hidden ones, and those that systems add. No torch."""

from collections.abc import Iterable, Iterator
from pathlib import Path

SYSTEM_NAMES = frozenset(
    {
        ".ds_store", "__macosx",  # macOS, and ZIP archives made by it
        "thumbs.db", "ehthumbs.db", "desktop.ini", "$recycle.bin", "system volume information",
        "@eadir", "lost+found",  # thumbnails of a NAS; ext4
    }
)  # fmt: skip
"""Names in lower case."""


def is_system_file(name: str) -> bool:
    """Return True for a file or folder that a system made, such as AppleDouble `._a.jpg`."""
    return name.startswith("._") or name.lower() in SYSTEM_NAMES


def is_passed_over(name: str) -> bool:
    """Return True for the name of a file or folder that is no input: hidden, or of a system."""
    return name.startswith(".") or is_system_file(name)


def visible(paths: Iterable[Path], top: Path | None = None) -> Iterator[Path]:
    """Yield the paths of a listing that may be input; see `is_passed_over`.

    Args:
        paths: files or folders.
        top: the listed folder. If given, the folders between it and a path are checked, too.
    """
    for path in paths:
        names = (path.name,) if top is None else path.relative_to(top).parts
        if not any(map(is_passed_over, names)):
            yield path
