from dataclasses import replace

import numpy as np
import pytest
from support.textured_scene import CAMERA, textured_scene

from climatenerf.scene.checks.appearance import MAX_PHOTOS, appearance_findings, shared_pairs
from climatenerf.scene.checks.check import corrected


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photos that show each other's points."""
    found = textured_scene(tmp_path_factory.mktemp("images"), 30)
    views = []
    for view in found.views:
        local = (found.points - view.c2w[:3, 3]) @ view.c2w[:3, :3]
        x, y = CAMERA.project(local).T
        inside = (x >= 0) & (y >= 0) & (x < CAMERA.width) & (y < CAMERA.height)
        views.append(replace(view, seen=np.flatnonzero(inside & (local[:, 2] > 0))))
    return replace(found, views=tuple(views))


def exchanged(scene, *pairs):
    views = list(scene.views)
    for a, b in pairs:
        views[a], views[b] = (
            replace(views[a], path=scene.views[b].path),
            replace(views[b], path=scene.views[a].path),
        )
    return replace(scene, views=tuple(views))


def test_photos_that_show_their_points_are_not_odd(scene):
    assert appearance_findings(scene) == []
    assert corrected(scene).findings == ()


def test_few_photos_are_read_and_compared_with_those_that_share_points(scene):
    pairs = shared_pairs(scene.views)
    assert len({i for pair in pairs for i in pair}) <= MAX_PHOTOS
    apart = [abs(a - b) for a, b in pairs]
    assert max(min(d, 30 - d) for d in apart) <= 3, "neighbours on the round walk"


def test_exchanged_photos_are_found_and_named(scene):
    (finding,) = corrected(exchanged(scene, (0, 16))).findings
    assert finding.code == "photo-exchanged" and "000.png" in finding.message
    assert finding.message.startswith("2 of 24 compared photos") and finding.remedy
    assert finding.file == str(scene.views[16].path), "the file that has the name of another"


def test_photos_that_are_all_named_wrongly_are_found(scene):
    order = np.random.default_rng(0).permutation(30)
    moved = list(zip(order[::2].tolist(), order[1::2].tolist(), strict=True))
    (finding,) = corrected(exchanged(scene, *moved)).findings
    assert finding.code == "photo-exchanged" and "files had other names" in finding.message


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.25, 1.5])
def test_a_wrong_focal_length_is_found_and_the_right_one_named(scene, factor):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    (finding,) = corrected(replace(scene, cameras=(camera,))).findings
    assert finding.code == "focal-disagrees"
    named = float(finding.message.split("about ")[1].split()[0])
    assert named == pytest.approx(CAMERA.fx, rel=0.04)


def test_points_that_no_two_photos_share_leave_the_question_to_matches(scene):
    alone = [replace(view, seen=np.arange(120) + 120 * i) for i, view in enumerate(scene.views)]
    alone = replace(scene, views=tuple(alone))
    assert appearance_findings(alone) is None and corrected(alone).findings == ()
    camera = replace(CAMERA, fx=CAMERA.fx / 2, fy=CAMERA.fy / 2)
    assert [f.code for f in corrected(replace(alone, cameras=(camera,))).findings] == [
        "focal-disagrees"
    ]
