import numpy as np
import pytest
from scipy import ndimage
from support.shape_checks import unchecked

from climatenerf.evaluation.metrics import colour_corrected, psnr, psnr_cc, ssim


@pytest.fixture(scope="module")
def photo():
    rng = np.random.default_rng(3)
    return np.clip(ndimage.gaussian_filter(rng.random((40, 53, 3)), (3, 3, 0)) * 4 - 1.5, 0, 1)


def slow_ssim(a, b):
    """Compute SSIM (Wang et al. 2004) per channel with windows of scipy: a slow twin."""
    values = []
    for channel in range(a.shape[2]):
        x, y = a[..., channel], b[..., channel]

        def mean(image):
            # truncate 3.5 with sigma 1.5 is a radius of 5 pixels, an 11x11 window
            return ndimage.gaussian_filter(image, 1.5, truncate=3.5)[5:-5, 5:-5]

        mx, my = mean(x), mean(y)
        sxx, syy, sxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
        top = (2 * mx * my + 1e-4) * (2 * sxy + 9e-4)
        values.append((top / ((mx * mx + my * my + 1e-4) * (sxx + syy + 9e-4))).mean())
    return np.mean(values)


def test_psnr_of_known_errors(photo):
    assert psnr(photo, photo) == float("inf")
    grey = np.full((4, 5, 3), 0.5)
    assert psnr(grey, grey + 0.1) == pytest.approx(20.0)
    assert psnr(grey, grey + 0.01) == pytest.approx(40.0)
    bytes_ = np.full((4, 5, 3), 100, np.uint8)
    assert psnr(bytes_, bytes_ + np.uint8(51)) == pytest.approx(-20 * np.log10(0.2))


def test_torch_tensors_are_accepted(photo):
    import torch

    assert psnr(torch.tensor(photo), photo) == float("inf")


def test_ssim_equals_the_slow_twin(photo):
    rng = np.random.default_rng(0)
    for noise in (0.02, 0.2):
        other = np.clip(photo + noise * rng.normal(size=photo.shape), 0, 1)
        assert ssim(other, photo) == pytest.approx(slow_ssim(other, photo), abs=1e-10)
    assert ssim(photo, photo) == pytest.approx(1.0, abs=1e-12)
    # A constant against a constant: only the luminance term remains.
    a, b = np.full((12, 12, 1), 0.2), np.full((12, 12, 1), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4), abs=1e-9)
    assert ssim(1 - photo, photo) < 0.3


def test_colour_correction_inverts_affine_maps_but_keeps_noise(photo):
    rng = np.random.default_rng(1)
    matrix = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    tinted = photo @ matrix + rng.normal(size=3) * 0.1
    assert psnr(tinted, photo) < 30
    assert psnr_cc(tinted, photo) > 200
    noisy = photo + 0.05 * rng.normal(size=photo.shape)
    # Twelve parameters cannot fit the noise.
    assert psnr(noisy, photo) - 0.01 <= psnr_cc(noisy, photo) < psnr(noisy, photo) + 1.0
    corrected = colour_corrected(photo, np.clip(3 * photo, 0, 1))
    assert corrected.min() >= 0 and corrected.max() <= 1
    flat = np.full_like(photo, 0.5)
    assert np.allclose(colour_corrected(flat, photo), photo.mean((0, 1)))


def test_wrong_shapes_are_refused(photo):
    with unchecked(), pytest.raises(ValueError, match="shape"):
        psnr(photo, photo[:-1])
    with pytest.raises(ValueError, match="11 pixels"):
        ssim(photo[:8], photo[:8])
