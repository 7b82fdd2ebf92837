"""Free-space constraint: empties the air above the ground, keeps the obstacles on it."""

import copy
import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.tower import CAMERA, TOWER, in_matter, labels, poses
from support.toy_scene import TINY

from climatenerf.core.classes import BUILDING, SKY, SOLID, TERRAIN
from climatenerf.field.hash_field import Field
from climatenerf.ops.reference import contract
from climatenerf.scene.terrain_fit import Heights
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence import ground_height
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import ExactBuffers

EXACT = ExactBuffers()
TRAIN_ID = {BUILDING: 2, TERRAIN: 9, SKY: 10}


def ground_labels(pose):
    """Train ids: the tower, the ground and the sky."""
    d = CAMERA.directions() @ pose[:3, :3].T
    kind = labels(CAMERA, pose)
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        near = np.minimum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).max(-1)
        far = np.maximum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).min(-1)
    kind = np.where((kind == BUILDING) & ~((near < far) & (far > 0)), TERRAIN, kind)
    return np.vectorize(TRAIN_ID.get)(kind).astype(np.uint8)


def tower_and_ground(c2w, n=300):
    """Sparse depth of points on the ground and the tower, each in the first view that sees it."""
    random = np.random.default_rng(0)
    angle, radius = random.uniform(0, 2 * np.pi, n), random.uniform(1.0, 5.0, n)
    ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)
    side = np.stack([np.full(60, 0.5), random.uniform(-0.5, 0.5, 60), random.uniform(0, 2, 60)], -1)
    rows = []
    for x in np.concatenate([ground, side]):
        for index, pose in enumerate(c2w):
            local = (x - pose[:3, 3]) @ pose[:3, :3]
            pixel = CAMERA.project(local[None])[0]
            if not (local[2] > 0 and (pixel > 0).all() and (pixel < (80, 60)).all()):
                continue
            d = (x - pose[:3, 3]) / np.linalg.norm(x - pose[:3, 3])
            steps = pose[:3, 3] + np.linspace(0, 0.98, 200)[:, None] * (x - pose[:3, 3])
            inside = ((steps > TOWER[0] + 0.01) & (steps < TOWER[1] - 0.01)).all(-1)
            if not inside.any():
                rows.append((pose[:3, 3], d, np.linalg.norm(x - pose[:3, 3]), index))
                break
    eye, d, depth, image = zip(*rows, strict=True)
    return SparseDepth(
        torch.from_numpy(np.array(eye, np.float32)),
        torch.from_numpy(np.array(d, np.float32)),
        torch.from_numpy(np.array(depth, np.float32)),
        torch.from_numpy(np.array(image)),
    )


def free_space(change=None, **settings):
    """One of its own for each caller, since tests change its field."""
    if change is None and not settings:
        return copy.deepcopy(usual_free_space())
    return make_free_space(change, **settings)


@functools.cache
def usual_free_space():
    return make_free_space()


def make_free_space(change=None, **settings):
    c2w = poses(12, height=1.5)
    maps = [ground_labels(pose) for pose in c2w]
    maps = change(maps) if change else maps
    images = [np.zeros((60, 80, 3), np.uint8)] * 12
    pixels = TrainingPixels([CAMERA], [0] * 12, c2w, images, maps)
    field = Field(TINY, 12, np.array([0.0, 0.0, 0.5]), 3.0, 0.1)
    return FreeSpace(field, pixels, tower_and_ground(c2w), FitSettings(**settings))


def test_cells_above_the_ground_are_forced_empty_except_the_tower():
    found = free_space()
    occupancy, field = found.field.occupancy, found.field
    centre, size = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    x, size, forced = (
        centre * field.unit + field.centre,
        size * field.unit,
        occupancy.forced_empty.view(-1),
    )
    ring = x[:, :2].norm(dim=-1)
    assert found.ground is not None
    tolerance = found.ground.tolerance_at(field.to_grid(x))
    clear = size * 3**0.5 / 2 + tolerance * field.unit
    air = (ring > 2) & (ring < 4) & (x[:, 2] < 0.9)
    assert forced[air & (x[:, 2] > clear)].float().mean() > 0.3
    without_ground = free_space(
        losses=type(FitSettings().losses)(ground_height=0.0)
    ).field.occupancy.forced_empty.view(-1)
    assert not (forced & ~without_ground)[air & (x[:, 2] < clear - 0.02)].any()
    assert (forced & ~without_ground)[air].any()
    touches = in_matter(x) & (x[:, 2] > -size / 2) & (ring < 5)
    assert touches.sum() > 50 and not forced[touches].any()


def test_cells_of_sparse_points_are_protected_from_wrong_labels():
    """Even if all views label the tower sky."""

    def err(maps):
        return [np.where(m == 2, 10, m).astype(np.uint8) for m in maps]

    found = free_space(err, losses=type(FitSettings().losses)(ground_height=0.0))
    field, forced = found.field, found.field.occupancy.forced_empty.view(-1)
    assert found.sparse is not None
    ends = field.to_grid(found.sparse.points)
    on_tower = ends[found.sparse.points[:, 2] > 0.2]
    assert len(on_tower) > 10
    cells, _ = field.occupancy.cell_index(on_tower)
    assert not forced[cells].any(), "cells of points"
    side = 2.0 / field.occupancy.side  # of the cells of the first cascade
    beside, _ = field.occupancy.cell_index(on_tower - torch.tensor([0.9 * side, 0.0, 0.0]))
    assert not forced[beside].any(), "and their neighbours"
    found.sparse = None
    found.force_empty()
    assert forced[cells].float().mean() > 0.2, "without points the labels empty the tower"


def test_an_obstacle_without_points_may_be_much_nearer_than_all_points():
    """Points on a far wall say nothing about a plain car before it, which all photos show."""
    found = free_space()
    field, occupancy = found.field, found.field.occupancy
    assert found.sparse is not None
    ground = found.sparse.points[:, 2] < 0.01
    far = found.sparse.select(ground & (found.sparse.depth > found.sparse.depth.median()))
    found.sparse = SparseDepth(far.rays_o, far.rays_d, 3 * far.depth, far.image)
    found.obstacle_points = found.obstacle_points[:0]
    occupancy.forced_empty.zero_()
    found.force_empty()
    centre, _ = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    x = centre * field.unit + field.centre
    inner = in_matter(x) & (x[:, 2] > 0.3) & (x[:, 2] < 1.5) & (x[:, :2].abs() < 0.4).all(-1)
    radius = torch.zeros_like(x[:, 0])
    near = found.too_near_camera(x, radius)
    assert inner.sum() > 5 and near[inner].any()
    assert not occupancy.forced_empty.view(-1)[inner].any()
    outside = near & ~found.obstacle.view(-1) & ~found.protected.view(-1)
    assert occupancy.forced_empty.view(-1)[outside].float().mean() > 0.8, "points are dilated"


def test_space_much_nearer_to_a_camera_than_its_points_is_empty():
    found = free_space(losses=type(FitSettings().losses)(ground_height=0.0))
    field, occupancy = found.field, found.field.occupancy
    assert found.sparse is not None
    middle, size = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    x, radius = middle * field.unit + field.centre, size * field.unit * 3**0.5 / 2
    before = found.too_near_camera(x, radius)
    distance = torch.stack([(x - eye).norm(dim=-1) for eye in found.pixels.c2w[:, :3, 3]])
    nearest = [found.sparse.depth[found.sparse.image == i] for i in range(12)]
    enough = torch.tensor([len(each) >= 20 for each in nearest])
    assert before.any() and enough.any()
    clearance = [0.8 * float(each.quantile(0.02)) if len(each) >= 20 else 0.0 for each in nearest]
    within = (distance < torch.tensor(clearance)[:, None]).any(0)
    assert within[before].all() and distance[enough].amin(0)[before].max() > 0.7 * max(clearance)
    spared = ~occupancy.forced_empty.view(-1)[before]
    apart = torch.cdist(x[before][spared], found.sparse.points).amin(-1)
    assert spared.float().mean() < 0.5 and (apart < 3 * size.min() * field.unit).all(), (
        "near points"
    )
    one = int(enough.nonzero()[0, 0])
    found.sparse = found.sparse.select(torch.isin(found.sparse.image, torch.tensor([one])))
    assert distance[one][found.too_near_camera(x, radius)].max() < float(nearest[one].min()) + 1e-3
    found.sparse = found.sparse.select(torch.arange(19))
    assert not found.too_near_camera(x, radius).any(), "too few points"
    found.sparse = None
    assert not found.too_near_camera(x, radius).any()


def test_smooth_ground_near_a_camera_is_not_emptied():
    """An asphalt road has few points, so the nearest ones are far away."""
    found = free_space()
    assert found.sparse is not None and found.ground is not None
    middle, size = found.field.occupancy.cell_centres(
        torch.arange(found.field.occupancy.occupied.numel())
    )
    x, radius = middle * found.field.unit + found.field.centre, size * found.field.unit * 3**0.5 / 2
    sparse = found.sparse
    found.sparse = SparseDepth(sparse.rays_o, sparse.rays_d, sparse.depth + 4.0, sparse.image)
    valid = found.ground.height_above(middle)[1]
    low = valid & (x[:, 2].abs() < radius)
    near, found.ground = found.too_near_camera(x, radius), None
    without = found.too_near_camera(x, radius)
    assert (without & low).sum() > 20 and not (near & low).any()
    assert (near & valid).any() and torch.equal(near & ~valid, without & ~valid)


def ground_through(q):
    """The ground through points in grid units of ten metres."""
    heights = Heights(10 * q.double().numpy(), np.full(len(q), 0.05))
    return ground_height.fit_ground_height(heights, np.zeros(3), 10.0)


def test_balls_below_a_nearby_crest_are_not_above_crests():
    """A ditch 0.3 units deep: its inside is hidden from most views, which see the far bank."""
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 7
    z = torch.where(xy[:, 0].abs() < 0.5, -0.3, 0.0)
    ground = ground_through(torch.cat([xy, z[:, None]], -1))
    assert ground is not None
    q = torch.tensor([[0.0, 0.0, -0.15], [0.0, 0.0, 0.9], [2.5, 0.0, 0.9]])
    assert ground.is_above_crests(q, torch.full((3,), 0.02)).tolist() == [False, True, True]
    assert not ground.is_above_crests(q, torch.full((3,), 0.9)).any()


def test_balls_above_ground_without_points_are_not_above_crests():
    """A lawn without points beside a road with many can be higher than the road."""
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 4
    xy = xy[xy[:, 0] < 0]
    ground = ground_through(torch.cat([xy, torch.zeros(len(xy), 1)], -1))
    assert ground is not None
    q = torch.tensor([[-0.5, 0.0, 0.1], [0.1, 0.0, 0.1], [0.35, 0.0, 0.1]])
    assert ground.height_above(q)[1].all(), "the height is valid, but not supported"
    assert ground.is_above_crests(q, torch.full((3,), 0.02)).tolist() == [True, True, False]


def refined(found):
    """The same with cells of half the size, as later in a fit."""
    found.field.occupancy.refine()
    found.force_empty(everywhere=False)
    return found


def rim(shift):
    """Samples at 1 m height on rays from +x, shifted along y across the tower's edges."""
    o = torch.tensor([4.0, 0.0, 1.5]).expand(shift.shape[0], 3)
    x = torch.tensor([0.5, 0.0, 1.0]) + shift[:, None] * torch.tensor([0.0, 1.0, 0.0])
    t = (x - o).norm(dim=-1)
    return x, (x - o) / t[:, None], t


def penalised_samples(found, x, d, t, use_classes=False):
    q = found.field.to_grid(x)
    off, _, penalised = found.ground_offsets(q, d, t / found.field.unit, EXACT, use_classes)
    return torch.zeros(len(x), dtype=torch.bool).index_fill(0, off[penalised], True)


def test_air_beside_the_tower_is_penalised_and_the_tower_is_not():
    found = refined(free_space())
    x, d, t = rim(torch.linspace(-1.5, 1.5, 61))
    near_tower = penalised_samples(found, x, d, t)
    assert near_tower[x[:, 1].abs() > 1.35].all(), "closer, half of the views see the tower"
    found.obstacle[:] = False
    without_obstacle = penalised_samples(found, x, d, t)
    assert found.ground is not None and without_obstacle[x[:, 1].abs() > 1.0].all()
    assert not without_obstacle[in_matter(x)].any()
    bare = free_space(losses=type(FitSettings().losses)(ground_height=0.0))
    assert bare.ground is None and not penalised_samples(bare, x, d, t).any()


@pytest.mark.slow
def test_a_minority_of_wrong_views_does_not_penalise_the_tower():
    def err(count):
        wrong = range(0, 12, 12 // count)

        def change(maps):
            return [
                np.where(m == 2, 9, m).astype(np.uint8) if i in wrong else m
                for i, m in enumerate(maps)
            ]

        return change

    x, d, t = rim(torch.linspace(-0.4, 0.4, 17))
    for count in (1, 4):
        assert not penalised_samples(free_space(err(count)), x, d, t).any()


@pytest.mark.slow
def test_obstacles_with_points_of_their_own_are_exempt():
    """Most views label the tower ground, but not those that observe the points on it."""

    def err(maps):
        return [*maps[:4], *(np.where(m == 2, 9, m).astype(np.uint8) for m in maps[4:])]

    found = free_space(err)
    x, d, t = rim(torch.linspace(-0.4, 0.4, 17))
    assert not penalised_samples(found, x, d, t).any()
    found.obstacle[:] = False
    assert penalised_samples(found, x, d, t).any()


def test_points_are_merged_over_views_and_classified_by_majority():
    found = free_space()
    once = tower_and_ground(poses(12, height=1.5))
    assert found.sparse is not None
    many = SparseDepth(*(torch.cat([each] * 3) for each in vars(once).values()))
    q, on_ground = found.classify_points(many)
    single, single_on_ground = found.classify_points(once)
    assert len(q) == len(single) == len(once.depth) and torch.equal(on_ground, single_on_ground)
    ground = (q * found.field.unit + found.field.centre)[:, 2].abs() < 0.01
    assert (ground == on_ground).float().mean() > 0.97, "except for pixels at the tower's foot"


def test_ground_points_off_the_fitted_height_are_steps_and_exempt(monkeypatch):
    """A terrace 60 cm high, a step that the fitted height cannot follow."""
    found = free_space()
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 20
    z = torch.where(xy[:, 0] > 0.2, 0.6, 0.0)
    x = torch.cat([xy, z[:, None]], -1)
    q, on_ground = found.field.to_grid(x), torch.ones(3000, dtype=torch.bool)
    centre = found.field.centre.double().numpy()
    heights = Heights(x.double().numpy(), np.full(3000, 0.02))
    ground = ground_height.fit_ground_height(heights, centre, found.field.unit)
    monkeypatch.setattr(found, "find_ground", lambda: ground)
    monkeypatch.setattr(found, "classify_points", lambda _: (q, on_ground.clone()))
    found.fit_ground()
    found.rasterise_points()
    assert found.ground is not None
    height, valid = found.ground.height_above(q)
    off = height.abs() > found.ground.tolerance_at(q)
    assert valid.all() and 0.02 < off.float().mean() < 0.2
    cells, _ = found.field.occupancy.cell_index(q[off])
    assert found.obstacle.view(-1)[cells].all() and found.near_step.view(-1)[cells].all()
    assert not found.near_step.view(-1)[
        found.field.occupancy.cell_index(q[height.abs() < 0.01])[0]
    ].all()


def test_samples_off_the_ground_get_the_depth_of_the_ground():
    found = free_space()
    o = torch.tensor([4.0, 0.0, 1.5]).expand(4, 3)
    foot = torch.tensor([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    length = (foot - o).norm(dim=-1)
    d = (foot - o) / length[:, None]
    t = length * torch.tensor([0.7, 1.0, 1.2, 1.0])  # above, on and under the ground; on the tower
    x = o + t[:, None] * d
    q = found.field.to_grid(x)
    off, target, penalised = found.ground_offsets(q, d, t / found.field.unit, EXACT)
    assert off[penalised].tolist() == [0, 2]
    assert torch.allclose(target[penalised] * found.field.unit, length[[0, 2]], atol=0.15)
    # Ground that is known too badly holds nothing.
    assert found.ground is not None
    found.ground = replace(found.ground, holding=torch.zeros_like(found.ground.holding))
    assert not len(found.ground_offsets(q, d, t / found.field.unit, EXACT)[0])


def test_obstacles_from_labels_are_exempt_with_a_margin():
    """From labels alone, without obstacle points."""
    found = free_space()
    found.obstacle_points = found.obstacle_points[:0]
    found.rasterise_points()
    beside = torch.tensor([0.0, 0.0, 0.9]).repeat(60, 1)
    beside[:, 1] = torch.linspace(0.0, 2.5, 60)
    o = torch.tensor([4.0, 0.0, 1.5]).expand(60, 3)
    t = (beside - o).norm(dim=-1)
    penalised = penalised_samples(found, beside, (beside - o) / t[:, None], t)
    cell = 2 * found.field.unit / found.field.occupancy.side
    off = beside[:, 1] - 0.5
    assert not penalised[off < 0.5 * cell].any() and penalised[off > 3 * cell].all()
    hull = found.find_obstacles()
    margin = torch.roll(hull, 1, dims=2) & ~hull
    margin[:, :, 0] = False
    assert margin.any() and found.obstacle[margin].all(), "neighbours along y"
    found.obstacle[:] = False
    bare = penalised_samples(found, beside, (beside - o) / t[:, None], t)
    assert bare[off > 0].sum() > penalised.sum() and not bare[off < 0].any()


def test_the_margin_is_penalised_where_the_field_classifies_ground(monkeypatch):
    """The field classifies everything more than 5 cm beside the tower as ground."""
    found = free_space()
    field, edge = found.field, 0.55

    def surface_at(u):
        middle = contract(field.to_grid(torch.tensor([[0.0, edge, 1.0]])))[0, 1]
        logits = torch.zeros(u.shape[0], len(SOLID))
        logits[:, SOLID.tolist().index(BUILDING)] = 1.0
        logits[u[:, 1] > middle, SOLID.tolist().index(TERRAIN)] = 2.0
        return torch.zeros(u.shape[0], 3), logits

    monkeypatch.setattr(field, "surface_at", surface_at)
    x, d, t = rim(torch.linspace(-0.5, 1.5, 41))
    before, later = (
        penalised_samples(found, x, d, t),
        penalised_samples(found, x, d, t, use_classes=True),
    )
    by_class = x[:, 1] > edge
    exempt = found.obstacle.view(-1)[field.occupancy.cell_index(field.to_grid(x))[0]]
    assert (by_class & exempt).any() and not before[exempt].any()
    assert later[by_class].all() and torch.equal(later[~by_class], before[~by_class])
    found.step_points = found.obstacle_points = field.to_grid(x[by_class])
    found.rasterise_points()
    stepped = penalised_samples(found, x, d, t, use_classes=True)
    assert not stepped[by_class].any()


def test_obstacles_are_upsampled_when_the_occupancy_is_refined():
    found = refined(free_space())
    recomputed = found.find_obstacles()
    assert found.obstacle_hull is not None and found.obstacle_hull.shape == recomputed.shape
    both, either = (
        (found.obstacle_hull & recomputed).sum(),
        (found.obstacle_hull | recomputed).sum(),
    )
    assert recomputed.any() and both > 0.6 * either, (both, either)
    assert (found.obstacle | ~recomputed).float().mean() > 0.999


def test_labels_are_looked_up_at_the_pixel_of_a_direction():
    found = free_space()
    pixels = found.pixels
    batch = pixels.draw(500, torch.Generator().manual_seed(0))
    assert torch.equal(pixels.label_towards(batch.image, batch.rays_d), batch.label)
    behind = pixels.label_towards(batch.image, -batch.rays_d)
    assert (behind == 255).all()
