"""Geometric scores of a rendered weather: waterline, snow surface, transmittance of the smog."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from climatenerf.core.classes import BUILDING, CLASS_NAMES, MERGED, ROAD, TERRAIN, VEGETATION
from climatenerf.core.srgb import to_linear
from climatenerf.evaluation.geometry import ground_or_roof
from climatenerf.evaluation.reference import Truth
from climatenerf.render.depth_normals import plane_normals

MAX_GAP, RELATIVE_GAP = 0.5, 0.05  # m, and of the distance; closer neighbours are one surface
MAX_SNOW_DISTANCE = 30.0  # m, snow is compared up to here
MAX_LINE_ERROR = 10.0  # m, error of a waterline that is missing, and upper bound of all errors
MIN_SNOW = 0.005  # m, thinner snow counts as bare ground
SNOWY_CLASSES = ("road", "terrain", "building", "vegetation", "vehicle")

Layers = dict[str, np.ndarray]


def waterline_scores(
    depth: list[Float[np.ndarray, "h w"]], masks: list[Float[np.ndarray, "h w"]],
    poses: list[Float[np.ndarray, "4 4"]], level: float,
    truths: tuple[Truth, ...], true_level: float, pixel_angle: float,
) -> dict[str, float]:  # fmt: skip
    """Compare the edge of the rendered water with that of the true water.

    Both waterlines are found between neighbouring pixels of one dry surface, one above and one
    below the water level, by linear interpolation of the heights.

    Args:
        depth: rendered ray lengths without water, m.
        masks: water coverage of the flooded renders, [0, 1].
        poses: of the cameras in the run's world.
        level: height of the water in the run's world, m.
        truths: the same views.
        true_level: height of the true water, m.
        pixel_angle: angle of a pixel, rad.

    Returns:
        `waterline_error_cm`, the mean over both directions of the median distance from a point of
        one line to the other line, in space. `waterline_error_px`, the same in the picture, where
        distant shores at grazing angles have less weight. `waterline_height_error_cm`, the median
        height of the fitted ground above or below the water at the true line. `water_iou` of the
        flooded pixels.
    """
    # Each pair: from the true line to the rendered one, and back.
    distance, angle = ([], []), ([], [])
    height_error, intersection, union = [], 0, 0
    for rendered, mask, c2w, truth in zip(depth, masks, poses, truths, strict=True):
        rays_c = truth.rays_d @ truth.c2w[:3, :3]  # camera axes
        true_height = truth.points[..., 2] - true_level
        true_height[truth.sky] = np.inf
        true_line, (i, j) = crossings(truth.depth[..., None] * rays_c, true_height)
        with np.errstate(invalid="ignore"):
            height = c2w[2, 3] + rendered * (rays_c @ c2w[2, :3]) - level
        height[~np.isfinite(rendered)] = np.inf
        line, _ = crossings(rendered[..., None] * rays_c, height)
        if len(true_line):
            for k, (a, b) in enumerate(((true_line, line), (line, true_line))):
                distance[k].append(_nearest(a, b))
                angle[k].append(_nearest(_unit(a), _unit(b)) / pixel_angle)
            at_line = 0.5 * (height.ravel()[i] + height.ravel()[j])
            height_error.append(np.minimum(np.abs(at_line), MAX_LINE_ERROR))
        wet, true_wet = mask > 0.5, water_visible(truth, true_level)
        intersection, union = intersection + (wet & true_wet).sum(), union + (wet | true_wet).sum()
    return {
        "waterline_error_cm": float(np.mean([_median_cm(each) for each in distance])),
        "waterline_error_px": float(np.mean([_median_cm(each) for each in angle])) / 100,
        "waterline_height_error_cm": _median_cm(height_error),
        "water_iou": float(intersection / union) if union else float("nan"),
    }


def water_correlation(
    rendered: list[UInt8[np.ndarray, "h w 3"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
    masks: list[Float[np.ndarray, "h w"]],
) -> float:
    """Correlation of the grey values of water, ours and true: the mean of the views that show any.

    Crests at other places than in the truth have a correlation of 0, however alike they look.
    """
    found = []
    for ours, other, mask in zip(rendered, true, masks, strict=True):
        a, b = (each[mask > 0.5].mean(-1) for each in (ours.astype(float), other.astype(float)))
        if len(a) > 1 and a.std() > 0 and b.std() > 0:
            found.append(float(np.corrcoef(a, b)[0, 1]))
    return float(np.mean(found)) if found else float("nan")


def crossings(
    points: Float[np.ndarray, "h w 3"], height: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "n 3"], tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]]:
    """Find where a surface crosses height 0 between neighbouring pixels.

    Args:
        points: surface points of the pixels relative to the camera centre, m.
        height: their heights, m; inf without a surface.

    Returns:
        The crossing points, m, and the flat indices of the two pixels of each.
    """
    index = np.arange(height.size).reshape(height.shape)
    i = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    j = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    p, z = points.reshape(-1, 3), height.ravel()
    finite = np.isfinite(z[i]) & np.isfinite(z[j])
    i, j = i[finite], j[finite]
    crosses = (z[i] < 0) != (z[j] < 0)
    i, j = i[crosses], j[crosses]
    distance = np.minimum(*(np.linalg.norm(p[k], axis=-1) for k in (i, j)))
    same_surface = np.linalg.norm(p[i] - p[j], axis=-1) < MAX_GAP + RELATIVE_GAP * distance
    i, j = i[same_surface], j[same_surface]
    fraction = z[i] / (z[i] - z[j])  # the signs differ: never 0/0
    return p[i] + fraction[:, None] * (p[j] - p[i]), (i, j)


def snow_scores(
    layers: list[Layers], truths: tuple[Truth, ...], snow: list[Layers], pixel_angle: float
) -> dict[str, float]:
    """Compare where snow lies, and how deep, with the truth.

    Args:
        layers: rendered `depth`, `snow_thickness` and `mask_snow` of each view.
        truths: the same views without snow.
        snow: true `depth` and `thickness` under snow.
        pixel_angle: angle of a pixel, rad.

    Returns:
        Over ground and roofs nearer than `MAX_SNOW_DISTANCE` with true snow:
        `snow_surface_error_cm`, the median distance between the surfaces along the true normal;
        `thickness_error_cm`, the median error of the thickness; `thickness_cm` and
        `true_thickness_cm`, medians. `snow_iou` of the snowy pixels on ground and roofs.
        `snowy_CLASS` and `true_snowy_CLASS`: the fractions of a class's pixels within that
        distance that show snow; both leave out what is thinner than `MIN_SNOW`.
    """
    shares = {name: [0, 0, 0] for name in SNOWY_CLASSES}  # snowy, truly snowy, all
    distance, error, thickness, true_thickness, intersection, union = [], [], [], [], 0, 0
    for rendered, truth, true in zip(layers, truths, snow, strict=True):
        thick = true["thickness"].astype(np.float64)
        rays_c = truth.rays_d @ truth.c2w[:3, :3]
        level = ground_or_roof(truth) & (truth.depth < MAX_SNOW_DISTANCE)
        true_snow = level & (thick > MIN_SNOW) & np.isfinite(true["depth"])
        normal = plane_normals(np.zeros(3), rays_c, true["depth"], pixel_angle)
        depth = np.minimum(rendered["depth"], 2 * np.where(true_snow, true["depth"], 1.0))
        along_ray = np.abs(depth - np.where(true_snow, true["depth"], depth))
        distance.append((along_ray * np.abs((normal * rays_c).sum(-1)))[true_snow])
        error.append(np.abs(rendered["snow_thickness"] - thick)[true_snow])
        thickness.append(rendered["snow_thickness"][true_snow])
        true_thickness.append(thick[true_snow])
        snow_seen = (rendered["mask_snow"] > 0.5) & (rendered["snow_thickness"] > MIN_SNOW)
        snowy = level & snow_seen
        intersection += (snowy & true_snow).sum()
        union += (snowy | true_snow).sum()
        label = MERGED[truth.label]
        for name, counts in shares.items():
            own = (label == CLASS_NAMES.index(name)) & (truth.depth < MAX_SNOW_DISTANCE)
            counts[0] += int((own & snow_seen).sum())
            counts[1] += int((own & (thick > MIN_SNOW)).sum())
            counts[2] += int(own.sum())
    by_class = {}
    for name, (snowy, truly, every) in shares.items():
        by_class[f"snowy_{name}"] = snowy / every if every else float("nan")
        by_class[f"true_snowy_{name}"] = truly / every if every else float("nan")
    return by_class | {
        "snow_surface_error_cm": _median_cm(distance),
        "thickness_error_cm": _median_cm(error),
        "thickness_cm": _median_cm(thickness),
        "true_thickness_cm": _median_cm(true_thickness),
        "snow_iou": float(intersection / union) if union else float("nan"),
    }


def transmittance_scores(
    rendered: list[Float[np.ndarray, "h w"]], true: list[Float[np.ndarray, "h w"]]
) -> dict[str, float]:
    """Return the mean absolute error of the smog's transmittance over all pixels."""
    pairs = zip(rendered, true, strict=True)
    errors = [np.abs(a - b.astype(np.float64)).ravel() for a, b in pairs]
    return {"transmittance_error": float(np.concatenate(errors).mean())}


def by_view(
    truths: tuple[Truth, ...],
    rendered: list[UInt8[np.ndarray, "h w 3"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
) -> dict[str, Any]:
    """Return `views`, the PSNR (dB) of each view, and `psnr_no_vegetation`, their mean without it.

    Snow and light in leaves are finer than a pixel, and no two simulations of them agree.
    """
    views, rest = {}, []
    for truth, ours, other in zip(truths, rendered, true, strict=True):
        squared = ((ours.astype(float) - other.astype(float)) / 255.0) ** 2
        views[Path(truth.name).stem] = float(-10 * np.log10(max(squared.mean(), 1e-12)))
        plain = MERGED[truth.label] != VEGETATION
        if plain.any():
            rest.append(-10 * np.log10(max(squared[plain].mean(), 1e-12)))  # 1e-12: equal pictures
    return {"views": views, "psnr_no_vegetation": float(np.mean(rest)) if rest else float("nan")}


def wall_scores(
    snowy: list[Float[np.ndarray, "h w 3"]],
    dry: list[Float[np.ndarray, "h w 3"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
    truths: tuple[Truth, ...],
) -> dict[str, float]:
    """Score how much snow on the ground brightens walls.

    Returns:
        `ratio`: mean radiance of walls under snow over dry; `true_ratio`; and `ratio_error`, the
        relative error of the first. NaN without walls in view.
    """
    sums = np.zeros(4)
    for ours, clean, picture, truth in zip(snowy, dry, true, truths, strict=True):
        up = np.abs(truth.normal @ truth.c2w[2, :3])
        display = picture / 255.0
        wall = (MERGED[truth.label] == BUILDING) & (up < 0.3) & (truth.depth < MAX_SNOW_DISTANCE)
        wall &= display.max(-1) < 0.99
        linear = to_linear(display)
        sums += [each[wall].sum() for each in (ours, clean, linear, truth.clean)]
    if not sums[1] or not sums[3]:
        nothing = float("nan")
        return {"ratio": nothing, "true_ratio": nothing, "ratio_error": nothing}
    ratio, other = float(sums[0] / sums[1]), float(sums[2] / sums[3])
    return {"ratio": ratio, "true_ratio": other, "ratio_error": abs(ratio / other - 1)}


def ground_scores(
    ours: list[Float[np.ndarray, "h w 3"]],
    true: list[UInt8[np.ndarray, "h w 3"]],
    truths: tuple[Truth, ...],
) -> dict[str, float]:
    """Score how bright snow on terrain is beside snow on roads, as bushes and houses shade both.

    Returns:
        `terrain_over_road`: mean radiance of the one over that of the other, and
        `true_terrain_over_road`. NaN where one of the two is not in view.
    """
    sums = np.zeros((2, 2))
    counts = np.zeros(2)
    for linear, picture, truth in zip(ours, true, truths, strict=True):
        label = MERGED[truth.label]
        for k, kind in enumerate((TERRAIN, ROAD)):
            own = (label == kind) & (truth.depth < MAX_SNOW_DISTANCE)
            counts[k] += own.sum()
            sums[k] += linear[own].sum(), to_linear(picture[own] / 255.0).sum()
    if not counts.all() or not sums[1].all():
        return dict.fromkeys(("terrain_over_road", "true_terrain_over_road"), float("nan"))
    mean = sums / counts[:, None]
    found, other = mean[0] / mean[1]
    return {"terrain_over_road": float(found), "true_terrain_over_road": float(other)}


def water_visible(truth: Truth, level: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose true ray meets the water plane before any surface."""
    descent = -truth.rays_d[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(descent > 0, (truth.c2w[2, 3] - level) / descent, np.inf)
    return (t > 0) & (t < truth.depth)


def _unit(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return line / np.linalg.norm(line, axis=-1, keepdims=True)


def _nearest(
    line: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "k"]:
    """Return the distance of each point of a line from the nearest of another.

    Distances are bounded by `MAX_LINE_ERROR`, which is also the result for an empty line.
    """
    if not len(other):
        return np.full(max(len(line), 1), MAX_LINE_ERROR)
    parts = [line[k : k + 512] for k in range(0, len(line), 512)]
    near = [np.sqrt(((p[:, None] - other[None]) ** 2).sum(-1).min(1)) for p in parts]
    if not near:
        return np.full(1, MAX_LINE_ERROR)
    return np.minimum(np.concatenate(near), MAX_LINE_ERROR)


def _median_cm(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0)
    return float(100 * np.median(values)) if values.size else float("nan")
