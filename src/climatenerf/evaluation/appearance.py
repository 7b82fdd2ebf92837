"""The appearance (exposure and light) that a photo from a given camera would have had."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device
from climatenerf.field.hash_field import Field

POWER = 4  # of inverse distance weighting; 2 and 6 score alike


def nearby_appearance(
    field: Field, photos: Float[np.ndarray, "n 4 4"], c2w: Float[np.ndarray, "4 4"]
) -> Float[Tensor, "1 e"]:
    """Return the mean appearance vector of the fitted photos, weighted by nearness of their poses.

    A phone sets its exposure by what it looks at, so photos of the same things are exposed alike.
    The distance of two cameras is sqrt(angle^2 + (length / unit)^2), with the angle in rad and the
    field's unit of length; the weights are inverse distances to a power (Shepard 1968).

    Args:
        field: a fitted field.
        photos: poses of the photos it was fitted to, in their order, world m.
        c2w: pose of the camera, world m. No picture of its own is used.
    """
    cosine = (np.einsum("nij,ij->n", photos[:, :3, :3], c2w[:3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    length = np.linalg.norm(photos[:, :3, 3] - c2w[:3, 3], axis=-1) / field.unit
    # 1e-3: at the pose of a photo the distance is 0, and the weight would be 1/0.
    weight = (1e-3 + np.hypot(angle, length)) ** -POWER
    weight = to_device((weight / weight.sum()).astype(np.float32), field.embeddings.device)
    return (weight @ field.embeddings)[None].detach()
