"""What labels of sky, ground and classes do to a fit."""

import dataclasses

import numpy as np
import pytest
import torch
from support.toy_fit import begin, labelled, labelled_pixels, with_labels

from climatenerf.core.classes import PERSON, ROAD, SKY, UNKNOWN, VEHICLE
from climatenerf.core.colour import decode_srgb
from climatenerf.core.samples import Samples
from climatenerf.field.normalisation import find_extent
from climatenerf.ops import compositing
from climatenerf.training import losses
from climatenerf.training import trainer as fit
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.sparse_depth import SparseDepth, read_sparse_depth
from climatenerf.training.run import load_pixels
from climatenerf.training.settings import PAPER, FitSettings, Losses
from climatenerf.training.trainer import Fitting
from climatenerf.training.transients import SUSPECT, still_cells


def opacity(fitting):
    """Mean opacity of a thousand training rays."""
    batch = fitting.pixels.draw(1000, torch.Generator().manual_seed(0))
    samples = fitting.field.march(
        batch.rays_o,
        batch.rays_d,
        torch.full((1000,), fitting.field.near),
        torch.full((1000,), 1e9),
    )
    left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)[1]
    return float((1 - left).mean())


@pytest.mark.slow
def test_pixels_labelled_sky_lose_their_matter(scene):
    fitting = begin(scene, steps=100, losses=Losses(sky=10.0))
    fitting.pixels.label = torch.full((fitting.pixels.rgb.shape[0],), SKY, dtype=torch.uint8)
    fitting = Fitting(fitting.pixels, 20, fitting.extent, fitting.settings)
    fitting.run(lambda _: None)
    plain = begin(scene, steps=100)
    plain.run(lambda _: None)
    assert opacity(fitting) < 0.2 * opacity(plain), (opacity(fitting), opacity(plain))


def test_with_labels_the_sky_learns_from_its_own_pixels_alone(scene):
    fitting = begin(scene, steps=1, losses=Losses(sky_prior=0.0))
    fitting.pixels.label = torch.full((fitting.pixels.rgb.shape[0],), ROAD, dtype=torch.uint8)
    fitting.pixels.label[0] = SKY  # labels that know of sky
    fitting = Fitting(fitting.pixels, 20, fitting.extent, fitting.settings)
    batch = fitting.pixels.draw(200, fitting.generator)
    batch.label[:] = ROAD
    fitting.step(batch)
    sky = {k: p.grad for k, p in fitting.field.named_parameters() if k.startswith("sky_net")}
    assert all((grad == 0).all() for grad in sky.values())
    batch.label[:] = SKY
    fitting.step(batch)
    assert any((p.grad != 0).any() for p in fitting.field.sky_net)
    # Nor does haze before it take its colour.
    assert all((p.grad == 0).all() for p in fitting.field.colour_net)


def test_what_nobody_has_labelled_may_be_sky_too(scene):
    fitting = begin(scene, steps=1, losses=Losses(sky_prior=0.0))
    fitting.pixels.label = torch.full((fitting.pixels.rgb.shape[0],), ROAD, dtype=torch.uint8)
    fitting.pixels.label[0] = SKY
    fitting = Fitting(fitting.pixels, 20, fitting.extent, fitting.settings)
    batch = fitting.pixels.draw(200, fitting.generator)
    batch.label[:] = UNKNOWN
    fitting.step(batch)
    assert any((p.grad != 0).any() for p in fitting.field.sky_net)


def test_a_sky_label_spares_what_other_photos_and_points_see(scene):
    """Of a half-opaque pole before the open sky only what others see the sky at is sky."""
    fitting = begin(scene, steps=1)
    batch = fitting.pixels.draw(2, fitting.generator)
    batch.label[:] = torch.tensor([SKY, ROAD], dtype=torch.uint8)
    t = torch.tensor([1.0, 2.0, 3.0, 4.0, 1.0])
    samples = Samples(torch.tensor([0, 4, 5]), t, torch.full((5,), 0.1), torch.ones(5))
    weights = torch.tensor([0.3, 0.2, 0.2, 0.0, 0.9])

    def asked():
        which, empty = fitting.sky_samples(batch, samples, weights)
        return which[empty].tolist()

    assert asked() == [0, 1, 2]

    class VisualHull:
        def consensus(self, x, radius):
            far = (x - batch.rays_o[0]).norm(dim=-1)
            return far > 1.5  # the nearest is seen as matter elsewhere

    fitting.pixels.sky_hull = VisualHull()
    assert asked() == [1, 2]
    x = batch.rays_o[0] + 3.0 * batch.rays_d[0]
    cell, _ = fitting.field.occupancy.cell_index(fitting.field.to_grid(x[None]))
    fitting.carving.protected.view(-1)[cell] = True  # a sparse point lies by the last
    assert asked() == [1]


def test_what_is_masked_has_no_part_in_labels_and_relative_depth(scene, monkeypatch):
    fitting = begin(scene, steps=10)
    fitting.steps = 9  # masks are in use
    batch = fitting.pixels.draw(4, fitting.generator)
    batch.label[:], batch.relative = VEHICLE, torch.ones(4)
    mask = torch.tensor([0.9, 0.1, 0.4, 0.6])
    monkeypatch.setattr(fitting, "masks", lambda image, place: mask)
    _, stays = fitting.colour_loss(torch.ones(4, 3), torch.ones(4), batch)
    assert stays.label.tolist() == [UNKNOWN, VEHICLE, VEHICLE, UNKNOWN]
    assert torch.isnan(stays.relative).tolist() == [True, False, False, True]
    assert (batch.label == VEHICLE).all()


def test_a_triple_that_is_masked_in_part_is_none(scene, monkeypatch):
    fitting = begin(scene, steps=10)
    fitting.steps = 9
    batch = fitting.pixels.draw(12, fitting.generator, 3)
    n, m = batch.rays_o.shape[0], 3
    batch.in_line[:] = True
    mask = torch.zeros(n)
    mask[1], mask[n - 2 * m + 2] = 0.9, 0.9  # a middle, and a side of another
    monkeypatch.setattr(fitting, "masks", lambda image, place: mask)
    _, stays = fitting.colour_loss(torch.ones(n, 3), torch.ones(n), batch)
    assert stays.in_line.tolist() == [True, False, False]


def test_an_opaque_sky_has_its_photos_colour(scene):
    """The paper's sky is matter: rays labelled sky have to teach it their colour."""
    pixels = load_pixels(scene, 1)
    pixels.label = torch.full((len(pixels.rgb),), SKY, dtype=torch.uint8)
    settings = dataclasses.replace(PAPER, preset="tiny", minutes=None, steps=9)
    for opaque in (True, False):
        chosen = dataclasses.replace(settings, opaque_sky=opaque)
        fitting = Fitting(pixels, 20, begin(scene).extent, chosen)
        fitting.step(fitting.pixels.draw(64, fitting.generator))
        slopes = [p.grad.abs().sum() for p in fitting.field.colour_net]
        assert (sum(slopes) > 0) == opaque


@pytest.mark.slow
@pytest.mark.parametrize(("spared", "steps"), [(False, 40), (True, 80)])
def test_matter_on_rays_to_the_ground_comes_to_lie_on_it(scene, monkeypatch, spared, steps):
    """Without points as depth, which would do the same: by the map of the ground alone.

    Once where nothing is spared, and once where all is, but for what the field's own classes say
    (`test_carving.py` is about what is spared).
    """

    def everywhere(carving):
        return torch.full_like(carving.field.occupancy.occupied, spared, dtype=torch.bool)

    monkeypatch.setattr(FreeSpace, "find_obstacles", everywhere)
    known, labels = labelled(scene)
    pixels = labelled_pixels(known, labels)
    views = known.of_split("train")
    extent = find_extent(np.stack([known.c2w_world(v) for v in views]), None)
    above = {}
    for weight in (100.0, 0.0):
        settings = FitSettings(
            preset="tiny",
            minutes=None,
            steps=steps,
            samples_per_step=2**15,
            losses=Losses(sparse_depth=0.0, ground_height=weight),
        )
        fitting = Fitting(pixels, len(views), extent, settings, read_sparse_depth(known))
        fitting.run(lambda _: None)
        batch = pixels.draw(3000, torch.Generator().manual_seed(1))
        d, o = batch.rays_d[batch.label == 3], batch.rays_o[batch.label == 3]
        near, far = torch.full((len(d),), fitting.field.near), torch.full((len(d),), 1e9)
        samples = fitting.field.march(o, d, near, far)
        weights, _ = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        ray = samples.ray_index()
        height = o[ray, 2] + samples.t * d[ray, 2]
        above[weight] = float((weights * (height > 0.15)).sum() / len(d))
    assert above[100.0] < 0.5 * above[0.0], above


def test_what_is_matched_on_the_ground_is_left_to_its_map(scene):
    known, labels = labelled(scene)
    pixels = labelled_pixels(known, labels)
    views = known.of_split("train")
    extent = find_extent(np.stack([known.c2w_world(v) for v in views]), None)
    settings = FitSettings(preset="tiny", minutes=None, steps=10)
    batch = pixels.draw(2000, torch.Generator().manual_seed(0))
    matched = SparseDepth(batch.rays_o, batch.rays_d, torch.full((2000,), 3.0), batch.image)
    lies = int((batch.label == 3).sum())
    assert 200 < lies < 1800
    points = read_sparse_depth(known)
    fitting = Fitting(pixels, len(views), extent, settings, points, matched)
    assert fitting.carving.ground is not None
    assert fitting.measured[0] is points
    assert len(fitting.measured[1].depth) == pytest.approx(2000 - lies, abs=20)
    alone = Fitting(pixels, len(views), extent, settings, None, matched)
    assert alone.carving.ground is None and alone.measured == [matched]


def test_classes_and_normals_move_no_matter(scene, monkeypatch):
    """Colours' errors are taken away, so that nothing else is left to learn from."""
    monkeypatch.setattr(losses, "colour_error", lambda linear, _: 0.0 * linear.sum(-1))
    nothing = {each.name: 0.0 for each in dataclasses.fields(Losses)}
    for bend, moves in ((0.0, False), (1.0, True)):
        weights = Losses(**{**nothing, "classes": 1.0, "normals": 1.0, "normal_consistency": bend})
        fitting = with_labels(scene, np.asarray, losses=weights)
        field = fitting.field
        before = {name: value.clone() for name, value in field.named_parameters()}
        for _ in range(3):
            fitting.step(fitting.pixels.draw(1024, fitting.generator))
        moved = {n for n, value in field.named_parameters() if not torch.equal(value, before[n])}
        assert any(name.startswith("surface_net") for name in moved)
        assert any(name.startswith("geometry") for name in moved) == moves, moved


@pytest.mark.parametrize(("kept", "told"), [((9,), False), ((2,), False), ((2, 9), True)])
def test_a_single_class_is_not_learned(scene, kept, told):
    """As the fall-back's labels are, sky and terrain: all else would be called terrain too."""
    fitting = with_labels(scene, lambda ids: np.where(np.isin(ids, (*kept, 10)), ids, 255))
    assert fitting.field.knows_classes == told
    before = fitting.field.surface_net[-2].detach().clone()
    fitting.step(fitting.pixels.draw(1024, fitting.generator))
    moved = fitting.field.surface_net[-2].detach() != before
    assert bool(moved[:, 3:].any()) == told and bool(moved[:, :3].any()), "normals are learned"


def test_what_several_photos_show_in_one_place_is_not_suspected(scene, monkeypatch):
    """A network calls the ground a person, but points lie on it."""
    prices = []

    def recorded(error, unexplained, mask, price):
        prices.append(price)
        return (error + mask).mean()

    monkeypatch.setattr(losses, "masked_colour_loss", recorded)
    fitting = with_labels(scene, lambda ids: np.where(ids == 9, 11, ids))
    batch = fitting.pixels.draw(4000, torch.Generator().manual_seed(0))
    fitting.colour_loss(torch.zeros(4000, 3), torch.zeros(4000), batch)
    person = batch.label == PERSON
    full = fitting.settings.losses.transient
    assert torch.isclose(prices[0][~person], torch.tensor(full)).all()
    still = torch.isclose(prices[0][person], torch.tensor(full))
    suspected = torch.isclose(prices[0][person], torch.tensor(SUSPECT * full))
    assert (still | suspected).all() and still.float().mean() > 0.05 and suspected.any()
    images = fitting.still.shape[0]
    told = still_cells(fitting.pixels, fitting.measured, images)
    assert told.any() and torch.equal(told, fitting.still)
    assert not still_cells(fitting.pixels, [], images).any()


@pytest.mark.slow
@pytest.mark.parametrize("label", [True, False])
def test_the_sky_goes_on_where_no_photo_looked(scene, label, monkeypatch):
    """It begins as noise, or black, which upwards only the fill can take away."""
    monkeypatch.setattr(fit, "SKY_SHARES", (1.0, 1.0))  # without labels it learns slowly
    up = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    up[:, 2] = 2 * up[:, 2].abs() + 1.0
    up = torch.nn.functional.normalize(up, dim=-1)
    off = {}
    for weight in (Losses.sky_prior, 0.0):
        kept = np.asarray if label else lambda ids: np.full_like(ids, 255)
        fitting = with_labels(scene, kept, losses=Losses(sky_prior=weight))
        field = fitting.field
        with torch.no_grad():
            if label:
                fitting.reached = 0.0
                field.sky_grid.normal_(0.0, 10.0, generator=torch.Generator().manual_seed(0))
            else:
                field.sky_net[-1].fill_(-0.4)
        for _ in range(150):
            fitting.step(fitting.pixels.draw(512, fitting.generator))
            fitting.steps += 1
        batch = fitting.pixels.draw(2000, fitting.generator)
        above = batch.label == SKY if label else batch.rays_d[:, 2] > 0
        seen = decode_srgb(batch.rgb[above]).mean()
        with torch.no_grad():
            shown = field.sky_colour(up, field.mean_embedding.expand(500, -1))
        ratio = shown.mean(-1) / seen
        off[weight] = float(((ratio < 0.5) | (ratio > 2.0)).float().mean())
    assert off[Losses.sky_prior] < 0.5 * off[0.0], off


def test_what_an_ablation_leaves_out_is_left_out(scene, monkeypatch):
    full = with_labels(scene, np.asarray)
    assert full.field.occupancy.forced_empty.any() and full.knows_sky
    assert not with_labels(scene, np.asarray, free_space=False).field.occupancy.forced_empty.any()
    bare = with_labels(scene, np.asarray, sky_labels=False)
    assert not bare.knows_sky and bare.pixels.sky_hull is None
    assert not (bare.pixels.label == SKY).any() and (full.pixels.label == SKY).any()
    factors = []
    monkeypatch.setattr(fit, "scale_gradient", lambda x, factor: factors.append(factor) or x)
    for crowded in (3.0, 0.0):
        factors.clear()
        fitting = with_labels(scene, np.asarray, near_camera_gradient_scaling=crowded)
        fitting.step(fitting.pixels.draw(1024, fitting.generator))
        # The first ones are those of density: 1 / chance, and less near the cameras.
        assert (factors[0].min() < 1) == (crowded > 0)


def test_what_a_neighbouring_pixel_shows_is_not_unexplained(scene, monkeypatch):
    """Leaves before the sky are never met pixel by pixel, and no passers-by for that."""
    found = []

    def recorded(error, unexplained, mask, price):
        found.append(unexplained)
        return (error + mask).mean()

    monkeypatch.setattr(losses, "masked_colour_loss", recorded)
    fitting = begin(scene, steps=10)
    fitting.steps = 9
    pixels = fitting.pixels
    batch = pixels.draw(4000, torch.Generator().manual_seed(0))
    x = (batch.place[:, 0] * pixels.width[batch.image]).long()
    y = (batch.place[:, 1] * pixels.height[batch.image]).long()
    beside = (x + 1).minimum(pixels.width[batch.image] - 1)
    shown = pixels.rgb[pixels.pixel_start[batch.image] + y * pixels.width[batch.image] + beside]
    linear = decode_srgb(shown.float() / 255)
    fitting.colour_loss(linear, torch.ones(4000), batch)
    fitting.colour_loss(linear + 8.0, torch.ones(4000), batch)
    assert found[0].max() < 1e-9 and found[1].min() > 1.0
