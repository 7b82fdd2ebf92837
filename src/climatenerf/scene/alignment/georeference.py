"""Scale, heading and geographic position of a scene from the GPS positions of its photos."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float

from climatenerf.scene.alignment.scale import rescaled, with_scale_evidence
from climatenerf.scene.findings import Finding
from climatenerf.scene.scene import Scene

MIN_FIXES = 5
MAX_PAIRS = 2000  # of fixes, tried as initial solutions
MIN_ERROR = 0.005  # relative, of the scale: error of the arc lengths and of the fit
EXACT = 0.005  # of the extent: smaller residuals are rounding, not correlated receiver errors
MIN_INDEPENDENT = 4.0  # fixes
MAX_SCALE_ERROR = 0.2  # relative standard error above which GPS is not used
MAX_LISTED = 3  # photos named in a message
# WGS 84 (EPSG:4326): equatorial radius, m, and first eccentricity squared.
RADIUS, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True)
class Georeference:
    """Similarity between a scene in the world frame and its GPS positions.

    Attributes:
        scale: Metres according to GPS per metre of the scene.
        scale_error: Relative standard error of `scale`.
        heading: Angle from the scene's x axis to east, rad.
        shift: East and north of the scene's origin, m, relative to `origin`.
        origin: Latitude and longitude, degrees.
        spread: Robust standard deviation of a GPS coordinate about the camera position, m.
        photos: Number of photos used.
        left_out: Names of the photos excluded as outliers.
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
class UnusableGps:
    """GPS positions that do not determine scale and heading.

    Attributes:
        photos: Number of photos with a GPS position.
        reason: Why they are not sufficient, as a clause.
    """

    photos: int
    reason: str


def east_north(
    positions: Float[np.ndarray, "n 2"], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Convert geographic positions to metres east and north of a nearby origin.

    The conversion uses arcs of the ellipsoid's meridian and parallel at the origin; within 10 km it
    is exact to a metre.

    Args:
        positions: Latitude and longitude, degrees.
        origin: Latitude and longitude, degrees.
    """
    latitude = math.radians(origin[0])
    w = math.sqrt(1 - ECCENTRICITY2 * math.sin(latitude) ** 2)
    meridian_radius, normal_radius = RADIUS * (1 - ECCENTRICITY2) / w**3, RADIUS / w
    d = np.radians(positions - origin)
    d[:, 1] = (d[:, 1] + np.pi) % (2 * np.pi) - np.pi  # across the date line
    east = d[:, 1] * normal_radius * math.cos(latitude)
    return np.stack([east, d[:, 0] * meridian_radius], axis=-1)


def find_georeference(
    scene: Scene, positions: Mapping[str, tuple[float, float, float]]
) -> Georeference | UnusableGps:
    """Fit a horizontal similarity from the camera positions to their GPS positions.

    Up stays unchanged, because GPS heights are less accurate than the vertical edges of images. The
    fit is robust, because the first fixes of a phone may be far off.

    Args:
        scene: Scene aligned to the world frame.
        positions: Latitude, longitude (degrees) and altitude (m) by image name.

    Returns:
        `UnusableGps` if there are fewer than `MIN_FIXES` different fixes, they are too close
        together, or they are too inaccurate.
    """
    local, geographic, names = _fixes(scene, positions)
    photos = sum(map(len, names))
    if len(local) < MIN_FIXES:
        return UnusableGps(
            photos, f"it has {len(local)} distinct position(s), and {MIN_FIXES} are needed"
        )
    origin = np.median(geographic, axis=0)
    metric = east_north(geographic, origin)
    target, source = metric[:, 0] + 1j * metric[:, 1], local[:, 0] + 1j * local[:, 1]
    factor, shift, weight = _similarity(source, target)
    inlier = weight > 0
    source, residual = source[inlier], (target - factor * source - shift)[inlier]
    extent = math.sqrt(float((np.abs(source - source.mean()) ** 2).mean()))
    # Residuals of nearly exact positions are rounding errors, without the drift of a receiver.
    exact = float(np.abs(residual).max()) < EXACT * abs(factor) * extent
    independent = float(len(residual)) if exact else _independent_count(residual)
    if abs(factor) * extent < 1e-9:
        return UnusableGps(photos, "the photos are too close together")
    # The fit has 4 parameters and 2 n observations, so 2 independent fixes leave no residual.
    if independent < MIN_INDEPENDENT:
        return UnusableGps(
            photos,
            f"its errors drift from photo to photo, which leaves {independent:.1f} independent"
            f" positions where {MIN_INDEPENDENT:g} are needed",
        )
    variance = float((np.abs(residual) ** 2).mean()) / 2
    spread = math.sqrt(variance * independent / (independent - 2))
    error = spread / (abs(factor) * extent * math.sqrt(independent))
    if error > MAX_SCALE_ERROR:
        return UnusableGps(
            photos,
            f"its positions are off by {spread:.1f} m, and the photos lie within about"
            f" {2 * abs(factor) * extent:.1f} m of each other",
        )
    left_out = [
        name for group, used in zip(names, inlier, strict=True) if not used for name in group
    ]
    return Georeference(
        scale=float(abs(factor)),
        scale_error=error,
        heading=float(np.angle(factor)),
        shift=(float(shift.real), float(shift.imag)),
        origin=(float(origin[0]), float(origin[1])),
        spread=spread,
        photos=photos - len(left_out),
        left_out=tuple(left_out),
    )


def gps_finding(found: Georeference | UnusableGps, sources: Mapping[str, str]) -> Finding | None:
    """Return a finding about GPS positions that are not used; None if there is nothing to report.

    Args:
        found: Result of `find_georeference`.
        sources: The user's name of each photo, by image name.
    """
    if isinstance(found, UnusableGps):
        if not found.photos:
            return None
        message = f"GPS of {found.photos} photos is of no use here: {found.reason}"
        return Finding("gps", message, "give --camera-height or --known-length for the scale")
    if not found.left_out:
        return None
    listed = ", ".join(sources.get(name, name) for name in found.left_out[:MAX_LISTED])
    more = ", ..." if len(found.left_out) > MAX_LISTED else ""
    return Finding(
        "gps",
        f"GPS of {len(found.left_out)} of {found.photos + len(found.left_out)} photos is far from"
        f" their camera positions and is left out: {listed}{more}",
        severity="note",
    )


def apply_georeference(scene: Scene, found: Georeference, keep_scale: bool) -> Scene:
    """Return the scene with x pointing east and y north.

    Args:
        scene: The scene that was given to `find_georeference`.
        found: Its result.
        keep_scale: Keep the scene's scale and only report that of GPS.
    """
    error = max(found.scale_error, MIN_ERROR)
    if keep_scale:
        out = with_scale_evidence(scene, "gps", found.scale, error)
    else:
        out = rescaled(scene, found.scale, "gps", error)
    transform = np.eye(4)
    c, s = math.cos(found.heading), math.sin(found.heading)
    transform[:2, :2] = [[c, -s], [s, c]]
    transform[:2, 3] = found.shift
    return replace(
        out,
        world_from_input=transform @ out.world_from_input,
        georeference={
            "latitude": found.origin[0],
            "longitude": found.origin[1],
            "photos": found.photos,
            "spread_m": round(found.spread, 3),
        },
    )


def _fixes(
    scene: Scene, positions: Mapping[str, tuple[float, float, float]]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], list[list[str]]]:
    """Return camera position (m), latitude and longitude (degrees), and photos of each fix.

    Consecutive photos with the same GPS position share one fix of a slow receiver. Their mean
    camera position is used.
    """
    local, geographic, names = [], [], []
    for view in scene.views:
        if view.name not in positions:
            continue
        camera, fix = scene.c2w_world(view)[:2, 3], positions[view.name][:2]
        if geographic and fix == geographic[-1]:
            local[-1] = local[-1] + camera
            names[-1].append(view.name)
        else:
            local.append(camera)
            geographic.append(fix)
            names.append([view.name])
    if not local:
        return np.empty((0, 2)), np.empty((0, 2)), []
    count = np.array([len(group) for group in names])
    return np.array(local) / count[:, None], np.array(geographic), names


def _independent_count(residual: Complex[np.ndarray, "n"]) -> float:
    """Return the effective number of independent fixes; receiver errors change slowly.

    It is n (1 - r) / (1 + r) for the correlation r of consecutive residuals (Bartlett 1946), with r
    corrected for the bias of a short series after a fit.
    """
    n = len(residual)
    power = float((np.abs(residual) ** 2).sum())
    if n < MIN_FIXES:
        return float(n)
    r = float(np.real(residual[1:] * residual[:-1].conj()).sum()) / power
    r = min(max(r + (2 + 4 * r) / n, 0.0), 0.99)
    return n * (1 - r) / (1 + r)


def _similarity(
    source: Complex[np.ndarray, "n"], target: Complex[np.ndarray, "n"]
) -> tuple[complex, complex, Float[np.ndarray, "n"]]:
    """Fit target = factor * source + shift by least median of squares, then least squares.

    The initial solution is the pair of points whose similarity gives the smallest median distance,
    so up to half of the targets may be outliers.

    Args:
        source: Positions as complex numbers.
        target: Corresponding positions.

    Returns:
        Factor (scale and rotation), shift, and weights: 0 for outliers, otherwise 1.
    """
    n = len(source)
    i, j = np.triu_indices(n, 1)
    baseline = source[j] - source[i]
    pairs = np.flatnonzero(np.abs(baseline) > 0.3 * np.abs(baseline).max())
    pairs = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    if not len(pairs):
        return 0j, complex(target.mean()), np.ones(n)
    factors = (target[j[pairs]] - target[i[pairs]]) / baseline[pairs]
    shifts = target[i[pairs]] - factors * source[i[pairs]]
    distance = np.abs(target - factors[:, None] * source - shifts[:, None])
    best = int(np.argmin(np.median(distance, axis=1)))
    factor, shift = complex(factors[best]), complex(shifts[best])
    weight = np.ones(n)
    for _ in range(20):
        distance = np.abs(target - factor * source - shift)
        # The correction for few points is that of Rousseeuw and Leroy (1987); 1.1774 is the median
        # of a Rayleigh distribution.
        sigma = (1 + 5 / max(n - 2, 1)) * float(np.median(distance)) / 1.1774
        sigma = max(sigma, 1e-9)  # m: exact positions have a median of 0
        weight = (distance < 4 * sigma).astype(float)
        ms, mt = np.average(source, weights=weight), np.average(target, weights=weight)
        p, q = source - ms, target - mt
        # 1e-12: all inliers at one position give 0 / 0.
        factor = complex((weight * q * p.conj()).sum() / max((weight * abs(p) ** 2).sum(), 1e-12))
        shift = complex(mt - factor * ms)
    return factor, shift, weight
