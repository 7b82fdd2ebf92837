import os

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import (
    PINHOLE,
    names_of,
    ring,
    write_colmap,
    write_images,
    write_transforms,
)

from climatenerf.core.errors import UserError
from climatenerf.scene import load_image, read_scene, save_scene
from climatenerf.scene.images import load_labels, load_mask

SIZES = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 31.0, "cx": 16.0, "cy": 12.0}


def make(tmp_path, count=9, points=()):
    write_images(tmp_path / "images", names_of(count))
    write_colmap(tmp_path / "sparse/0", ring(count), names_of(count), points=points)
    return tmp_path


def test_default_split_is_every_eighth_by_sorted_name(tmp_path):
    names = [f"{i}.png" for i in range(17)]  # sorted as text: 0, 1, 10, 11, ...
    write_images(tmp_path / "images", names)
    write_colmap(tmp_path / "sparse/0", ring(17), names)
    scene = read_scene(tmp_path)
    order = sorted(names)
    assert [v.name for v in scene.views] == order
    assert [v.name for v in scene.of_split("heldout")] == [order[0], order[8], order[16]]


def test_holdout_by_name(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path, holdout="002.png, 005")
    assert [v.name for v in scene.of_split("heldout")] == ["002.png", "005.png"]
    assert not read_scene(tmp_path, holdout="0").of_split("heldout")


@pytest.mark.parametrize("holdout", ["nope.png", "002.png,nope.png", "", ","])
def test_unknown_holdout_raises(tmp_path, holdout):
    make(tmp_path)
    with pytest.raises(UserError, match="nope|no name"):
        read_scene(tmp_path, holdout=holdout)


def test_holding_out_everything_raises(tmp_path):
    make(tmp_path, 3)
    with pytest.raises(UserError, match="none is left"):
        read_scene(tmp_path, holdout=",".join(names_of(3)))


def test_leaving_one_image_to_fit_raises(tmp_path):
    make(tmp_path, 3)
    with pytest.raises(UserError, match="no depth; hold out fewer"):
        read_scene(tmp_path, holdout="000.png,001.png")


def white_masks(root, names):
    (root / "masks").mkdir(exist_ok=True)
    for name in names:
        Image.new("L", (32, 24), 255).save(root / "masks" / name)


def sidecar_warnings(scene):
    return [w for w in scene.warnings if "have a file in" in w]


def test_incomplete_sidecar_folders_give_a_warning(tmp_path):
    make(tmp_path)
    assert not sidecar_warnings(read_scene(tmp_path))
    white_masks(tmp_path, ["000.png", "001.png", "002.jpg"])
    (warning,) = sidecar_warnings(read_scene(tmp_path))
    assert warning.startswith("Only 2 of 9 images have a file in masks/")
    assert "name each file after its image and store it as PNG" in warning
    white_masks(tmp_path, names_of(9))
    assert not sidecar_warnings(read_scene(tmp_path))


def test_sidecar_folders_without_images_give_no_warning(tmp_path):
    make(tmp_path)
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "made_by.json").write_text("{}")
    assert not sidecar_warnings(read_scene(tmp_path))


def test_rescaled_scene_has_sidecar_warnings(tmp_path):
    x, y = np.mgrid[-6:6:40j, -6:6:40j]
    make(tmp_path, points=np.stack([x, y, 0.01 * np.sin(9 * x + 7 * y)], axis=-1).reshape(-1, 3))
    save_scene(read_scene(tmp_path), tmp_path)
    white_masks(tmp_path, ["000.png"])
    rescaled = read_scene(tmp_path, camera_height=2.0)
    assert "camera-height-assumed" in rescaled.scale_report
    assert sidecar_warnings(rescaled)


def test_missing_images_give_one_warning(tmp_path):
    make(tmp_path, 9)
    for name in names_of(9)[2:6]:
        (tmp_path / "images" / name).unlink()
    scene = read_scene(tmp_path)
    found = [w for w in scene.warnings if "not on disk" in w]
    assert len(found) == 1 and found[0].startswith("4 of the 9") and "002.png" in found[0]
    assert len(scene.views) == 5


def test_too_few_images_raise(tmp_path):
    make(tmp_path, 5)
    for name in names_of(5)[2:]:
        (tmp_path / "images" / name).unlink()
    with pytest.raises(UserError, match="Only 2 of the 5"):
        read_scene(tmp_path)


def test_missing_folder_raises(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_scene(tmp_path / "nowhere")


def test_folder_without_poses_raises(tmp_path):
    with pytest.raises(UserError, match="neither images nor poses"):
        read_scene(tmp_path)
    write_images(tmp_path / "images", names_of(3))
    with pytest.raises(UserError, match="no poses in a supported layout"):
        read_scene(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(UserError, match="not a folder or a .json"):
        read_scene(tmp_path / "a.txt")


def test_unreadable_image_raises(tmp_path):
    make(tmp_path)
    (tmp_path / "images/004.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match=r"004\.png cannot be read"):
        read_scene(tmp_path)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_image_raises_on_loading(tmp_path, suffix):
    names = [f"{i}.{suffix}" for i in range(4)]
    write_colmap(tmp_path / "sparse/0", ring(4), names)
    noise = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    (tmp_path / "images").mkdir()
    for name in names:
        Image.fromarray(noise).save(tmp_path / "images" / name)
    scene = read_scene(tmp_path)
    path = scene.views[2].path
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(UserError, match=rf"2\.{suffix} cannot be read"):
        load_image(scene.views[2], scene)
    path.unlink()
    with pytest.raises(UserError, match=rf"2\.{suffix} is missing"):
        load_image(scene.views[2], scene)


def test_image_of_another_shape_raises(tmp_path):
    make(tmp_path)
    Image.new("RGB", (24, 32)).save(tmp_path / "images/003.png")
    with pytest.raises(UserError, match=r"003\.png has 24x32 .* another shape"):
        read_scene(tmp_path)


def test_duplicate_names_raise(tmp_path):
    write_images(tmp_path / "images", names_of(4))
    write_colmap(tmp_path / "sparse/0", ring(4), [*names_of(3), "000.png"])
    with pytest.raises(UserError, match=r"000\.png has two poses"):
        read_scene(tmp_path)


def test_two_names_of_one_file_are_two_poses(tmp_path):
    write_images(tmp_path / "images", names_of(4))
    names = [f"images/{name}" for name in names_of(3)] + ["images/../images/000.png"]
    write_transforms(tmp_path / "transforms.json", ring(4), names, **SIZES)
    with pytest.raises(UserError, match=r"000\.png has two poses"):
        read_scene(tmp_path)


def test_photos_under_roundabout_names_have_poses(tmp_path):
    write_images(tmp_path / "images", names_of(4))
    names = [f"images/../images/{name}" for name in names_of(4)]
    write_transforms(tmp_path / "transforms.json", ring(4), names, **SIZES)
    scene = read_scene(tmp_path)
    assert not [each for each in scene.findings if each.code == "photo-without-pose"]


def test_a_name_without_suffix_with_two_pictures_is_told(tmp_path):
    write_images(tmp_path / "images", [*names_of(4), "001.jpg"])
    names = [f"images/{name.removesuffix('.png')}" for name in names_of(4)]
    write_transforms(tmp_path / "transforms.json", ring(4), names, **SIZES)
    found = [each for each in read_scene(tmp_path).findings if each.code == "name-ambiguous"]
    assert len(found) == 1 and "images/001.png, images/001.jpg" in found[0].message


@pytest.mark.parametrize(("name", "read"), [("mask", "masks"), ("depths", "depth")])
def test_folders_with_a_similar_name_are_noted(tmp_path, name, read):
    make(tmp_path)
    write_images(tmp_path / name, names_of(9))
    found = [each for each in read_scene(tmp_path).findings if each.code == "sidecar-unused"]
    assert f"9 files in {name}/, which is not read" in str(found) and read in found[0].remedy


@pytest.mark.parametrize("kind", ["masks", "labels", "depth"])
def test_headers_of_all_sidecars_are_read(tmp_path, kind):
    """One file among more than those whose pixels are read."""
    make(tmp_path, 60)
    (tmp_path / kind).mkdir()
    for name in names_of(60):
        size = (24, 32) if name == "007.png" else (32, 24)
        if kind == "depth":
            np.save(tmp_path / kind / name.replace("png", "npy"), np.ones(size[::-1]))
        else:
            Image.new("L", size).save(tmp_path / kind / name)
    errors = [each for each in read_scene(tmp_path).findings if each.severity == "error"]
    assert any("007" in each.message and "24x32" in each.message for each in errors), errors


def test_what_special_files_are_is_told(tmp_path):
    make(tmp_path)
    (tmp_path / "images/003.png").unlink()
    os.mkfifo(tmp_path / "images/003.png")
    (finding,) = [f for f in read_scene(tmp_path).findings if f.code == "photo-missing"]
    assert "003.png, which is a pipe" in finding.message
    os.mkfifo(tmp_path / "transforms.json")
    for name in ("cameras.txt", "cameras.bin"):
        (tmp_path / "sparse/0" / name).unlink(missing_ok=True)
    with pytest.raises(UserError, match=r"transforms\.json is a pipe"):
        read_scene(tmp_path)


def test_labels_and_masks_are_found(tmp_path):
    make(tmp_path, 4)
    write_images(tmp_path / "labels", names_of(2))
    labels = (np.arange(24 * 32) % 19).astype(np.uint8).reshape(24, 32)
    Image.fromarray(labels).save(tmp_path / "labels/000.png")
    mask = np.full((24, 32), 255, dtype=np.uint8)
    mask[:4, :4] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/001.png.png")
    scene = read_scene(tmp_path)
    np.testing.assert_array_equal(load_labels(scene.views[0], scene), labels)
    small = load_labels(scene.views[0], scene, 4)
    assert small is not None and small.shape == (6, 8) and set(small.flat) <= set(labels.flat)
    assert scene.views[1].mask_path == tmp_path / "masks/001.png.png"
    usable = load_mask(scene.views[1], scene, 3)
    assert usable is not None and usable.shape == (8, 10)
    # The masked area ends within the second pixel, so that pixel is masked too.
    np.testing.assert_array_equal(usable[:3, 0], [False, False, True])
    assert load_mask(scene.views[2], scene) is None and load_labels(scene.views[2], scene) is None


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P", "PA", "1"])
def test_masks_of_any_image_mode_exclude_black_pixels(tmp_path, mode):
    make(tmp_path, 3)
    (tmp_path / "masks").mkdir()
    mask = np.full((24, 32), 255, dtype=np.uint8)
    mask[:, :16] = 0
    kind = "TIFF" if mode == "PA" else "PNG"
    picture = Image.fromarray(mask).convert("RGB").convert("P") if mode == "PA" else None
    picture = (picture or Image.fromarray(mask)).convert(mode)
    picture.save(tmp_path / "masks/001.png", format=kind)
    usable = load_mask(read_scene(tmp_path).views[1], read_scene(tmp_path))
    assert usable is not None and not usable[:, :16].any() and usable[:, 16:].all()


def test_labels_of_another_size_are_resampled_to_the_image(tmp_path):
    make(tmp_path, 3)
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.full((48, 64), 7, dtype=np.uint8)).save(tmp_path / "labels/000.png")
    Image.fromarray(np.full((48, 48), 7, dtype=np.uint8)).save(tmp_path / "labels/001.png")
    scene = read_scene(tmp_path)
    labels = load_labels(scene.views[0], scene)
    assert labels is not None and labels.shape == (24, 32) and (labels == 7).all()
    with pytest.raises(UserError, match=r"001\.png has 48x48"):
        load_labels(scene.views[1], scene)


def test_transforms_are_preferred_over_colmap(tmp_path):
    make(tmp_path, 4)
    names = [f"images/{n}" for n in names_of(3)]
    write_transforms(tmp_path / "transforms.json", ring(3), names, fl_x=30, w=32, h=24)
    assert read_scene(tmp_path).source == "transforms"


def test_saved_scene_keeps_its_alignment_unless_camera_height_is_given(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path, camera_height=2.0)
    save_scene(scene, tmp_path)
    again = read_scene(tmp_path)
    np.testing.assert_array_equal(again.world_from_input, scene.world_from_input)
    assert again.scale_source == "camera-height" and again.source == "colmap"
    assert [v.split for v in again.views] == [v.split for v in scene.views]
    other = read_scene(tmp_path / "scene.json", holdout="0", camera_height=4.0)
    assert other.scale == pytest.approx(2 * scene.scale)
    assert not other.of_split("heldout")


@pytest.mark.parametrize("height", [0.0, -1.0, float("nan")])
def test_invalid_camera_height_raises(tmp_path, height):
    make(tmp_path)
    with pytest.raises(UserError, match="camera height"):
        read_scene(tmp_path, camera_height=height)


def test_distortion_without_inverse_gives_a_warning(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    camera = (1, "SIMPLE_RADIAL", 32, 24, (10.0, 16.0, 12.0, -1.0))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3), cameras=(camera,))
    assert any("cannot be inverted" in w for w in read_scene(tmp_path).warnings)
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3), cameras=(PINHOLE,))
    assert not any("cannot be inverted" in w for w in read_scene(tmp_path).warnings)


def test_photos_with_absolute_names_are_not_taken_as_sidecars(tmp_path):
    names = names_of(9)
    write_images(tmp_path / "images", names)
    absolute = [str(tmp_path / "images" / name) for name in names]
    write_transforms(
        tmp_path / "transforms.json", ring(9), absolute, w=32, h=24, fl_x=30.0, fl_y=30.0
    )
    for view in read_scene(tmp_path).views:
        assert view.label_path is None and view.mask_path is None
