import numpy as np
import pytest

from climatenerf.core.rotations import quaternions, rotation_matrices


@pytest.fixture
def turns():
    rng = np.random.default_rng(1)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(50)]
    turns = [t * np.sign(np.linalg.det(t)) for t in turns]
    half_turns = [np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1.0, 1, 1])]
    return np.array(turns + half_turns)


def test_quaternions_of_any_rotation(turns):
    q = quaternions(turns)
    assert (q[:, 0] >= 0).all()
    for (w, x, y, z), turn in zip(q, turns, strict=True):
        v = np.array([x, y, z])
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        back = np.eye(3) * (w * w - v @ v) + 2 * np.outer(v, v) + 2 * w * k
        np.testing.assert_allclose(back, turn, atol=1e-12)


def test_rotation_matrices_undo_it_at_any_length(turns):
    q = quaternions(turns)
    np.testing.assert_allclose(rotation_matrices(-3.0 * q), turns, atol=1e-12)
    np.testing.assert_allclose(rotation_matrices(q[0]), turns[0], atol=1e-12)
    assert quaternions(turns[0]).shape == (4,)
