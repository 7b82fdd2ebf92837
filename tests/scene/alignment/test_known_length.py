from dataclasses import replace

import numpy as np
import pytest
from support.scene_builders import ring

from climatenerf.core.errors import UserError
from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.alignment.known_length import (
    LengthMeasurement,
    apply_known_lengths,
    measure,
    read_marks,
)
from climatenerf.scene.findings import Finding

CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, k1=-0.05)
FOOT, HEAD = np.array([0.3, -0.2, 0.0]), np.array([0.3, -0.2, 2.0])


@pytest.fixture
def scene(tmp_path):
    views = tuple(
        View(f"{i:03}.jpg", tmp_path / f"{i:03}.jpg", 0, pose)
        for i, pose in enumerate(ring(9, radius=6.0))
    )
    return Scene(
        tmp_path, "test", (CAMERA,), views, scale_source="camera-height-assumed",
        scale_error=0.3, lowest_ground_z=-1.0,
        findings=(Finding("scale-assumed", "1.6 m"), Finding("gps", "Other")),
    )  # fmt: skip


def make_marks(scene, names=("000.jpg", "002.jpg", "004.jpg"), noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    marks = {"DOOR": {"from": {}, "to": {}}}
    for end, point in (("from", FOOT), ("to", HEAD)):
        for view in scene.views:
            if view.name in names:
                w2c = np.linalg.inv(scene.c2w_world(view))
                pixel = CAMERA.project(w2c[:3, :3] @ point + w2c[:3, 3])
                pixel = pixel + noise * rng.normal(size=2)
                marks["DOOR"][end][view.name] = tuple(float(x) for x in pixel)
    return marks


def test_length_is_measured_through_a_distorted_lens(scene):
    found = measure(scene, make_marks(scene), "DOOR", 2.0)
    assert found.measured == pytest.approx(2.0, abs=1e-6)
    # Marks are accurate to 2 pixels, here 2 cm, in three images at either end.
    assert 0.005 < found.error < 0.02


def test_error_matches_the_scatter_of_the_lengths(scene):
    lengths = [measure(scene, make_marks(scene, noise=6.0, seed=s), "DOOR", 2.0) for s in range(80)]
    actual = np.sqrt(np.mean([(m.measured / 2 - 1) ** 2 for m in lengths]))
    assert np.mean([m.error for m in lengths]) == pytest.approx(actual, rel=0.6)


def test_scene_is_scaled_about_its_ground_datum(scene):
    length = measure(scene, make_marks(scene), "DOOR", 3.0)
    out = apply_known_lengths(replace(scene, ground_z=0.5), [length])
    assert out.scale == pytest.approx(1.5) and out.scale_source == "known-length"
    assert out.scale_error == pytest.approx(length.error)
    assert out.lowest_ground_z == pytest.approx(0.5 - 1.5 * 1.5)
    height = scene.c2w_world(scene.views[0])[2, 3] - 0.5
    assert out.c2w_world(out.views[0])[2, 3] - 0.5 == pytest.approx(1.5 * height)
    assert out.warnings == ("Other.",)
    entry = out.scale_report["camera-height-assumed"]
    assert entry == {"times": pytest.approx(1 / 1.5), "error": 0.3}


def test_several_lengths_are_averaged_and_disagreement_is_a_warning(scene):
    good, bad = LengthMeasurement("A", 2.0, 1.0, 0.01), LengthMeasurement("B", 3.0, 1.0, 0.01)
    out = apply_known_lengths(scene, [good, replace(good, name="C", measured=1.01)])
    assert out.scale == pytest.approx(1.99, abs=0.01)
    assert not any("disagree" in w for w in out.warnings)
    out = apply_known_lengths(scene, [good, bad])
    assert any("disagree" in w and "B x3.00" in w for w in out.warnings)
    assert out.scale_error == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("DOOR"), "contain no 'DOOR'"),
        (lambda m: m["DOOR"]["to"].update({"x.jpg": (1.0, 1.0)}), "x.jpg"),
        (lambda m: m["DOOR"]["to"].update({"000.jpg": (900.0, 1.0)}), "outside"),
        (lambda m: m["DOOR"].update(to=m["DOOR"]["from"]), "same position"),
    ],
)
def test_unusable_marks_raise(scene, change, message):
    marks = make_marks(scene)
    change(marks)
    with pytest.raises(UserError, match=message):
        measure(scene, marks, "DOOR", 2.0)


def test_marks_from_nearly_one_position_raise(scene):
    twin = replace(scene.views[0], name="twin.jpg")
    scene = replace(scene, views=(*scene.views, twin))
    with pytest.raises(UserError, match="nearly one position"):
        measure(scene, make_marks(scene, ("000.jpg", "twin.jpg")), "DOOR", 2.0)


def test_read_marks_and_malformed_files(tmp_path):
    path = tmp_path / "marks.toml"
    with pytest.raises(UserError, match="mark.html"):
        read_marks(path)
    path.write_text('[D.from]\n"a.jpg" = [1, 2.5]\n"b.jpg" = [3, 4]\n[D.to]\n"a.jpg" = [5, 6]\n'
                    '"b.jpg" = [7, 8]\n')  # fmt: skip
    assert read_marks(path)["D"]["from"]["a.jpg"] == (1.0, 2.5)
    for text in (
        "[D", '[D.from]\n"a.jpg" = [1, 2]\n"b.jpg" = [1, 2]\n', "D = 3",
        '[D.from]\n"a.jpg" = [1, 2]\n[D.to]\n"a.jpg" = [1, 2]\n',
        '[D.from]\n"a.jpg" = [1, true]\n"b.jpg" = [1, 2]\n[D.to]\n"a.jpg" = [1, 2]\n"b.jpg" = 3\n',
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(UserError):
            read_marks(path)
