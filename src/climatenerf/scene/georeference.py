"""Scale, heading and place from where photos say that they were taken (GPS)."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float

from climatenerf.scene.scale import rescaled, with_witness
from climatenerf.scene.scene import Scene

FEWEST = 5
MOST_PAIRS = 2000  # that are tried for a start
LEAST_ERROR = 0.005  # of the scale: the map's and the fit's own
WORST_SCALE = 0.2  # relative standard error from which GPS says nothing of use
# WGS 84 (EPSG:4326): equatorial radius, m, and first eccentricity squared.
RADIUS, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True)
class Georeference:
    """What GPS says of a levelled scene.

    Attributes:
        scale: metres by GPS in one metre of the scene as it is.
        scale_error: relative standard error.
        heading: angle from the scene's x axis to east, rad.
        shift: east and north of the scene's origin, m, in the frame about `origin`.
        origin: latitude and longitude, degrees, of the frame's origin.
        spread: robust standard deviation of a GPS coordinate from its photo's, m.
        photos: number of photos used.
    """

    scale: float
    scale_error: float
    heading: float
    shift: tuple[float, float]
    origin: tuple[float, float]
    spread: float
    photos: int


def east_north(
    places: Float[np.ndarray, "n 2"], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Metres east and north of an origin, for places (latitude, longitude in degrees) near it.

    Arcs of the ellipsoid's meridian and parallel at the origin: within 10 km exact to a metre.
    """
    latitude = math.radians(origin[0])
    w = math.sqrt(1 - ECCENTRICITY2 * math.sin(latitude) ** 2)
    meridian, across = RADIUS * (1 - ECCENTRICITY2) / w**3, RADIUS / w
    d = np.radians(places - origin)
    d[:, 1] = (d[:, 1] + np.pi) % (2 * np.pi) - np.pi  # over the date line
    return np.stack([d[:, 1] * across * math.cos(latitude), d[:, 0] * meridian], axis=-1)


def find_georeference(
    scene: Scene, places: dict[str, tuple[float, float, float]]
) -> Georeference | None:
    """Fits a level similarity from the scene's camera positions to their GPS places.

    Up stays as it is: GPS heights are worse than the vertical lines of a picture. Robust, since a
    phone's first fixes may be far off.

    Args:
        scene: levelled.
        places: latitude, longitude (degrees) and altitude (m) by picture name.

    Returns:
        None where fewer than five photos know their place or they lie too close together.
    """
    views = [view for view in scene.views if view.name in places]
    if len(views) < FEWEST:
        return None
    origin = np.median([places[v.name][:2] for v in views], axis=0)
    flat = east_north(np.array([places[v.name][:2] for v in views]), origin)
    target = flat[:, 0] + 1j * flat[:, 1]
    own = np.array([scene.c2w_world(v)[:2, 3] for v in views])
    source = own[:, 0] + 1j * own[:, 1]
    turn, shift, weight = _similarity(source, target)
    away = np.abs(target - turn * source - shift)
    spread = float(np.median(away)) / 1.1774  # median of Rayleigh's distribution in sigmas
    extent = math.sqrt(float((weight * np.abs(source - source.mean()) ** 2).sum()))
    if abs(turn) * extent < 1e-9:
        return None
    error = spread / (abs(turn) * extent)
    if error > WORST_SCALE:
        return None
    return Georeference(
        scale=float(abs(turn)),
        scale_error=error,
        heading=float(np.angle(turn)),
        shift=(float(shift.real), float(shift.imag)),
        origin=(float(origin[0]), float(origin[1])),
        spread=spread,
        photos=len(views),
    )


def apply_georeference(scene: Scene, found: Georeference, keep_scale: bool) -> Scene:
    """The scene with x to the east and y to the north, and GPS's scale unless a better is known."""
    error = max(found.scale_error, LEAST_ERROR)
    if keep_scale:
        out = with_witness(scene, "gps", found.scale, error)
    else:
        out = rescaled(scene, found.scale, "gps", error)
    turn = np.eye(4)
    c, s = math.cos(found.heading), math.sin(found.heading)
    turn[:2, :2] = [[c, -s], [s, c]]
    turn[:2, 3] = found.shift
    return replace(
        out,
        world_from_input=turn @ out.world_from_input,
        georeference={
            "latitude": found.origin[0],
            "longitude": found.origin[1],
            "photos": found.photos,
            "spread_m": round(found.spread, 3),
        },
    )


def _similarity(
    source: Complex[np.ndarray, "n"], target: Complex[np.ndarray, "n"]
) -> tuple[complex, complex, Float[np.ndarray, "n"]]:
    """target = turn * source + shift: least median of squares, then weighted least squares.

    The start is the pair of photos whose similarity leaves the smallest median distance, so up to
    half of the places may be wrong. Weights are 0 for those.
    """
    n = len(source)
    i, j = np.triu_indices(n, 1)
    apart = source[j] - source[i]
    far = np.flatnonzero(np.abs(apart) > 0.3 * np.abs(apart).max())
    far = far[:: max(1, len(far) // MOST_PAIRS)]
    if not len(far):
        return 0j, complex(target.mean()), np.ones(n)
    turns = (target[j[far]] - target[i[far]]) / apart[far]
    shifts = target[i[far]] - turns * source[i[far]]
    away = np.abs(target - turns[:, None] * source - shifts[:, None])
    best = int(np.argmin(np.median(away, axis=1)))
    turn, shift = complex(turns[best]), complex(shifts[best])
    weight = np.ones(n)
    for _ in range(20):
        gap = np.abs(target - turn * source - shift)
        sigma = max(float(np.median(gap)) / 1.1774, 1e-9)  # exact places: 0/0
        weight = (gap < 4 * sigma).astype(float)
        ms, mt = np.average(source, weights=weight), np.average(target, weights=weight)
        p, q = source - ms, target - mt
        turn = complex((weight * q * p.conj()).sum() / max((weight * abs(p) ** 2).sum(), 1e-12))
        shift = complex(mt - turn * ms)
    return turn, shift, weight
