import math
from dataclasses import replace

import numpy as np
import pytest
from support.scene_builders import look_at, ring

from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.alignment.georeference import (
    Georeference,
    Unused,
    apply_georeference,
    east_north,
    find_georeference,
    gps_warning,
)
from climatenerf.scene.alignment.scale import scale_warnings

CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
HOME = np.array([47.3769, 8.5417])
# Arc lengths at 47.3769 deg, m per degree, from the standard series in cosines of the latitude.
LAT_M = (
    111132.954
    - 559.822 * math.cos(2 * math.radians(HOME[0]))
    + 1.175 * math.cos(4 * math.radians(HOME[0]))
)
LON_M = 111412.84 * math.cos(math.radians(HOME[0])) - 93.5 * math.cos(3 * math.radians(HOME[0]))


def scene_of(poses, tmp_path):
    views = tuple(View(f"{i}.png", tmp_path / f"{i}.png", 0, p) for i, p in enumerate(poses))
    return Scene(
        tmp_path, "test", (CAMERA,), views, scale_source="camera-height-assumed",
        scale_error=0.3, lowest_ground_z=-2.0,
        warnings=("The scale is assumed: cameras 1.6 m.", "Something else."),
    )  # fmt: skip


def places_of(scene, scale, heading, noise=0.0, seed=0):
    """GPS places of a scene that is `scale` times larger and turned by `heading` in truth."""
    rng = np.random.default_rng(seed)
    out = {}
    for view in scene.views:
        x, y = view.c2w[:2, 3]
        east = scale * (math.cos(heading) * x - math.sin(heading) * y) + noise * rng.normal()
        north = scale * (math.sin(heading) * x + math.cos(heading) * y) + noise * rng.normal()
        out[view.name] = (HOME[0] + north / LAT_M, HOME[1] + east / LON_M, 400.0)
    return out


def test_metres_per_degree():
    moved = HOME + np.array([[0.001, 0.0], [0.0, 0.001]])
    flat = east_north(moved, HOME)
    assert flat[0] == pytest.approx([0, LAT_M / 1000], abs=0.01)
    assert flat[1] == pytest.approx([LON_M / 1000, 0], abs=0.01)
    over = east_north(np.array([[0.0, -179.9995]]), np.array([0.0, 179.9995]))
    assert over[0] == pytest.approx([111.32, 0], abs=0.01), "over the date line"


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_scale_and_heading(tmp_path, noise):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    places = places_of(scene, 1.7, 2.1, noise)
    found = find_georeference(scene, places)
    assert isinstance(found, Georeference) and gps_warning(found, {}) is None
    assert found.scale == pytest.approx(1.7, rel=max(1e-3, 3 * found.scale_error))
    assert found.scale_error < 0.06
    assert found.heading == pytest.approx(2.1, abs=max(1e-3, 3 * found.scale_error))
    out = apply_georeference(scene, found, keep_scale=False)
    assert out.scale == pytest.approx(found.scale) and out.scale_source == "gps"
    assert out.ground_z == 0 and out.lowest_ground_z == pytest.approx(-2 * found.scale)
    assert out.warnings == ("Something else.",)
    assert out.georeference["photos"] == 24
    assert out.scale_report["camera-height-assumed"]["times"] == pytest.approx(1 / found.scale)
    # x is east, y is north.
    origin = np.array(found.origin)
    for view in out.views:
        east, north = east_north(np.array([places[view.name][:2]]), origin)[0]
        assert out.c2w_world(view)[:2, 3] == pytest.approx([east, north], abs=4 * noise + 0.02)


def test_the_error_that_is_told_is_the_error_that_is_made(tmp_path):
    scene = scene_of(ring(30, radius=20.0), tmp_path)
    found = [find_georeference(scene, places_of(scene, 1.0, 0.3, 1.5, seed)) for seed in range(60)]
    made = np.std([f.scale - 1 for f in found])
    told = np.mean([f.scale_error for f in found])
    assert told == pytest.approx(made, rel=0.35)


def drifting(scene, noise, correlation, seed):
    """Places whose errors change slowly from photo to photo, as a receiver's do."""
    rng = np.random.default_rng(seed)
    error, out = rng.normal(size=2), {}
    for view in scene.views:
        x, y = view.c2w[:2, 3] + noise * error
        out[view.name] = (HOME[0] + y / LAT_M, HOME[1] + x / LON_M, 400.0)
        fresh = math.sqrt(1 - correlation**2) * rng.normal(size=2)
        error = correlation * error + fresh
    return out


@pytest.mark.parametrize(("count", "noise", "correlation"), [(60, 3.0, 0.9), (8, 1.5, 0.0)])
def test_the_error_is_honest_for_drift_and_for_few_photos(tmp_path, count, noise, correlation):
    scene = scene_of(ring(count, radius=20.0), tmp_path)
    found = [find_georeference(scene, drifting(scene, noise, correlation, s)) for s in range(80)]
    ratio = [(f.scale - 1) / f.scale_error for f in found if isinstance(f, Georeference)]
    assert len(ratio) > 20 and np.sqrt(np.mean(np.square(ratio))) < 2.2


def test_drift_as_large_as_the_path_is_not_believed(tmp_path):
    scene = scene_of(ring(48, radius=3.0), tmp_path)
    found = [find_georeference(scene, drifting(scene, 4.0, 0.95, seed)) for seed in range(60)]
    assert np.mean([isinstance(f, Unused) for f in found]) > 0.8


def test_a_fix_that_is_given_to_several_photos_is_one(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    places = places_of(scene, 1.0, 0.0, 1.0)
    names = [view.name for view in scene.views]
    lagging = {name: places[names[i // 4 * 4]] for i, name in enumerate(names)}
    found = find_georeference(scene, lagging)
    assert isinstance(found, Georeference) and found.photos == 24
    assert abs(found.scale - 1) < 3 * found.scale_error
    assert found.scale_error > 1.5 * find_georeference(scene, places).scale_error


def test_a_third_of_wild_fixes_does_no_harm(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    places = places_of(scene, 1.3, 0.5, 0.5)
    for i in range(8):
        lat, lon, alt = places[f"{i}.png"]
        places[f"{i}.png"] = (lat + 0.002, lon - 0.001, alt)
    found = find_georeference(scene, places)
    assert isinstance(found, Georeference) and found.scale == pytest.approx(1.3, rel=0.05)
    assert set(found.left_out) == {f"{i}.png" for i in range(8)} and found.photos == 16
    note = gps_warning(found, {"0.png": "IMG_0.HEIC"})
    assert note is not None and "GPS of 8 of 24 photos" in note and "IMG_0.HEIC, 1.png, " in note


def test_a_scale_that_is_known_better_is_kept(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    scene = replace(scene, scale_source="camera-height", scale_error=0.05)
    found = find_georeference(scene, places_of(scene, 1.7, 2.1))
    assert isinstance(found, Georeference)
    out = apply_georeference(scene, found, keep_scale=True)
    assert out.scale == pytest.approx(1.0) and out.scale_source == "camera-height"
    assert out.scale_report["gps"]["times"] == pytest.approx(1.7, rel=1e-3)
    assert scale_warnings(out) and "gps makes the scene 1.70 times" in scale_warnings(out)[0]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("few", "GPS of 4 photos is of no use here: it names 4 different places, and 5"),
        ("one spot", "GPS of 9 photos"),
        ("noise", "GPS of 24 photos"),
        ("lag", "GPS of 24 photos is of no use here: it names 1 different places"),
    ],
)
def test_gps_that_says_nothing_is_left_alone_and_told_of(tmp_path, what, words):
    if what == "one spot":
        poses = [look_at((0, 0, 1.6), (math.cos(t), math.sin(t), 1.6)) for t in range(9)]
    else:
        poses = ring(24, radius=2.0)
    scene = scene_of(poses, tmp_path)
    places = places_of(scene, 1.0, 0.0, 8.0 if what == "noise" else 0.0)
    if what == "few":
        places = dict(list(places.items())[:4])
    if what == "lag":
        places = dict.fromkeys(places, places["0.png"])
    found = find_georeference(scene, places)
    assert isinstance(found, Unused) and str(gps_warning(found, {})).startswith(words)


def test_no_gps_is_nothing_to_tell_of(tmp_path):
    found = find_georeference(scene_of(ring(9), tmp_path), {})
    assert isinstance(found, Unused) and gps_warning(found, {}) is None
