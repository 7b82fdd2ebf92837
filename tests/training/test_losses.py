"""Each loss by known values, and that the fit adds it with its weight."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch
from support.toy_fit import begin

from climatenerf.core.classes import ROAD, SKY, UNKNOWN
from climatenerf.ops import compositing
from climatenerf.training import losses
from climatenerf.training import trainer as fit
from climatenerf.training.settings import Losses
from climatenerf.training.trainer import scale_gradient


def test_colour_loss_is_the_error_of_display_values():
    linear = torch.tensor([[0.21404114, 0.0, 1.0]])
    assert losses.colour_error(linear, torch.tensor([[0.5, 0.0, 1.0]])) < 1e-10
    assert losses.colour_error(linear, torch.tensor([[0.2, 0.0, 1.0]])) == pytest.approx(0.03)


def test_distances_are_bounded_smooth_and_plain_when_near():
    t = torch.tensor([0.0, 0.5, 1.0, 2.0, 1e9])
    measure = losses.distance_measure(t)
    assert torch.allclose(measure, torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]))


def test_distortion_of_known_weights():
    offsets = torch.tensor([0, 1, 3])
    t = torch.tensor([0.5, 0.2, 0.6])
    dt = torch.tensor([0.1, 0.1, 0.1])
    weights = torch.tensor([1.0, 0.5, 0.5])
    one = 0.1 / 3
    two = 2 * 0.5 * 0.5 * 0.4 + 2 * 0.25 * 0.1 / 3
    found = losses.distortion_loss(weights, t, dt, offsets)
    assert found == pytest.approx((one + two) / 2, rel=1e-5)
    gathered = torch.tensor([1.0, 0.95, 0.05])
    assert losses.distortion_loss(gathered, t, dt, offsets) < found


def test_light_left_below_the_horizon_counts_squared_and_above_not_at_all():
    left = torch.tensor([0.5, 0.5, 0.0, 1.0], requires_grad=True)
    below = torch.tensor([True, False, True, True])
    loss = losses.below_horizon_loss(left, below)
    assert loss.item() == pytest.approx((0.25 + 0.0 + 0.0 + 1.0) / 4)
    (gradient,) = torch.autograd.grad(loss, left)
    assert torch.allclose(gradient, torch.tensor([0.25, 0.0, 0.0, 0.5]))


def test_depth_loss_is_the_mean_distance_of_weight_from_the_point():
    weights = torch.tensor([0.25, 0.5, 0.5], requires_grad=True)
    left = torch.tensor([0.25, 0.5])
    t, depth = torch.tensor([0.5, 1.0, 4.0]), torch.tensor([0.75, 2.0])
    ray = torch.tensor([0, 0, 1])
    # Bounded: 2 -> 1.5, 4 -> 1.75, infinity -> 2.
    first = 0.25 * 0.25 + 0.5 * 0.25 + 0.25 * 1.25
    second = 0.5 * 0.25 + 0.5 * 0.5
    loss = losses.sparse_depth_loss(weights, left, t, depth, ray)
    assert loss.item() == pytest.approx((first + second) / 2)
    (gradient,) = torch.autograd.grad(loss, weights)
    assert torch.allclose(gradient, torch.tensor([0.25, 0.25, 0.25]) / 2)


def test_opacity_is_pushed_to_none_or_all():
    left = torch.tensor([0.0, 1.0], requires_grad=True)
    loss = losses.opacity_entropy_loss(left)
    assert abs(loss.item()) < 2e-5
    loss.backward()
    assert torch.isfinite(left.grad).all()
    half = losses.opacity_entropy_loss(torch.tensor([0.5]))
    assert half == pytest.approx(0.5 * math.log(2))


def test_sky_loss_is_the_weight_in_the_sky_over_all_rays():
    assert losses.sky_loss(torch.tensor([0.5, 0.25]), 3) == pytest.approx(0.25)


def only(scene, weight=1.0, **settings):
    """A fit with one loss alone, half way, and the arguments of its `geometry_loss`."""
    nothing = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    name = settings.pop("loss")
    fitting = begin(scene, steps=1000, losses=Losses(**{**nothing, name: weight}), **settings)
    fitting.reached = 0.5
    field, batch = fitting.field, fitting.pixels.draw(900, torch.Generator().manual_seed(0), 150)
    near, far = torch.full((900,), field.near), torch.full((900,), 1e9)
    samples = field.march(batch.rays_o, batch.rays_d, near, far)
    dense = 100 * samples.sigma * samples.dt  # an untrained field is haze; flat is what is solid
    weights, left = compositing.render_weights(dense, samples.offsets)
    return fitting, (batch, samples, weights, left, samples.t / field.unit, samples.dt / field.unit)


def test_surfaces_that_no_label_names_are_flattened_less(scene):
    fitting, (batch, *rest) = only(scene, loss="planarity")
    found = {
        kind: float(
            fitting.geometry_loss(replace(batch, label=torch.full_like(batch.label, kind)), *rest)
        )
        for kind in (UNKNOWN, ROAD, SKY)
    }
    assert found[ROAD] > 0 and found[SKY] == 0
    assert found[UNKNOWN] == pytest.approx(fit.UNSURE_FLAT * found[ROAD], rel=1e-4)
    assert fit.UNSURE_FLAT < 1


def test_distortion_and_opacity_of_a_step_are_the_functions_of_their_names(scene):
    fitting, (batch, samples, weights, left, t, dt) = only(scene, loss="distortion", weight=3.0)
    found = fitting.geometry_loss(batch, samples, weights, left, t, dt)
    wanted = losses.distortion_loss(weights, t, dt, samples.offsets)
    assert wanted > 0 and found == pytest.approx(3.0 * wanted)
    fitting, (batch, samples, weights, _, t, dt) = only(scene, loss="opacity_entropy", weight=3.0)
    left = torch.linspace(0.0, 1.0, 900)
    found = fitting.geometry_loss(batch, samples, weights, left, t, dt)
    wanted = losses.opacity_entropy_loss(left)
    assert wanted > 0 and found == pytest.approx(3.0 * wanted)


def test_an_opaque_sky_is_asked_to_be_far(scene):
    """The paper's form: exp(-distance) of sky rays, by their composited distance."""
    fitting, (batch, samples, weights, left, t, dt) = only(scene, loss="sky", opaque_sky=True)
    fitting.knows_sky = True
    label = torch.where(torch.arange(900) % 2 == 0, SKY, UNKNOWN).to(torch.uint8)
    batch = replace(batch, label=label)
    weights, left = 0.5 * weights, 0.5 + 0.5 * left  # thin: no mean distance of what is there
    found = fitting.geometry_loss(batch, samples, weights, left, t, dt)
    distance = torch.zeros(900).index_add(0, samples.ray_index(), weights * t)
    assert found == pytest.approx(float(torch.exp(-distance)[::2].sum() / 900), rel=1e-4)


def test_relative_depth_counts_by_its_weight_where_it_is_known(scene):
    found = []
    for weight, known in ((1.0, True), (2.0, True), (1.0, False)):
        fitting, (batch, *rest) = only(scene, loss="monocular_depth", weight=weight)
        relative = torch.rand(900, generator=torch.Generator().manual_seed(1))
        batch = replace(batch, relative=relative if known else relative * torch.nan)
        found.append(float(fitting.geometry_loss(batch, *rest)))
    assert found[0] > 0 and found[1] == pytest.approx(2 * found[0], rel=1e-5) and found[2] == 0


def test_scaling_a_gradient_leaves_the_value():
    x = torch.tensor([2.0, -3.0], requires_grad=True)
    y = scale_gradient(x, torch.tensor([0.25, 1.0]))
    assert torch.equal(y.detach(), x.detach())
    y.sum().backward()
    assert x.grad.tolist() == [0.25, 1.0]
