"""The views' sky carves the scene: what it empties, what it must not, and on how many words."""

import numpy as np
import torch

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, SKY, UNKNOWN
from climatenerf.ops import reference
from climatenerf.training.evidence import visual_hull as witness
from climatenerf.training.evidence.visual_hull import VisualHull, depth_within

CAMERA = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)
TOWER = (np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 2.0]))
GROUND = 0.0


def poses(count, distance=6.0, height=1.0):
    """Level cameras on a circle, looking at the tower."""
    found = []
    for i in range(count):
        turn = 2 * np.pi * i / count
        eye = np.array([distance * np.cos(turn), distance * np.sin(turn), height])
        forward = np.array([0.0, 0.0, height]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
        found.append(c2w)
    return np.stack(found)


def labels(camera, c2w):
    """True labels: the tower, the ground, and sky elsewhere."""
    d = camera.directions() @ c2w[:3, :3].T
    eye = c2w[:3, 3]
    with np.errstate(divide="ignore"):
        near = np.minimum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).max(-1)
        far = np.maximum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).min(-1)
    solid = ((near < far) & (far > 0)) | (d[..., 2] < 0)
    return np.where(solid, BUILDING, SKY).astype(np.uint8)


def asking(count=12, change=None):
    c2w = poses(count)
    maps = [labels(CAMERA, pose) for pose in c2w]
    return VisualHull([CAMERA] * count, c2w, change(maps) if change else maps, [SKY], 0.1)


def places(n=4000, seed=0):
    spread = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))
    return (spread - torch.tensor([0.5, 0.5, 0.1])) * torch.tensor([8.0, 8.0, 5.0])


def in_matter(x, margin=0.0):
    low, high = (torch.tensor(each).float() for each in TOWER)
    inside = ((x > low - margin) & (x < high + margin)).all(-1)
    return inside | (x[:, 2] < GROUND + margin)


def test_the_tower_and_the_ground_stay_and_the_air_beside_them_goes():
    x = places()
    agreed = asking().consensus(x, torch.full((len(x),), 0.1))
    assert not (agreed & in_matter(x, 0.1)).any()
    beside = (x[:, :2].norm(dim=-1) > 1.0) & (x[:, :2].norm(dim=-1) < 2.5)
    beside &= (x[:, 2] > 1.3) & (x[:, 2] < 2.0)
    assert agreed[beside].float().mean() > 0.8, agreed[beside].float().mean()


def test_larger_footprints_are_emptied_less():
    x, one = places(), asking()
    shares = [one.consensus(x, torch.full((len(x),), r)).float().mean() for r in (0.0, 0.2, 0.8)]
    assert shares[0] > shares[1] > shares[2]


def test_one_view_alone_empties_nothing():
    """All others have no word: they show matter everywhere, or no labels at all."""
    x = places()
    for other in (BUILDING, UNKNOWN):
        alone = asking(
            change=lambda maps, o=other: [maps[0]] + [np.full_like(m, o) for m in maps[1:]]
        )
        assert not alone.consensus(x, torch.zeros(len(x))).any()


def test_a_wrong_label_in_one_view_of_many_removes_no_matter():
    def err(maps):
        return [np.full_like(maps[0], SKY), *maps[1:]]

    x = places()
    x = x[in_matter(x, -0.1)]
    assert len(x) > 100
    assert not asking(12, err).consensus(x, torch.zeros(len(x))).any()


def test_neighbouring_frames_have_one_voice():
    """Two wrong views side by side, as a network errs on a film, against two that are far apart."""

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


def test_few_voices_among_many_watchers_are_not_enough(monkeypatch):
    """Two wrong views of 30 are below a tenth; of 12 they would be above it."""

    def err(maps):
        return [np.full_like(maps[0], SKY)] * 2 + maps[2:]

    x = torch.tensor([[0.0, 0.0, 1.0]])
    assert not asking(30, err).consensus(x, torch.zeros(1)).any()
    assert asking(12, err).consensus(x, torch.zeros(1)).any()


def test_depth_within_the_sky_counts_pixels_from_its_edge():
    label = np.full((20, 30), BUILDING, np.uint8)
    label[3:12, 5:20] = SKY
    camera = Camera(30, 20, 25.0, 25.0, 15.0, 10.0)
    depth, intrinsics = depth_within(camera, label == SKY)
    assert intrinsics == (25.0, 25.0, 15.0, 10.0)
    assert depth[3, 10] == 1 and depth[7, 12] == 5 and depth[2, 10] == 0
    assert depth.max() == 5


def test_a_thin_wire_in_a_large_photo_is_not_lost(monkeypatch):
    """One pixel wide, it would fall between the pixels of the small map."""
    monkeypatch.setattr(witness, "WIDEST", 40)
    label = np.full((90, 120), SKY, np.uint8)
    label[:, 61] = BUILDING
    depth, _ = depth_within(Camera(120, 90, 100.0, 100.0, 60.0, 45.0), label == SKY)
    assert (depth[5:-5, 20] == 0).all()
    assert (depth[15, 8:14] > 0).all()


def test_a_distorted_camera_is_asked_at_the_right_pixel():
    bent = Camera(80, 60, 60.0, 60.0, 40.0, 30.0, k1=-0.15)
    c2w = poses(12)
    one = VisualHull([bent] * 12, c2w, [labels(bent, pose) for pose in c2w], [SKY], 0.1)
    x = places()
    agreed = one.consensus(x, torch.full((len(x),), 0.1))
    assert agreed.any() and not (agreed & in_matter(x, 0.1)).any()


def test_the_kernel_matches_its_twin():
    c2w = poses(12)
    wide = Camera(100, 40, 60.0, 55.0, 52.0, 19.0)  # views need not be of one size
    cameras = [CAMERA, wide] * 6
    found = VisualHull(
        cameras, c2w, [labels(*each) for each in zip(cameras, c2w, strict=True)], [SKY], 0.1
    )
    x, radius = places(), 0.3 * torch.rand(4000, generator=torch.Generator().manual_seed(1))
    row, starts, sizes, *views = found.views
    reach = [
        row[start : start + h * w].view(h, w).float()
        for start, (h, w) in zip(starts.tolist(), sizes.tolist(), strict=True)
    ]
    least = (witness.MIN_VOICES, found.share, found.apart)
    real = reference.label_votes(x, radius, reach, *views, least)
    ours = found.consensus(x, radius)
    # Rounding may put a place that lies on a pixel's border into its neighbour.
    assert (ours == real).float().mean() > 0.999
    assert 0.1 < real.float().mean() < 0.9
