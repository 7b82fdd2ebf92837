import numpy as np
from support.scene_builders import angle, look_at, ring, street, street_scene, tilted, up_of

from climatenerf.scene.alignment.up import UpEstimate, combine, up_from_cameras
from climatenerf.scene.alignment.world_frame import align_scene

UP = np.array([0.0, 0.0, 1.0])


def test_vertical_lines_correct_a_common_pitch(tmp_path):
    # All cameras look in one direction and 7 degrees down, so only the posts determine up.
    _, posts = street()
    posts = posts + (0.0, 9.0, 0.0)
    poses = [
        look_at((x, 0, 1.6), (x, 10.0, 1.6 - 10 * np.tan(np.radians(7)))) for x in range(-4, 5)
    ]
    scene, up = street_scene(tmp_path, poses, None, posts, seed=1)
    out = align_scene(scene)
    assert angle(up_of(out), up) < 1
    assert out.up_report["cameras"] > 5 and "lines" in out.up_report["used"]
    # The pitch that cameras have in common may be 8 degrees, so there is no warning.
    assert not any("Up is uncertain" in w for w in out.warnings)


def gravity_readings(scene, up, tilt=0.0):
    """Accelerometer readings of the cameras, alternately off by `tilt` degrees in either sense."""
    down = {}
    for i, view in enumerate(scene.views):
        local = view.c2w[:3, :3].T @ -up
        a = np.radians(tilt if i % 2 else -tilt)
        rotation = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        down[view.name] = tuple(rotation @ local)
    return down


def test_gravity_determines_up_for_nadir_images(tmp_path):
    # All cameras look straight down, as from a drone, so their axes do not determine up.
    poses = [look_at((x, 0, 20.0), (x, 0.001, 0.0)) for x in range(-4, 5)]
    scene, up = street_scene(tmp_path, poses, None, street()[1], seed=2)
    assert angle(up_of(align_scene(scene)), up) > 45
    out = align_scene(scene, gravity=gravity_readings(scene, up, tilt=2.0))
    assert angle(up_of(out), up) < 1 and out.up_report["used"].startswith("gravity")
    assert out.up_report["cameras"] > 45
    assert any("Up is uncertain: cameras" in w for w in out.warnings)


def test_inconsistent_or_rare_gravity_readings_are_ignored(tmp_path):
    points, posts = street()
    scene, up = street_scene(tmp_path, ring(9), points, posts)
    inconsistent = gravity_readings(scene, up)
    rng = np.random.default_rng(0)
    for name in inconsistent:
        v = rng.normal(size=3)
        inconsistent[name] = tuple(v / np.linalg.norm(v))
    rare = dict(list(gravity_readings(scene, up).items())[:2])
    for gravity in (inconsistent, rare):
        out = align_scene(scene, gravity=gravity)
        assert "gravity" not in out.up_report and angle(up_of(out), up) < 1
    one_wrong = gravity_readings(scene, up) | {scene.views[0].name: (0.0, 0.0, 1.0)}
    assert align_scene(scene, gravity=one_wrong).up_report["gravity"] < 1


def test_up_from_cameras_ignores_a_common_pitch_if_headings_differ():
    poses = np.stack([tilted(p, 0, -15) for p in ring(16)])
    axes = np.stack([poses[:, :3, 0], -poses[:, :3, 1]], axis=-1)
    estimate = up_from_cameras(axes)
    assert angle(estimate.direction, UP) < 0.01 and estimate.sigma < 5


def test_combine_rejects_an_unconfirmed_outlier_and_follows_a_majority():
    def estimate(tilt, sigma, method):
        t = np.radians(tilt)
        return UpEstimate(np.array([np.sin(t), 0, np.cos(t)]), sigma, method)

    up, used = combine([estimate(0, 5, "cameras"), estimate(18, 0.6, "lines")])
    assert used == "cameras" and angle(up, UP) < 1e-6
    up, used = combine(
        [estimate(0, 8, "cameras"), estimate(17, 2.5, "ground"), estimate(18, 0.6, "lines")]
    )
    assert used == "lines+ground" and 17.8 < angle(up, UP) < 18
    up, used = combine(
        [estimate(0, 3, "cameras"), estimate(1, 2.5, "ground"), estimate(18, 0.6, "lines")]
    )
    assert used == "ground+cameras" and angle(up, UP) < 1
