"""Frames that another program made from our clean ones, such as Swapping Autoencoder or ARF.

The clean frames lie in `OUT/clean/frames/`. The other program writes `PATH/EFFECT/NNNN.png` (or
`.jpg`) with the same numbers.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.storage import hash_of_files
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare.material import Kind, Material
from climatenerf.studies.compare.pictures import Picture, resized
from climatenerf.studies.compare.settings import EFFECTS

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
MAX_ASPECT_ERROR = 0.02  # relative; another program may round the sides
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9+._-]{0,39}")


@dataclass(frozen=True)
class FrameFolder:
    """Frames of another program; see `material.Method`."""

    name: str
    path: Path
    kind: Kind = "folder"
    licence: str = "as stated by the program that made the frames"

    def shows(self, material: Material) -> bool:
        """Return whether the folder has frames of the effect."""
        return self._place(material).is_dir()

    def identity(self, material: Material) -> object:
        """Return the hash of the frames."""
        return hash_of_files(self._files(material))

    def pictures(self, material: Material, indices: Sequence[int], work: Path) -> Iterator[Picture]:
        """Yield the frames in our size; see `material.Method`."""
        files = self._files(material)
        for index in indices:
            picture = read_rgb(files[index])
            height, width = picture.shape[:2]
            aspect = width / height / (material.size[0] / material.size[1])
            if abs(aspect - 1) > MAX_ASPECT_ERROR:
                raise UserError(
                    f"{files[index]} has {width}x{height} pixels, another shape than our frames of"
                    f" {material.size[0]}x{material.size[1]}; edit the frames of clean/frames"
                    " without cutting them"
                )
            yield resized(picture, material.size)

    def _place(self, material: Material) -> Path:
        return self.path / material.reel / material.effect

    def _files(self, material: Material) -> list[Path]:
        """Return the frames in order.

        Raises:
            UserError: one is missing.
        """
        found = []
        for index in range(len(material)):
            paths = [self._place(material) / f"{index:04d}{suffix}" for suffix in SUFFIXES]
            existing = [path for path in paths if path.is_file()]
            if not existing:
                raise UserError(
                    f"{paths[0]} is missing: {self.name} needs {len(material)} frames, numbered as"
                    " those of clean/frames; make it, or remove its folder"
                )
            found.append(existing[0])
        return found


def frame_folders(given: Sequence[str]) -> tuple[FrameFolder, ...]:
    """Return the folders of flags such as `arf=frames/arf`.

    Raises:
        UserError: a flag has another form, or its folder has frames of no effect.
    """
    return tuple(_frame_folder(text) for text in given)


def _frame_folder(text: str) -> FrameFolder:
    name, equals, path = text.partition("=")
    if not equals or not path:
        raise UserError(f"--folder must be NAME=PATH, such as arf=frames/arf; got {excerpt(text)}")
    check_name(name)
    folder = Path(path).expanduser().resolve()
    if not any((folder / effect).is_dir() for effect in EFFECTS):
        raise UserError(
            f"{path} has no folder {', '.join(EFFECTS[:-1])} or {EFFECTS[-1]}; put the frames of"
            f" {name} there, such as {Path(path) / 'flood' / '0000.png'}"
        )
    return FrameFolder(name, folder)


def check_name(name: str) -> str:
    """Return the name of a method, which is the name of its folder, too.

    Raises:
        UserError: it has other characters than letters, digits and +._-.
    """
    if not _NAME.fullmatch(name):
        raise UserError(
            f"a method cannot be named {excerpt(name)}; use up to 40 letters, digits or any of +._-"
        )
    return name
