"""The main job on real photographs, through the command line; what must be seen, from the layers.

pytest -m slow tests/test_captures_end_to_end.py      (about a quarter of an hour on two cores)

A few hundred steps of fitting: a soft picture, but where things are is settled. After half as many
haze still hangs over the ground and takes the snow. Steps, not minutes: a busy machine takes longer
and finds the same.
"""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from climatenerf import cli

pytestmark = pytest.mark.slow

VISIBILITY = 40.0
SNOW = 0.15
# Where each is flooded to (ditch: its datum is the street, the channel lies below), how much of
# the picture must then show water, and from where it is looked at.
CAPTURES = {
    "ditch": {"level": "-1.5 m", "least_water": 0.05, "least_snow": 0.05, "downscale": 2},
    "stone_sign": {"level": "0.3 m", "least_water": 0.10, "least_snow": 0.15, "downscale": 2},
    "kitti_drive": {"level": "0.3 m", "least_water": 0.05, "least_snow": 0.05, "downscale": 2},
    "fox": {"level": "0.3 m", "least_water": 0.02, "downscale": 1},
}
WALL = "fox"  # hangs on one: in its picture hardly anything lies level
FLAGS = {
    "smog": ["--smog.visibility", f"{VISIBILITY} m"],
    "snow": ["--snow.depth", f"{SNOW} m"],
}


@pytest.fixture(scope="module", params=CAPTURES)
def fitted(request, captures, tmp_path_factory):
    """Name of the capture and its run."""
    name = request.param
    run = tmp_path_factory.mktemp(name) / "run"
    words = ["fit", str(captures / name), "-o", str(run), "--steps", "700", "--minutes", "30"]
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
        picture = np.asarray(Image.open(out / frame["file"])) / 255
        found[weather]["linear"] = np.where(
            picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4
        )
        for key, values in found[weather].items():
            assert not np.isnan(values).any(), (weather, key)
    return found


def test_the_fit_is_measured(fitted):
    name, run = fitted
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["psnr"] > 14 and metrics["psnr_cc"] >= metrics["psnr"] - 0.1, name
    if name != "kitti_drive":  # nothing moves in the others
        assert metrics["masked_fraction"] < 0.02, name


def test_no_weather_leaves_no_trace(rendered):
    clean = rendered["clean"]
    assert (clean["mask_water"] == 0).all() and (clean["mask_snow"] == 0).all()
    assert (clean["transmittance"] == 1).all()


def test_smog_takes_the_contrast_that_distance_asks_for(rendered):
    """The picture itself, against clean picture and clean depth: I = T J + (1 - T) A.

    A visibility of 40 m leaves 5 % of the contrast there.
    """
    clean, smog = rendered["clean"], rendered["smog"]
    seen = np.isfinite(clean["depth"])
    assert seen.mean() > 0.2
    passed = np.where(seen, np.exp(np.log(0.05) / VISIBILITY * clean["depth"]), 0.0)[..., None]
    white = np.array([0.8394, 0.8034, 0.5363])  # .925 .906 .758 in display values
    expected = passed * clean["linear"] + (1 - passed) * white
    off = np.abs(smog["linear"] - expected).max(-1)
    # Not exact: a ray's light comes from a spread of depths, and the clean picture is clipped.
    assert np.median(off[seen]) < 0.04 and np.quantile(off[seen], 0.9) < 0.15
    changed = np.abs(clean["linear"] - expected).max(-1)
    assert np.median(changed) > 2 * np.median(off), "it changes the picture by far more than that"
    # The layer tells the same, and what is far away is gone.
    assert np.allclose(smog["transmittance"], passed[..., 0], atol=2e-3)
    assert np.allclose(smog["mask_smog"], 1 - smog["transmittance"], atol=1e-5)


def test_with_all_weathers_the_air_still_counts_from_the_surface_seen(rendered):
    layers = rendered["all"]
    seen = np.isfinite(layers["depth"])
    expected = np.exp(np.log(0.05) / VISIBILITY * layers["depth"][seen])
    assert np.allclose(layers["transmittance"][seen], expected, atol=2e-3)
    assert (layers["transmittance"][~seen] < 1e-3).all()


@pytest.mark.parametrize("weather", ["flood", "all"])
def test_water_covers_what_lies_low(fitted, rendered, weather):
    name, _ = fitted
    layers = rendered[weather]
    share = layers["mask_water"].mean()
    assert CAPTURES[name]["least_water"] <= share < 0.95, share
    wet = layers["mask_water"] > 0.5
    assert layers["water_depth"][wet].mean() > 0.01
    assert (layers["water_depth"][layers["mask_water"] == 0] == 0).all()
    # The level is a plane: water is level ground at most as far as the clean scene's surface.
    clean = rendered["clean"]["depth"]
    assert (layers["depth"][wet] <= clean[wet] + 0.05 * np.abs(clean[wet]) + 0.1).mean() > 0.9


def test_the_water_mirrors_the_place(fitted, monkeypatch):
    """Still water that reflects all shows what a camera mirrored in its surface sees."""
    import torch

    from climatenerf.field.checkpoint import load_field
    from climatenerf.field.compositing import RENDER_STEP
    from climatenerf.paths.camera_path import camera_path
    from climatenerf.render import integrator as tracing
    from climatenerf.render.integrator import trace
    from climatenerf.render.session import RenderSession
    from climatenerf.render.volume import camera_rays
    from climatenerf.scene import load_scene
    from climatenerf.weather.description import weather_from_table

    # Else reflected rays march in coarser steps, in which leaves come out differently.
    monkeypatch.setattr(tracing, "SECONDARY_STEP", RENDER_STEP)
    name, run = fitted
    field, scene = load_field(run), load_scene(run)
    path = camera_path("still", scene, 1, (160, 90))
    table = {"flood": {"level": CAPTURES[name]["level"], "wind-speed": "0 m/s"}}
    places, times = path.c2w[:, :3, 3], np.zeros(1)
    world = RenderSession(field, scene, weather_from_table(table), places, times).world(0.0)
    (water,) = world.surfaces
    level = water.level
    mirror = dataclasses.replace(world, surfaces=(dataclasses.replace(water, mirror_only=True),))
    o, d = camera_rays(path.cameras[0], path.c2w[0])
    angle = torch.full((len(o),), 1 / 160)
    seen = trace(mirror, o, d, angle)
    wet = seen.mask_water > 0.999
    assert wet.float().mean() > CAPTURES[name]["least_water"] / 2
    t = (level - o[:, 2]) / d[:, 2]
    start = (o + t[:, None] * d)[wet]
    turned = (d * torch.tensor([1.0, 1.0, -1.0]))[wet]
    clean = trace(dataclasses.replace(world, near=0.0, water=None), start, turned, angle[wet])
    error = (clean.rgb.clamp(0, 1) - seen.rgb[wet].clamp(0, 1)).square().mean()
    assert -10 * np.log10(float(error)) > 35


def test_snow_lies_as_deep_as_asked_for(fitted, rendered):
    layers = rendered["snow"]
    assert (layers["snow_thickness"][layers["mask_snow"] == 0] == 0).all()
    snowy = layers["mask_snow"] > 0.5  # a short fit's surfaces are soft and shine through
    if fitted[0] == WALL:
        assert snowy.mean() < 0.02, "hardly anything lies level"
        return
    assert snowy.mean() > CAPTURES[fitted[0]]["least_snow"]
    # Within 10 % over known planes (test_snow.py); here the ground is rough and soft.
    assert np.median(layers["snow_thickness"][snowy]) == pytest.approx(SNOW, rel=0.45)


def test_sheltered_places_stay_bare(fitted, rendered):
    """Surfaces seen in the picture, and whether matter stands straight above them."""
    if fitted[0] == WALL:
        pytest.skip("a wall: no snow in the open to compare with")
    import torch

    from climatenerf.field.checkpoint import load_field
    from climatenerf.ops import compositing
    from climatenerf.paths.camera_path import camera_path
    from climatenerf.render.volume import camera_rays
    from climatenerf.scene import load_scene

    _, run = fitted
    field = load_field(run).observed_only()
    path = camera_path("still", load_scene(run), 1, (160, 90))
    o, d = camera_rays(path.cameras[0], path.c2w[0])
    depth = torch.from_numpy(rendered["clean"]["depth"]).reshape(-1).float()
    solid = torch.isfinite(depth)
    above = (o + torch.where(solid, depth, 0.0)[:, None] * d) + torch.tensor([0.0, 0.0, 0.6])
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(above).contiguous()
    samples = field.march(above, up, torch.zeros(len(o)), torch.full((len(o),), 60.0))
    _, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    snow = torch.from_numpy(rendered["snow"]["mask_snow"]).reshape(-1)
    bare, open_sky = snow[solid & (left < 0.02)], snow[solid & (left > 0.9)]
    if len(bare) < 50 or len(open_sky) < 50:
        pytest.skip("nothing in this picture is sheltered, or nothing is open")
    assert bare.mean() < 0.4 * open_sky.mean()


def test_no_snow_is_seen_under_water(rendered):
    layers = rendered["all"]
    wet = layers["mask_water"] > 0.99
    assert (layers["mask_snow"][wet] < 0.01 + 1e-4).all()
    assert (layers["snow_thickness"][wet & (layers["mask_snow"] < 1 / 2048)] == 0).all()
    assert layers["mask_snow"].mean() <= rendered["snow"]["mask_snow"].mean() + 0.05
