"""How right a fitted place is: depth, normals, floaters, sky, classes, against the truth."""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from climatenerf.core.classes import (
    BUILDING,
    CLASS_NAMES,
    MERGED,
    ROAD,
    TERRAIN,
    UNKNOWN,
    VEGETATION,
)
from climatenerf.evaluation.reference import Truth
from climatenerf.scene import Camera

HOLE = 1.5  # times the true distance: ground seen beyond that is missing
FARTHEST = 50.0  # m: beyond it photos of a walk say little about distance
MARGIN, MARGIN_SHARE = 0.1, 0.05  # m, and of the depth: matter this close before a surface is its
EDGE, EDGE_SHARE = 0.1, 0.1  # m, and of the depth: a neighbour so much nearer makes an edge
EMPTY = 0.99  # transmittance of what counts as empty sky
CLEAR = 1.0  # m: how far around a place nothing stands over open ground,
STANDING = 0.5  # m: and from which height it counts
EVERY = 41  # of the pixels that show ground are asked for what is above them
TALLEST_ROOF = 0.5  # upward part of a normal from which a building's surface is a roof


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


def ground_holes(depth: list[np.ndarray], truths: tuple[Truth, ...]) -> float:
    """Share of road and terrain nearer than `FARTHEST` that is seen through.

    Args:
        depth: ray lengths of the field, in true metres; +inf where nothing is.
        truths: the same views.
    """
    seen_through = []
    for own, truth in zip(depth, truths, strict=True):
        ground = np.isin(MERGED[truth.label], (ROAD, TERRAIN)) & (truth.depth < FARTHEST)
        seen_through.append(own[ground] > HOLE * truth.depth[ground])
    found = np.concatenate(seen_through)
    return float(found.sum() / max(len(found), 1))  # 1: no ground, 0/0


def free_space(truth: Truth) -> Float[np.ndarray, "h w"]:
    """Ray length, m, up to which the truth is empty with a margin; +inf in the sky."""
    return np.maximum((1 - MARGIN_SHARE) * truth.depth - MARGIN, 0.0)


def open_ground(truths: tuple[Truth, ...]) -> Float[np.ndarray, "n 3"]:
    """Places on road and terrain under the open sky, in the true world, m.

    What the test views show is all that is known to stand over the ground: a place is open if none
    of it is higher than `STANDING` over the place within about `CLEAR` around.
    """
    places, heights = [], []
    for truth in truths:
        near = truth.depth < FARTHEST
        kind = MERGED[truth.label]
        heights.append(truth.points[near])
        places.append(truth.points[near & ((kind == ROAD) | (kind == TERRAIN))][::EVERY])
    place, above = np.concatenate(places), np.concatenate(heights)
    tallest: dict[tuple[int, int], float] = {}
    cells = np.floor(above[:, :2] / CLEAR).astype(int)
    order = np.lexsort((above[:, 2], cells[:, 1], cells[:, 0]))
    for (x, y), z in zip(cells[order].tolist(), above[order, 2].tolist(), strict=True):
        tallest[x, y] = z  # the last of a cell is its highest
    free = []
    for x, y, z in place.tolist():
        i, j = int(np.floor(x / CLEAR)), int(np.floor(y / CLEAR))
        around = [tallest.get((i + a, j + b), -np.inf) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        free.append(max(around) < z + STANDING)
    return place[np.array(free, bool)]


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
        `floater_mass`, the mean share lost before the surface, and `floaters_CLASS`, the same
        before surfaces of each class; `sky_empty_fraction`, the share of true sky pixels that at
        least `EMPTY` of the light passes; `clear_floater_mass` and `clear_sky_empty_fraction`, the
        same of pixels with nothing nearer beside them, and of those with sky all around (a pixel
        beside a leaf is leaf in part, whatever its middle shows).
    """
    lost = np.concatenate([a[~t.sky] for a, t in zip(absorbed, truths, strict=True)])
    passed = np.concatenate([s[t.sky] for s, t in zip(skyward, truths, strict=True)])
    clear = np.concatenate([within(t.sky)[t.sky] for t in truths])
    inner = np.concatenate([~beside_nearer(t)[~t.sky] for t in truths])
    kind = np.concatenate([MERGED[t.label][~t.sky] for t in truths])
    each = {
        f"floaters_{name}": float(lost[kind == own].mean())
        for own, name in enumerate(CLASS_NAMES)
        if (kind == own).any()
    }
    return {
        "floater_mass": float(lost.mean()),
        "clear_floater_mass": float(lost[inner].mean()),
        **each,
        "sky_empty_fraction": _share(passed >= EMPTY),
        "clear_sky_empty_fraction": _share(passed[clear] >= EMPTY),
    }


def beside_nearer(truth: Truth) -> Bool[np.ndarray, "h w"]:
    """Pixels one of whose eight neighbours shows what is much nearer."""
    # What may be this near and still belong to the pixel's own surface; the sky has no end.
    least = np.where(truth.sky, np.inf, (1 - EDGE_SHARE) * truth.depth - EDGE)
    padded = np.pad(truth.depth, 1, mode="edge")
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    return np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]) < least


def within(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose neighbours are in the mask too; beyond the border there are none."""
    padded = np.pad(mask, 1, mode="edge")
    rows = padded[:-2] & padded[1:-1] & padded[2:]
    return rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]


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
    known = real != UNKNOWN
    ours, real = ours[known], real[known]
    each = {}
    for kind, name in enumerate(CLASS_NAMES):
        if (real == kind).any():
            union = ((ours == kind) | (real == kind)).sum()
            each[f"iou_{name}"] = float(((ours == kind) & (real == kind)).sum() / union)
    return {"miou": float(np.mean(list(each.values()))), **each}


def _share(which: Bool[np.ndarray, "n"]) -> float:
    return float(which.mean()) if which.size else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else float("nan")
