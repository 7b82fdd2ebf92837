import math
from dataclasses import replace

import numpy as np
import pytest
from support.scene_builders import look_at, ring

from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.alignment.georeference import (
    Georeference,
    UnusableGps,
    apply_georeference,
    east_north,
    find_georeference,
    gps_finding,
)
from climatenerf.scene.alignment.scale import scale_findings
from climatenerf.scene.findings import Finding

CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
HOME = np.array([47.3769, 8.5417])
# Arc lengths at HOME, m per degree, from the standard series in cosines of the latitude.
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
        findings=(Finding("scale-assumed", "The scale is assumed"), Finding("gps", "Else")),
    )  # fmt: skip


def gps_positions(scene, scale, heading, noise=0.0, seed=0):
    """GPS positions for a true scale of `scale` and rotation by `heading`; `noise` in metres."""
    rng = np.random.default_rng(seed)
    out = {}
    for view in scene.views:
        x, y = view.c2w[:2, 3]
        east = scale * (math.cos(heading) * x - math.sin(heading) * y) + noise * rng.normal()
        north = scale * (math.sin(heading) * x + math.cos(heading) * y) + noise * rng.normal()
        out[view.name] = (HOME[0] + north / LAT_M, HOME[1] + east / LON_M, 400.0)
    return out


def test_east_north_matches_the_series_of_arc_lengths():
    nearby = HOME + np.array([[0.001, 0.0], [0.0, 0.001]])
    metres = east_north(nearby, HOME)
    assert metres[0] == pytest.approx([0, LAT_M / 1000], abs=0.01)
    assert metres[1] == pytest.approx([LON_M / 1000, 0], abs=0.01)
    across = east_north(np.array([[0.0, -179.9995]]), np.array([0.0, 179.9995]))
    assert across[0] == pytest.approx([111.32, 0], abs=0.01), "across the date line"


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_georeference_recovers_scale_and_heading(tmp_path, noise):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    positions = gps_positions(scene, 1.7, 2.1, noise)
    found = find_georeference(scene, positions)
    assert isinstance(found, Georeference) and gps_finding(found, {}) is None
    assert found.scale == pytest.approx(1.7, rel=max(1e-3, 3 * found.scale_error))
    assert found.scale_error < 0.06
    assert found.heading == pytest.approx(2.1, abs=max(1e-3, 3 * found.scale_error))
    out = apply_georeference(scene, found, keep_scale=False)
    assert out.scale == pytest.approx(found.scale) and out.scale_source == "gps"
    assert out.ground_z == 0 and out.lowest_ground_z == pytest.approx(-2 * found.scale)
    assert out.warnings == ("Else.",)
    assert out.georeference["photos"] == 24
    assert out.scale_report["camera-height-assumed"]["times"] == pytest.approx(1 / found.scale)
    # x is east, y is north.
    origin = np.array(found.origin)
    for view in out.views:
        east, north = east_north(np.array([positions[view.name][:2]]), origin)[0]
        assert out.c2w_world(view)[:2, 3] == pytest.approx([east, north], abs=4 * noise + 0.02)


def test_scale_error_matches_the_scatter_of_the_scale(tmp_path):
    scene = scene_of(ring(30, radius=20.0), tmp_path)
    found = [
        find_georeference(scene, gps_positions(scene, 1.0, 0.3, 1.5, seed)) for seed in range(60)
    ]
    actual = np.std([f.scale - 1 for f in found])
    estimated = np.mean([f.scale_error for f in found])
    assert estimated == pytest.approx(actual, rel=0.35)


def drifting(scene, noise, correlation, seed):
    """Positions whose errors change slowly from photo to photo, as those of a receiver do."""
    rng = np.random.default_rng(seed)
    error, out = rng.normal(size=2), {}
    for view in scene.views:
        x, y = view.c2w[:2, 3] + noise * error
        out[view.name] = (HOME[0] + y / LAT_M, HOME[1] + x / LON_M, 400.0)
        innovation = math.sqrt(1 - correlation**2) * rng.normal(size=2)
        error = correlation * error + innovation
    return out


@pytest.mark.parametrize(("count", "noise", "correlation"), [(60, 3.0, 0.9), (8, 1.5, 0.0)])
def test_scale_error_accounts_for_drift_and_few_photos(tmp_path, count, noise, correlation):
    scene = scene_of(ring(count, radius=20.0), tmp_path)
    found = [find_georeference(scene, drifting(scene, noise, correlation, s)) for s in range(80)]
    ratio = [(f.scale - 1) / f.scale_error for f in found if isinstance(f, Georeference)]
    assert len(ratio) > 20 and np.sqrt(np.mean(np.square(ratio))) < 2.2


def test_drift_as_large_as_the_path_makes_gps_unusable(tmp_path):
    scene = scene_of(ring(48, radius=3.0), tmp_path)
    found = [find_georeference(scene, drifting(scene, 4.0, 0.95, seed)) for seed in range(60)]
    assert np.mean([isinstance(f, UnusableGps) for f in found]) > 0.8


def test_consecutive_photos_with_one_position_count_as_one_fix(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    positions = gps_positions(scene, 1.0, 0.0, 1.0)
    names = [view.name for view in scene.views]
    lagging = {name: positions[names[i // 4 * 4]] for i, name in enumerate(names)}
    found = find_georeference(scene, lagging)
    assert isinstance(found, Georeference) and found.photos == 24
    assert abs(found.scale - 1) < 3 * found.scale_error
    assert found.scale_error > 1.5 * find_georeference(scene, positions).scale_error


def test_a_third_of_outliers_is_left_out(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    positions = gps_positions(scene, 1.3, 0.5, 0.5)
    for i in range(8):
        lat, lon, alt = positions[f"{i}.png"]
        positions[f"{i}.png"] = (lat + 0.002, lon - 0.001, alt)
    found = find_georeference(scene, positions)
    assert isinstance(found, Georeference) and found.scale == pytest.approx(1.3, rel=0.05)
    assert set(found.left_out) == {f"{i}.png" for i in range(8)} and found.photos == 16
    warning = str(gps_finding(found, {"0.png": "IMG_0.HEIC"}))
    assert warning is not None
    assert "GPS of 8 of 24 photos" in warning and "IMG_0.HEIC, 1.png, " in warning


def test_keep_scale_adds_gps_to_the_scale_report(tmp_path):
    scene = scene_of(ring(24, radius=15.0), tmp_path)
    scene = replace(scene, scale_source="camera-height", scale_error=0.05)
    found = find_georeference(scene, gps_positions(scene, 1.7, 2.1))
    assert isinstance(found, Georeference)
    out = apply_georeference(scene, found, keep_scale=True)
    assert out.scale == pytest.approx(1.0) and out.scale_source == "camera-height"
    assert out.scale_report["gps"]["times"] == pytest.approx(1.7, rel=1e-3)
    (warning,) = map(str, scale_findings(out))
    assert warning.startswith("The scale from gps is 1.70 times the one from camera-height")


@pytest.mark.parametrize(
    ("case", "warning"),
    [
        ("few", "GPS of 4 photos is of no use here: it has 4 distinct position(s), and 5"),
        ("one position", "GPS of 9 photos"),
        ("noise", "GPS of 24 photos"),
        ("lag", "GPS of 24 photos is of no use here: it has 1 distinct position(s)"),
    ],
)
def test_insufficient_gps_gives_a_warning(tmp_path, case, warning):
    if case == "one position":
        poses = [look_at((0, 0, 1.6), (math.cos(t), math.sin(t), 1.6)) for t in range(9)]
    else:
        poses = ring(24, radius=2.0)
    scene = scene_of(poses, tmp_path)
    positions = gps_positions(scene, 1.0, 0.0, 8.0 if case == "noise" else 0.0)
    if case == "few":
        positions = dict(list(positions.items())[:4])
    if case == "lag":
        positions = dict.fromkeys(positions, positions["0.png"])
    found = find_georeference(scene, positions)
    assert isinstance(found, UnusableGps) and str(gps_finding(found, {})).startswith(warning)


def test_absent_gps_gives_no_warning(tmp_path):
    found = find_georeference(scene_of(ring(9), tmp_path), {})
    assert isinstance(found, UnusableGps) and gps_finding(found, {}) is None
