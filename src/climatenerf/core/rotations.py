"""Conversions between rotation matrices and unit quaternions (w, x, y, z), Hamilton's convention.

scipy orders quaternions (x, y, z, w); the files that this program reads and writes put w first.
scipy is imported on first use, so that loading a scene module stays quick.
"""

import numpy as np
from jaxtyping import Float


def quaternions(rotations: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Return the unit quaternions (w, x, y, z), w >= 0, of rotation matrices."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(np.asarray(rotations).reshape(-1, 3, 3)).as_quat(canonical=True)
    return flat[:, [3, 0, 1, 2]].reshape(*np.shape(rotations)[:-2], 4)


def rotation_matrices(quaternions: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the rotation matrices of quaternions (w, x, y, z) of any length but 0."""
    from scipy.spatial.transform import Rotation

    flat = np.asarray(quaternions, float).reshape(-1, 4)[:, [1, 2, 3, 0]]
    return Rotation.from_quat(flat).as_matrix().reshape(*np.shape(quaternions)[:-1], 3, 3)
