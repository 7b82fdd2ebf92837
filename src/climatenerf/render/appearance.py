"""The exposure and light that a photo from a given camera would have had."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device
from climatenerf.field.hash_field import Field

FALL = 4  # with which power of its distance a photo's say falls; 2 and 6 do as well


def nearby_appearance(
    field: Field, photos: Float[np.ndarray, "n 4 4"], c2w: Float[np.ndarray, "4 4"]
) -> Float[Tensor, "1 e"]:
    """The fitted photos' appearance, each weighted by how much it looks from there to there.

    A phone exposes by what it looks at, so photos of the same are exposed alike. Two cameras are
    sqrt(angle^2 + (way / unit)^2) apart (rad; the field's unit of length): inverse distance
    weighting (Shepard 1968), smooth in the pose and without a scale of its own.

    Args:
        field: a fitted field.
        photos: poses of the photos it was fitted to, in their order, world m.
        c2w: the camera asked about, world m; no picture of its own is used.
    """
    cosine = (np.einsum("nij,ij->n", photos[:, :3, :3], c2w[:3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    way = np.linalg.norm(photos[:, :3, 3] - c2w[:3, 3], axis=-1) / field.unit
    # 1e-3: from where a photo was taken its distance is 0, and 1/0 has no share.
    share = (1e-3 + np.hypot(angle, way)) ** -FALL
    share = to_device((share / share.sum()).astype(np.float32))
    return (share @ field.embeddings)[None].detach()
