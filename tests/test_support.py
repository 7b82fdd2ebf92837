"""The helpers of other tests: shape checks and the statistical comparison of pictures."""

import jaxtyping
import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from PIL import Image
from support.images import assert_images_match

from climatenerf.core.samples import Samples
from climatenerf.evaluation.metrics import psnr
from climatenerf.ops import reference

needs_checks = pytest.mark.skipif(
    jaxtyping.config.jaxtyping_disable, reason="the shape checks are switched off"
)


@needs_checks
def test_calls_with_wrong_shapes_or_types_raise():
    u = torch.rand(5, 3)
    assert reference.contract(u).shape == (5, 3)
    with pytest.raises(TypeCheckError, match="'q'"):
        reference.contract(torch.rand(5, 2))
    with pytest.raises(TypeCheckError, match="'resolutions'"):
        reference.hash_encode(u, torch.rand(2, 8, 2), torch.tensor([4, 8, 16]))
    with pytest.raises(TypeCheckError, match="'offsets'"):
        reference.render_weights(torch.rand(4), torch.tensor([0.0, 4.0]))
    with pytest.raises(TypeCheckError, match="'photo'"):
        psnr(np.zeros((4, 5, 3)), np.zeros((4, 6, 3)))


@needs_checks
def test_dataclasses_check_their_fields():
    one = torch.ones(4)
    assert len(Samples(torch.tensor([0, 4]), one, one, one).t) == 4
    with pytest.raises(TypeCheckError, match="'sigma'"):
        Samples(torch.tensor([0, 4]), one, one, torch.ones(3))


@pytest.fixture(scope="module")
def pictures():
    """A smooth picture, and the same with independent noise of deviation 0.1 per value."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:60, :90] / 90.0
    clean = np.stack([0.3 + 0.4 * x, 0.5 + 0.2 * np.sin(9 * y), 0.4 + 0.2 * x * y], -1)
    return clean, [clean + 0.1 * rng.normal(size=clean.shape) for _ in range(20)]


def test_noise_alone_matches(pictures, tmp_path):
    clean, noisy = pictures
    for each in noisy:
        assert_images_match(each, clean, tmp_path / "failure")
    assert_images_match(clean, clean, tmp_path / "failure")
    assert not (tmp_path / "failure").exists()


def test_a_bias_far_below_the_noise_of_a_pixel_fails(pictures, tmp_path):
    clean, noisy = pictures
    folder = tmp_path / "failure"
    for each in noisy:
        with pytest.raises(AssertionError, match=f"mean difference.*{folder}"):
            assert_images_match(each + [0.0, 0.012, 0.0], clean, folder)
        assert_images_match(each + [0.0, 0.012, 0.0], clean, folder, tolerance=0.012)
    assert sorted(path.name for path in folder.iterdir()) == [
        "difference.png",
        "image.png",
        "reference.png",
    ]
    with Image.open(folder / "reference.png") as written:
        assert np.abs(np.asarray(written) / 255.0 - clean).max() < 0.003
    with Image.open(folder / "difference.png") as written:
        difference = np.asarray(written) / 255.0
    assert 0.5 < difference[..., 1].mean() < 0.6 and difference.max() == 1.0


def test_a_local_defect_fails_and_can_be_masked(pictures, tmp_path):
    clean, noisy = pictures
    defect = noisy[0].copy()
    defect[32:40, 48:56] -= 0.2
    # Opposite values elsewhere leave the mean as it was.
    defect[8:16, 8:16] += 0.2
    with pytest.raises(AssertionError, match="largest mean difference of a block 0.2"):
        assert_images_match(defect, clean, tmp_path)
    mask = np.ones(clean.shape[:2], bool)
    mask[32:40, 48:56] = mask[8:16, 8:16] = False
    assert_images_match(defect, clean, tmp_path, mask=mask)


def test_wrong_input_of_the_comparison_is_refused(pictures, tmp_path):
    clean, noisy = pictures
    with pytest.raises(ValueError, match="shape"):
        assert_images_match(clean[:-1], clean, tmp_path)
    with pytest.raises(ValueError, match="blocks"):
        assert_images_match(noisy[0], clean, tmp_path, block=60)
    with pytest.raises(AssertionError, match="mean difference"):
        assert_images_match(np.full_like(clean, np.nan), clean, tmp_path)
    white = (255 * np.ones(clean.shape)).astype(np.uint8)
    assert_images_match(white, np.ones(clean.shape), tmp_path)
