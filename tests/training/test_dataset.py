"""Pixels of all photos in one array: in memory or, beyond a limit, in a file."""

import numpy as np
import pytest
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import UNKNOWN
from climatenerf.core.errors import UserError
from climatenerf.training import dataset as module
from climatenerf.training.dataset import TrainingPixels, in_one_row

CAMERAS = [Camera(20, 14, 20.0, 20.0, 10.0, 7.0), Camera(14, 20, 20.0, 20.0, 7.0, 10.0)]


def made() -> TrainingPixels:
    """Four pictures of two cameras, partly without labels, masks and depths."""
    rng = np.random.default_rng(0)
    camera_of = [0, 1, 0, 1]
    shapes = [(CAMERAS[i].height, CAMERAS[i].width) for i in camera_of]
    images = (rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in shapes)
    labels = [None, *(np.full(shape, 8, np.uint8) for shape in shapes[1:])]
    masks = [np.arange(20 * 14).reshape(shapes[0]) % 3 > 0, None, None, None]
    relative = [None, None, np.linspace(1, 2, 20 * 14, dtype=np.float32).reshape(shapes[2]), None]
    poses = np.stack([np.eye(4)] * 4)
    return TrainingPixels(CAMERAS, camera_of, poses, images, labels, masks, relative)


def test_draws_from_memory_and_from_a_file_are_equal(monkeypatch):
    inside = made()
    monkeypatch.setattr(module, "MAX_IN_MEMORY", 100)
    outside = made()
    row, parts = in_one_row([(2, 3), (30, 40)], [None, np.ones((30, 40), np.uint8)], np.uint8, 7)
    assert isinstance(row, np.memmap) and (row[:6] == 7).all() and (row[6:] == 1).all()
    assert np.shares_memory(row, parts[1])
    a, b = (each.draw(400, torch.Generator().manual_seed(0), 60) for each in (inside, outside))
    for name in ("rgb", "label", "in_line", "image"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert a.relative is not None and b.relative is not None
    assert torch.equal(a.relative.nan_to_num(-1), b.relative.nan_to_num(-1))


def test_missing_labels_masks_and_depths_are_unknown_in_their_image_only():
    pixels = made()
    assert pixels.label is not None and pixels.relative is not None and pixels.usable is not None
    n = 20 * 14
    assert (pixels.label[:n] == UNKNOWN).all() and (pixels.label[n:] != UNKNOWN).all()
    known = torch.isfinite(pixels.relative.float())
    assert known[2 * n : 3 * n].all() and known.sum() == n
    assert pixels.usable[n:].all() and pixels.usable_fraction == pytest.approx(1 - 94 / (4 * n))


def test_classes_are_counted_in_chunks(monkeypatch):
    pixels = made()
    assert pixels.label is not None
    pixels.label[5], pixels.label[700] = 3, 4
    monkeypatch.setattr(module, "MAX_DRAWN", 100)
    assert torch.equal(pixels.classes(), pixels.label.unique()) and pixels.classes().numel() == 4
    pixels.label = None
    assert pixels.classes().numel() == 0


def test_a_full_temporary_folder_is_a_user_error(monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "MAX_IN_MEMORY", 100)
    monkeypatch.setattr(module.tempfile, "TemporaryFile", full)
    with pytest.raises(UserError, match=r"No space left.*TMPDIR"):
        made()


@pytest.mark.parametrize("count", [1, 3])
def test_the_number_of_pictures_must_equal_that_of_cameras(count):
    images = [np.zeros((14, 20, 3), np.uint8)] * count
    with pytest.raises(ValueError, match=f"{count} pictures for 2 cameras"):
        TrainingPixels(CAMERAS, [0, 0], np.stack([np.eye(4)] * 2), images)


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(ValueError, match="size differs"):
        TrainingPixels(CAMERAS, [0], np.eye(4)[None], [np.zeros((20, 14, 3), np.uint8)])


def test_masked_sky_labels_force_no_cell_empty():
    """A masked thumb or mirror can be labelled as sky."""
    poses = np.stack([np.eye(4)] * 6)
    poses[:, 0, 3] = np.arange(6)  # m, side by side, with parallel axes
    images = [np.zeros((14, 20, 3), np.uint8)] * 6
    labels = [np.full((14, 20), 10, np.uint8)] * 6  # sky in each view
    masks = [np.ones((14, 20), bool) for _ in range(6)]
    for mask in masks:
        mask[:, :12] = False
    x, radius = torch.tensor([[2.5, -1.0, 40.0]]), torch.tensor([0.01])
    for given, forced in ((None, True), (masks, False)):
        pixels = TrainingPixels(CAMERAS, [0] * 6, poses, images, labels, given)
        assert pixels.sky_hull is not None and pixels.label is not None
        assert bool(pixels.sky_hull.consensus(x, radius)) == forced
        assert (pixels.label == UNKNOWN).any() == (not forced)


def test_colours_nearby_are_the_minimum_and_maximum_of_a_window():
    """Compare with filters of whole pictures; windows end at the border of a photo."""
    pixels = made()
    start = pixels.pixel_start.tolist()
    batch = pixels.draw(3000, torch.Generator().manual_seed(0))
    low, high = pixels.colours_nearby(batch.image, batch.xy)
    for i, camera in enumerate(pixels.cameras):
        rgb = pixels.rgb[start[i] : start[i + 1]].numpy().reshape(camera.height, camera.width, 3)
        rows = batch.image == i
        x, y = (batch.xy[rows].numpy() * (camera.width, camera.height)).astype(int).T
        side = 2 * module.NEARBY + 1
        for found, filtered in ((low, minimum_filter), (high, maximum_filter)):
            expected = filtered(rgb, (side, side, 1), mode="nearest")[y, x] / 255
            assert np.allclose(found[rows].numpy(), expected, atol=1e-6)
