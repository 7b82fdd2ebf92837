"""What a method is given: clean frames with geometry, and our frames of one effect.

All is read from rendered folders, frame by frame, so a long movie needs little memory.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core import arrays
from climatenerf.core.errors import UserError
from climatenerf.evaluation.baselines import CleanView, linear_of
from climatenerf.evaluation.reference import world_rays
from climatenerf.output.job import RenderJob
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare.pictures import Picture

Kind = Literal["ours", "stand-in", "model", "folder"]
MASKS = {"smog": "mask_smog", "flood": "mask_water", "snow": "mask_snow"}
"""Layer that says how much of a pixel shows the effect."""
TRUTH = "truth"
"""Folder of the test views of a reference set; the movie itself lies in the top folder."""


@dataclass(frozen=True)
class Rendered:
    """A rendered job and its folder."""

    job: RenderJob
    folder: Path

    def picture(self, index: int) -> Picture:
        """Read the picture of a frame."""
        return read_rgb(self.folder / self.job.files(index)[0])

    def layer(self, name: str, index: int) -> Float[np.ndarray, "h w *c"]:
        """Read a layer of a frame.

        Raises:
            UserError: the file is missing or damaged.
        """
        path = self.folder / name / f"{index:04d}.npz"
        try:
            return arrays.read_npz(path)[name]
        except arrays.ERRORS as error:
            raise UserError(
                f"{path} is missing or damaged; remove the folder {self.folder} and run it again"
            ) from error


@dataclass(frozen=True)
class Material:
    """What a method edits, and what is known about it.

    Attributes:
        effect: one of `settings.EFFECTS`.
        reel: "" for the movie, `TRUTH` for the test views of a reference set.
        clean: the frames without weather, with the layers depth and normal, and label if known.
        ours: our frames, with depth and the mask of the effect.
        ground_z: ground datum, world m.
        seed: random seed of all methods.
        true: true pictures of the frames, or none.
    """

    effect: str
    reel: str
    clean: Rendered
    ours: Rendered
    ground_z: float
    seed: int
    true: tuple[Picture, ...] = ()

    def __len__(self) -> int:
        return len(self.clean.job)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        return self.clean.job.path.size

    @property
    def has_labels(self) -> bool:
        """Whether the classes of the pixels are known."""
        return "label" in self.clean.job.layers

    def view(self, index: int) -> CleanView:
        """Return the clean frame as the stand-ins take it; its radiance has 8 bits."""
        path = self.clean.job.path
        camera, c2w = path.cameras[index], path.c2w[index]
        return CleanView(
            linear_of(self.clean.picture(index)),
            self.clean.layer("depth", index).astype(np.float64),
            self.clean.layer("normal", index).astype(np.float64),
            world_rays(camera, c2w),
            c2w,
            camera,
        )

    def label(self, index: int) -> UInt8[np.ndarray, "h w"]:
        """Return the merged class of each pixel of the dry scene."""
        return self.clean.layer("label", index).astype(np.uint8)

    def mask(self, index: int) -> Float[np.ndarray, "h w"]:
        """Return the fraction of each pixel that shows the effect."""
        return self.ours.layer(MASKS[self.effect], index)

    def target(self, index: int) -> Picture:
        """Return the picture whose colours stand-ins may use: the truth if known, else ours."""
        return self.true[index] if self.true else self.ours.picture(index)


class Method(Protocol):
    """A way to put weather into clean frames."""

    @property
    def name(self) -> str:
        """Name of its folder and in all tables."""
        ...

    @property
    def kind(self) -> Kind:
        """What it is: one of our stand-ins, a model of the user, or a folder of frames."""
        ...

    @property
    def licence(self) -> str:
        """Licence of what it uses, in one line."""
        ...

    def shows(self, material: Material) -> bool:
        """Return whether it can show the effect in these frames."""
        ...

    def identity(self, material: Material) -> object:
        """Return all that its pictures depend on besides the material, as plain values."""
        ...

    def pictures(self, material: Material, indices: Sequence[int], work: Path) -> Iterator[Picture]:
        """Return the edited frames of some indices, in their order.

        What is done once, such as loading weights, is done before the iterator is returned, so
        that it does not count in the seconds of a frame.

        Args:
            material: what to edit.
            indices: the frames.
            work: folder of the method, for the log of another program.

        Raises:
            UserError: weights, a program or frames are missing or cannot be used.
        """
        ...
