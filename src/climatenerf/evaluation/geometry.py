"""How right a fitted place is: depth, normals, floaters, sky, classes, against the truth."""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from climatenerf.evaluation.reference import Truth
from climatenerf.scene import Camera, Scene
from climatenerf.scene.images import load_labels

FARTHEST = 50.0  # m: beyond it photos of a walk say little about distance
MARGIN, MARGIN_SHARE = 0.1, 0.05  # m, and of the depth: matter this close before a surface is its
EMPTY = 0.99  # transmittance of what counts as empty sky
# Cityscapes train ids as the paper's seven classes; 255 is unknown.
ROAD, BUILDING, VEGETATION, TERRAIN, SKY, PERSON, VEHICLE = range(7)
CLASS_NAMES = ("road", "building", "vegetation", "terrain", "sky", "person", "vehicle")
MERGED = np.full(256, 255, np.uint8)
MERGED[[0, 1]] = ROAD
MERGED[2:8] = BUILDING
MERGED[8], MERGED[9], MERGED[10] = VEGETATION, TERRAIN, SKY
MERGED[[11, 12]] = PERSON
MERGED[13:19] = VEHICLE
TALLEST_ROOF = 0.5  # upward part of a normal from which a building's surface is a roof
VOTERS = 24  # training views that are asked for a test view's classes
AGREE = 0.05  # of the distance: a view sees a place if its depth there is this near
ROUNDS = 20000  # places at once


def depth_scores(depth: list[np.ndarray], truths: tuple[Truth, ...]) -> dict[str, float]:
    """Relative and absolute error of ray lengths, where the truth is nearer than `FARTHEST`.

    A ray that meets nothing, or something beyond twice the truth, counts as twice the truth, so
    that a single hole does not outweigh all else.
    """
    relative, metres = [], []
    for ours, truth in zip(depth, truths, strict=True):
        near = truth.depth < FARTHEST
        real = truth.depth[near].astype(np.float64)
        error = np.minimum(ours[near], 2 * real) - real
        relative.append(np.abs(error) / real)
        metres.append(error**2)
    return {
        "depth_abs_rel": float(np.concatenate(relative).mean()),
        "depth_rmse_m": float(np.sqrt(np.concatenate(metres).mean())),
    }


def normal_scores(normal: list[np.ndarray], truths: tuple[Truth, ...]) -> dict[str, float]:
    """Angles between true normals and ours, both in camera axes, in degrees.

    Medians over places nearer than `FARTHEST`: without vegetation, on ground and roofs alone, and
    over all. A pixel without a surface counts as 90 degrees.
    """
    angles, smooth, level = [], [], []
    for ours, truth in zip(normal, truths, strict=True):
        near = truth.depth < FARTHEST
        cosine = (ours * truth.normal).sum(-1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[near])
        smooth.append((MERGED[truth.label] != VEGETATION)[near])
        level.append(ground_or_roof(truth)[near])
    angle, plain, flat = (np.concatenate(each) for each in (angles, smooth, level))
    return {
        "normal_median_deg": _median(angle[plain]),
        "normal_ground_roof_median_deg": _median(angle[flat]),
        "normal_all_median_deg": _median(angle),
    }


def ground_or_roof(truth: Truth) -> Bool[np.ndarray, "h w"]:
    """Road, terrain, and what of the buildings looks up."""
    kind = MERGED[truth.label]
    up = truth.c2w[2, :3]  # in the camera's axes
    roof = (kind == BUILDING) & (truth.normal @ up > TALLEST_ROOF)
    return (kind == ROAD) | (kind == TERRAIN) | roof


def free_space(truth: Truth) -> Float[np.ndarray, "h w"]:
    """Ray length, m, up to which the truth is empty with a margin; +inf in the sky."""
    return np.maximum((1 - MARGIN_SHARE) * truth.depth - MARGIN, 0.0)


def emptiness_scores(
    absorbed: list[Float[np.ndarray, "h w"]],
    skyward: list[Float[np.ndarray, "h w"]],
    truths: tuple[Truth, ...],
) -> dict[str, float]:
    """Matter where there is none.

    Args:
        absorbed: share of light lost within `free_space`.
        skyward: transmittance of whole rays.
        truths: of the same views.

    Returns:
        `floater_mass`, the mean share lost before the surface; `sky_empty_fraction`, the share of
        true sky pixels that at least `EMPTY` of the light passes.
    """
    lost = np.concatenate([a[~t.sky] for a, t in zip(absorbed, truths, strict=True)])
    passed = np.concatenate([s[t.sky] for s, t in zip(skyward, truths, strict=True)])
    return {
        "floater_mass": float(lost.mean()),
        "sky_empty_fraction": float((passed >= EMPTY).mean()) if passed.size else float("nan"),
    }


def voted_labels(
    scene: Scene,
    depths: dict[str, Float[np.ndarray, "h w"]],
    points: Float[np.ndarray, "h w 3"],
    sky: Bool[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w"]:
    """Classes of a new view by the vote of the training views that see the same places.

    A field without classes of its own still has geometry, and the training photos have labels: a
    place takes the class that most of the views give it which see it, by their own depth.

    Args:
        scene: the run's scene, with labels.
        depths: our depth of some of its training views, by name.
        points: places that the new view sees, world m.
        sky: where it sees none.

    Returns:
        Merged classes; 255 where no view sees the place.
    """
    flat = points.reshape(-1, 3)
    votes = np.zeros((len(flat), len(CLASS_NAMES)), np.int32)
    for view in scene.views:
        label = None if view.name not in depths else load_labels(view, scene)
        if label is None:
            continue
        camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
        depth = depths[view.name]
        for start in range(0, len(flat), ROUNDS):
            some = slice(start, start + ROUNDS)
            local = (flat[some] - c2w[:3, 3]) @ c2w[:3, :3]
            row, column, inside = nearest_pixels(camera, local)
            distance = np.linalg.norm(local, axis=-1)
            seen = inside & (np.abs(depth[row, column] - distance) < AGREE * distance)
            kind = MERGED[label[row, column]]
            seen &= (kind < len(CLASS_NAMES)) & (kind != SKY)
            np.add.at(votes[some], (np.flatnonzero(seen), kind[seen]), 1)
    out = np.where(votes.any(-1), votes.argmax(-1), 255).astype(np.uint8).reshape(points.shape[:2])
    out[sky] = SKY
    return out


def nearest_pixels(
    camera: Camera, local: Float[np.ndarray, "*n 3"]
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "*n"]]:
    """Row, column (0 where outside) of points in camera axes, and whether they are in the picture.

    Points behind the camera project to NaN, which is outside.
    """
    pixel = camera.project(local)
    with np.errstate(invalid="ignore"):
        inside = np.asarray((pixel >= 0).all(-1) & (pixel < (camera.width, camera.height)).all(-1))
    whole = np.where(inside[..., None], np.floor(np.nan_to_num(pixel)), 0).astype(np.int64)
    return whole[..., 1], whole[..., 0], inside


def label_scores(
    labels: list[UInt8[np.ndarray, "h w"]], truths: tuple[Truth, ...]
) -> dict[str, float]:
    """Intersection over union of each class that occurs, and their mean; unknown is wrong."""
    ours = np.concatenate([each.ravel() for each in labels])
    real = np.concatenate([MERGED[truth.label].ravel() for truth in truths])
    known = real != 255
    ours, real = ours[known], real[known]
    each = {}
    for kind, name in enumerate(CLASS_NAMES):
        if (real == kind).any():
            union = ((ours == kind) | (real == kind)).sum()
            each[f"iou_{name}"] = float(((ours == kind) & (real == kind)).sum() / union)
    return {"miou": float(np.mean(list(each.values()))), **each}


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else float("nan")
