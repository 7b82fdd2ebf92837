import numpy as np
from support.scene_builders import (
    STREET_CAMERA,
    angle,
    look_at,
    posts_image,
    random_rotation,
    ring,
    street_scene,
)

from climatenerf.scene.alignment.vanishing_point import (
    find_vanishing_point,
    segment_normals,
    upright_segments,
    vanishing_point_from_normals,
    vanishing_point_with_split_error,
)

UP = np.array([0.0, 0.0, 1.0])


def test_segments_are_found_at_the_edges_of_posts():
    posts = np.array([[[-1.0, 6, 0], [-1, 6, 3]], [[1.5, 7, 0.5], [1.5, 7, 3]]])
    pose = look_at((0, 0, 1.6), (0, 6, 1.4))
    grey = np.asarray(posts_image(STREET_CAMERA, pose, posts).convert("L"), dtype=np.float64)
    ends, lengths = upright_segments(grey, STREET_CAMERA, pose[:3, :3].T @ UP)
    assert 4 <= len(ends) <= 8  # both sides of both posts, possibly split
    normals = segment_normals(ends, STREET_CAMERA, pose[:3, :3])
    assert np.degrees(np.arcsin(np.abs(normals @ UP))).max() < 0.3
    assert lengths.sum() > 300


def lines_with_outliers():
    """60 normals of lines near the vertical `up`, then 60 of other lines; `guess` is near `up`."""
    random = np.random.default_rng(0)
    guess = random_rotation(1)[0]
    up = guess + 0.1 * random.normal(size=3)
    up /= np.linalg.norm(up)
    good = np.cross(up, random.normal(size=(60, 3))) + 0.004 * random.normal(size=(60, 3))
    bad = np.cross(guess + 0.4 * random.normal(size=(60, 3)), random.normal(size=(60, 3)))
    normals = np.concatenate([good, bad])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True), guess, up


def test_vanishing_point_is_robust_to_false_lines():
    normals, guess, up = lines_with_outliers()
    found = vanishing_point_from_normals(normals, np.ones(120), np.arange(120) % 10, guess)
    assert found is not None and angle(found.up, up) < 0.5
    assert found.images == 10 and 0.4 < found.fraction < 0.7
    assert vanishing_point_from_normals(normals[:3], np.ones(3), np.arange(3), guess) is None


def test_split_error_distinguishes_vertical_edges_from_chance_agreement():
    normals, guess, _ = lines_with_outliers()
    image = np.arange(120) % 16
    vertical = vanishing_point_with_split_error(normals, np.ones(120), image, guess)
    chance = vanishing_point_with_split_error(normals[60:], np.ones(60), image[60:], guess)
    assert vertical is not None and vertical.sigma < 1
    assert chance is None or chance.sigma > 1.5


def test_blank_images_have_no_vanishing_point(tmp_path):
    scene, up = street_scene(tmp_path, ring(4), None, [])
    assert find_vanishing_point(scene, up) is None
