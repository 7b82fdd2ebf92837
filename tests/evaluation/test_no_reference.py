"""Scores without truth: each reacts to its fault, and says why it is absent."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.holed_ground import LabelledField
from support.scene_builders import look_at

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, ROAD
from climatenerf.evaluation.no_reference import NAMES, no_reference_scores, no_scores
from climatenerf.field.analytic import Box, HalfSpace
from climatenerf.render import ground_evidence
from climatenerf.render.ground_evidence import terrain_below
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.volume import render_view
from climatenerf.scene.scene import Scene, View
from climatenerf.scene.withheld import EVERY, is_withheld

BOX = Image.Resampling.BOX
CAMERA = Camera(96, 72, 60.0, 60.0, 48.0, 36.0)
WIDE = ((-20.0, -20.0, -3.0), (20.0, 20.0, 8.0))
GROUND = HalfSpace(colour=(0.5, 0.5, 0.5), checker=1.5)
WALL = Box((-6.0, 12.0, -1.0), (6.0, 13.0, 3.0), (0.5, 0.2, 0.1), checker=1.5)
EYES = [(-1.5, -4.0, 1.6), (-0.5, -4.2, 1.6), (0.5, -3.8, 1.6), (1.5, -4.0, 1.6)]


def field(*more, classes=(ROAD, BUILDING)):
    extra = [BUILDING] * len(more)
    return LabelledField([GROUND, WALL, *more], classes=(*classes, *extra), box=WIDE)


@pytest.fixture(autouse=True, scope="module")
def few_nodes():
    """Keep rasters small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_evidence, "MAX_NODES", 96)
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photos, labels and points of level ground in front of a wall."""
    folder = tmp_path_factory.mktemp("capture")
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform((-2, 0.0), (2, 9.0), (400, 2)), np.zeros(400)]
    views = []
    for index, eye in enumerate(EYES):
        c2w = look_at(eye, np.add(eye, (0.0, 6.0, -1.0)))
        fine = render_view(field(), CAMERA.resized(6 * 96, 6 * 72), c2w)
        picture = Image.fromarray((255 * fine + 0.5).astype(np.uint8)).resize((96, 72), BOX)
        path, label_path = folder / f"{index}.png", folder / f"{index}-label.png"
        picture.save(path)
        view = View(path.name, path, 0, c2w, label_path=label_path, seen=np.arange(400))
        bare = replace(view, label_path=None)
        seen = trace_photos(field(), Scene(folder, "test", (CAMERA,), (bare,)))[0].label
        ids = np.array([0, 2, 8, 9, 10, 11, 13], np.uint8)  # Cityscapes
        Image.fromarray(ids[seen]).resize((96, 72), Image.Resampling.NEAREST).save(label_path)
        views.append(view)
    return Scene(folder, "test", (CAMERA,), tuple(views), points=flat)


def scores(scene, fitted):
    photos = trace_photos(fitted, scene)
    return no_reference_scores(fitted, scene, photos, terrain_below(fitted, photos))


@pytest.fixture(scope="module")
def right(capture):
    return scores(capture, field())


def test_a_right_field_has_good_scores(right):
    assert right["ground.present"] > 0.99
    assert right["ground.roughness_cm"] < 2.0
    assert right["neighbours.psnr"] > 15.0
    assert right["floating.components"] == 0 and right["floating.share"] == 0
    assert right["sky.empty"] == 1
    assert right["points.abs_rel"] < 0.01
    assert not right["score_reasons"]


def test_lumps_on_the_ground_worsen_ground_neighbours_and_points(capture, right):
    lumps = [
        Box((x - 0.4, y - 0.4, -1.0), (x + 0.4, y + 0.4, 0.4), (0.5, 0.5, 0.5), checker=1.5)
        for x, y in ((-1.2, 1.0), (0.9, 2.0), (-0.3, 4.0), (1.3, 6.0))
    ]
    lumpy = scores(capture, LabelledField([GROUND, WALL, *lumps], classes=(0, 1), box=WIDE))
    assert lumpy["ground.present"] < right["ground.present"] - 0.03
    assert lumpy["ground.roughness_cm"] > 4 * right["ground.roughness_cm"] + 3
    assert lumpy["neighbours.psnr"] < right["neighbours.psnr"] - 0.3
    assert lumpy["points.abs_rel"] > right["points.abs_rel"] + 0.01
    assert lumpy["floating.components"] == 0


def test_missing_ground_worsens_ground_and_neighbours(capture, right, tmp_path):
    """What no ray meets is taken to be far away, and does not drop out of the score."""
    bare = scores(capture, LabelledField([WALL], classes=(BUILDING,), box=WIDE))
    assert bare["neighbours.psnr"] < right["neighbours.psnr"] - 1.0
    as_sky = []
    for view in capture.views:
        labels = np.asarray(Image.open(view.label_path))
        path = tmp_path / view.label_path.name
        Image.fromarray(np.where(labels == 0, 10, labels).astype(np.uint8)).save(path)
        as_sky.append(replace(view, label_path=path))
    left_out = scores(
        replace(capture, views=tuple(as_sky)), LabelledField([WALL], classes=(BUILDING,), box=WIDE)
    )
    assert bare["neighbours.psnr"] < left_out["neighbours.psnr"] - 0.5
    holes = [Box((x, y, -3.0), (x + 0.9, y + 0.9, 0.0)) for x in (-2, -1, 0, 1) for y in range(8)]
    holed = scores(
        capture, LabelledField([WALL, *holes], classes=(BUILDING, *[ROAD] * 32), box=WIDE)
    )
    assert holed["ground.present"] < 0.98 and right["ground.present"] > 0.99


def test_fields_without_matter_say_so(capture):
    photos = trace_photos(LabelledField([], box=WIDE), capture)
    found = no_reference_scores(LabelledField([], box=WIDE), capture, photos, None)
    assert "no ray" in found["score_reasons"]["neighbours.psnr"]
    assert "hardly any near ground" in found["score_reasons"]["ground.roughness_cm"]
    assert no_scores("why") == dict.fromkeys(NAMES) | {"score_reasons": dict.fromkeys(NAMES, "why")}
    assert set(NAMES) | {"score_reasons"} == set(found)


def test_matter_in_the_air_floats_unless_it_stands(capture):
    cloud = Box((-2.0, 4.0, 2.4), (-1.0, 5.0, 3.0))
    floating = scores(capture, field(cloud))
    assert floating["floating.components"] == 1 and 0.005 < floating["floating.share"] < 0.2
    assert floating["sky.empty"] < 0.99, "it also hides sky"
    standing = scores(capture, field(replace(cloud, lower=(-2.0, 4.0, -1.0))))
    assert standing["floating.components"] == 0


def test_points_count_only_if_they_were_withheld(capture, right):
    """A fit has seen the others, so their depth says nothing new."""
    rows = np.arange(400)
    assert is_withheld(rows).sum() == 400 // EVERY
    moved = np.array(capture.points)
    moved[~is_withheld(rows), 2] += 5.0
    assert (
        scores(replace(capture, points=moved), field())["points.abs_rel"] == right["points.abs_rel"]
    )
    moved = np.array(capture.points)
    moved[is_withheld(rows), 2] -= 1.0
    assert scores(replace(capture, points=moved), field())["points.abs_rel"] > 0.1


def test_scores_that_do_not_apply_say_why(capture):
    views = tuple(replace(view, label_path=None, seen=None) for view in capture.views)
    found = scores(replace(capture, views=views, points=None), field())
    absent = {"ground.present", "ground.roughness_cm", "sky.empty", "points.abs_rel"}
    assert {name for name in found if found[name] is None} == absent
    assert found["score_reasons"].keys() == absent
    photos = trace_photos(field(), capture)
    nowhere = no_reference_scores(field(), capture, photos, None)
    assert nowhere["floating.components"] is None and nowhere["ground.present"] is None
    assert "too little ground" in nowhere["score_reasons"]["floating.share"]
