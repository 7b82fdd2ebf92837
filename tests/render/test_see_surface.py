"""Normals and classes of rays, and the layers that contain them."""

import numpy as np
import pytest
import torch
from support.random_field import random_field

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, CLASS_NAMES, SKY, SOLID
from climatenerf.render.frame import FrameOptions, see_frame
from climatenerf.render.heads import see_surface
from climatenerf.render.volume import camera_rays
from climatenerf.weather.world import World

CAMERA = Camera(32, 24, 25.0, 25.0, 16.0, 12.0)


@pytest.fixture
def field():
    """Dense matter everywhere; the surface head predicts upward normals and buildings."""
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[-1].fill_(4.0)
        for parameter in field.surface_net:
            parameter.zero_()
        field.surface_net[-1][2] = 1.0
        field.surface_net[-1][3 + list(SOLID).index(BUILDING)] = 5.0
    return field


def rays(field):
    pose = np.eye(4)
    pose[:3, 3] = field.centre.numpy()
    return pose, camera_rays(CAMERA, pose)


def test_composited_normals_and_classes_are_those_of_the_head(field):
    _, (o, d) = rays(field)
    normal, label = see_surface(field, o, d)
    up = torch.tensor([0.0, 0.0, 1.0])
    facing = torch.where((d @ up)[:, None] > 0, -up, up)
    assert torch.allclose(normal, facing.expand_as(normal), atol=1e-5)
    assert (label == BUILDING).all()


def test_rays_without_samples_are_sky_with_a_zero_normal(field):
    field.occupancy.occupied.zero_()
    _, (o, d) = rays(field)
    normal, label = see_surface(field, o, d)
    assert (normal == 0).all() and (label == SKY).all()


def test_layers_use_learned_heads_or_else_planes_of_the_depth(field):
    pose, (o, d) = rays(field)
    _, layers = see_frame(World(field), CAMERA, pose, FrameOptions(normals=True, labels=True))
    assert "label" not in layers  # an untrained head is not evaluated
    planes = layers["normal"]
    field.learned[:] = True
    _, layers = see_frame(World(field), CAMERA, pose, FrameOptions(normals=True, labels=True))
    assert layers["label"].shape == (24, 32) and (layers["label"] == BUILDING).all()
    assert np.allclose(np.abs(layers["normal"][..., 2]), 1, atol=1e-5)
    assert not np.allclose(planes, layers["normal"])
    assert len(CLASS_NAMES) == 7


def test_the_sky_has_the_given_or_the_mean_appearance(field):
    d = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    mean = field.sky(d)
    one = field.sky(d, field.embeddings[[2]].detach())
    with torch.no_grad():
        expected = field.sky_colour(d, field.embeddings[[2]].expand(20, -1))
    assert torch.equal(one, expected) and not torch.equal(one, mean)
