"""The photos' own shadows, from masks that the user brings: for the paper's snow shading.

ClimateNeRF bakes two-dimensional shadow masks of the photos into a volume, by least squares over
the rays of all photos. The value with the least squares at a place is the mean over the rays that
end there, which is what this module takes.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.spatial import KDTree

from climatenerf.core.errors import UserError, excerpt
from climatenerf.scene.file_names import FileNames
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import read_rgb
from climatenerf.scene.photo_rays import PhotoRays

NEAREST = 12  # rays of which the mean is taken
REACH = 0.5  # m from a place, up to which rays count
PROPORTIONS = 0.05  # relative difference of those of a reduced photo and its mask


def check_folder(folder: Path) -> None:
    """Check that a folder of masks exists.

    Raises:
        UserError: it does not.
    """
    if not folder.is_dir():
        raise UserError(
            f"--snow.shadows: there is no folder {excerpt(str(folder))}; give one with a mask"
            " for each photo, white in shadow"
        )


class ShadowMasks:
    """Sunlight of places, by masks of the photos."""

    def __init__(self, folder: Path, photos: Sequence[PhotoRays]):
        """Read the masks.

        Args:
            folder: a mask for each photo, with its name and any suffix; white in shadow. Photos
                without one do not count.
            photos: where the rays of the photos end.

        Raises:
            UserError: there is no such folder, no mask of any photo in it, or one cannot be read.
        """
        check_folder(folder)
        files, ends, values = FileNames(folder), [], []
        for photo in photos:
            path = files.find_any(_names(photo.view.name))
            if path is None:
                continue
            mask, (rows, columns) = read_rgb(path).max(-1), photo.t.shape
            if abs(mask.shape[1] / mask.shape[0] * rows / columns - 1) > PROPORTIONS:
                height, width = mask.shape
                raise UserError(
                    f"--snow.shadows: {path.name} of {width}x{height} pixels has other proportions"
                    f" than its photo, which is {columns}x{rows} reduced; make masks of the photos'"
                    " size"
                )
            known = np.isfinite(photo.t)
            ends.append(photo.x[known])
            # As many rays as the reduced photo has pixels: each is the mean of its part.
            reduced = Image.fromarray(mask).resize((columns, rows), Image.Resampling.BOX)
            values.append(np.asarray(reduced, np.float64)[known] / 255)
        if not any(len(each) for each in ends):
            example = Path(photos[0].view.name).with_suffix(".png") if photos else "photo.png"
            raise UserError(
                f"--snow.shadows: {excerpt(str(folder))} has no mask of any photo; name them after"
                f" the photos, such as {example}"
            )
        self._values = np.concatenate(values)
        self._tree = KDTree(np.concatenate(ends))

    def sunlight(self, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Fraction of the sun at positions (world m), 0 to 1; NaN where no photo with a mask sees.

        The mean over the `NEAREST` rays that end within `REACH`.
        """
        count = min(NEAREST, len(self._values))
        found = self._tree.query(x, count, distance_upper_bound=REACH)
        distance, index = (np.reshape(each, (len(x), count)) for each in found)
        near = np.isfinite(distance)
        shadow = np.where(near, self._values[np.where(near, index, 0)], 0.0).sum(1)
        # 1: no ray is near, and the result is replaced.
        return np.where(near.any(1), 1 - shadow / np.maximum(near.sum(1), 1), np.nan)


def _names(photo: str) -> list[str]:
    """Names that the mask of a photo may have: its own, or that before its suffix; PNG first."""
    suffixes = sorted(PHOTO_SUFFIXES, key=lambda suffix: (suffix != ".png", suffix))
    stems = (Path(photo).with_suffix("").as_posix(), Path(photo).as_posix())
    return [f"{stem}{suffix}" for suffix in suffixes for stem in stems]
