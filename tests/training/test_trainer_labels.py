"""Effects of sky, ground and class labels on a fit."""

import dataclasses

import numpy as np
import pytest
import torch
from support.toy_fit import begin, labelled, labelled_pixels, with_labels
from support.toy_scene import TINY

from climatenerf.core.classes import PERSON, ROAD, SKY, UNKNOWN, VEHICLE
from climatenerf.core.colour import decode_srgb
from climatenerf.core.samples import Samples
from climatenerf.field.normalisation import find_extent
from climatenerf.ops import compositing
from climatenerf.training import losses
from climatenerf.training import trainer as module
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.sparse_depth import SparseDepth, read_sparse_depth
from climatenerf.training.run import load_pixels
from climatenerf.training.schedule import Schedule
from climatenerf.training.settings import PAPER, FitSettings, Losses
from climatenerf.training.setup import make_trainer
from climatenerf.training.transients import MOVABLE_PRICE, find_static_cells


def opacity(trainer):
    """Mean opacity of a thousand training rays."""
    batch = trainer.pixels.draw(1000, torch.Generator().manual_seed(0))
    samples = trainer.field.march(
        batch.rays_o,
        batch.rays_d,
        torch.full((1000,), trainer.field.near),
        torch.full((1000,), 1e9),
    )
    transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)[1]
    return float((1 - transmittance).mean())


def colour_loss(trainer, radiance, error, batch):
    """The colour term and the unmasked batch at the current progress of the fit."""
    progress = trainer.progress
    return trainer.objective.colour(radiance, error, batch, progress, trainer.error)


@pytest.mark.slow
def test_sky_labels_remove_matter(scene):
    trainer = begin(scene, steps=100, losses=Losses(sky=10.0))
    trainer.pixels.label = torch.full((trainer.pixels.rgb.shape[0],), SKY, dtype=torch.uint8)
    trainer = make_trainer(trainer.pixels, trainer.extent, trainer.settings)
    trainer.run(lambda _: None)
    plain = begin(scene, steps=100)
    plain.run(lambda _: None)
    assert opacity(trainer) < 0.2 * opacity(plain), (opacity(trainer), opacity(plain))


def test_a_labelled_sky_has_gradients_from_sky_pixels_only(scene):
    trainer = begin(scene, steps=1, losses=Losses(sky_prior=0.0))
    trainer.pixels.label = torch.full((trainer.pixels.rgb.shape[0],), ROAD, dtype=torch.uint8)
    trainer.pixels.label[0] = SKY  # so that the labels contain sky
    trainer = make_trainer(trainer.pixels, trainer.extent, trainer.settings)
    batch = trainer.pixels.draw(200, trainer.generator)
    batch.label[:] = ROAD
    trainer.step(batch)
    sky = {k: p.grad for k, p in trainer.field.named_parameters() if k.startswith("sky_net")}
    assert all((grad == 0).all() for grad in sky.values())
    batch.label[:] = SKY
    trainer.step(batch)
    assert any((p.grad != 0).any() for p in trainer.field.sky_net)
    # The colour of haze in front of the sky is not changed.
    assert all((p.grad == 0).all() for p in trainer.field.colour_net)


def test_the_sky_has_gradients_from_unlabelled_pixels(scene):
    trainer = begin(scene, steps=1, losses=Losses(sky_prior=0.0))
    trainer.pixels.label = torch.full((trainer.pixels.rgb.shape[0],), ROAD, dtype=torch.uint8)
    trainer.pixels.label[0] = SKY
    trainer = make_trainer(trainer.pixels, trainer.extent, trainer.settings)
    batch = trainer.pixels.draw(200, trainer.generator)
    batch.label[:] = UNKNOWN
    trainer.step(batch)
    assert any((p.grad != 0).any() for p in trainer.field.sky_net)


def test_sky_samples_exclude_matter_in_other_photos_and_cells_of_points(scene):
    """A translucent pole before the sky: samples are kept if other photos label them matter."""
    trainer = begin(scene, steps=1)
    batch = trainer.pixels.draw(2, trainer.generator)
    batch.label[:] = torch.tensor([SKY, ROAD], dtype=torch.uint8)
    t = torch.tensor([1.0, 2.0, 3.0, 4.0, 1.0])
    samples = Samples(torch.tensor([0, 4, 5]), t, torch.full((5,), 0.1), torch.ones(5))
    weights = torch.tensor([0.3, 0.2, 0.2, 0.0, 0.9])

    def sky_samples():
        which, empty = trainer.objective.sky_samples(batch, samples, weights)
        return which[empty].tolist()

    assert sky_samples() == [0, 1, 2]

    class VisualHull:
        def consensus(self, x, radius):
            far = (x - batch.rays_o[0]).norm(dim=-1)
            return far > 1.5  # the nearest sample is matter in other photos

    trainer.pixels.sky_hull = VisualHull()
    assert sky_samples() == [1, 2]
    x = batch.rays_o[0] + 3.0 * batch.rays_d[0]
    cell, _ = trainer.field.occupancy.cell_index(trainer.field.to_grid(x[None]))
    trainer.evidence.free_space.protected.view(-1)[cell] = True  # cell of a sparse point
    assert sky_samples() == [1]


def test_masked_pixels_have_no_label_and_no_relative_depth(scene, monkeypatch):
    trainer = begin(scene, steps=10)
    trainer.steps = 9  # masks are active
    batch = trainer.pixels.draw(4, trainer.generator)
    batch.label[:], batch.relative = VEHICLE, torch.ones(4)
    mask = torch.tensor([0.9, 0.1, 0.4, 0.6])
    monkeypatch.setattr(trainer.objective, "masks", lambda image, xy: mask)
    _, unmasked = colour_loss(trainer, torch.ones(4, 3), torch.ones(4), batch)
    assert unmasked.label.tolist() == [UNKNOWN, VEHICLE, VEHICLE, UNKNOWN]
    assert torch.isnan(unmasked.relative).tolist() == [True, False, False, True]
    assert (batch.label == VEHICLE).all()


def test_a_partly_masked_triple_does_not_count(scene, monkeypatch):
    trainer = begin(scene, steps=10)
    trainer.steps = 9
    batch = trainer.pixels.draw(12, trainer.generator, 3)
    n, m = batch.rays_o.shape[0], 3
    batch.in_line[:] = True
    mask = torch.zeros(n)
    mask[1], mask[n - 2 * m + 2] = 0.9, 0.9  # the middle of one triple, a side of another
    monkeypatch.setattr(trainer.objective, "masks", lambda image, xy: mask)
    _, unmasked = colour_loss(trainer, torch.ones(n, 3), torch.ones(n), batch)
    assert unmasked.in_line.tolist() == [True, False, False]


def test_sky_pixels_give_gradients_to_the_colour_of_an_opaque_sky(scene):
    """The paper's sky is matter, so rays labelled sky give gradients to its colour."""
    pixels = load_pixels(scene, 1)
    pixels.label = torch.full((len(pixels.rgb),), SKY, dtype=torch.uint8)
    settings = dataclasses.replace(PAPER, size=TINY, minutes=None, steps=9)
    for opaque in (True, False):
        chosen = dataclasses.replace(settings, opaque_sky=opaque)
        trainer = make_trainer(pixels, begin(scene).extent, chosen)
        trainer.step(trainer.pixels.draw(64, trainer.generator))
        slopes = [p.grad.abs().sum() for p in trainer.field.colour_net]
        assert (sum(slopes) > 0) == opaque


@pytest.mark.slow
@pytest.mark.parametrize(("obstacles", "steps"), [(False, 40), (True, 80)])
def test_ground_height_moves_matter_to_the_ground(scene, monkeypatch, obstacles, steps):
    """Sparse depth has the same effect and is switched off.

    With obstacles everywhere only samples that the field classifies as ground are moved
    (`test_free_space.py` tests obstacles).
    """

    def everywhere(free_space):
        return torch.full_like(free_space.field.occupancy.occupied, obstacles, dtype=torch.bool)

    monkeypatch.setattr(FreeSpace, "find_obstacles", everywhere)
    known, labels = labelled(scene)
    pixels = labelled_pixels(known, labels)
    views = known.of_split("train")
    extent = find_extent(np.stack([known.c2w_world(v) for v in views]), None)
    above = {}
    for weight in (100.0, 0.0):
        settings = FitSettings(
            size=TINY,
            minutes=None,
            steps=steps,
            samples_per_step=2**15,
            losses=Losses(sparse_depth=0.0, ground_height=weight),
        )
        trainer = make_trainer(pixels, extent, settings, read_sparse_depth(known))
        trainer.run(lambda _: None)
        batch = pixels.draw(3000, torch.Generator().manual_seed(1))
        d, o = batch.rays_d[batch.label == 3], batch.rays_o[batch.label == 3]
        near, far = torch.full((len(d),), trainer.field.near), torch.full((len(d),), 1e9)
        samples = trainer.field.march(o, d, near, far)
        weights, _ = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        ray = samples.ray_index()
        height = o[ray, 2] + samples.t * d[ray, 2]
        above[weight] = float((weights * (height > 0.15)).sum() / len(d))
    assert above[100.0] < 0.5 * above[0.0], above


@pytest.mark.slow
def test_multiview_matches_on_the_ground_are_dropped(scene):
    known, labels = labelled(scene)
    pixels = labelled_pixels(known, labels)
    views = known.of_split("train")
    extent = find_extent(np.stack([known.c2w_world(v) for v in views]), None)
    settings = FitSettings(size=TINY, minutes=None, steps=10)
    batch = pixels.draw(2000, torch.Generator().manual_seed(0))
    matched = SparseDepth(batch.rays_o, batch.rays_d, torch.full((2000,), 3.0), batch.image)
    on_ground = int((batch.label == 3).sum())
    assert 200 < on_ground < 1800
    points = read_sparse_depth(known)
    trainer = make_trainer(pixels, extent, settings, points, matched)
    assert trainer.evidence.free_space.ground is not None
    assert trainer.evidence.depths[0] is points
    assert len(trainer.evidence.depths[1].depth) == pytest.approx(2000 - on_ground, abs=20)
    alone = make_trainer(pixels, extent, settings, None, matched)
    assert alone.evidence.free_space.ground is not None, "matches alone show the ground as well"
    unused = dataclasses.replace(settings, losses=Losses(ground_height=0.0))
    alone = make_trainer(pixels, extent, unused, None, matched)
    assert alone.evidence.free_space.ground is None and alone.evidence.depths == (matched,)


def test_classes_and_normals_do_not_change_the_density(scene, monkeypatch):
    """The colour loss is zeroed, so that only classes and normals give gradients."""
    monkeypatch.setattr(losses, "colour_error", lambda linear, _: 0.0 * linear.sum(-1))
    nothing = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    for consistency, changed in ((0.0, False), (1.0, True)):
        weights = Losses(
            **{**nothing, "classes": 1.0, "normals": 1.0, "normal_consistency": consistency}
        )
        trainer = with_labels(scene, np.asarray, losses=weights)
        field = trainer.field
        before = {name: value.clone() for name, value in field.named_parameters()}
        for _ in range(3):
            trainer.step(trainer.pixels.draw(1024, trainer.generator))
        moved = {n for n, value in field.named_parameters() if not torch.equal(value, before[n])}
        assert any(name.startswith("surface_net") for name in moved)
        assert any(name.startswith("geometry") for name in moved) == changed, moved


@pytest.mark.slow
@pytest.mark.parametrize(
    ("labelled_ids", "learned"), [((9,), False), ((2,), False), ((2, 9), True)]
)
def test_a_single_class_is_not_learned(scene, labelled_ids, learned):
    """With heuristic labels (sky and terrain) everything would be classified as terrain."""
    trainer = with_labels(scene, lambda ids: np.where(np.isin(ids, (*labelled_ids, 10)), ids, 255))
    assert trainer.field.knows_classes == learned
    before = trainer.field.surface_net[-2].detach().clone()
    trainer.step(trainer.pixels.draw(1024, trainer.generator))
    moved = trainer.field.surface_net[-2].detach() != before
    assert bool(moved[:, 3:].any()) == learned and bool(moved[:, :3].any()), "normals are learned"


def test_points_on_a_movable_class_keep_the_full_mask_price(scene, monkeypatch):
    """A network labels the ground as a person, but points lie on it."""
    prices = []

    def recorded(error, unexplained, mask, price):
        prices.append(price)
        return (error + mask).mean()

    monkeypatch.setattr(losses, "masked_colour_loss", recorded)
    trainer = with_labels(scene, lambda ids: np.where(ids == 9, 11, ids))
    batch = trainer.pixels.draw(4000, torch.Generator().manual_seed(0))
    colour_loss(trainer, torch.zeros(4000, 3), torch.zeros(4000), batch)
    person = batch.label == PERSON
    full = trainer.settings.losses.transient
    assert torch.isclose(prices[0][~person], torch.tensor(full)).all()
    static = torch.isclose(prices[0][person], torch.tensor(full))
    movable = torch.isclose(prices[0][person], torch.tensor(MOVABLE_PRICE * full))
    assert (static | movable).all() and static.float().mean() > 0.04 and movable.any()
    images = trainer.evidence.static_cells.shape[0]
    cells = find_static_cells(trainer.pixels, trainer.evidence.depths, images)
    assert cells.any() and torch.equal(cells, trainer.evidence.static_cells)
    assert not find_static_cells(trainer.pixels, [], images).any()


@pytest.mark.slow
@pytest.mark.parametrize("label", [True, False])
def test_the_sky_prior_extrapolates_the_sky_to_unseen_directions(scene, label):
    """The sky is initialised with noise or black, which only the prior corrects overhead."""
    schedule = Schedule(unlabelled_sky=(1.0, 1.0))  # the default ramp is slow
    up = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    up[:, 2] = 2 * up[:, 2].abs() + 1.0
    up = torch.nn.functional.normalize(up, dim=-1)
    errors = {}
    for weight in (Losses.sky_prior, 0.0):
        relabel = np.asarray if label else lambda ids: np.full_like(ids, 255)
        trainer = with_labels(scene, relabel, losses=Losses(sky_prior=weight), schedule=schedule)
        field = trainer.field
        with torch.no_grad():
            if label:
                trainer.resumed_progress = 0.0
                field.sky_grid.normal_(0.0, 10.0, generator=torch.Generator().manual_seed(0))
            else:
                field.sky_net[-1].fill_(-0.4)
        for _ in range(150):
            trainer.step(trainer.pixels.draw(512, trainer.generator))
            trainer.steps += 1
        batch = trainer.pixels.draw(2000, trainer.generator)
        above = batch.label == SKY if label else batch.rays_d[:, 2] > 0
        photographed = decode_srgb(batch.rgb[above]).mean()
        with torch.no_grad():
            sky = field.sky_colour(up, field.mean_embedding.expand(500, -1))
        ratio = sky.mean(-1) / photographed
        errors[weight] = float(((ratio < 0.5) | (ratio > 2.0)).float().mean())
    assert errors[Losses.sky_prior] < 0.5 * errors[0.0], errors


@pytest.mark.slow
def test_settings_of_the_ablation_disable_parts(scene, monkeypatch):
    full = with_labels(scene, np.asarray)
    assert full.field.occupancy.forced_empty.any() and full.evidence.knows_sky
    assert not with_labels(scene, np.asarray, free_space=False).field.occupancy.forced_empty.any()
    bare = with_labels(scene, np.asarray, sky_labels=False)
    assert not bare.evidence.knows_sky and bare.pixels.sky_hull is None
    assert not (bare.pixels.label == SKY).any() and (full.pixels.label == SKY).any()
    factors = []
    monkeypatch.setattr(module, "scale_gradient", lambda x, factor: factors.append(factor) or x)
    for scaling in (3.0, 0.0):
        factors.clear()
        trainer = with_labels(scene, np.asarray, near_camera_gradient_scaling=scaling)
        trainer.step(trainer.pixels.draw(1024, trainer.generator))
        # The first factors scale the density: 1 / inclusion probability, reduced near cameras.
        assert (factors[0].min() < 1) == (scaling > 0)


def test_the_colour_of_a_neighbouring_pixel_is_no_unexplained_error(scene, monkeypatch):
    """Leaves in front of the sky never match exactly, but are not transient."""
    found = []

    def recorded(error, unexplained, mask, price):
        found.append(unexplained)
        return (error + mask).mean()

    monkeypatch.setattr(losses, "masked_colour_loss", recorded)
    trainer = begin(scene, steps=10)
    trainer.steps = 9
    pixels = trainer.pixels
    batch = pixels.draw(4000, torch.Generator().manual_seed(0))
    x = (batch.xy[:, 0] * pixels.width[batch.image]).long()
    y = (batch.xy[:, 1] * pixels.height[batch.image]).long()
    right = (x + 1).minimum(pixels.width[batch.image] - 1)
    neighbour = pixels.rgb[pixels.pixel_start[batch.image] + y * pixels.width[batch.image] + right]
    linear = decode_srgb(neighbour.float() / 255)
    colour_loss(trainer, linear, torch.ones(4000), batch)
    colour_loss(trainer, linear + 8.0, torch.ones(4000), batch)
    assert found[0].max() < 1e-9 and found[1].min() > 1.0
