"""Scores of a fitted scene's geometry against the truth: depth, normals, free space, classes."""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from climatenerf.core.classes import (
    BUILDING,
    CLASS_NAMES,
    GROUND,
    MERGED,
    ROAD,
    TERRAIN,
    UNKNOWN,
    VEGETATION,
)
from climatenerf.evaluation.reference import Truth
from climatenerf.scene import Camera

HOLE_RATIO = 1.5  # rendered over true distance from which ground counts as missing
MAX_DISTANCE = 50.0  # m; photos of a walk do not constrain geometry beyond it
MARGIN, RELATIVE_MARGIN = 0.1, 0.05  # m, and of the depth; closer density belongs to the surface
EDGE, RELATIVE_EDGE = 0.1, 0.1  # m, and of the depth; a depth step between pixels that is an edge
EMPTY = 0.99  # transmittance from which a sky pixel counts as empty
CLEARANCE = 1.0  # m, radius around open ground that must be free of obstacles
MIN_OBSTACLE_HEIGHT = 0.5  # m
GROUND_STRIDE = 41  # every so many ground pixels is tested for open sky
GROUND_TOLERANCES = (0.1, 0.05)  # m, vertical errors of ground that are counted
MIN_GROUND_SLOPE = 0.7  # z of the unit normal from which ground has a height: kerb faces have none
MIN_ROOF_SLOPE = 0.5  # z of the unit normal from which a building's surface counts as a roof


def depth_scores(
    depth: list[Float[np.ndarray, "h w"]], truths: tuple[Truth, ...]
) -> dict[str, float]:
    """Return the errors of ray lengths where the truth is nearer than `MAX_DISTANCE`.

    A ray without a hit, or with one beyond twice the true length, counts as twice the true length:
    a single hole must not outweigh all other pixels.

    Args:
        depth: rendered ray lengths, m; +inf in the sky.
        truths: the same views.

    Returns:
        `depth_abs_rel`, the mean relative error, and `depth_rmse_m`.
    """
    relative, squared = [], []
    for rendered, truth in zip(depth, truths, strict=True):
        near = truth.depth < MAX_DISTANCE
        true = truth.depth[near].astype(np.float64)
        error = np.minimum(rendered[near], 2 * true) - true
        relative.append(np.abs(error) / true)
        squared.append(error**2)
    return {
        "depth_abs_rel": float(np.concatenate(relative).mean()),
        "depth_rmse_m": float(np.sqrt(np.concatenate(squared).mean())),
    }


def normal_scores(
    normal: list[Float[np.ndarray, "h w 3"]], truths: tuple[Truth, ...]
) -> dict[str, float]:
    """Return median angles between rendered and true normals, degrees.

    Args:
        normal: rendered unit normals in camera axes; 0 where there is no surface, which counts as
            an error of 90 degrees.
        truths: the same views.

    Returns:
        Medians over pixels nearer than `MAX_DISTANCE`: `normal_median_deg` without vegetation,
        `normal_ground_roof_median_deg` on ground and roofs, `normal_all_median_deg` over all.
    """
    angles, not_vegetation, ground_roof = [], [], []
    for rendered, truth in zip(normal, truths, strict=True):
        near = truth.depth < MAX_DISTANCE
        cosine = (rendered * truth.normal).sum(-1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[near])
        not_vegetation.append((MERGED[truth.label] != VEGETATION)[near])
        ground_roof.append(ground_or_roof(truth)[near])
    angle = np.concatenate(angles)
    return {
        "normal_median_deg": _median(angle[np.concatenate(not_vegetation)]),
        "normal_ground_roof_median_deg": _median(angle[np.concatenate(ground_roof)]),
        "normal_all_median_deg": _median(angle),
    }


def ground_or_roof(truth: Truth) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of roads, terrain and upward-facing surfaces of buildings."""
    label = MERGED[truth.label]
    up = truth.c2w[2, :3]  # world z in camera axes
    roof = (label == BUILDING) & (truth.normal @ up > MIN_ROOF_SLOPE)
    return (label == ROAD) | (label == TERRAIN) | roof


def ground_holes(depth: list[Float[np.ndarray, "h w"]], truths: tuple[Truth, ...]) -> float:
    """Return the fraction of road and terrain nearer than `MAX_DISTANCE` that rays pass through.

    Args:
        depth: ray lengths of the field, true metres; +inf without a hit.
        truths: the same views.
    """
    missing = []
    for rendered, truth in zip(depth, truths, strict=True):
        ground = np.isin(MERGED[truth.label], (ROAD, TERRAIN)) & (truth.depth < MAX_DISTANCE)
        missing.append(rendered[ground] > HOLE_RATIO * truth.depth[ground])
    holes = np.concatenate(missing)
    return float(holes.sum() / max(len(holes), 1))  # 1: views without ground, 0/0


def ground_scores(
    depth: list[Float[np.ndarray, "h w"]], truths: tuple[Truth, ...]
) -> dict[str, float]:
    """Return the fractions of visible ground that are rendered at the right height.

    Ground is road, pavement and terrain nearer than `MAX_DISTANCE`, without faces steeper than 45
    degrees. The error is the vertical distance from the rendered point to the tangent plane of the
    true surface. A ray without a hit counts as wrong.

    Args:
        depth: rendered ray lengths, m; +inf without a hit.
        truths: the same views.

    Returns:
        `ground_within_10cm` and `ground_within_5cm`; NaN if no view shows ground.
    """
    errors = []
    for rendered, truth in zip(depth, truths, strict=True):
        normal = truth.normal @ truth.c2w[:3, :3].T
        ground = np.isin(MERGED[truth.label], GROUND) & (truth.depth < MAX_DISTANCE)
        ground &= normal[..., 2] > MIN_GROUND_SLOPE
        along = np.abs(rendered[ground] - truth.depth[ground])
        towards = np.abs((truth.rays_d[ground] * normal[ground]).sum(-1))
        errors.append(along * towards / normal[ground][:, 2])
    error = np.concatenate(errors)
    return {
        f"ground_within_{round(100 * tolerance)}cm": _fraction(error < tolerance)
        for tolerance in GROUND_TOLERANCES
    }


def free_space(truth: Truth) -> Float[np.ndarray, "h w"]:
    """Return the ray length, m, up to which space is empty, with a margin; +inf in the sky."""
    return np.maximum((1 - RELATIVE_MARGIN) * truth.depth - MARGIN, 0.0)


def open_ground(truths: tuple[Truth, ...]) -> Float[np.ndarray, "n 3"]:
    """Return points on road and terrain under the open sky, true world, m.

    Obstacles are known only from the test views. A point is open if no surface that they show lies
    more than `MIN_OBSTACLE_HEIGHT` above it within about `CLEARANCE`.
    """
    ground, surfaces = [], []
    for truth in truths:
        near = truth.depth < MAX_DISTANCE
        label = MERGED[truth.label]
        surfaces.append(truth.points[near])
        is_ground = near & ((label == ROAD) | (label == TERRAIN))
        ground.append(truth.points[is_ground][::GROUND_STRIDE])
    candidates, points = np.concatenate(ground), np.concatenate(surfaces)
    highest: dict[tuple[int, int], float] = {}
    cells = np.floor(points[:, :2] / CLEARANCE).astype(int)
    order = np.lexsort((points[:, 2], cells[:, 1], cells[:, 0]))
    for (x, y), z in zip(cells[order].tolist(), points[order, 2].tolist(), strict=True):
        highest[x, y] = z  # ascending z: the last of a cell is its highest
    is_open = []
    for x, y, z in candidates.tolist():
        i, j = int(np.floor(x / CLEARANCE)), int(np.floor(y / CLEARANCE))
        around = [highest.get((i + a, j + b), -np.inf) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        is_open.append(max(around) < z + MIN_OBSTACLE_HEIGHT)
    return candidates[np.array(is_open, bool)]


def emptiness_scores(
    absorbed: list[Float[np.ndarray, "h w"]],
    transmittance: list[Float[np.ndarray, "h w"]],
    truths: tuple[Truth, ...],
) -> dict[str, float]:
    """Return how much density lies in space that is truly empty.

    Args:
        absorbed: fraction of light absorbed within `free_space`.
        transmittance: of whole rays.
        truths: the same views.

    Returns:
        `floater_mass`, the mean fraction absorbed before the surface, and `floaters_CLASS`, the
        same before surfaces of each class. `sky_empty_fraction`, the fraction of true sky pixels
        with a transmittance of at least `EMPTY`. `clear_floater_mass` and
        `clear_sky_empty_fraction`, the same without pixels at a depth edge, and without sky pixels
        beside other classes: the area of such a pixel contains both surfaces.
    """
    mass = np.concatenate([a[~t.sky] for a, t in zip(absorbed, truths, strict=True)])
    sky = np.concatenate([s[t.sky] for s, t in zip(transmittance, truths, strict=True)])
    clear_sky = np.concatenate([interior(t.sky)[t.sky] for t in truths])
    inner = np.concatenate([~occluded_edges(t)[~t.sky] for t in truths])
    label = np.concatenate([MERGED[t.label][~t.sky] for t in truths])
    by_class = {
        f"floaters_{name}": float(mass[label == index].mean())
        for index, name in enumerate(CLASS_NAMES)
        if (label == index).any()
    }
    return {
        "floater_mass": float(mass.mean()),
        "clear_floater_mass": float(mass[inner].mean()),
        **by_class,
        "sky_empty_fraction": _fraction(sky >= EMPTY),
        "clear_sky_empty_fraction": _fraction(sky[clear_sky] >= EMPTY),
    }


def occluded_edges(truth: Truth) -> Bool[np.ndarray, "h w"]:
    """Return the pixels with a much nearer surface among their eight neighbours."""
    # Nearer neighbours belong to another surface. The sky has no depth, hence no such bound.
    bound = np.where(truth.sky, np.inf, (1 - RELATIVE_EDGE) * truth.depth - EDGE)
    padded = np.pad(truth.depth, 1, mode="edge")
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    return np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]) < bound


def interior(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a mask whose neighbours inside the picture are all in it.

    `core.morphology.eroded` differs: there pixels beyond the border count as outside the mask.
    """
    padded = np.pad(mask, 1, mode="edge")
    rows = padded[:-2] & padded[1:-1] & padded[2:]
    return rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]


def nearest_pixels(
    camera: Camera, local: Float[np.ndarray, "*n 3"]
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "*n"]]:
    """Return the pixels that points in camera axes (m) project to.

    Points behind the camera project to NaN, which counts as outside.

    Returns:
        Row and column, 0 outside the picture, and whether the point is inside.
    """
    pixel = camera.project(local)
    with np.errstate(invalid="ignore"):
        inside = np.asarray((pixel >= 0).all(-1) & (pixel < (camera.width, camera.height)).all(-1))
    whole = np.where(inside[..., None], np.floor(np.nan_to_num(pixel)), 0).astype(np.int64)
    return whole[..., 1], whole[..., 0], inside


def label_scores(
    labels: list[UInt8[np.ndarray, "h w"]], truths: tuple[Truth, ...]
) -> dict[str, float]:
    """Return the intersection over union of each true class, and the mean `miou`.

    Args:
        labels: rendered merged classes; unknown counts as wrong.
        truths: the same views; their unknown pixels are left out.
    """
    rendered = np.concatenate([each.ravel() for each in labels])
    true = np.concatenate([MERGED[truth.label].ravel() for truth in truths])
    labelled = true != UNKNOWN
    rendered, true = rendered[labelled], true[labelled]
    scores = {}
    for index, name in enumerate(CLASS_NAMES):
        if (true == index).any():
            union = ((rendered == index) | (true == index)).sum()
            scores[f"iou_{name}"] = float(((rendered == index) & (true == index)).sum() / union)
    return {"miou": float(np.mean(list(scores.values()))), **scores}


def _fraction(mask: Bool[np.ndarray, "n"]) -> float:
    return float(mask.mean()) if mask.size else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else float("nan")
