"""Heights of ground by a sweep, against a textured slope and a slow twin."""

import numpy as np
import pytest

from climatenerf.core.cameras import Camera
from climatenerf.ops.cpu.ground_sweep import LEVELS, SAMPLES, sweep_heights
from climatenerf.scene.terrain import HeightRaster
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.ground_sweep import ground_pictures, sweep_patches

CAMERA = Camera(width=320, height=240, fx=280.0, fy=280.0, cx=160.0, cy=120.0)
SLOPE = np.array([0.05, -0.03])
TERRAIN, BUILDING = 9, 2  # Cityscapes train ids


def ground(x, y):
    return SLOPE[0] * x + SLOPE[1] * y + 0.2


def texture(x, y):
    """Soft spots of a metre, grains of a decimetre and a ramp of light, 8-bit levels about 100."""
    spots = np.sin(5.1 * x + 1.3 * np.sin(2.0 * y)) * np.cos(4.3 * y - 0.7 * x)
    grains = np.sin(23.0 * x + 2.0 * np.sin(7.0 * y)) * np.sin(19.0 * y)
    return 100 + 12 * spots + 8 * grains + 2.0 * x


def poses():
    """Eight cameras 1.6 m above the ground, looking 25 degrees down along +x."""
    found = []
    pitch = np.radians(25.0)
    forward = np.array([np.cos(pitch), 0.0, -np.sin(pitch)])
    right = np.array([0.0, -1.0, 0.0])
    for k in range(8):
        pose = np.eye(4)
        x, y = -4.0 - 0.7 * k, 0.8 * (k % 3 - 1)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
        pose[:3, 3] = x, y, ground(x, y) + 1.6
        found.append(pose)
    return np.stack(found)


def photo(pose, noise, random):
    d = CAMERA.directions() @ pose[:3, :3].T
    normal = np.array([-SLOPE[0], -SLOPE[1], 1.0])
    eye = pose[:3, 3]
    t = (0.2 - eye @ normal) / np.minimum(d @ normal, -1e-3)
    x = eye + t[..., None] * d
    grey = texture(x[..., 0], x[..., 1]) + noise * random.normal(size=t.shape)
    return np.repeat(np.clip(np.rint(grey), 1, 255)[..., None], 3, -1).astype(np.uint8)


def pixels_of(noise=0.0, label=TERRAIN):
    random = np.random.default_rng(0)
    c2w = poses()
    photos = [photo(pose, noise, random) for pose in c2w]
    labels = [np.full((CAMERA.height, CAMERA.width), label, np.uint8) for _ in c2w]
    return TrainingPixels([CAMERA], [0] * 8, c2w, photos, labels)


def expected(off, error):
    """A raster ahead of the cameras whose heights are off by so much, m."""
    cell = 0.25
    x, y = np.meshgrid(np.arange(0, 4, cell), np.arange(-1.5, 1.5, cell))
    height = (ground(x, y) + off).astype(np.float32)
    return HeightRaster((0.0, -1.5), cell, height, np.full_like(height, error))


@pytest.mark.parametrize("noise", [0.0, 4.0])
@pytest.mark.parametrize("off", [0.0, 0.12, -0.12])
def test_heights_are_found_within_centimetres(noise, off):
    pictures = ground_pictures(pixels_of(noise))
    assert pictures is not None
    found = sweep_patches(pictures, expected(off, 0.1), side=1.0)
    assert len(found.x) > 8
    wrong = np.abs(found.x[:, 2] - ground(*found.x[:, :2].T))
    assert np.median(wrong) < 0.015 + 0.003 * noise and wrong.max() < 0.1 + 0.03 * noise
    assert (wrong < 3 * found.error).mean() > 0.9


def test_only_pixels_labelled_ground_count():
    pictures = ground_pictures(pixels_of(label=BUILDING))
    assert pictures is not None and not pictures.ground.any()
    assert len(sweep_patches(pictures, expected(0.0, 0.1), side=1.0).x) == 0


def test_ground_without_texture_gives_no_heights():
    """A ramp of light agrees at every height."""
    known = pixels_of()
    columns = np.linspace(90, 110, CAMERA.width)
    flat = np.repeat(np.broadcast_to(columns, (240, 320))[..., None], 3, -1).astype(np.uint8)
    labels = [np.full((CAMERA.height, CAMERA.width), TERRAIN, np.uint8)] * 8
    pixels = TrainingPixels([CAMERA], [0] * 8, poses(), [flat] * 8, labels)
    pictures, textured = ground_pictures(pixels), ground_pictures(known)
    assert pictures is not None and textured is not None
    plain = sweep_patches(pictures, expected(0.0, 0.1), side=1.0)
    assert len(plain.x) < 0.2 * len(sweep_patches(textured, expected(0.0, 0.1), side=1.0).x)


def test_levels_halve_the_pictures():
    pictures = ground_pictures(pixels_of(4.0))
    assert pictures is not None and pictures.start.shape == (8, LEVELS)

    def level(v, k):
        width, height = pictures.size[v, k]
        start = pictures.start[v, k]
        return pictures.grey[start : start + width * height].reshape(height, width).astype(float)

    for k in range(LEVELS - 1):
        full = level(3, k)
        means = full.reshape(full.shape[0] // 2, 2, full.shape[1] // 2, 2).mean((1, 3))
        assert np.abs(level(3, k + 1) - means).max() <= 1.0


def slow_agreement(photos, c2w, centre, z, half):
    """The mean correlation over all pairs of photos, of patches without mean and ramps."""
    line = np.linspace(-half, half, SAMPLES)
    a, b = np.meshgrid(line, line, indexing="ij")
    x = np.stack([centre[0] + a, centre[1] + b, z + SLOPE[0] * a + SLOPE[1] * b], -1)
    basis = np.linalg.qr(np.stack([np.ones(a.size), a.ravel(), b.ravel()], -1))[0]
    units = []
    for grey, pose in zip(photos, c2w, strict=True):
        local = (x.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
        pixel = CAMERA.project(local)
        i, j = np.floor(pixel - 0.5).astype(int).T
        u, w = (pixel - 0.5 - np.stack([i, j], -1)).T
        value = (1 - w) * ((1 - u) * grey[j, i] + u * grey[j, i + 1])
        value += w * ((1 - u) * grey[j + 1, i] + u * grey[j + 1, i + 1])
        value -= basis @ (basis.T @ value)
        units.append(value / np.linalg.norm(value))
    table = np.stack(units) @ np.stack(units).T
    return (table.sum() - len(units)) / (len(units) * (len(units) - 1))


def test_agreement_equals_the_slow_twin():
    """Patches so small that full-size pixels are used."""
    pixels = pixels_of()
    pictures = ground_pictures(pixels)
    assert pictures is not None
    greys = [
        pixels.rgb[a:b, 0].numpy().reshape(240, 320).astype(float)
        for a, b in zip(pixels.pixel_start[:-1], pixels.pixel_start[1:], strict=True)
    ]
    centre = np.array([[0.5, 0.1, ground(0.5, 0.1) + 0.02]])
    reach, steps, half = 0.1, 10, 0.1
    found = sweep_heights(pictures, centre, SLOPE[None], half, np.array([reach]), steps)[0]
    heights = centre[0, 2] + np.linspace(-reach, reach, 2 * steps + 1)
    slow = [slow_agreement(greys, poses(), centre[0], z, half) for z in heights]
    best = int(np.argmax(slow))
    assert found[1] == pytest.approx(slow[best], abs=1e-3)
    assert centre[0, 2] + found[0] == pytest.approx(heights[best], abs=reach / steps)
    apart = np.abs(np.arange(2 * steps + 1) - best) >= 3
    assert found[2] == pytest.approx(np.array(slow)[apart].max(), abs=1e-3)
