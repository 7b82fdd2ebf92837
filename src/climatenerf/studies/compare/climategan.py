"""ClimateGAN (GPL-3.0) in a checkout of the user, as a process of its own; it is never imported.

`climategan` runs its `apply_events.py`, which finds where to paint by itself. `climategan++` paints
our water mask, as in ClimateNeRF's paper: `assets/compare/climategan_paint.py` runs in ClimateGAN's
process and calls its painter. Neither was run with the real weights here.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.core.storage import hash_of_files
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare.material import Kind, Material
from climatenerf.studies.compare.pictures import Picture, grey, pasted, resized, working_size
from climatenerf.studies.compare.program import check_checkout, python_of, run_program
from climatenerf.studies.compare.settings import ClimateGanSettings

SIDE, MULTIPLE = 640, 128  # of its pictures, pixels
LICENCE = "GPL-3.0 code in its own process; weights as stated where you got them"
WEIGHTS = "checkpoints/latest_ckpt.pth"


@dataclass(frozen=True)
class ClimateGan:
    """ClimateGAN with its own masks, or with ours; see `material.Method`.

    Attributes:
        checkout: folder of its repository.
        weights: folder with `opts.yaml` and `checkpoints/`.
        python: of its environment.
        our_mask: paint our water mask (`climategan++`).
    """

    checkout: Path
    weights: Path
    python: Path
    our_mask: bool
    kind: Kind = "model"
    licence: str = LICENCE

    @property
    def name(self) -> str:
        """Name in all tables."""
        return "climategan++" if self.our_mask else "climategan"

    def shows(self, material: Material) -> bool:
        """Return whether it paints the effect: it has a flood and a smog, and no snow."""
        return material.effect == "flood" or (material.effect == "smog" and not self.our_mask)

    def identity(self, material: Material) -> object:
        """Return the hash of the weights."""
        return hash_of_files([self.weights / "opts.yaml", self.weights / WEIGHTS])

    def pictures(self, material: Material, indices: Sequence[int], work: Path) -> Iterator[Picture]:
        """Yield the edited frames; see `material.Method`."""
        size = working_size(material.size, SIDE, MULTIPLE)
        run = self._paint if self.our_mask else self._apply
        with _exchange(material, indices, size) as folder:
            run(material, folder, work / "log.txt")
            for index in indices:
                painted = resized(_result(folder, index, self.name, work), material.size)
                if self.our_mask:
                    clean = material.clean.picture(index)
                    painted = pasted(clean, painted, material.mask(index))
                yield painted

    def _apply(self, material: Material, folder: Path, log: Path) -> None:
        # --keep_ratio_128: without it the sides of wide pictures are cut off.
        command = [self.python, "apply_events.py", "-b", "1", "-i", folder / "frames"]
        command += ["-r", self.weights, "--output_path", folder / "made", "--keep_ratio_128"]
        run_program(command, self.checkout, log, self.name)
        for path in (folder / "made").glob(f"*_{material.effect}_*.png"):
            path.rename(folder / "made" / f"{path.name[:4]}.png")

    def _paint(self, material: Material, folder: Path, log: Path) -> None:
        request = {
            "weights": str(self.weights),
            "frames": str(folder / "frames"),
            "masks": str(folder / "masks"),
            "made": str(folder / "made"),
            "seed": material.seed,
        }
        script = resources.files("climatenerf") / "assets" / "compare" / "climategan_paint.py"
        with resources.as_file(script) as path:
            command = [self.python, path, json.dumps(request)]
            run_program(command, self.checkout, log, self.name)


def climategan_methods(settings: ClimateGanSettings) -> tuple[ClimateGan, ...]:
    """Return ClimateGAN and ClimateGAN++, or nothing without a checkout.

    Raises:
        UserError: the checkout or the weights are not there.
    """
    if settings.checkout is None:
        return ()
    checkout = check_checkout(settings.checkout, "apply_events.py", "ClimateGAN")
    if settings.weights is None:
        raise UserError(
            "ClimateGAN needs its weights; give --climategan.weights with the folder that holds"
            " opts.yaml and checkpoints/"
        )
    weights = settings.weights.expanduser().resolve()
    for name in ("opts.yaml", WEIGHTS):
        if not (weights / name).is_file():
            raise UserError(
                f"{settings.weights} holds no weights of ClimateGAN: it has no {name}; give the"
                " folder that holds opts.yaml and checkpoints/"
            )
    python = python_of(settings.python)
    return tuple(ClimateGan(checkout, weights, python, ours) for ours in (False, True))


@contextmanager
def _exchange(material: Material, indices: Sequence[int], size: tuple[int, int]) -> Iterator[Path]:
    """Yield a folder with `frames/` and `masks/` (white is water) in ClimateGAN's size."""
    # Its own rule of sizes divides by the width and multiplies by it again, and may round a
    # multiple of 128 down to the next. One more row prevents that.
    taller = size[0], size[1] + 1
    with tempfile.TemporaryDirectory(prefix="climatenerf-") as name:
        folder = Path(name)
        for part in ("frames", "masks"):
            (folder / part).mkdir()
        for index in indices:
            clean = resized(material.clean.picture(index), taller)
            Image.fromarray(clean).save(folder / "frames" / f"{index:04d}.png")
            mask = Image.fromarray(grey(material.mask(index), taller))
            mask.save(folder / "masks" / f"{index:04d}.png")
        yield folder


def _result(folder: Path, index: int, name: str, work: Path) -> Picture:
    path = folder / "made" / f"{index:04d}.png"
    if not path.is_file():
        raise UserError(
            f"{name} ended without a picture of frame {index:04d}; see {work / 'log.txt'}, and"
            " check that the checkout is the published version"
        )
    return np.asarray(read_rgb(path))
