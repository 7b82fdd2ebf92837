"""Sky by its looks: pictures with known sky, rooms without, and the reference street."""

from pathlib import Path

import numpy as np
import pytest
from scene.scene_builders import names_of, ring, write_colmap, write_images

from climatenerf.perception.simple import SKY, find_sky, shows_sky, sky_labels
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_labels

STREET = Path(__file__).parents[2] / "reference" / "street"
HEIGHT, WIDTH = 120, 200


def upward(horizon=70, roll=0):
    """Sine above the horizon of the rays of an upright or rolled camera."""
    rows = np.broadcast_to((horizon - np.arange(HEIGHT))[:, None] / 150, (HEIGHT, WIDTH))
    return np.rot90(rows, roll).astype(np.float32)


def textured(seed=0, base=(90, 80, 50)):
    noise = np.random.default_rng(seed).integers(-40, 41, (HEIGHT, WIDTH, 1))
    return np.clip(np.asarray(base) + noise, 0, 255).astype(np.uint8)


def landscape(top=(110, 160, 235), low=(200, 215, 240), edge=50):
    """A gradient sky over textured ground, and where the sky is."""
    share = np.linspace(0, 1, edge)[:, None, None]
    picture = textured()
    picture[:edge] = np.rint(np.asarray(top) * (1 - share) + np.asarray(low) * share)
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[:edge] = True
    return picture, sky


NO_POINTS = np.zeros((HEIGHT, WIDTH), bool)


@pytest.mark.parametrize(
    "colours", [((110, 160, 235), (200, 215, 240)), ((225, 228, 232), (245, 246, 248))]
)
def test_blue_and_overcast_skies_are_found_up_to_their_edge(colours):
    picture, sky = landscape(*colours)
    found = find_sky(picture, upward(), NO_POINTS)
    assert not (found & ~sky).any()
    assert found.sum() > 0.9 * sky.sum() and not found[47:50].any(), "the edge is doubtful"


def test_a_camera_on_its_side_sees_the_same_sky():
    picture, _ = landscape()
    upright = find_sky(picture, upward(), NO_POINTS)
    for roll in (1, 2, 3):
        turned = np.ascontiguousarray(np.rot90(picture, roll))
        found = find_sky(turned, upward(roll=roll), np.rot90(NO_POINTS, roll))
        np.testing.assert_array_equal(np.rot90(found, -roll), upright)


def test_wires_do_not_stop_the_sky_and_clouds_belong_to_it():
    picture, sky = landscape()
    picture[20:22] = 40
    picture[30:40, 60:90] = 250
    found = find_sky(picture, upward(), NO_POINTS)
    assert found[5:15].all() and found[27:29].all() and found[30:40, 60:90].all()
    assert not found[20:22].any() and not (found & ~sky).any()


def test_what_goes_on_below_the_horizon_is_no_sky():
    wall = np.full((HEIGHT, WIDTH, 3), 235, np.uint8)
    wall[100:] = textured()[100:]
    assert not find_sky(wall, upward(), NO_POINTS).any()


def test_a_room_has_no_sky():
    """Warm walls, a white wall no brighter than the window, and a ceiling in dim light."""
    for colour in ((240, 232, 215), (150, 152, 155)):
        picture = textured()
        picture[:50] = colour
        assert not find_sky(picture, upward(), NO_POINTS).any()
    picture = textured()
    picture[:50] = (215, 216, 218)
    picture[55:75, 50:190] = 255
    assert not find_sky(picture, upward(), NO_POINTS).any()


def test_points_of_matter_are_no_sky():
    picture, _ = landscape()
    some = NO_POINTS.copy()
    some[10:20, 30:40] = True
    found = find_sky(picture, upward(), some)
    assert found.any() and not found[some].any()
    some[:40] = True
    assert not find_sky(picture, upward(), some).any()


def test_a_capture_without_sky_is_not_outdoors(tmp_path):
    names = names_of(9)
    write_images(tmp_path / "images", names)  # plain and dark
    write_colmap(tmp_path / "sparse" / "0", ring(9), names)
    scene = read_scene(tmp_path)
    assert not shows_sky(scene)
    assert (sky_labels(scene.views[0], scene) == 255).all()


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_sky_of_the_street_is_sky():
    scene = read_scene(STREET, holdout="0")
    assert shows_sky(scene)
    right = wrong = missed = 0
    for view in scene.views[::7]:
        labels = sky_labels(view, scene)
        assert set(np.unique(labels)) <= {SKY, 255}
        truth = load_labels(view, scene) == SKY
        found = labels == SKY
        right += (found & truth).sum()
        wrong += (found & ~truth).sum()
        missed += (truth & ~found).sum()
    assert right / (right + wrong) > 0.999
    assert right / (right + missed) > 0.7


@pytest.mark.slow
def test_sky_of_real_captures_and_none_in_a_room(captures):
    """The labels are a network's, and miss some sky between branches."""
    for name, precision, recall in (("ditch", 0.95, 0.65), ("stone_sign", 0.75, 0.65)):
        scene = read_scene(captures / name, holdout="0")
        assert shows_sky(scene), name
        found = [sky_labels(view, scene) == SKY for view in scene.views[::12]]
        truth = [load_labels(view, scene) == SKY for view in scene.views[::12]]
        right = np.sum([f & t for f, t in zip(found, truth, strict=True)])
        assert right > precision * np.sum(found) and right > recall * np.sum(truth), name
    assert not shows_sky(read_scene(captures / "fox", holdout="0"))
