import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.scene import Camera, Scene, View, images, load_image
from climatenerf.scene.images import (
    downscaled_camera,
    load_depth,
    load_relative_depth,
    read_header,
)

CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)


def scene_of(path: Path, camera=CAMERA):
    view = View(path.name, path, 0, np.eye(4))
    return view, Scene(path.parent, "test", (camera,), (view,))


def save(tmp_path, image: Image.Image, name="a.png", **options):
    image.save(tmp_path / name, **options)
    return scene_of(tmp_path / name)


RGB = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def test_rgb_is_unchanged(tmp_path):
    np.testing.assert_array_equal(load_image(*save(tmp_path, Image.fromarray(RGB))), RGB)


def test_grey_becomes_rgb(tmp_path):
    values = load_image(*save(tmp_path, Image.fromarray(RGB[..., 0])))
    np.testing.assert_array_equal(values, np.repeat(RGB[..., :1], 3, axis=-1))


def test_16_bit_grey_is_reduced_to_8_bits(tmp_path):
    deep = RGB[..., 0].astype(np.uint16) * 257
    values = load_image(*save(tmp_path, Image.fromarray(deep)))
    np.testing.assert_array_equal(values[..., 1], RGB[..., 0])


def test_dark_16_bit_grey_stays_dark(tmp_path):
    deep = np.full((24, 32), 200, dtype=np.uint16)
    assert load_image(*save(tmp_path, Image.fromarray(deep))).max() <= 1


def test_alpha_is_dropped_not_composited(tmp_path):
    alpha = np.zeros((24, 32, 1), dtype=np.uint8)
    view, scene = save(tmp_path, Image.fromarray(np.concatenate([RGB, alpha], axis=-1)))
    np.testing.assert_array_equal(load_image(view, scene), RGB)
    assert read_header(view.path).alpha


def test_palette_becomes_rgb(tmp_path):
    image = Image.fromarray(RGB).quantize(16)
    values = load_image(*save(tmp_path, image))
    np.testing.assert_array_equal(values, np.asarray(image.convert("RGB")))


def test_downscale_averages_linear_light(tmp_path):
    # Half of the linear light is sRGB 188, not 128.
    checks = ((np.indices((24, 32)).sum(axis=0) % 2) * 255).astype(np.uint8)
    values = load_image(*save(tmp_path, Image.fromarray(checks)), 2)
    assert values.shape == (12, 16, 3) and (values == 188).all()


@pytest.mark.parametrize("downscale", [2, 3, 5])
def test_averaging_in_strips_changes_nothing(tmp_path, monkeypatch, downscale):
    view, scene = save(tmp_path, Image.fromarray(RGB))
    whole = load_image(view, scene, downscale)
    monkeypatch.setattr(images, "_STRIP", 100)
    np.testing.assert_array_equal(load_image(view, scene, downscale), whole)


def test_downscale_keeps_uniform_colours_and_crops_the_rest(tmp_path):
    for value in (0, 1, 7, 128, 255):
        view, scene = save(tmp_path, Image.new("L", (32, 24), value))
        values = load_image(view, scene, 5)
        assert values.shape == (4, 6, 3) and (values == value).all()


def test_downscaled_camera_has_the_same_rays():
    small = downscaled_camera(CAMERA, 5)
    assert (small.width, small.height) == (6, 4)
    full, coarse = CAMERA.directions(), small.directions()
    # The centre of a 5x5 block is the centre of its middle pixel.
    np.testing.assert_allclose(coarse, full[2:20:5, 2:30:5], atol=1e-6)
    with pytest.raises(UserError, match="downscaled by 25"):
        downscaled_camera(CAMERA, 25)


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


def test_exif_orientation_is_ignored_if_the_stored_size_fits(tmp_path):
    for orientation in (3, 6, 8):
        view, scene = save(tmp_path, Image.fromarray(RGB), exif=exif(orientation))
        np.testing.assert_array_equal(load_image(view, scene), RGB)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_exif_orientation_is_applied_if_only_the_rotated_size_fits(tmp_path, orientation):
    from PIL import ImageOps

    camera = Camera(24, 32, 30.0, 30.0, 12.0, 16.0)
    Image.fromarray(RGB).save(tmp_path / "a.png", exif=exif(orientation))
    view, scene = scene_of(tmp_path / "a.png", camera)
    with Image.open(tmp_path / "a.png") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(load_image(view, scene), expected)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_up_direction_of_the_displayed_image(tmp_path, orientation):
    from PIL import ImageOps

    # A gradient along `up_direction` is brightest at the top of the displayed image.
    view, _ = save(tmp_path, Image.fromarray(RGB), exif=exif(orientation))
    x, y = read_header(view.path).up_direction(CAMERA)
    rows, columns = np.mgrid[:24, :32]
    ramp = Image.fromarray((100 + 3 * (x * columns + y * rows)).astype(np.uint8))
    ramp.getexif()[0x0112] = orientation
    shown = np.asarray(ImageOps.exif_transpose(ramp)).astype(int)
    assert (np.diff(shown, axis=0) < 0).all() and (np.diff(shown, axis=1) == 0).all()


def test_wrong_image_size_raises(tmp_path):
    view, scene = save(tmp_path, Image.new("RGB", (10, 10)))
    with pytest.raises(UserError, match="10x10"):
        load_image(view, scene)


def test_relative_depth_is_found_with_and_without_the_image_suffix(tmp_path):
    view, scene = save(tmp_path, Image.fromarray(RGB))
    other, _ = save(tmp_path, Image.fromarray(RGB), "a.jpg")
    assert load_relative_depth(view, scene) is None
    folder = tmp_path / "depth_relative"
    folder.mkdir()
    np.savez(folder / "a.npz", inverse_depth=np.full((24, 32), 2.0))
    for photo in (view, other):
        assert (load_relative_depth(photo, scene) == 2).all()
    np.savez(folder / "a.jpg.npz", inverse_depth=np.full((24, 32), 3.0))
    assert (load_relative_depth(view, scene) == 2).all()
    assert (load_relative_depth(other, scene) == 3).all()


def test_relative_depth_of_another_shape_raises(tmp_path):
    view, scene = save(tmp_path, Image.new("RGB", (32, 24)))
    path = tmp_path / "depth_relative" / "a.npz"
    path.parent.mkdir()
    np.savez(path, x=np.ones((64, 48)))
    with pytest.raises(UserError, match="48x64 pixels but its camera 32x24"):
        load_relative_depth(view, scene)


def test_unusable_relative_depth_raises(tmp_path):
    view, scene = save(tmp_path, Image.new("RGB", (32, 24)))
    path = tmp_path / "depth_relative" / "a.npz"
    path.parent.mkdir()
    with path.open("wb") as file:
        np.save(file, np.ones((24, 32)))  # an NPY file named .npz
    for damage in (
        lambda: None,
        lambda: np.savez(path, x=np.ones((2, 24, 32))),
        lambda: np.savez(path, x=np.ones((24, 32), complex)),
        lambda: np.savez(path, x=np.array([["a"] * 32] * 24)),
        lambda: np.savez(path),
        lambda: path.write_bytes(b"PK junk"),
    ):
        damage()
        with pytest.raises(UserError, match="relative depth") as caught:
            load_relative_depth(view, scene)
        assert "pickle" not in str(caught.value)


def test_relative_depth_falls_back_to_the_depth_file(tmp_path):
    view, scene = save(tmp_path, Image.fromarray(RGB))
    z = np.full((24, 32), 4.0, np.float32)
    z[:, 16:] = 2.0
    z[0] = np.nan
    (tmp_path / "depth").mkdir()
    np.savez(tmp_path / "depth" / "a.npz", depth=z)
    view = dataclasses.replace(view, depth_path=tmp_path / "depth" / "a.npz")
    found = load_relative_depth(view, scene)
    assert found is not None and np.isnan(found[0]).all()
    assert (found[1:, :16] == 0.25).all() and (found[1:, 16:] == 0.5).all()
    half = load_relative_depth(view, scene, 2)
    assert half is not None and half.shape == (12, 16) and half[-1, 0] == 0.25
    (tmp_path / "depth_relative").mkdir()
    np.savez(tmp_path / "depth_relative" / "a.npz", inverse_depth=np.full((24, 32), 7.0))
    assert (load_relative_depth(view, scene) == 7).all()


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_depth_file_with_the_wrong_suffix_raises(tmp_path, suffix):
    view, scene = save(tmp_path, Image.new("RGB", (32, 24)))
    path = tmp_path / f"a{suffix}"
    with path.open("wb") as file:
        (np.savez if suffix == ".npy" else np.save)(file, np.ones((24, 32)))
    with pytest.raises(UserError, match=f"depth .*no {suffix[1:].upper()}.*replace it"):
        load_depth(dataclasses.replace(view, depth_path=path), scene)
    with path.open("wb") as file:
        (np.save if suffix == ".npy" else np.savez)(file, np.full((24, 32), 2.0))
    assert (load_depth(dataclasses.replace(view, depth_path=path), scene) == 2).all()
