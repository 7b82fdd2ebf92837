"""The main job on real photographs, through the command line; what must be seen, from the layers.

pytest -m slow tests/test_captures_end_to_end.py      (about ten minutes on two cores)
"""

import json

import numpy as np
import pytest

from climatenerf import cli

pytestmark = pytest.mark.slow

VISIBILITY = 40.0
SNOW = 0.15
# Where each is flooded to (ditch: its datum is the street, the channel lies below), how much of
# the picture must then show water, and from where it is looked at.
CAPTURES = {
    "ditch": {"level": "-1.5 m", "least_water": 0.05, "downscale": 2},
    "stone_sign": {"level": "0.3 m", "least_water": 0.10, "downscale": 2},
    "kitti_drive": {"level": "0.3 m", "least_water": 0.05, "downscale": 2},
    "fox": {"level": "0.3 m", "least_water": 0.0, "downscale": 1},
}
FLAGS = {
    "smog": ["--smog.visibility", f"{VISIBILITY} m"],
    "snow": ["--snow.depth", f"{SNOW} m"],
}


@pytest.fixture(scope="module", params=CAPTURES)
def fitted(request, captures, tmp_path_factory):
    """Name of the capture and its run."""
    name = request.param
    run = tmp_path_factory.mktemp(name) / "run"
    words = ["fit", str(captures / name), "-o", str(run), "--minutes", "1"]
    assert cli.main([*words, "--downscale", str(CAPTURES[name]["downscale"])]) == 0
    return name, run


@pytest.fixture(scope="module")
def rendered(fitted, tmp_path_factory):
    """Layers of one still frame by weather."""
    name, run = fitted
    level = ["--flood.level", CAPTURES[name]["level"]]
    weathers = {"clean": [], **FLAGS, "flood": level, "all": [*level, *sum(FLAGS.values(), [])]}
    found = {}
    for weather, flags in weathers.items():
        out = tmp_path_factory.mktemp(f"{name}-{weather}")
        words = ["render", str(run), "-o", str(out), "--path", "still", "--frames", "1"]
        assert cli.main([*words, "--size", "160x90", "--layers", "all", *flags]) == 0
        frame = json.loads((out / "movie.json").read_text())["frames"][0]
        found[weather] = {
            key: np.load(out / paths[0])[key] for key, paths in frame["layers"].items()
        }
        for key, values in found[weather].items():
            assert not np.isnan(values).any(), (weather, key)
    return found


def test_the_fit_is_measured(fitted):
    name, run = fitted
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["psnr"] > 14 and metrics["psnr_cc"] >= metrics["psnr"] - 0.1, name


def test_no_weather_leaves_no_trace(rendered):
    clean = rendered["clean"]
    assert (clean["mask_water"] == 0).all() and (clean["mask_snow"] == 0).all()
    assert (clean["transmittance"] == 1).all()


@pytest.mark.parametrize("weather", ["smog", "all"])
def test_transmittance_falls_with_distance(rendered, weather):
    """As exp(-sigma depth) for a visibility of 40 m (5 % of the contrast is left there)."""
    layers = rendered[weather]
    seen = np.isfinite(layers["depth"])
    assert seen.mean() > 0.2
    expected = np.exp(np.log(0.05) / VISIBILITY * layers["depth"][seen])
    assert np.allclose(layers["transmittance"][seen], expected, atol=2e-3)
    assert (layers["transmittance"][~seen] < 1e-3).all()
    assert np.allclose(layers["mask_smog"], 1 - layers["transmittance"], atol=1e-5)


@pytest.mark.parametrize("weather", ["flood", "all"])
def test_water_covers_what_lies_low(fitted, rendered, weather):
    name, _ = fitted
    layers = rendered[weather]
    share = layers["mask_water"].mean()
    assert CAPTURES[name]["least_water"] <= share < 0.95, share
    if share > 0:
        wet = layers["mask_water"] > 0.5
        assert layers["water_depth"][wet].mean() > 0.01
        assert (layers["water_depth"][layers["mask_water"] == 0] == 0).all()
        # The level is a plane: water is level ground at most as far as the clean scene's surface.
        clean = rendered["clean"]["depth"]
        assert (layers["depth"][wet] <= clean[wet] + 0.05 * np.abs(clean[wet]) + 0.1).mean() > 0.9


def test_snow_lies_as_deep_as_asked_for(rendered):
    layers = rendered["snow"]
    snowy = layers["mask_snow"] > 0.5
    assert snowy.mean() > 0.01
    mean = layers["snow_thickness"][snowy].mean()
    assert SNOW / 3 < mean < SNOW * 3, mean
    assert (layers["snow_thickness"][layers["mask_snow"] == 0] == 0).all()


def test_no_snow_is_seen_under_water(rendered):
    layers = rendered["all"]
    wet = layers["mask_water"] > 0.99
    assert (layers["mask_snow"][wet] < 0.01 + 1e-4).all()
    assert (layers["snow_thickness"][wet & (layers["mask_snow"] < 1 / 2048)] == 0).all()
    assert layers["mask_snow"].mean() <= rendered["snow"]["mask_snow"].mean() + 0.05
