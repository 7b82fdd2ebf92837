"""Scale, heading and place from where photos say that they were taken (GPS)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float

from climatenerf.scene.alignment.scale import rescaled, with_scale_evidence
from climatenerf.scene.scene import Scene

FEWEST = 5
MAX_PAIRS = 2000  # that are tried for a start
MIN_ERROR = 0.005  # of the scale: the map's and the fit's own
EXACT = 0.005  # of the extent: residuals below are not looked at for correlation
MIN_INDEPENDENT = 4.0  # fixes
WORST_SCALE = 0.2  # relative standard error from which GPS says nothing of use
NAMED = 3  # photos, in a sentence about several
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
        left_out: names of the photos whose places are too far off to be used.
    """

    scale: float
    scale_error: float
    heading: float
    shift: tuple[float, float]
    origin: tuple[float, float]
    spread: float
    photos: int
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class Unused:
    """GPS that tells nothing of a scene.

    Attributes:
        photos: number of photos that know their place.
        reason: why that is not enough, as a clause.
    """

    photos: int
    reason: str


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
) -> Georeference | Unused:
    """Fits a level similarity from the scene's camera positions to their GPS places.

    Up stays as it is: GPS heights are worse than the vertical lines of a picture. Robust, since a
    phone's first fixes may be far off.

    Args:
        scene: levelled.
        places: latitude, longitude (degrees) and altitude (m) by picture name.

    Returns:
        Why it says nothing where fewer than five photos know their place, they lie too close
        together or the places are too inexact.
    """
    own, where, names = _fixes(scene, places)
    photos = sum(map(len, names))
    if len(own) < FEWEST:
        return Unused(photos, f"it names {len(own)} different places, and {FEWEST} are needed")
    origin = np.median(where, axis=0)
    flat = east_north(where, origin)
    target, source = flat[:, 0] + 1j * flat[:, 1], own[:, 0] + 1j * own[:, 1]
    turn, shift, weight = _similarity(source, target)
    sound = weight > 0
    source, away = source[sound], (target - turn * source - shift)[sound]
    extent = math.sqrt(float((np.abs(source - source.mean()) ** 2).mean()))
    # What is left of places that fit all but exactly is rounding, not a receiver's drift.
    exact = float(np.abs(away).max()) < EXACT * abs(turn) * extent
    independent = float(len(away)) if exact else _independent(away)
    # The fit takes 4 of the 2 n degrees of freedom; with two independent fixes none is left.
    if abs(turn) * extent < 1e-9:
        return Unused(photos, "the photos lie too close together")
    if independent < MIN_INDEPENDENT:
        drift = f"its errors drift from photo to photo, which leaves {independent:.1f} fixes"
        return Unused(photos, f"{drift} where {MIN_INDEPENDENT:g} are needed")
    spread = math.sqrt(float((np.abs(away) ** 2).mean()) / 2 * independent / (independent - 2))
    error = spread / (abs(turn) * extent * math.sqrt(independent))
    if error > WORST_SCALE:
        apart = f"its places are off by {spread:.1f} m, and the photos lie within about"
        return Unused(photos, f"{apart} {2 * abs(turn) * extent:.1f} m of each other")
    left_out = [name for some, kept in zip(names, sound, strict=True) if not kept for name in some]
    return Georeference(
        scale=float(abs(turn)),
        scale_error=error,
        heading=float(np.angle(turn)),
        shift=(float(shift.real), float(shift.imag)),
        origin=(float(origin[0]), float(origin[1])),
        spread=spread,
        photos=photos - len(left_out),
        left_out=tuple(left_out),
    )


def gps_warning(found: Georeference | Unused, sources: Mapping[str, str]) -> str | None:
    """What the user should know of GPS that is not used; None if there is none or all is.

    Args:
        found: what came of it.
        sources: the user's name of each photo, by picture name.
    """
    if isinstance(found, Unused):
        if not found.photos:
            return None
        return f"GPS of {found.photos} photos is of no use here: {found.reason}."
    if not found.left_out:
        return None
    named = ", ".join(sources.get(name, name) for name in found.left_out[:NAMED])
    more = ", ..." if len(found.left_out) > NAMED else ""
    return (
        f"GPS of {len(found.left_out)} of {found.photos + len(found.left_out)} photos is far from"
        f" where the pictures put them and is left out: {named}{more}."
    )


def _fixes(
    scene: Scene, places: dict[str, tuple[float, float, float]]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], list[list[str]]]:
    """Camera positions, m, latitude and longitude, and the photos of each fix, in views' order.

    A receiver that lags gives one fix to several photos: those are one, at their mean position.
    """
    own, where, names = [], [], []
    for view in scene.views:
        if view.name not in places:
            continue
        position, place = scene.c2w_world(view)[:2, 3], places[view.name][:2]
        if where and place == where[-1]:
            own[-1] = own[-1] + position
            names[-1].append(view.name)
        else:
            own.append(position)
            where.append(place)
            names.append([view.name])
    if not own:
        return np.empty((0, 2)), np.empty((0, 2)), []
    count = np.array([len(some) for some in names])
    return np.array(own) / count[:, None], np.array(where), names


def _independent(away: Complex[np.ndarray, "n"]) -> float:
    """How many independent fixes these count for: a receiver's errors change slowly.

    By the correlation r of neighbours, n (1 - r) / (1 + r) (Bartlett 1946), r being corrected for
    what a short series and the fit take from it.
    """
    n = len(away)
    power = float((np.abs(away) ** 2).sum())
    if n < FEWEST:
        return float(n)
    r = float(np.real(away[1:] * away[:-1].conj()).sum()) / power
    r = min(max(r + (2 + 4 * r) / n, 0.0), 0.99)
    return n * (1 - r) / (1 + r)


def apply_georeference(scene: Scene, found: Georeference, keep_scale: bool) -> Scene:
    """The scene with x to the east and y to the north, and GPS's scale unless a better is known."""
    error = max(found.scale_error, MIN_ERROR)
    if keep_scale:
        out = with_scale_evidence(scene, "gps", found.scale, error)
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
    far = far[:: max(1, len(far) // MAX_PAIRS)]
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
        # Of few places the best half fits by chance (Rousseeuw and Leroy 1987).
        sigma = (1 + 5 / max(n - 2, 1)) * float(np.median(gap)) / 1.1774
        sigma = max(sigma, 1e-9)  # exact places: 0/0
        weight = (gap < 4 * sigma).astype(float)
        ms, mt = np.average(source, weights=weight), np.average(target, weights=weight)
        p, q = source - ms, target - mt
        turn = complex((weight * q * p.conj()).sum() / max((weight * abs(p) ** 2).sum(), 1e-12))
        shift = complex(mt - turn * ms)
    return turn, shift, weight
