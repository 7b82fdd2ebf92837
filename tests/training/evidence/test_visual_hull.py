"""Visual hull from labels: carved space, protected matter, and minimum votes."""

import numpy as np
import torch
from support.tower import CAMERA, in_matter, labels, poses

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, SKY, UNKNOWN
from climatenerf.ops import visual_hull_reference
from climatenerf.training.evidence import visual_hull
from climatenerf.training.evidence.visual_hull import VisualHull, border_distance


def sky_hull(count=12, change=None):
    c2w = poses(count)
    maps = [labels(CAMERA, pose) for pose in c2w]
    return VisualHull([CAMERA] * count, c2w, change(maps) if change else maps, [SKY], 0.1)


def positions(n=4000, seed=0):
    uniform = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))
    return (uniform - torch.tensor([0.5, 0.5, 0.1])) * torch.tensor([8.0, 8.0, 5.0])


def test_air_beside_the_tower_is_carved_and_matter_is_kept():
    x = positions()
    carved = sky_hull().consensus(x, torch.full((len(x),), 0.1))
    assert not (carved & in_matter(x, 0.1)).any()
    beside = (x[:, :2].norm(dim=-1) > 1.0) & (x[:, :2].norm(dim=-1) < 2.5)
    beside &= (x[:, 2] > 1.3) & (x[:, 2] < 2.0)
    assert carved[beside].float().mean() > 0.8, carved[beside].float().mean()


def test_larger_balls_are_carved_less():
    x, hull = positions(), sky_hull()
    fractions = [
        hull.consensus(x, torch.full((len(x),), r)).float().mean() for r in (0.0, 0.2, 0.8)
    ]
    assert fractions[0] > fractions[1] > fractions[2]


def test_one_vote_carves_nothing():
    """All other views show matter everywhere, or have no labels."""
    x = positions()
    for other in (BUILDING, UNKNOWN):
        alone = sky_hull(
            change=lambda maps, o=other: [maps[0]] + [np.full_like(m, o) for m in maps[1:]]
        )
        assert not alone.consensus(x, torch.zeros(len(x))).any()


def test_one_wrong_view_carves_no_matter():
    def err(maps):
        return [np.full_like(maps[0], SKY), *maps[1:]]

    x = positions()
    x = x[in_matter(x, -0.1)]
    assert len(x) > 100
    assert not sky_hull(12, err).consensus(x, torch.zeros(len(x))).any()


def test_votes_closer_than_the_minimum_baseline_count_once():
    """Two wrong views side by side, as in a video, against two that are far apart."""

    def err(maps, wrong):
        return [np.full_like(m, SKY) if i in wrong else m for i, m in enumerate(maps)]

    x = torch.tensor([[0.0, 0.0, 1.0]])
    c2w = poses(12)
    c2w[1, :3, 3] = c2w[0, :3, 3] + [0.0, 0.2, 0.0]
    maps = [labels(CAMERA, pose) for pose in c2w]
    close = VisualHull([CAMERA] * 12, c2w, err(maps, {0, 1}), [SKY], 0.1)
    far = VisualHull([CAMERA] * 12, c2w, err(maps, {0, 6}), [SKY], 0.1)
    assert not close.consensus(x, torch.zeros(1)).any()
    assert far.consensus(x, torch.zeros(1)).any()


def test_consensus_requires_a_minimum_fraction_of_votes():
    """Two wrong views of 30 are less than a tenth; two of 12 are more."""

    def err(maps):
        return [np.full_like(maps[0], SKY)] * 2 + maps[2:]

    x = torch.tensor([[0.0, 0.0, 1.0]])
    assert not sky_hull(30, err).consensus(x, torch.zeros(1)).any()
    assert sky_hull(12, err).consensus(x, torch.zeros(1)).any()


def test_border_distance_counts_pixels_from_the_border_of_the_mask():
    label = np.full((20, 30), BUILDING, np.uint8)
    label[3:12, 5:20] = SKY
    camera = Camera(30, 20, 25.0, 25.0, 15.0, 10.0)
    depth, intrinsics = border_distance(camera, label == SKY)
    assert intrinsics == (25.0, 25.0, 15.0, 10.0)
    assert depth[3, 10] == 1 and depth[7, 12] == 5 and depth[2, 10] == 0
    assert depth.max() == 5


def test_thin_wires_survive_downsampling(monkeypatch):
    """A wire of one pixel lies between the samples of the small map."""
    monkeypatch.setattr(visual_hull, "MAX_MAP_WIDTH", 40)
    label = np.full((90, 120), SKY, np.uint8)
    label[:, 61] = BUILDING
    depth, _ = border_distance(Camera(120, 90, 100.0, 100.0, 60.0, 45.0), label == SKY)
    assert (depth[5:-5, 20] == 0).all()
    assert (depth[15, 8:14] > 0).all()


def test_lens_distortion_is_undone():
    distorted = Camera(80, 60, 60.0, 60.0, 40.0, 30.0, k1=-0.15)
    c2w = poses(12)
    hull = VisualHull([distorted] * 12, c2w, [labels(distorted, pose) for pose in c2w], [SKY], 0.1)
    x = positions()
    carved = hull.consensus(x, torch.full((len(x),), 0.1))
    assert carved.any() and not (carved & in_matter(x, 0.1)).any()


def test_kernel_matches_the_reference():
    c2w = poses(12)
    wide = Camera(100, 40, 60.0, 55.0, 52.0, 19.0)  # views may differ in size
    cameras = [CAMERA, wide] * 6
    hull = VisualHull(
        cameras, c2w, [labels(*each) for each in zip(cameras, c2w, strict=True)], [SKY], 0.1
    )
    x, radius = positions(), 0.3 * torch.rand(4000, generator=torch.Generator().manual_seed(1))
    row, starts, sizes, *views = hull.views
    distances = [
        row[start : start + h * w].view(h, w).float()
        for start, (h, w) in zip(starts.tolist(), sizes.tolist(), strict=True)
    ]
    needed = (visual_hull.MIN_VOTES, hull.min_fraction, hull.min_baseline)
    expected = visual_hull_reference.label_votes(x, radius, distances, *views, needed)
    ours = hull.consensus(x, radius)
    # Rounding can move a projection on a pixel's border into the neighbouring pixel.
    assert (ours == expected).float().mean() > 0.999
    assert 0.1 < expected.float().mean() < 0.9
