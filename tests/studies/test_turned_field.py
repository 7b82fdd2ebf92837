"""A turned field answers as a field of turned solids."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.study_yard import BOX, CAMERA, LABELLED, pose

from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.field.capabilities import COMPLETES, DENSITY
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.studies.turned_field import Turn, TurnedField
from climatenerf.weather.world import World

TURN = Turn(Rotation.from_rotvec([0.1, -0.05, 0.02]).as_matrix(), np.array([1.0, 2.0, 0.5]))


def test_a_turned_camera_sees_in_a_turned_field_what_it_saw():
    c2w = pose((0.0, 1.0, -0.3))
    options = FrameOptions(normals=True, labels=True)
    picture, layers = render_frame(World(LABELLED), CAMERA, c2w, options)
    turned = World(TurnedField(LABELLED, TURN))
    seen, others = render_frame(turned, CAMERA, TURN.matrix() @ c2w, options)
    # A ray along an edge may fall to either side of it.
    close = np.abs(picture.astype(int) - seen).max(-1) <= 1
    assert close.mean() > 0.99
    assert np.allclose(layers["depth"][close], others["depth"][close], rtol=1e-4)
    assert np.allclose(
        layers["normal"][close] @ TURN.rotation.T, others["normal"][close], atol=2e-3
    )
    assert (layers["label"] == others["label"])[close].all()


def test_the_pivot_stays_and_lengths_do():
    matrix = TURN.matrix()
    assert np.allclose(matrix @ [*TURN.pivot, 1], [*TURN.pivot, 1])
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3))


def test_the_box_holds_the_turned_box():
    lower, upper = TurnedField(LABELLED, TURN).bounds
    corners = np.array([[BOX[i][0], BOX[j][1], BOX[k][2], 1]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    turned = (corners @ TURN.matrix().T)[:, :3]
    assert np.allclose(turned.min(0), lower, atol=1e-4)
    assert np.allclose(turned.max(0), upper, atol=1e-4)


class Grounded(AnalyticField):
    """Level ground whose height is known where x < 3."""

    def ground_height(self, xy):
        return torch.where(xy[:, 0] < 3, 0.2, torch.nan)


def test_the_ground_of_a_turned_field_is_a_slope():
    """The plane z = 0.2 turned about the pivot, solved for z."""
    inner = Grounded([HalfSpace(offset=0.2)], capabilities=frozenset({DENSITY, COMPLETES}))
    field = TurnedField(inner, TURN)  # pyright: ignore[reportArgumentType]
    xy = torch.tensor([[0.0, 0.0], [-2.0, 1.0], [1.0, -3.0], [9.0, 0.0]])
    normal = TURN.rotation @ np.array([0.0, 0.0, 1.0])
    point = TURN.rotation @ (np.array([0.0, 0.0, 0.2]) - TURN.pivot) + TURN.pivot
    expected = point[2] - ((xy.numpy() - point[:2]) @ normal[:2]) / normal[2]
    found = field.ground_height(xy)
    assert found[:3].numpy() == pytest.approx(expected[:3], abs=5e-3)
    assert found[3].isnan(), "unknown there"
