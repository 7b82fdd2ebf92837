"""Sky prior: observed cells, diffusion into the gaps, and captures without a visible sky."""

import numpy as np
import pytest
import torch

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import MERGED, SKY
from climatenerf.core.colour import decode_srgb
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence import sky_prior
from climatenerf.training.evidence.sky_prior import (
    COLUMNS,
    MIN_SINE,
    ROWS,
    SkyPrior,
    diffuse,
    direction,
    fit_sky_prior,
)

SKY_ID = 10


def upward(turn):
    """Pose whose axis has an elevation of 30 degrees and the azimuth `turn` (radians)."""
    flat = np.array([np.cos(turn), np.sin(turn), 0.0])
    forward = np.cos(np.pi / 6) * flat + np.array([0, 0, np.sin(np.pi / 6)])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    return c2w


def pixels(colours, label=SKY_ID):
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0)
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    c2w = np.stack([upward(2 * np.pi * i / len(colours)) for i in range(len(colours))])
    labels = [np.full((30, 40), label, np.uint8) for _ in colours]
    return TrainingPixels([camera], [0] * len(colours), c2w, images, labels)


def test_directions_are_unit_and_uniform_over_solid_angle():
    at = torch.rand(20000, 2, generator=torch.Generator().manual_seed(0))
    d = direction(at[:, 0] * ROWS, at[:, 1] * COLUMNS)
    assert torch.allclose(d.norm(dim=-1), torch.ones(len(d)), atol=1e-5)
    assert d[:, 2].min() >= MIN_SINE - 1e-6
    # Archimedes: the heights of uniform directions are uniform.
    assert d[:, 2].mean() == pytest.approx((1 + MIN_SINE) / 2, abs=0.01)
    assert d[:, :2].mean(0).abs().max() < 0.02


def test_seen_cells_are_kept_and_gaps_are_interpolated():
    prior = fit_sky_prior(pixels([60, 200]), torch.Generator().manual_seed(0))
    dark, bright = (float(decode_srgb(torch.tensor(v / 255))) for v in (60, 200))
    seen = prior.colour[~prior.unseen]
    assert 0.02 < (~prior.unseen).float().mean() < 0.6
    assert torch.isin(seen.mul(1e4).round(), torch.tensor([dark, bright]).mul(1e4).round()).all()
    gaps = prior.colour[prior.unseen]
    assert gaps.min() >= dark - 1e-5 and gaps.max() <= bright + 1e-5
    assert gaps.std() > 0.01  # darker towards the dark side
    zenith = prior.colour[-1]
    assert zenith.std() < 0.25 * (bright - dark)


def test_drawn_directions_have_the_radiance_of_their_cell():
    colour = torch.rand(ROWS, COLUMNS, 3)
    unseen = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    unseen[3:6, 10:20] = True
    d, drawn, which = SkyPrior(colour, unseen).draw(20000, torch.Generator().manual_seed(0))
    d, drawn = d[which], drawn[which]
    assert 0.5 < len(d) / (20000 * unseen.float().mean()) < 1.5
    row = ((d[:, 2] - MIN_SINE) / (1 - MIN_SINE) * ROWS).long()
    assert ((row >= 3) & (row < 6)).all()
    assert (drawn[:, None] - colour[3:6, 10:20].reshape(-1, 3)).abs().sum(-1).min(1)[0].max() == 0


def test_without_sky_labels_all_pixels_above_the_horizon_count():
    assert MERGED[0] != MERGED[SKY_ID]
    prior = fit_sky_prior(pixels([100, 100], label=0), torch.Generator())
    grey = float(decode_srgb(torch.tensor(100 / 255)))
    assert prior.colour.numpy() == pytest.approx(grey, abs=1e-5)
    assert 0.3 < prior.unseen.float().mean() < 0.98


def test_with_sky_labels_other_pixels_above_the_horizon_are_ignored():
    sky_and_house = [60, 200]
    labelled = pixels(sky_and_house)
    labelled.label[labelled.pixel_start[1] : labelled.pixel_start[2]] = MERGED[2]
    prior = fit_sky_prior(labelled, torch.Generator().manual_seed(0))
    dark = float(decode_srgb(torch.tensor(60 / 255)))
    assert prior.colour.numpy() == pytest.approx(dark, abs=1e-5)


@pytest.mark.parametrize(("shown", "bright"), [(100, False), (230, True)])
def test_photos_looking_down_give_a_uniform_sky_that_lights_their_ground(shown, bright):
    """Lambertian ground of albedo 0.2 has a fifth of the sky's radiance, at most white's."""
    low = pixels([(shown, shown // 2, shown // 4)] * 2, label=0)
    low.c2w[:, 2] *= -1  # mirrored: the axes point 30 degrees below the horizon
    low.c2w[:, :3, 3] = 0
    batch = low.draw(1000, torch.Generator().manual_seed(0))
    assert batch.rays_d[:, 2].max() < MIN_SINE
    prior = fit_sky_prior(low, torch.Generator())
    r, g, b = (float(decode_srgb(torch.tensor(v / 255))) for v in (shown, shown // 2, shown // 4))
    radiance = (0.2126 * r + 0.7152 * g + 0.0722 * b) / 0.2
    assert prior.unseen.all() and (radiance > 1) == bright
    assert torch.allclose(prior.colour, torch.full((ROWS, COLUMNS, 3), min(radiance, 1.0)))


def test_too_few_sky_labels_are_ignored(monkeypatch):
    """A lamp that a network labels as sky, in a room with grey walls."""
    monkeypatch.setattr(sky_prior, "MAX_PIXELS", 600)  # a quarter of the pixels
    room = pixels([100, 100], label=0)
    room.label[:2] = SKY
    assert room.knows_sky
    prior = fit_sky_prior(room, torch.Generator().manual_seed(0))
    wall = float(decode_srgb(torch.tensor(100 / 255)))
    assert prior.colour.numpy() == pytest.approx(wall, abs=1e-5) and not prior.unseen.all()


def test_diffusion_keeps_a_uniform_sky():
    seen = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    seen[4, 7] = True
    observed = torch.full((ROWS, COLUMNS, 3), 0.3) * seen[..., None]
    assert torch.allclose(diffuse(observed, seen), torch.full((ROWS, COLUMNS, 3), 0.3), atol=1e-5)
