"""What is barred before a fit: the air above the ground, and nothing that stands on it."""

import numpy as np
import torch
from support.toy_scene import TINY
from test_visual_hull import CAMERA, TOWER, in_matter, labels, poses

from climatenerf.core.classes import BUILDING, SKY, SOLID, TERRAIN
from climatenerf.field.hash_field import Field
from climatenerf.ops.reference import contract
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence import ground_height as ground_map
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Rooms

EXACT = Rooms(fixed=False)
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


def points(c2w, n=300):
    """Rays of the first view that sees each point of the ground and of the tower's sides."""
    random = np.random.default_rng(0)
    angle, reach = random.uniform(0, 2 * np.pi, n), random.uniform(1.0, 5.0, n)
    ground = np.stack([reach * np.cos(angle), reach * np.sin(angle), 0 * angle], -1)
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


def carving(change=None, **settings):
    c2w = poses(12, height=1.5)
    maps = [ground_labels(pose) for pose in c2w]
    maps = change(maps) if change else maps
    images = [np.zeros((60, 80, 3), np.uint8)] * 12
    pixels = TrainingPixels([CAMERA], [0] * 12, c2w, images, maps)
    field = Field(TINY, 12, np.array([0.0, 0.0, 0.5]), 3.0, 0.1)
    return FreeSpace(field, pixels, points(c2w), FitSettings(**settings))


def test_cells_well_above_the_ground_are_barred_and_neither_low_ones_nor_the_tower():
    found = carving()
    occupancy, field = found.field.occupancy, found.field
    centre, size = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    x, size, barred = (
        centre * field.unit + field.centre,
        size * field.unit,
        occupancy.barred.view(-1),
    )
    ring = x[:, :2].norm(dim=-1)
    assert found.ground is not None
    clear = size * 3**0.5 / 2 + found.ground.tolerance * field.unit
    air = (ring > 2) & (ring < 4) & (x[:, 2] < 0.9)
    assert barred[air & (x[:, 2] > clear)].float().mean() > 0.3
    unseen = carving(
        losses=type(FitSettings().losses)(ground_height=0.0)
    ).field.occupancy.barred.view(-1)
    assert not (barred & ~unseen)[air & (x[:, 2] < clear - 0.02)].any()
    assert (barred & ~unseen)[air].any()
    touches = in_matter(x) & (x[:, 2] > -size / 2) & (ring < 5)
    assert touches.sum() > 50 and not barred[touches].any()


def test_matter_with_points_is_kept_though_every_view_takes_it_for_sky():
    """A network's word, even unanimous, empties nothing that was measured."""

    def err(maps):
        return [np.where(m == 2, 10, m).astype(np.uint8) for m in maps]

    found = carving(err, losses=type(FitSettings().losses)(ground_height=0.0))
    field, barred = found.field, found.field.occupancy.barred.view(-1)
    assert found.points is not None
    ends = field.to_grid(found.points.ends)
    on_tower = ends[found.points.ends[:, 2] > 0.2]
    assert len(on_tower) > 10
    cells, _ = field._cells(on_tower)
    assert not barred[cells].any(), "where points lie"
    side = 2.0 / field.occupancy.side  # of the cells of the first cascade
    beside, _ = field._cells(on_tower - torch.tensor([0.9 * side, 0.0, 0.0]))
    assert not barred[beside].any(), "and beside them"
    found.points = None
    found.force_empty()
    assert barred[cells].float().mean() > 0.2, "without points the word would empty it"


def test_what_is_much_nearer_to_a_camera_than_its_points_is_empty():
    found = carving(losses=type(FitSettings().losses)(ground_height=0.0))
    field, occupancy = found.field, found.field.occupancy
    assert found.points is not None
    middle, size = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    x, radius = middle * field.unit + field.centre, size * field.unit * 3**0.5 / 2
    before = found.too_near_camera(x, radius)
    away = torch.stack([(x - eye).norm(dim=-1) for eye in found.pixels.c2w[:, :3, 3]])
    nearest = [found.points.depth[found.points.image == i] for i in range(12)]
    told = torch.tensor([len(each) >= 20 for each in nearest])
    assert before.any() and told.any()
    reach = [0.8 * float(each.quantile(0.02)) if len(each) >= 20 else 0.0 for each in nearest]
    within = (away < torch.tensor(reach)[:, None]).any(0)
    assert within[before].all() and away[told].amin(0)[before].max() > 0.7 * max(reach)
    spared = ~occupancy.barred.view(-1)[before]
    apart = torch.cdist(x[before][spared], found.points.ends).amin(-1)
    assert spared.float().mean() < 0.5 and (apart < 3 * size.min() * field.unit).all(), "by points"
    one = int(told.nonzero()[0, 0])
    found.points = found.points.select(torch.isin(found.points.image, torch.tensor([one])))
    assert away[one][found.too_near_camera(x, radius)].max() < float(nearest[one].min()) + 1e-3
    found.points = found.points.select(torch.arange(19))
    assert not found.too_near_camera(x, radius).any(), "too few points say nothing"
    found.points = None
    assert not found.too_near_camera(x, radius).any()


def test_smooth_ground_right_before_a_camera_is_spared():
    """Its nearest points lie far off: an asphalt road has few."""
    found = carving()
    assert found.points is not None and found.ground is not None
    middle, size = found.field.occupancy.cell_centres(
        torch.arange(found.field.occupancy.occupied.numel())
    )
    x, radius = middle * found.field.unit + found.field.centre, size * found.field.unit * 3**0.5 / 2
    some = found.points
    found.points = SparseDepth(some.rays_o, some.rays_d, some.depth + 4.0, some.image)
    known = found.ground.height_above(middle)[1]
    low = known & (x[:, 2].abs() < radius)
    kept, found.ground = found.too_near_camera(x, radius), None
    without = found.too_near_camera(x, radius)
    assert (without & low).sum() > 20 and not (kept & low).any()
    assert (kept & known).any() and torch.equal(kept & ~known, without & ~known)


def test_what_is_below_a_crest_nearby_is_not_taken_to_be_in_the_open():
    """A ditch 0.3 units deep: what is in it is hidden from most, though they see its far bank."""
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 7
    z = torch.where(xy[:, 0].abs() < 0.5, -0.3, 0.0)
    ground = ground_map.fit_ground_height(torch.cat([xy, z[:, None]], -1))
    assert ground is not None
    q = torch.tensor([[0.0, 0.0, -0.15], [0.0, 0.0, 0.9], [2.5, 0.0, 0.9]])
    assert ground.clears(q, torch.full((3,), 0.02)).tolist() == [False, True, True]
    assert not ground.clears(q, torch.full((3,), 0.9)).any()


def test_where_no_point_lies_nothing_is_taken_to_be_in_the_open():
    """A lawn without points beside a road with many may lie higher than the road."""
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 4
    xy = xy[xy[:, 0] < 0]
    ground = ground_map.fit_ground_height(torch.cat([xy, torch.zeros(len(xy), 1)], -1))
    assert ground is not None
    q = torch.tensor([[-0.5, 0.0, 0.1], [0.1, 0.0, 0.1], [0.35, 0.0, 0.1]])
    assert ground.height_above(q)[1].all(), "but the map is known there"
    assert ground.clears(q, torch.full((3,), 0.02)).tolist() == [True, True, False]


def refined(found):
    """With cells of half the size, as later in a fit."""
    found.field.occupancy.refine()
    found.force_empty(everywhere=False)
    return found


def rim(shift):
    """Samples on rays from the side that graze the tower's left edge at 1 m, some of it beside."""
    o = torch.tensor([4.0, 0.0, 1.5]).expand(shift.shape[0], 3)
    x = torch.tensor([0.5, 0.0, 1.0]) + shift[:, None] * torch.tensor([0.0, 1.0, 0.0])
    t = (x - o).norm(dim=-1)
    return x, (x - o) / t[:, None], t


def asked(found, x, d, t, classed=False):
    q = found.field.to_grid(x)
    far, _, pulled = found.ground_offsets(q, d, t / found.field.unit, EXACT, classed)
    return torch.zeros(len(x), dtype=torch.bool).index_fill(0, far[pulled], True)


def test_the_air_beside_the_tower_costs_and_the_tower_does_not():
    found = refined(carving())
    x, d, t = rim(torch.linspace(-1.5, 1.5, 61))
    spared = asked(found, x, d, t)
    assert spared[x[:, 1].abs() > 1.35].all(), "half of the views see it before or behind the tower"
    found.obstacle[:] = False
    costs = asked(found, x, d, t)
    assert found.ground is not None and costs[x[:, 1].abs() > 1.0].all()
    assert not costs[in_matter(x)].any()
    bare = carving(losses=type(FitSettings().losses)(ground_height=0.0))
    assert bare.ground is None and not asked(bare, x, d, t).any()


def test_views_that_take_the_tower_for_ground_do_not_thin_it():
    def err(count):
        wrong = range(0, 12, 12 // count)

        def change(maps):
            return [
                np.where(m == 2, 9, m).astype(np.uint8) if i in wrong else m
                for i, m in enumerate(maps)
            ]

        return change

    x, d, t = rim(torch.linspace(-0.4, 0.4, 17))
    for few in (1, 4):
        assert not asked(carving(err(few)), x, d, t).any()


def test_matter_with_points_of_its_own_is_spared():
    """Most views take the tower for ground, but not those that show the points on it."""

    def err(maps):
        return [*maps[:4], *(np.where(m == 2, 9, m).astype(np.uint8) for m in maps[4:])]

    found = carving(err)
    x, d, t = rim(torch.linspace(-0.4, 0.4, 17))
    assert not asked(found, x, d, t).any()
    found.obstacle[:] = False
    assert asked(found, x, d, t).any()


def test_a_point_is_one_however_many_photos_show_it_and_most_of_them_name_it():
    found = carving()
    once = points(poses(12, height=1.5))
    assert found.points is not None
    many = SparseDepth(*(torch.cat([each] * 3) for each in vars(once).values()))
    places, lies = found.classify_points(many)
    single, alone = found.classify_points(once)
    assert len(places) == len(single) == len(once.depth) and torch.equal(lies, alone)
    ground = (places * found.field.unit + found.field.centre)[:, 2].abs() < 0.01
    assert (ground == lies).float().mean() > 0.97, "but for pixels at the tower's foot"


def test_points_off_the_map_are_no_ground_and_spare_what_is_by_them(monkeypatch):
    """A terrace 60 cm up: the map cannot step, and must not level it."""
    found = carving()
    xy = (torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 20
    z = torch.where(xy[:, 0] > 0.2, 0.6, 0.0)
    q = found.field.to_grid(torch.cat([xy, z[:, None]], -1))
    lies = torch.ones(3000, dtype=torch.bool)
    monkeypatch.setattr(found, "classify_points", lambda _: (q, lies.clone()))
    found.fit_ground()
    found.rasterise_points()
    assert found.ground is not None
    over, known = found.ground.height_above(q)
    off = over.abs() > found.ground.tolerance
    assert known.all() and 0.02 < off.float().mean() < 0.2
    cells, _ = found.field._cells(q[off])
    assert found.obstacle.view(-1)[cells].all() and found.stepped.view(-1)[cells].all()
    assert not found.stepped.view(-1)[found.field._cells(q[over.abs() < 0.01])[0]].all()


def test_samples_far_from_the_ground_are_told_and_where_they_should_be():
    found = carving()
    o = torch.tensor([4.0, 0.0, 1.5]).expand(4, 3)
    foot = torch.tensor([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    way = (foot - o).norm(dim=-1)
    d = (foot - o) / way[:, None]
    t = way * torch.tensor([0.7, 1.0, 1.2, 1.0])  # above, on and under the ground; on the tower
    x = o + t[:, None] * d
    q = found.field.to_grid(x)
    far, goal, pulled = found.ground_offsets(q, d, t / found.field.unit, EXACT)
    assert far[pulled].tolist() == [0, 2]
    assert torch.allclose(goal[pulled] * found.field.unit, way[[0, 2]], atol=0.15)


def test_what_stands_is_spared_with_a_rim_about_it():
    """Labels alone tell of it: the tower's points are taken for ground's."""
    found = carving()
    found.standing = found.standing[:0]
    found.rasterise_points()
    beside = torch.tensor([0.0, 0.0, 0.9]).repeat(60, 1)
    beside[:, 1] = torch.linspace(0.0, 2.5, 60)
    o = torch.tensor([4.0, 0.0, 1.5]).expand(60, 3)
    t = (beside - o).norm(dim=-1)
    costs = asked(found, beside, (beside - o) / t[:, None], t)
    cell = 2 * found.field.unit / found.field.occupancy.side
    off = beside[:, 1] - 0.5
    assert not costs[off < 0.5 * cell].any() and costs[off > 3 * cell].all()
    hull = found.find_obstacles()
    beyond = torch.roll(hull, 1, dims=2) & ~hull
    beyond[:, :, 0] = False
    assert beyond.any() and found.obstacle[beyond].all(), "neighbours along y"
    found.obstacle[:] = False
    bare = asked(found, beside, (beside - o) / t[:, None], t)
    assert bare[off > 0].sum() > costs.sum() and not bare[off < 0].any()


def test_lumps_by_the_tower_cost_once_the_field_takes_them_for_ground(monkeypatch):
    """It takes all that is more than 5 cm beside the tower for ground; a step is let be."""
    found = carving()
    field, edge = found.field, 0.55

    def surface_at(u):
        middle = contract(field.to_grid(torch.tensor([[0.0, edge, 1.0]])))[0, 1]
        logits = torch.zeros(u.shape[0], len(SOLID))
        logits[:, SOLID.tolist().index(BUILDING)] = 1.0
        logits[u[:, 1] > middle, SOLID.tolist().index(TERRAIN)] = 2.0
        return torch.zeros(u.shape[0], 3), logits

    monkeypatch.setattr(field, "surface_at", surface_at)
    x, d, t = rim(torch.linspace(-0.5, 1.5, 41))
    before, later = asked(found, x, d, t), asked(found, x, d, t, classed=True)
    by_class = x[:, 1] > edge
    spared = found.obstacle.view(-1)[field._cells(field.to_grid(x))[0]]
    assert (by_class & spared).any() and not before[spared].any()
    assert later[by_class].all() and torch.equal(later[~by_class], before[~by_class])
    found.steps = found.standing = field.to_grid(x[by_class])
    found.rasterise_points()
    stepped = asked(found, x, d, t, classed=True)
    assert not stepped[by_class].any()


def test_what_stands_is_kept_when_cells_are_halved():
    found = refined(carving())
    asked_again = found.find_obstacles()
    assert found.hull is not None and found.hull.shape == asked_again.shape
    both, either = (found.hull & asked_again).sum(), (found.hull | asked_again).sum()
    assert asked_again.any() and both > 0.6 * either, (both, either)
    assert (found.obstacle | ~asked_again).float().mean() > 0.999


def test_a_label_is_looked_up_where_a_ray_goes_through_the_picture():
    found = carving()
    pixels = found.pixels
    batch = pixels.draw(500, torch.Generator().manual_seed(0))
    assert torch.equal(pixels.label_towards(batch.image, batch.rays_d), batch.label)
    behind = pixels.label_towards(batch.image, -batch.rays_d)
    assert (behind == 255).all()
