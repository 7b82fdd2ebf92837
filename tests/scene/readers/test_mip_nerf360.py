"""mip-NeRF 360: COLMAP poses of `images/`, with downscaled copies in `images_2/4/8`."""

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import names_of, pixel_of, ring, write_colmap, write_images

from climatenerf.scene import load_image, read_scene
from climatenerf.scene.images import load_labels

FULL = (519, 337)
QUARTER = (130, 84)  # rounded: 129.75 and 84.25; int() would make it 129
F, CX, CY = 400.0, 260.0, 170.0
EDGE = 260, 200  # first column and row of the lower right part of the labels, full size
POINT = np.array([0.9, -0.4, 1.9])
MODELS = {
    "SIMPLE_RADIAL": ((F, CX, CY, 0.05), (0.05, 0, 0, 0)),
    "OPENCV": ((F, F, CX, CY, 0.05, -0.02, 0.003, -0.004), (0.05, -0.02, 0.003, -0.004)),
}


def make(root, folders, model="SIMPLE_RADIAL"):
    write_colmap(root / "sparse/0", ring(9), names_of(9), ((1, model, *FULL, MODELS[model][0]),))
    for folder, size in folders.items():
        write_images(root / folder, names_of(9), size)


def projected(pose, k):
    """(x, y) in the full image, from the formulas of OpenCV's lens model."""
    x, y, z = (np.linalg.inv(pose) @ np.append(POINT, 1.0))[:3]
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2 * r2
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    v = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return np.array([F * u + CX, F * v + CY])


@pytest.mark.parametrize("model", MODELS)
def test_downscaled_images_scale_the_intrinsics(tmp_path, model):
    make(tmp_path, {"images_4": QUARTER}, model)
    scene = read_scene(tmp_path)
    assert [(c.width, c.height) for c in scene.cameras] == [QUARTER]
    for pose, view in zip(ring(9), scene.views, strict=True):
        expected = projected(pose, MODELS[model][1]) * np.array(QUARTER) / FULL
        np.testing.assert_allclose(pixel_of(scene, view, POINT), expected, atol=1e-6)
        assert view.path.parent.name == "images_4"


def test_full_images_are_preferred(tmp_path):
    make(tmp_path, {"images_4": QUARTER, "images_8": (65, 42), "images": FULL})
    scene = read_scene(tmp_path)
    assert {v.path.parent.name for v in scene.views} == {"images"}
    assert [(c.width, c.height) for c in scene.cameras] == [FULL] and not any(
        "differ in size" in w for w in scene.warnings
    )


def test_rounded_sizes_of_the_garden_scene_are_accepted(tmp_path):
    write_colmap(
        tmp_path / "sparse/0",
        ring(3),
        names_of(3),
        ((1, "PINHOLE", 5187, 3361, (4e3, 4e3, 2e3, 1e3)),),
    )
    write_images(tmp_path / "images_4", names_of(3), (1297, 840))
    camera = read_scene(tmp_path).cameras[0]
    assert (camera.width, camera.height) == (1297, 840)
    assert camera.cx == pytest.approx(2e3 * 1297 / 5187) and camera.fy == pytest.approx(
        4e3 * 840 / 3361
    )


def test_full_size_labels_are_resampled_to_the_images(tmp_path):
    """A row length of int(519 / 4) instead of 130 would shear them by a pixel per row."""
    make(tmp_path, {"images_4": QUARTER})
    labels = np.full(FULL[::-1], 10, dtype=np.uint8)
    labels[EDGE[1] :, EDGE[0] :] = 2
    (tmp_path / "labels").mkdir()
    Image.fromarray(labels).save(tmp_path / "labels/000.png")
    pattern = np.where(labels == 2, 250, 5).astype(np.uint8)
    small = Image.fromarray(pattern).resize(QUARTER, Image.Resampling.BOX)
    small.convert("RGB").save(tmp_path / "images_4/000.png")
    scene = read_scene(tmp_path)
    found = load_labels(scene.views[0], scene)
    assert found is not None and found.shape == QUARTER[::-1]
    expected = np.full(QUARTER[::-1], 10)
    expected[50:, 65:] = 2  # 200 * 84 / 337 = 49.9, 260 * 130 / 519 = 65.1
    np.testing.assert_array_equal(found, expected)
    # The edge of the photo is at the same pixel.
    bright = load_image(scene.views[0], scene)[..., 0] > 127
    np.testing.assert_array_equal(bright, expected == 2)
