"""Losses on planarity, classes and normals: known values, invariances, gradients."""

import math

import numpy as np
import pytest
import torch

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import SKY
from climatenerf.training import losses
from climatenerf.training.dataset import TrainingPixels

CAMERA = Camera(64, 48, 50.0, 50.0, 30.0, 25.0)


def plane_depth(normal, offset):
    """z-depth of every pixel to the plane n·x = offset."""
    flat = CAMERA.directions()
    flat = flat / flat[..., 2:]
    return offset / (flat @ np.asarray(normal))


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, -0.95, 0.3), (0.3, 0.1, 0.9)])
def test_second_difference_of_a_plane_is_zero_at_any_tilt(normal):
    """Over pixels in any line, at any distance."""
    z = torch.tensor(plane_depth(normal, 3.0))
    for down, right in ((0, 1), (5, 0), (8, 8), (3, -3)):
        middle = z[20, 30]
        left, right_ = z[20 - down, 30 - right], z[20 + down, 30 + right]
        assert abs(losses.second_difference(torch.stack([middle, left, right_])[None])) < 1e-6


def test_ground_height_loss_is_the_mean_bounded_distance():
    weights = torch.tensor([0.5, 0.5, 0.2], requires_grad=True)
    t, goal = torch.tensor([0.5, 0.9, 1.0]), torch.tensor([0.53, 0.89, 4.0])
    loss = losses.ground_height_loss(weights, t, goal, 4)
    assert loss.item() == pytest.approx(
        (0.5 * 0.03 + 0.5 * 0.01 + 0.2 * losses.MAX_GROUND_ERROR) / 4
    )
    (gradient,) = torch.autograd.grad(loss, weights)
    assert torch.allclose(gradient, torch.tensor([0.03, 0.01, losses.MAX_GROUND_ERROR]) / 4)
    nothing = torch.zeros(0)
    assert losses.ground_height_loss(nothing, nothing, nothing, 4) == 0


def test_planarity_loss_is_at_most_one_at_an_edge():
    bump, edge = torch.tensor([[0.97, 1.0, 1.0]]), torch.tensor([[1.0, 1.0, 9.0]])
    assert losses.second_difference(bump) == pytest.approx(2 * (0.97 - 1.0), rel=1e-4)
    counts = torch.ones(1)
    assert 0.5 < losses.planarity_loss(bump, counts) < losses.planarity_loss(edge, counts) <= 1.0
    assert losses.planarity_loss(edge, torch.zeros(1)) == 0


def test_planarity_gradient_is_small_at_an_edge_and_large_at_a_bump():
    pulls = []
    for row in ([0.98, 1.0, 1.0], [1.0, 1.0, 9.0]):
        z = torch.tensor([row], requires_grad=True)
        losses.planarity_loss(z, torch.ones(1)).backward()
        assert z.grad is not None
        pulls.append(float(z.grad.abs().max()))
    assert pulls[1] < 0.01 * pulls[0]


def test_class_loss_is_the_cross_entropy_where_the_class_is_known():
    logits = torch.tensor([[2.0, 0.0], [0.0, 3.0], [1.0, 1.0]])
    target = torch.tensor([0, 255, 1])
    known = torch.tensor([True, False, True])
    expected = (math.log(1 + math.exp(-2)) + math.log(2)) / 3
    assert losses.class_loss(logits, target, known) == pytest.approx(expected)
    nothing = losses.class_loss(logits.requires_grad_(), target, torch.zeros(3, dtype=torch.bool))
    assert nothing == 0 and torch.isfinite(nothing)


def test_normal_loss_has_known_values():
    weights = torch.tensor([0.5, 0.25])
    up, side = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])
    same = losses.normal_loss(weights, torch.stack([up, up]), torch.stack([up, up]), 2)
    across = losses.normal_loss(weights, torch.stack([up, up]), torch.stack([side, -up]), 2)
    assert same == 0 and across == pytest.approx((0.5 * 2 + 0.25 * 4) / 2)


def test_far_sky_loss_falls_with_distance():
    is_sky = torch.tensor([1.0, 1.0, 0.0])
    near = losses.far_sky_loss(torch.tensor([0.0, 1.0, 0.0]), is_sky)
    far = losses.far_sky_loss(torch.tensor([8.0, 8.0, 0.0]), is_sky)
    assert near == pytest.approx((1 + math.exp(-1)) / 3) and far < 1e-3


def test_triples_lie_in_a_line_at_equal_distances_in_one_image():
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    images = [np.zeros((14, 20, 3), np.uint8)] * 3
    images = [np.full_like(image, index) for index, image in enumerate(images)]
    pixels = TrainingPixels([camera], [0, 0, 0], np.stack([np.eye(4)] * 3), images)
    n, m = 900, 200
    batch = pixels.draw(n, torch.Generator().manual_seed(0), m)
    assert batch.rays_d.shape == (n, 3) and batch.in_line.shape == (m,)
    middle, left, right = (
        part[batch.in_line]
        for part in (slice(0, m), slice(n - 2 * m, n - m), slice(n - m, n))
        for part in [batch.xy[part] * torch.tensor([20.0, 14.0])]
    )
    assert 0.2 < batch.in_line.float().mean() < 1
    assert torch.allclose((left + right) / 2, middle, atol=1e-4)
    spacing = (left - middle).abs().amax(-1).round()
    assert set(spacing.tolist()) == {1.0, 2.0, 4.0}  # 8 does not fit 14 rows here
    for side in (slice(n - 2 * m, n - m), slice(n - m, n)):
        assert torch.equal(batch.image[side], batch.image[:m])
    outside = ~batch.in_line
    assert torch.equal(batch.xy[n - m :][outside], batch.xy[:m][outside])
    # Colours belong to the pixels: each image is of one colour.
    assert torch.allclose(batch.rgb[:, 0] * 255, batch.image.float(), atol=1e-3)


def test_second_difference_of_a_plane_is_zero_along_drawn_triples():
    """The z-depth is the ray length times the batch's cosine; ray lengths are not affine."""
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    image = np.zeros((14, 20, 3), np.uint8)
    pixels = TrainingPixels([camera], [0], np.eye(4)[None], [image])
    n, m = 900, 200
    batch = pixels.draw(n, torch.Generator().manual_seed(0), m)
    t = 3.0 / (batch.rays_d @ torch.tensor([0.3, -0.5, 0.8]))
    rows = torch.arange(m) + torch.tensor([[0], [n - 2 * m], [n - m]])
    z = (t * batch.cosine)[rows][:, batch.in_line]
    assert losses.second_difference(z.T).abs().max() < 1e-4
    assert losses.second_difference(t[rows][:, batch.in_line].T).abs().max() > 1e-2


def test_sky_labels_below_the_horizon_are_dropped():
    """A level camera labelled sky entirely: pixels more than 3 degrees below it are unknown."""
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    level = np.eye(4)
    level[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along y, z up
    label = np.full((14, 20), 10, np.uint8)
    pixels = TrainingPixels([camera], [0], level[None], [np.zeros((14, 20, 3), np.uint8)], [label])
    assert pixels.label is not None
    sky = (pixels.label.view(14, 20) == SKY).numpy()
    down = (np.arange(14) + 0.5 - 7) / 20
    assert sky[down < 0].all() and not sky[down > 0.1].any()
    assert (label == 10).all()  # the caller's array is unchanged


def test_triples_have_no_masked_pixel():
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    mask = np.ones((14, 20), bool)
    mask[:, 10:] = False
    image = np.where(mask, 0, 255).astype(np.uint8)[..., None].repeat(3, -1)
    pixels = TrainingPixels([camera], [0], np.eye(4)[None], [image], None, [mask])
    batch = pixels.draw(900, torch.Generator().manual_seed(0), 250)
    assert batch.rgb.max() == 0 and batch.xy[:, 0].max() < 0.5
    assert 0.1 < batch.in_line.float().mean() < 0.9


def test_labels_without_any_class_count_as_none():
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    image, label = np.zeros((14, 20, 3), np.uint8), np.full((14, 20), 255, np.uint8)
    pixels = TrainingPixels([camera], [0], np.eye(4)[None], [image], [label])
    assert pixels.label is None and pixels.sky_hull is None and not pixels.knows_sky


def test_without_sky_makes_sky_labels_unknown():
    camera = Camera(20, 14, 20.0, 20.0, 10.0, 7.0)
    up = np.diag([1.0, -1.0, -1.0, 1.0])
    up[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    label = np.full((14, 20), 10, np.uint8)
    label[:, 10:] = 2
    images = [np.zeros((14, 20, 3), np.uint8)]
    pixels = TrainingPixels([camera], [0], up[None], images, [label])
    assert pixels.knows_sky and pixels.edge.numel()
    other = pixels.without_sky()
    assert not other.knows_sky and not other.edge.numel() and other.sky_hull is None
    assert other.label is not None and (other.label != 255).any() and pixels.knows_sky
