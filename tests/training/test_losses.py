"""Values of each loss, and its weight in the objective."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch
from support.toy_fit import begin

from climatenerf.core.classes import ROAD, SKY, UNKNOWN, VEGETATION, VEHICLE
from climatenerf.ops import compositing
from climatenerf.training import losses
from climatenerf.training.losses import scale_gradient
from climatenerf.training.rendered_rays import RenderedRays
from climatenerf.training.schedule import Schedule
from climatenerf.training.settings import Losses


def test_colour_loss_is_the_error_of_display_values():
    linear = torch.tensor([[0.21404114, 0.0, 1.0]])
    assert losses.colour_error(linear, torch.tensor([[0.5, 0.0, 1.0]])) < 1e-10
    assert losses.colour_error(linear, torch.tensor([[0.2, 0.0, 1.0]])) == pytest.approx(0.03)


def test_distance_measure_is_the_identity_near_and_bounded_far():
    t = torch.tensor([0.0, 0.5, 1.0, 2.0, 1e9])
    measure = losses.distance_measure(t)
    assert torch.allclose(measure, torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]))


def test_distortion_loss_has_known_values():
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


def test_below_horizon_loss_is_the_mean_squared_transmittance():
    transmittance = torch.tensor([0.5, 0.5, 0.0, 1.0], requires_grad=True)
    below = torch.tensor([True, False, True, True])
    loss = losses.below_horizon_loss(transmittance, below)
    assert loss.item() == pytest.approx((0.25 + 0.0 + 0.0 + 1.0) / 4)
    (gradient,) = torch.autograd.grad(loss, transmittance)
    assert torch.allclose(gradient, torch.tensor([0.25, 0.0, 0.0, 0.5]))


def test_sparse_depth_loss_is_the_mean_distance_of_the_weights_from_the_point():
    weights = torch.tensor([0.25, 0.5, 0.5], requires_grad=True)
    transmittance = torch.tensor([0.25, 0.5])
    t, depth = torch.tensor([0.5, 1.0, 4.0]), torch.tensor([0.75, 2.0])
    ray = torch.tensor([0, 0, 1])
    # Bounded: 2 -> 1.5, 4 -> 1.75, infinity -> 2.
    first = 0.25 * 0.25 + 0.5 * 0.25 + 0.25 * 1.25
    second = 0.5 * 0.25 + 0.5 * 0.5
    loss = losses.sparse_depth_loss(weights, transmittance, t, depth, ray)
    assert loss.item() == pytest.approx((first + second) / 2)
    (gradient,) = torch.autograd.grad(loss, weights)
    assert torch.allclose(gradient, torch.tensor([0.25, 0.25, 0.25]) / 2)


def test_nearness_is_2_at_the_camera_and_0_at_infinity():
    offsets = torch.tensor([0, 1, 3, 4, 4])
    t = torch.tensor([0.0, 0.5, 4.0, 1e12])
    weights = torch.tensor([1.0, 0.5, 0.25, 1.0], requires_grad=True)
    near = losses.nearness(weights, t, offsets)
    assert near.tolist() == pytest.approx([2.0, 0.5 * 1.5 + 0.25 * 0.25, 0.0, 0.0], abs=1e-6)
    (gradient,) = torch.autograd.grad(near.sum(), weights)
    assert gradient.tolist() == pytest.approx([2.0, 1.5, 0.25, 0.0], abs=1e-6)


def test_opacity_entropy_vanishes_at_0_and_1_with_finite_gradients():
    transmittance = torch.tensor([0.0, 1.0], requires_grad=True)
    loss = losses.opacity_entropy_loss(transmittance)
    assert abs(loss.item()) < 2e-5
    loss.backward()
    assert torch.isfinite(transmittance.grad).all()
    half = losses.opacity_entropy_loss(torch.tensor([0.5]))
    assert half == pytest.approx(0.5 * math.log(2))


def test_sky_loss_is_the_weight_in_the_sky_over_the_number_of_rays():
    assert losses.sky_loss(torch.tensor([0.5, 0.25]), 3) == pytest.approx(0.25)


def only(scene, weight=1.0, **settings):
    """A fit with a single loss at half of its steps, and a batch with its rendered rays."""
    nothing = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    name = settings.pop("loss")
    trainer = begin(scene, steps=1000, losses=Losses(**{**nothing, name: weight}), **settings)
    field, batch = trainer.field, trainer.pixels.draw(900, torch.Generator().manual_seed(0), 150)
    near, far = torch.full((900,), field.near), torch.full((900,), 1e9)
    samples = field.march(batch.rays_o, batch.rays_d, near, far)
    dense = 100 * samples.sigma * samples.dt  # an untrained field is haze; planarity needs matter
    weights, transmittance = compositing.render_weights(dense, samples.offsets)
    t, dt = samples.t / field.unit, samples.dt / field.unit
    return trainer, batch, RenderedRays(samples, t, dt, weights, transmittance)


def geometry(trainer, batch, rays):
    """The terms on the density at half of a fit."""
    return trainer.objective.geometry(trainer.field, batch, rays, 0.5)


def test_unlabelled_surfaces_have_a_smaller_planarity_weight(scene):
    trainer, batch, rays = only(scene, loss="planarity")
    found = {
        kind: float(
            geometry(trainer, replace(batch, label=torch.full_like(batch.label, kind)), rays)
        )
        for kind in (UNKNOWN, ROAD, SKY)
    }
    factor = Schedule().unlabelled_planarity
    assert found[ROAD] > 0 and found[SKY] == 0
    assert found[UNKNOWN] == pytest.approx(factor * found[ROAD], rel=1e-4) and factor < 1


def test_occlusion_applies_to_what_stands_on_the_ground_and_ends(scene):
    trainer, batch, rays = only(scene, loss="occlusion", weight=3.0)
    near = losses.nearness(rays.weights, rays.t, rays.samples.offsets)
    factor = Schedule().occlusion_weight(0.1)
    for kind, factor_of_class in (
        (VEGETATION, 1.0),
        (VEHICLE, 1.0),
        (ROAD, 0.0),
        (SKY, 0.0),
        (UNKNOWN, 0.0),
    ):
        labelled = replace(batch, label=torch.full_like(batch.label, kind))
        found = trainer.objective.geometry(trainer.field, labelled, rays, 0.1)
        assert float(found) == pytest.approx(3.0 * factor_of_class * factor * float(near.mean()))
    assert 0 < factor < Schedule().occlusion_weight(0.0) == 1
    assert Schedule().occlusion_weight(0.25) == Schedule().occlusion_weight(1.0) == 0


def test_distortion_and_opacity_entropy_of_a_step_are_the_formulas_times_their_weights(scene):
    trainer, batch, rays = only(scene, loss="distortion", weight=3.0)
    expected = losses.distortion_loss(rays.weights, rays.t, rays.dt, rays.samples.offsets)
    assert expected > 0 and geometry(trainer, batch, rays) == pytest.approx(3.0 * expected)
    trainer, batch, rays = only(scene, loss="opacity_entropy", weight=3.0)
    rays = replace(rays, transmittance=torch.linspace(0.0, 1.0, 900))
    expected = losses.opacity_entropy_loss(rays.transmittance)
    assert expected > 0 and geometry(trainer, batch, rays) == pytest.approx(3.0 * expected)


def test_an_opaque_sky_is_penalised_by_its_composited_distance(scene):
    """The paper's form: exp(-distance) of sky rays."""
    trainer, batch, rays = only(scene, loss="sky", opaque_sky=True)
    trainer.objective.evidence = replace(trainer.evidence, knows_sky=True)
    label = torch.where(torch.arange(900) % 2 == 0, SKY, UNKNOWN).to(torch.uint8)
    batch = replace(batch, label=label)
    # Translucent rays: their composited distance is not the mean distance of their matter.
    thin = replace(rays, weights=0.5 * rays.weights, transmittance=0.5 + 0.5 * rays.transmittance)
    distance = torch.zeros(900).index_add(0, rays.samples.ray_index(), thin.weights * thin.t)
    expected = float(torch.exp(-distance)[::2].sum() / 900)
    assert geometry(trainer, batch, thin) == pytest.approx(expected, rel=1e-4)


def test_monocular_depth_counts_by_its_weight_where_it_is_known(scene):
    found = []
    for weight, known in ((1.0, True), (2.0, True), (1.0, False)):
        trainer, batch, rays = only(scene, loss="monocular_depth", weight=weight)
        relative = torch.rand(900, generator=torch.Generator().manual_seed(1))
        batch = replace(batch, relative=relative if known else relative * torch.nan)
        found.append(float(geometry(trainer, batch, rays)))
    assert found[0] > 0 and found[1] == pytest.approx(2 * found[0], rel=1e-5) and found[2] == 0


def test_scale_gradient_leaves_the_value_unchanged():
    x = torch.tensor([2.0, -3.0], requires_grad=True)
    y = scale_gradient(x, torch.tensor([0.25, 1.0]))
    assert torch.equal(y.detach(), x.detach())
    y.sum().backward()
    assert x.grad.tolist() == [0.25, 1.0]
