"""The ground: one continuous height function, and the meshes sampled from it.

x runs across the road, y along it, z up, all in metres. The height is a long profile g(y) plus a
cross profile p(|x|), plus bumps on the grass and hills far away, so every slope is known in closed
form. The street lies in a shallow valley: a flood 0.5 m above the datum ends on the road near
y = 16 m one way and y = -43 m the other, and on the lawns 5 to 6 m from the pavement.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tools.reference_street.geometry import Mesh, grid, merge

ROAD_HALF = 2.72  # m, where the gutter begins
KERB_FACE = 3.0  # m
KERB_BACK = 3.14  # m
PAVEMENT_EDGE = 5.0  # m, where the grass begins
# Cross profile: (|x|, height) corners in metres. The kerb face leans 2 cm so height is continuous.
_PROFILE = np.array(
    [
        (0.0, 0.055),
        (0.7, 0.051),
        (1.4, 0.038),
        (2.1, 0.019),
        (2.72, 0.0),
        (2.98, -0.015),
        (3.0, 0.105),
        (3.14, 0.109),
        (5.0, 0.145),
    ]
)
DIP_AT = (-1.15, -5.2)  # m, a hollow in the left lane
DIP_DEPTH = 0.07  # m
DIP_RADIUS = 1.1  # m, to 1/e
NEAR_X = 24.0  # m: extent of the detailed lawn picture
NEAR_Y = 36.0
FAR = 260.0


def _softplus(t: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.logaddexp(0.0, t)


def road_profile(y: ArrayLike) -> Float[np.ndarray, "*n"]:
    """Return the long profile g(y) of the street, m, 0 at y = 0; slope 1.5 % to 6 %."""
    y = np.asarray(y, float)

    def raw(v):
        rise = 0.015 * v + 0.045 * 4 * _softplus((v - 8) / 4) + 0.07 * 5 * _softplus(-(v + 26) / 5)
        crest = 0.055 * 6 * _softplus((v - 56) / 6) + 0.05 * 6 * _softplus(-(v + 62) / 6)
        return rise - crest

    return raw(y) - raw(0.0)


def ground_height(x: ArrayLike, y: ArrayLike) -> Float[np.ndarray, "*n"]:
    """Return the height of the ground (road, kerb, pavement, grass, hills), m; continuous.

    Args:
        x: across the road, m, any shape.
        y: along the road, m, same shape.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    ax = np.abs(x)
    cross = np.interp(ax, _PROFILE[:, 0], _PROFILE[:, 1])
    off_pavement = np.maximum(ax - PAVEMENT_EDGE, 0.0)
    rise = 0.062 * 15 * np.tanh(off_pavement / 15)
    bumps = np.minimum(off_pavement, 1.5) * (
        0.012 * np.sin(1.3 * x + 0.7 * y)
        + 0.010 * np.sin(0.6 * x - 1.1 * y + 1.0)
        + 0.006 * np.sin(2.9 * x + 2.3 * y + 2.0)
    )
    dip = -DIP_DEPTH * np.exp(-((x - DIP_AT[0]) ** 2 + (y - DIP_AT[1]) ** 2) / DIP_RADIUS**2)
    r = np.hypot(x, y)
    away = np.clip((r - 75.0) / 130.0, 0.0, 1.0)
    away = away * away * (3 - 2 * away)
    hills = away * (
        15.0
        + 7.0 * np.sin(x / 37.0 + 1.0) * np.cos(y / 45.0)
        + 4.0 * np.sin(x / 19.0 - y / 24.0 + 0.5)
    )
    return road_profile(y) + cross + rise + bumps + hills + dip


def _spaced(near: float, step: float) -> Float[np.ndarray, " n"]:
    """Return grid lines from `near` outwards to FAR with steps that grow by 12 %."""
    out = [near]
    while out[-1] < FAR:
        step *= 1.12
        out.append(out[-1] + step)
    out[-1] = FAR
    return np.array(out)


def _y_lines() -> Float[np.ndarray, " n"]:
    half = np.concatenate(
        [np.arange(0, NEAR_Y, 0.5), np.arange(NEAR_Y, 76, 1.0), _spaced(76.0, 1.2)]
    )
    return np.concatenate([-half[:0:-1], half])


def _strip(xs, ys, uv_scale: tuple[float, float], u_from: float) -> Mesh:
    x, y = np.meshgrid(xs, ys)
    points = np.stack([x, y, ground_height(x, y)], -1)
    return grid(points, np.stack([(x - u_from) * uv_scale[0], y * uv_scale[1]], -1))


def _both_sides(xs, ys, uv_scale, u_from) -> Mesh:
    right = _strip(xs, ys, uv_scale, u_from)
    left = _strip(-np.asarray(xs)[::-1], ys, uv_scale, -u_from)
    return merge([right, left])


def ground_meshes() -> list[Mesh]:
    """Return the ground as labelled meshes: road, gutter, kerb, pavement, lawn, meadow, hills."""
    ys = _y_lines()
    corners = _PROFILE[:, 0]
    half = np.unique(np.concatenate([np.linspace(0, ROAD_HALF, 9), corners[:5]]))
    road_x = np.concatenate([-half[:0:-1], half])
    lawn_x = np.concatenate([np.arange(5.0, 12.0, 0.35), np.arange(12.0, NEAR_X + 0.1, 0.75)])
    near_y = ys[np.abs(ys) <= NEAR_Y]
    far_x = _spaced(NEAR_X, 0.8)
    meshes = [
        # Texture extents in metres: see textures.py.
        _strip(road_x, ys, (1 / 5.44, 1 / 48.0), -2.72).tagged("road", "asphalt", "road"),
        _both_sides([2.72, 2.98], ys, (1 / 0.26, 1 / 9.0), 2.72).tagged(
            "gutter", "concrete", "road"
        ),
        _both_sides([2.98, 3.0, 3.14], ys, (1 / 0.16, 1 / 9.0), 2.98).tagged(
            "kerb", "kerb", "road"
        ),
        _both_sides(np.linspace(3.14, 5.0, 7), ys, (1 / 1.86, 1 / 24.0), 3.14).tagged(
            "pavement", "slabs", "road"
        ),
    ]
    for side in (1, -1):
        xs = np.sort(side * lawn_x)
        x, y = np.meshgrid(xs, near_y)
        points = np.stack([x, y, ground_height(x, y)], -1)
        uv = np.stack([(x + NEAR_X) / (2 * NEAR_X), (y + NEAR_Y) / (2 * NEAR_Y)], -1)
        meshes.append(grid(points, uv).tagged(f"lawn{side:+d}", "lawn", "terrain"))
    outer = [_both_sides(far_x, ys, (1 / 30.0, 1 / 30.0), 0.0)]
    for part in (ys[ys >= NEAR_Y], ys[ys <= -NEAR_Y]):
        outer.append(_both_sides(lawn_x, part, (1 / 30.0, 1 / 30.0), 0.0))
    meshes.append(merge(outer).tagged("meadow", "meadow", "terrain"))
    return meshes
