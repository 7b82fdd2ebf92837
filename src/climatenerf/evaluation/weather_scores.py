"""How right a weather is beside its picture: waterline, snow surface, transmittance of the air."""

import numpy as np
from jaxtyping import Float

from climatenerf.evaluation.geometry import ground_or_roof
from climatenerf.evaluation.reference import Truth
from climatenerf.render.depth_normals import plane_normals

JOINED, JOINED_SHARE = 0.5, 0.05  # m, and of the distance: neighbours this close are one surface
NEAR = 30.0  # m: snow is compared up to here
NO_LINE = 10.0  # m: said of a line that is not there, and the most of one that is
MIN_SNOW = 0.005  # m: less is bare ground

Layers = dict[str, np.ndarray]


def waterline_scores(
    depth: list[Float[np.ndarray, "h w"]], masks: list[Float[np.ndarray, "h w"]],
    eyes: list[Float[np.ndarray, "4 4"]], level: float,
    truths: tuple[Truth, ...], true_level: float, pixel_angle: float,
) -> dict[str, float]:  # fmt: skip
    """Where the water ends, against where it truly does.

    Both lines are found between neighbouring pixels of one dry surface, one above and one below the
    water, at the share of the way where it crosses.

    Args:
        depth: our ray lengths without water, m.
        masks: shares of water in our flooded pictures.
        eyes: poses of the cameras in our world.
        level: height of our water, m.
        truths: of the same views.
        true_level: height of the true water, m.
        pixel_angle: of a pixel, rad.

    Returns:
        `waterline_error_cm`, the mean of the median distance of the true line from ours and of ours
        from the true one, in the place; `waterline_error_px`, the same in the picture, where far
        shores seen at grazing do not count for more than they are looked at;
        `waterline_height_error_cm`, the median height by which our ground misses the water at the
        true line; `water_iou` of the flooded pixels.
    """
    apart, seen, rise, both, either = ([], []), ([], []), [], 0, 0
    for ours, mask, c2w, truth in zip(depth, masks, eyes, truths, strict=True):
        rays_c = truth.rays_d @ truth.c2w[:3, :3]  # camera axes
        height = truth.points[..., 2] - true_level
        height[truth.sky] = np.inf
        line, (i, j) = crossings(truth.depth[..., None] * rays_c, height)
        with np.errstate(invalid="ignore"):
            own_height = c2w[2, 3] + ours * (rays_c @ c2w[2, :3]) - level
        own_height[~np.isfinite(ours)] = np.inf
        own, _ = crossings(ours[..., None] * rays_c, own_height)
        if len(line):
            for k, (a, b) in enumerate(((line, own), (own, line))):
                apart[k].append(_nearest(a, b))
                seen[k].append(_nearest(_unit(a), _unit(b)) / pixel_angle)
            here = 0.5 * (own_height.ravel()[i] + own_height.ravel()[j])
            rise.append(np.minimum(np.abs(here), NO_LINE))
        wet, real = mask > 0.5, plane_first(truth, true_level)
        both, either = both + (wet & real).sum(), either + (wet | real).sum()
    return {
        "waterline_error_cm": float(np.mean([_median_cm(each) for each in apart])),
        "waterline_error_px": float(np.mean([_median_cm(each) for each in seen])) / 100,
        "waterline_height_error_cm": _median_cm(rise),
        "water_iou": float(both / either) if either else float("nan"),
    }


def crossings(
    points: Float[np.ndarray, "h w 3"], height: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "n 3"], tuple[np.ndarray, np.ndarray]]:
    """Places where a surface crosses height 0 between neighbouring pixels.

    Args:
        points: seen by the pixels, from the eye.
        height: theirs, m; inf where there is nothing.

    Returns:
        The places, and the flat indices of the pixels on both sides of each.
    """
    number = np.arange(height.size).reshape(height.shape)
    i = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    j = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    p, z = points.reshape(-1, 3), height.ravel()
    known = np.isfinite(z[i]) & np.isfinite(z[j])
    i, j = i[known], j[known]
    crosses = (z[i] < 0) != (z[j] < 0)
    i, j = i[crosses], j[crosses]
    away = np.minimum(*(np.linalg.norm(p[k], axis=-1) for k in (i, j)))
    one = np.linalg.norm(p[i] - p[j], axis=-1) < JOINED + JOINED_SHARE * away
    i, j = i[one], j[one]
    share = z[i] / (z[i] - z[j])  # signs differ: never 0/0
    return p[i] + share[:, None] * (p[j] - p[i]), (i, j)


def snow_scores(
    layers: list[Layers], truths: tuple[Truth, ...], snow: list[Layers], pixel_angle: float
) -> dict[str, float]:
    """Where snow lies and how deep, against the truth.

    Args:
        layers: our `depth`, `snow_thickness` and `mask_snow` of each view.
        truths: of the same views, without snow.
        snow: true `depth` and `thickness` under snow.
        pixel_angle: of a pixel, rad.

    Returns:
        `snow_surface_error_cm`, the median distance between our surface and the true one, square to
        it; `thickness_error_cm`, the median error of the snow's thickness; both on ground and roofs
        nearer than `NEAR` where snow truly lies; `thickness_cm` and `true_thickness_cm`, medians;
        `snow_iou` of snowy pixels there.
    """
    apart, error, ours_thick, true_thick, both, either = [], [], [], [], 0, 0
    for ours, truth, real in zip(layers, truths, snow, strict=True):
        thickness = real["thickness"].astype(np.float64)
        rays_c = truth.rays_d @ truth.c2w[:3, :3]
        place = ground_or_roof(truth) & (truth.depth < NEAR)
        white = place & (thickness > MIN_SNOW) & np.isfinite(real["depth"])
        normal = plane_normals(np.zeros(3), rays_c, real["depth"], pixel_angle)
        depth = np.minimum(ours["depth"], 2 * np.where(white, real["depth"], 1.0))
        gap = np.abs(depth - np.where(white, real["depth"], depth)) * np.abs(
            (normal * rays_c).sum(-1)
        )
        apart.append(gap[white])
        error.append(np.abs(ours["snow_thickness"] - thickness)[white])
        ours_thick.append(ours["snow_thickness"][white])
        true_thick.append(thickness[white])
        own = place & (ours["mask_snow"] > 0.5)
        both, either = both + (own & white).sum(), either + (own | white).sum()
    return {
        "snow_surface_error_cm": _median_cm(apart),
        "thickness_error_cm": _median_cm(error),
        "thickness_cm": _median_cm(ours_thick),
        "true_thickness_cm": _median_cm(true_thick),
        "snow_iou": float(both / either) if either else float("nan"),
    }


def transmittance_scores(
    passed: list[Float[np.ndarray, "h w"]], real: list[Float[np.ndarray, "h w"]]
) -> dict[str, float]:
    """Mean absolute error of the air's transmittance over all pixels."""
    pairs = zip(passed, real, strict=True)
    errors = [np.abs(a - b.astype(np.float64)).ravel() for a, b in pairs]
    return {"transmittance_error": float(np.concatenate(errors).mean())}


def plane_first(truth: Truth, level: float) -> np.ndarray:
    """Where the truth shows the water's plane before anything else."""
    fall = -truth.rays_d[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(fall > 0, (truth.c2w[2, 3] - level) / fall, np.inf)
    return (t > 0) & (t < truth.depth)


def _unit(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return line / np.linalg.norm(line, axis=-1, keepdims=True)


def _nearest(line: Float[np.ndarray, "n 3"], own: Float[np.ndarray, "m 3"]) -> np.ndarray:
    """Distance of each place of a line from the nearest of another; `NO_LINE` if there is none."""
    if not len(own):
        return np.full(max(len(line), 1), NO_LINE)
    parts = [line[k : k + 512] for k in range(0, len(line), 512)]
    near = [np.sqrt(((p[:, None] - own[None]) ** 2).sum(-1).min(1)) for p in parts]
    return np.minimum(np.concatenate(near), NO_LINE) if near else np.full(1, NO_LINE)


def _median_cm(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0)
    return float(100 * np.median(values)) if values.size else float("nan")
