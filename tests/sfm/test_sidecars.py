"""Sidecars of photos: resampled through the lens and rotated by the orientation."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.images import load_depth, load_labels, load_mask
from climatenerf.sfm.sidecars import Photo, import_sidecars, orient

LENS = Camera(160, 120, 130.0, 130.0, 80.0, 60.0, k1=-0.15)
FLAT = Camera(150, 112, 128.0, 128.0, 75.0, 56.0)


def classes(camera, scale=1):
    """Class and z-depth at a camera's pixels, as functions of the direction."""
    if scale != 1:
        camera = camera.resized(camera.width * scale, camera.height * scale)
    d = camera.directions().astype(float)
    x, y = d[..., 0] / d[..., 2], d[..., 1] / d[..., 2]
    label = np.where(x > 0.13, 10, np.where(y > -0.07, 1, 4)).astype(np.uint8)
    return label, (3 + x + 2 * y).astype(np.float32)


@pytest.fixture
def scene(tmp_path):
    views = tuple(View(f"{n}.jpg", tmp_path / f"{n}.jpg", 0, np.eye(4)) for n in "abc")
    return Scene(tmp_path / "scene", "test", (FLAT,), views)


def import_folder(scene, kind, folder, orientation=1, lens=LENS, shown=True):
    photos = {
        view.name: Photo(f"sub/{view.name[0].upper()}.HEIC", lens, orientation, shown)
        for view in scene.views
    }
    return import_sidecars(scene, kind, folder, photos)


def edges(label):
    """Pixels next to a border of two classes."""
    out = np.zeros(label.shape, bool)
    out[1:] |= label[1:] != label[:-1]
    out[:-1] |= label[1:] != label[:-1]
    out[:, 1:] |= label[:, 1:] != label[:, :-1]
    out[:, :-1] |= label[:, 1:] != label[:, :-1]
    return out


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("name", ["sub/A.png", "A.png", "A.HEIC.png", "a.png"])
def test_labels_are_resampled_through_the_lens(scene, tmp_path, name, scale):
    path = tmp_path / "labels" / name
    path.parent.mkdir(parents=True)
    Image.fromarray(classes(LENS, scale)[0]).save(path)
    out = import_folder(scene, "labels", tmp_path / "labels")
    found, true = load_labels(out.views[0], out), classes(FLAT)[0]
    assert found is not None and (found == true)[~edges(true)].all()
    assert (found == true).mean() > 0.97
    # Resizing alone gives errors away from the borders.
    plain = np.asarray(Image.fromarray(classes(LENS)[0]).resize((150, 112), 0))
    assert (plain != true)[~edges(true)].any()
    assert out.views[1].label_path is None
    assert out.warnings == ("2 of 3 pictures have no labels; name each file after its photo.",)


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_files_of_stored_pixels_are_rotated(scene, tmp_path, orientation):
    (tmp_path / "labels").mkdir()
    shown = Image.fromarray(classes(LENS)[0])
    turn = {6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
    stored = shown if orientation == 1 else shown.transpose(turn[orientation])
    stored.save(tmp_path / "labels" / "A.png")
    out = import_folder(scene, "labels", tmp_path / "labels", orientation)
    true = classes(FLAT)[0]
    assert (load_labels(out.views[0], out) == true)[~edges(true)].all()


def stored(values, orientation):
    """Stored pixels of a picture that is shown as `values`."""
    return orient(values, {6: 8, 8: 6}.get(orientation, orientation))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_equal_pillow(tmp_path, orientation):
    from PIL import ImageOps

    data = Image.Exif()
    data[0x0112] = orientation
    values = np.arange(12, dtype=np.uint8).reshape(3, 4)
    Image.fromarray(values).save(tmp_path / "a.png", exif=data)
    shown = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    np.testing.assert_array_equal(orient(values, orientation), shown)
    np.testing.assert_array_equal(orient(stored(values, orientation), orientation), values)


@pytest.mark.parametrize("as_stored", [False, True])
def test_half_turned_photos_follow_quarter_turned_ones(scene, tmp_path, as_stored):
    """Only quarter turns change the shape of a file."""
    (tmp_path / "labels").mkdir()
    true, orientations = classes(FLAT)[0], {"a.jpg": 3, "b.jpg": 6, "c.jpg": 1}
    photos = {}
    for name, orientation in orientations.items():
        values = classes(LENS)[0]
        values = stored(values, orientation) if as_stored else values
        Image.fromarray(values).save(tmp_path / "labels" / f"{name[0]}.png")
        photos[name] = Photo(name, LENS, orientation, True)
    out = import_sidecars(scene, "labels", tmp_path / "labels", photos)
    for view in out.views:
        assert (load_labels(view, out) == true)[~edges(true)].all(), view.name
    assert out.warnings == ()
    # Without any quarter turn the user gets a warning.
    alone = {**photos, "b.jpg": Photo("b.jpg", LENS, 1, True)}
    Image.fromarray(classes(LENS)[0]).save(tmp_path / "labels" / "b.png")
    fresh = replace(scene, root=tmp_path / "other")
    out = import_sidecars(fresh, "labels", tmp_path / "labels", alone)
    assert any("by 180 degrees" in w for w in out.warnings)


@pytest.mark.parametrize("as_stored", [False, True])
def test_files_for_poses_of_stored_pixels(scene, tmp_path, as_stored):
    (tmp_path / "labels").mkdir()
    of_pixels = classes(LENS)[0]
    values = of_pixels if as_stored else orient(of_pixels, 6)
    Image.fromarray(values).save(tmp_path / "labels" / "A.png")
    out = import_folder(scene, "labels", tmp_path / "labels", orientation=6, shown=False)
    true = classes(FLAT)[0]
    assert (load_labels(out.views[0], out) == true)[~edges(true)].all()


def test_pixels_outside_the_photo_are_unknown(scene, tmp_path):
    wide = replace(scene, cameras=(Camera(300, 112, 128.0, 128.0, 150.0, 56.0),))
    for kind in ("labels", "masks", "depth"):
        (tmp_path / kind).mkdir()
        values = np.full((120, 160), 7, np.uint8)
        if kind == "depth":
            np.save(tmp_path / kind / "A.npy", values.astype(np.float32))
        else:
            Image.fromarray(values).save(tmp_path / kind / "A.png")
        wide = import_folder(wide, kind, tmp_path / kind)
    view = wide.views[0]
    labels, mask, depth = (f(view, wide) for f in (load_labels, load_mask, load_depth))
    assert labels[56, 0] == 255 and labels[56, 150] == 7
    assert not mask[56, 0] and mask[56, 150]
    assert np.isnan(depth[56, 0]) and depth[56, 150] == 7


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png"])
def test_depth_formats(scene, tmp_path, suffix):
    (tmp_path / "depth").mkdir()
    depth = classes(LENS)[1]
    depth[:, 80] = 0  # unknown
    path = tmp_path / "depth" / f"A{suffix}"
    if suffix == ".npy":
        np.save(path, depth[..., None])
    elif suffix == ".npz":
        np.savez(path, depth=depth)
    else:
        Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(path)
    out = import_folder(scene, "depth", tmp_path / "depth")
    found, true = load_depth(out.views[0], out), classes(FLAT)[1]
    known = np.isfinite(found)
    assert 0.98 < known.mean() < 1
    assert np.abs(found - true)[known].max() < 0.03  # half a pixel


def test_equal_lenses_leave_labels_unchanged(scene, tmp_path):
    (tmp_path / "labels").mkdir()
    values = np.random.default_rng(0).integers(0, 19, (112, 150), dtype=np.uint8)
    Image.fromarray(values).save(tmp_path / "labels" / "B.png")
    out = import_folder(scene, "labels", tmp_path / "labels", lens=FLAT)
    np.testing.assert_array_equal(load_labels(out.views[1], out), values)


def test_unusable_files_name_the_cause(scene, tmp_path):
    folder = tmp_path / "labels"
    folder.mkdir()
    with pytest.raises(UserError, match="name the files like"):
        import_folder(scene, "labels", folder)
    Image.new("L", (160, 160)).save(folder / "A.png")
    with pytest.raises(UserError, match="another aspect ratio"):
        import_folder(scene, "labels", folder)
    Image.new("RGB", (160, 120)).save(folder / "A.png")
    with pytest.raises(UserError, match="8-bit grey"):
        import_folder(scene, "labels", folder)
    (folder / "A.png").write_text("no picture")
    with pytest.raises(UserError, match="cannot be read"):
        import_folder(scene, "labels", folder)
    for data in (b"", b"text", np.arange(3).tobytes()):
        (folder / "A.npy").write_bytes(data)
        with pytest.raises(UserError, match="cannot be read"):
            import_folder(scene, "depth", folder)
    np.save(folder / "A.npy", np.zeros((3, 4, 5)))
    with pytest.raises(UserError, match="not an array of numbers"):
        import_folder(scene, "depth", folder)
    (folder / "A.npy").unlink()
    Image.new("L", (160, 120)).save(folder / "A.png")
    with pytest.raises(UserError, match="8 bits"):
        import_folder(scene, "depth", folder)
