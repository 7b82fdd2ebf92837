import numpy as np
import pytest

from climatenerf.core.rotations import quaternions, rotation_matrices


@pytest.fixture
def rotations():
    rng = np.random.default_rng(1)
    random = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(50)]
    random = [r * np.sign(np.linalg.det(r)) for r in random]
    half_turns = [np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1.0, 1, 1])]
    return np.array(random + half_turns)


def test_quaternions_reproduce_any_rotation(rotations):
    q = quaternions(rotations)
    assert (q[:, 0] >= 0).all()
    for (w, x, y, z), rotation in zip(q, rotations, strict=True):
        v = np.array([x, y, z])
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        matrix = np.eye(3) * (w * w - v @ v) + 2 * np.outer(v, v) + 2 * w * k
        np.testing.assert_allclose(matrix, rotation, atol=1e-12)


def test_rotation_matrices_invert_quaternions_of_any_length(rotations):
    q = quaternions(rotations)
    np.testing.assert_allclose(rotation_matrices(-3.0 * q), rotations, atol=1e-12)
    np.testing.assert_allclose(rotation_matrices(q[0]), rotations[0], atol=1e-12)
    assert quaternions(rotations[0]).shape == (4,)
