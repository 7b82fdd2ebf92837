import importlib.util
import sys

import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.output import layers
from climatenerf.weather.registry import layer_table

RNG = np.random.default_rng(0)
H, W = 6, 8


def sample_layers():
    depth = RNG.uniform(0.5, 60, (H, W)).astype(np.float32)
    depth[0, :3] = np.inf
    normal = RNG.normal(size=(H, W, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[0, :3] = 0
    water = np.where(RNG.random((H, W)) < 0.5, RNG.random((H, W)), 0).astype(np.float32)
    return {
        "depth": depth,
        "normal": normal,
        "water_depth": water,
        "transmittance": RNG.random((H, W), dtype=np.float32),
        "snow_thickness": 0.3 * RNG.random((H, W), dtype=np.float32),
        "mask_snow": RNG.random((H, W), dtype=np.float32),
    }


def test_npz_holds_the_values_exactly(tmp_path):
    given = sample_layers()
    files = layers.save_layers(tmp_path, "0007", given)
    assert files["depth"] == ["depth/0007.npz"] and files.keys() == given.keys()
    for name, values in given.items():
        with np.load(tmp_path / files[name][0]) as data:
            assert data[name].dtype == np.float32 and np.array_equal(data[name], values)


def test_png_is_within_half_a_step_and_marked(tmp_path):
    given = sample_layers()
    files = layers.save_layers(tmp_path, "0000", given, ("npz", "png"))
    for name, values in given.items():
        layer = layer_table()[name]
        with Image.open(tmp_path / files[name][1]) as image:
            assert "simulated" in image.info["simulated"]
            levels = np.asarray(image)
        assert levels.dtype == (np.uint8 if layer.png_bits == 8 else np.uint16)
        if name == "normal":
            back, step = levels / 255 * 2 - 1, 2 / 255
            assert (levels[0, :3] == 128).all()
        else:
            back, step = levels * float(layer.png_step), float(layer.png_step)
        finite = np.isfinite(values)
        assert np.abs(back - values)[finite].max() <= 0.5 * step + 1e-6
    depth = np.asarray(Image.open(tmp_path / "depth" / "0000.png"))
    assert (depth[0, :3] == 0).all() and (depth[1:] > 0).all()


def test_png_limits():
    depth = np.array([[0.0001, 70.0, np.inf, np.nan, 0.0, -1.0]])
    assert layers.png_values(layer_table()["depth"], depth).tolist() == [[1, 65535, 0, 0, 0, 0]]
    assert layers.png_values(
        layer_table()["mask_water"], np.array([[-0.1, 0.5, 2.0]])
    ).tolist() == [[0, 128, 255]]


def test_wrong_layers_are_refused(tmp_path):
    for bad in ({"colour": np.zeros((H, W))}, {"depth": np.zeros((H, W, 3))}):
        with pytest.raises(ValueError, match="see layer_table"):
            layers.save_layers(tmp_path, "0", bad)


def test_exr_without_its_package_is_a_user_error(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(UserError, match=r"pip install climatenerf\[exr\]"):
        layers.save_layers(tmp_path, "0", {"depth": np.ones((H, W))}, ("exr",))


@pytest.mark.skipif(not importlib.util.find_spec("OpenEXR"), reason="needs OpenEXR (extra exr)")
def test_exr_holds_the_values_exactly(tmp_path):
    import OpenEXR  # pyright: ignore[reportMissingImports]

    given = sample_layers()
    files = layers.save_layers(tmp_path, "0", given, ("exr",))
    with OpenEXR.File(str(tmp_path / files["depth"][0])) as file:
        assert np.array_equal(file.channels()["Z"].pixels, given["depth"])
        assert "simulated" in file.header()["comments"]
    with OpenEXR.File(str(tmp_path / files["normal"][0]), separate_channels=True) as file:
        for i, axis in enumerate("XYZ"):
            assert np.array_equal(file.channels()[axis].pixels, given["normal"][..., i])
