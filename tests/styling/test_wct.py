"""Whitening and colouring: covariances, classes, the networks' layout, and damaged weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.wct_weights import save_wct

from climatenerf.core.classes import TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.scene.images import read_rgb
from climatenerf.styling.paper import wct

REAL = Path(__file__).resolve().parents[3] / "shared" / "weights" / "wct_vgg16x"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_wct(tmp_path_factory.mktemp("weights"))


def correlated(channels, count, seed):
    """Random features with a covariance that is no multiple of the identity."""
    generator = torch.Generator(device="cpu").manual_seed(seed)
    mixing = torch.randn(channels, channels, generator=generator)
    x = mixing @ torch.randn(channels, count, generator=generator)
    return x + torch.randn(channels, 1, generator=generator)


def noise(height, width, seed, low=0.0, high=1.0):
    random = np.random.default_rng(seed)
    return low + (high - low) * random.random((height, width, 3))


def everywhere(picture, kind=VEGETATION):
    return {kind: np.ones(picture.shape[:2], bool)}


def test_transferred_features_have_mean_and_covariance_of_the_style():
    theirs = correlated(8, 900, 1)
    new = wct.transferred(correlated(8, 700, 0), wct.moments(theirs))
    assert np.allclose(np.cov(new.numpy(), bias=True), np.cov(theirs.numpy(), bias=True), rtol=1e-3,
                       atol=1e-3)  # fmt: skip
    torch.testing.assert_close(new.mean(1), theirs.mean(1), rtol=1e-4, atol=1e-4)


def test_transfer_equals_one_by_singular_values():
    """The twin whitens with the singular vectors of the centred features."""
    ours, theirs = correlated(6, 500, 2).double(), correlated(6, 800, 3).double()
    mean = ours.mean(1, keepdim=True)
    u, s, _ = torch.linalg.svd(ours - mean, full_matrices=False)
    white = u @ torch.diag(500**0.5 / s) @ u.T @ (ours - mean)
    own = theirs.mean(1, keepdim=True)
    v, t, _ = torch.linalg.svd(theirs - own, full_matrices=False)
    twin = v @ torch.diag(t / 800**0.5) @ v.T @ white + own
    found = wct.transferred(ours, wct.moments(theirs))
    torch.testing.assert_close(found, twin, rtol=1e-6, atol=1e-6)


def test_features_of_their_own_style_stay_and_constant_ones_stay_finite():
    x = correlated(5, 400, 4)
    torch.testing.assert_close(wct.transferred(x, wct.moments(x)), x, rtol=1e-3, atol=1e-3)
    flat = torch.full((5, 400), 0.3)
    new = wct.transferred(flat, wct.moments(x))
    assert new.isfinite().all()
    torch.testing.assert_close(new.mean(1), x.mean(1), rtol=1e-3, atol=1e-3)


def test_moments_add_up():
    x = correlated(4, 300, 5)
    both = wct.moments(x[:, :100]) + wct.moments(x[:, 100:])
    torch.testing.assert_close(both.covariance, wct.moments(x).covariance)
    assert both.count == 300


def by_hand(picture, path, level):
    """The encoder as a chain of modules, padded, without the code under test."""
    model = torch.load(path, weights_only=True)["model"]
    x = torch.from_numpy(picture).float().permute(2, 0, 1)[None]
    x = torch.nn.functional.conv2d(x, model["conv0.weight"], model["conv0.bias"])
    for name in ("conv11", "conv12", "conv21", "conv22", "conv31"):
        if name in ("conv21", "conv31"):
            x = torch.nn.MaxPool2d(2)(x)
        x = torch.nn.ReflectionPad2d(1)(x)
        x = torch.nn.functional.conv2d(x, model[f"{name}.weight"], model[f"{name}.bias"]).relu()
        if name == f"conv{level}1":
            return x
    raise AssertionError(level)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_encoder_is_vgg_to_its_relu(folder, level):
    picture = noise(16, 20, 0)
    net = next(each for each in wct.load_autoencoders(folder) if each.level == level)
    x = torch.from_numpy(picture).float().permute(2, 0, 1)[None]
    found = wct.encoded(x, net)
    torch.testing.assert_close(found, by_hand(picture, folder / f"encoder{level}.pth", level))
    assert found.shape[-2:] == (16 // 2 ** (level - 1), 20 // 2 ** (level - 1))
    assert wct.decoded(found, net).shape == (1, 3, 16, 20)


def test_only_classes_with_a_style_change_and_odd_sizes_keep_their_size(folder):
    nets = wct.load_autoencoders(folder)
    picture, other = noise(41, 123, 1), noise(48, 64, 2, 0.4, 0.6)
    left = np.zeros((41, 123), bool)
    left[:, :30] = True
    masks = {VEGETATION: left, TERRAIN: ~left}
    style = wct.style_moments([(other, everywhere(other))], nets)
    none = tuple({} for _ in nets)
    plain = wct.stylised(picture, masks, none, nets)
    new = wct.stylised(picture, masks, style, nets)
    assert new.shape == picture.shape and np.isfinite(new).all()
    reach = 75  # columns: the networks see this far beyond the edge of a class
    assert np.abs(new - plain)[:, :25].mean() > 0.01
    assert np.abs(new - plain)[:, reach:].max() < 1e-6
    assert np.array_equal(wct.stylised(picture, masks, style, nets, alpha=0.0), plain)


def test_classes_of_a_few_pixels_stay(folder):
    nets = wct.load_autoencoders(folder)
    picture, tiny = noise(40, 40, 3), noise(16, 16, 4)
    style = wct.style_moments([(tiny, everywhere(tiny))], nets)
    assert all(not sums for sums in style), "256 pixels are no style"
    whole = wct.style_moments([(picture, everywhere(picture))], nets)
    few = np.zeros((40, 40), bool)
    few[:10, :10] = True
    plain = wct.stylised(picture, {}, whole, nets)
    assert np.array_equal(wct.stylised(picture, {VEGETATION: few}, whole, nets), plain)


def spoil(folder, name, change):
    data = torch.load(folder / name, weights_only=True)
    change(data["model"])
    torch.save(data, folder / name)


def test_weights_of_another_layout_are_refused(tmp_path):
    with pytest.raises(UserError, match="no folder"):
        wct.load_autoencoders(tmp_path / "absent")
    save_wct(tmp_path)
    spoil(tmp_path, "encoder2.pth", lambda model: model.pop("conv12.weight"))
    with pytest.raises(UserError, match="another layout: conv12"):
        wct.load_autoencoders(tmp_path)
    save_wct(tmp_path)
    spoil(tmp_path, "decoder3.pth", lambda m: m.update({"conv22.bias": torch.zeros(5)}))
    with pytest.raises(UserError, match="another layout: conv22"):
        wct.load_autoencoders(tmp_path)
    save_wct(tmp_path)
    spoil(tmp_path, "encoder3.pth", lambda m: m["conv31.weight"].fill_(torch.nan))
    with pytest.raises(UserError, match="not finite"):
        wct.load_autoencoders(tmp_path)
    save_wct(tmp_path)
    (tmp_path / "encoder1.pth").write_bytes(b"no weights")
    with pytest.raises(UserError, match="cannot be read"):
        wct.load_autoencoders(tmp_path)
    save_wct(tmp_path)
    torch.save([1, 2], tmp_path / "encoder1.pth")
    with pytest.raises(UserError, match="no tensors by name"):
        wct.load_autoencoders(tmp_path)
    (tmp_path / "encoder1.pth").unlink()
    with pytest.raises(UserError, match=r"no encoder1\.pth"):
        wct.load_autoencoders(tmp_path)


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the WCT weights beside the checkout")
@pytest.mark.parametrize(("level", "least"), [(1, 45.0), (2, 30.0), (3, 26.0)])
def test_real_networks_reproduce_a_photo(captures, level, least):
    """The authors of the file list 48.2, 32.2 and 28.8 dB on another photo."""
    photo = read_rgb(captures / "style_winter" / "images" / "snow_0.jpg")[:240, :320] / 255
    net = next(each for each in wct.load_autoencoders(REAL) if each.level == level)
    x = torch.from_numpy(photo).float().permute(2, 0, 1)[None]
    with torch.no_grad():
        error = (wct.decoded(wct.encoded(x, net), net) - x).square().mean()
    assert -10 * float(error.log10()) > least


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the WCT weights beside the checkout")
def test_real_transfer_takes_the_colours_of_the_style(captures):
    photo = read_rgb(captures / "style_winter" / "images" / "snow_0.jpg")[::4, ::4] / 255
    green = np.clip(0.5 * noise(96, 128, 5) * np.array([0.5, 1.0, 0.3]), 0, 1)
    nets = wct.load_autoencoders(REAL)
    style = wct.style_moments([(photo, everywhere(photo))], nets)
    new = wct.stylised(green, everywhere(green), style, nets)
    before = np.abs(green.mean((0, 1)) - photo.mean((0, 1))).max()
    after = np.abs(new.mean((0, 1)) - photo.mean((0, 1))).max()
    assert after < 0.4 * before
