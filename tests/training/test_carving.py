"""What is barred before a fit: the air above the ground, and nothing that stands on it."""

import numpy as np
import torch
from test_witness import CAMERA, TOWER, in_matter, labels, poses
from toy_scene import TINY

from climatenerf.field.field import Field
from climatenerf.scene.classes import BUILDING, SKY, TERRAIN
from climatenerf.training.carving import Carving
from climatenerf.training.pixels import TrainingPixels
from climatenerf.training.points import PointRays
from climatenerf.training.settings import FitSettings

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
    return PointRays(
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
    return Carving(field, pixels, points(c2w), FitSettings(**settings))


def cells_of(found):
    occupancy, field = found.field.occupancy, found.field
    centre, size = occupancy.cell_centres(torch.arange(occupancy.occupied.numel()))
    return centre * field.unit + field.centre, size * field.unit, occupancy.barred.view(-1)


def test_the_air_above_the_ground_goes_and_ground_and_tower_stay():
    found = carving()
    x, size, barred = cells_of(found)
    ring = x[:, :2].norm(dim=-1)
    air = (ring > 2) & (ring < 4) & (x[:, 2] > size) & (x[:, 2] < 0.8)
    assert found.ground is not None and barred[air].float().mean() > 0.5
    touches = in_matter(x) & (x[:, 2] > -size / 2) & (ring < 5)
    assert touches.sum() > 50 and not barred[touches].any()
    bare = carving(losses=type(FitSettings().losses)(ground=0.0))
    assert bare.ground is None
    assert cells_of(bare)[2][air].float().mean() < barred[air].float().mean() / 2


def test_a_view_that_takes_the_tower_for_ground_does_not_remove_it():
    def err(maps):
        return [np.where(maps[0] == 2, 9, maps[0]).astype(np.uint8), *maps[1:]]

    found = carving(err)
    x, size, barred = cells_of(found)
    inside = (x[:, :2].abs() < 0.4).all(-1) & (x[:, 2] > 0) & (x[:, 2] < 1.8)
    assert inside.sum() > 20 and not barred[inside].any()


def test_matter_with_points_of_its_own_stays_though_half_of_the_views_take_it_for_ground():
    def err(maps):
        return [*maps[:6], *(np.where(m == 2, 9, m).astype(np.uint8) for m in maps[6:])]

    found = carving(err)
    x, size, barred = cells_of(found)
    high = (x[:, 2] > size) & (x[:, 2] < 1.8)
    side = high & ((x[:, 0] - 0.5).abs() < size / 2) & (x[:, 1].abs() < 0.4)
    away = high & (x[:, 0] < 0) & in_matter(x)
    assert side.sum() > 5 and not barred[side].any(), "points lie on this side"
    assert barred[away].any(), "and none here"


def test_samples_far_from_the_ground_are_told_and_where_they_should_be():
    found = carving()
    o = torch.tensor([4.0, 0.0, 1.5]).expand(4, 3)
    foot = torch.tensor([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    way = (foot - o).norm(dim=-1)
    d = (foot - o) / way[:, None]
    t = way * torch.tensor([0.7, 1.0, 1.2, 1.0])  # above, on and under the ground; on the tower
    x = o + t[:, None] * d
    far, goal = found.far_from_ground(found.field.to_grid(x), d, t / found.field.unit, 0.0)
    assert far.tolist() == [0, 2]
    assert torch.allclose(goal * found.field.unit, way[[0, 2]], atol=0.15)


def test_a_margin_spares_what_is_beside_the_tower():
    found = carving()
    o = torch.tensor([4.0, 0.0, 1.5]).expand(60, 3)
    beside = torch.tensor([0.0, 0.0, 1.0]) + torch.linspace(0.55, 2.5, 60)[:, None] * torch.tensor(
        [0.0, 1.0, 0.0]
    )
    beside[:, 2] = 0.9
    t = (beside - o).norm(dim=-1)
    d = (beside - o) / t[:, None]
    asked = found.field.to_grid(beside), d, t / found.field.unit
    near, _ = found.far_from_ground(*asked, 0.0)
    wide, _ = found.far_from_ground(*asked, 0.5 / found.field.unit)
    assert 0 < len(wide) < len(near)
    assert beside[wide[0], 1] - beside[near[0], 1] > 0.2


def test_a_label_is_looked_up_where_a_ray_goes_through_the_picture():
    found = carving()
    pixels = found.pixels
    batch = pixels.draw(500, torch.Generator().manual_seed(0))
    assert torch.equal(pixels.label_towards(batch.image, batch.rays_d), batch.label)
    behind = pixels.label_towards(batch.image, -batch.rays_d)
    assert (behind == 255).all()
