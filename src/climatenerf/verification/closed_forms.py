"""Expected values, in closed form and in double precision.

Nothing here is imported from the rest of the package, and no formula is written as it is there, so
that a mistake in the program is not repeated in its check. Angles are rad, lengths m.
"""

import numpy as np
from jaxtyping import Float


def linear_from_display(display: float) -> float:
    """Return the linear radiance of a display value, both in [0, 1] (IEC 61966-2-1)."""
    return display / 12.92 if display <= 0.04045 else ((display + 0.055) / 1.055) ** 2.4


def stratified_optical_depth(
    sigma: float,
    falloff: float,
    base: float,
    start_z: float,
    end_z: Float[np.ndarray, "*n"],
    length: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Return the optical depth of straight segments through a stratified medium.

    The extinction is sigma below `base` and sigma exp(-(z - base)/H) above it. Along a straight
    segment height is linear in length, so the optical depth is the segment's length times the mean
    of the extinction over its heights.

    Args:
        sigma: extinction at and below `base`, 1/m.
        falloff: scale height H, m.
        base: height where the fall-off begins, m.
        start_z: height of the start, m.
        end_z: heights of the ends, m, different from `start_z`.
        length: lengths of the segments, m.
    """

    def integral(z: np.ndarray | float) -> np.ndarray:
        above = falloff * -np.expm1(-np.maximum(np.asarray(z) - base, 0) / falloff)
        return np.minimum(np.asarray(z) - base, 0) + above

    return sigma * length * (integral(end_z) - integral(start_z)) / (end_z - start_z)


def sky_optical_depth(
    sigma: float,
    falloff: float,
    base: float,
    start_z: float,
    rise: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Return the optical depth of infinite rays that rise by `rise` per length, from over `base`.

    The integral of sigma exp(-(z - base)/H) over z from `start_z` is sigma H exp(-(start_z -
    base)/H), and a ray that rises by dz is longer by 1/dz.
    """
    return sigma * falloff * np.exp(-(start_z - base) / falloff) / rise


def refraction_angle(incidence: Float[np.ndarray, "*n"], ior: float) -> Float[np.ndarray, "*n"]:
    """Return the angle to the normal in water, by Snell's law (Born and Wolf 1999, 1.5.1)."""
    return np.arcsin(np.sin(incidence) / ior)


def fresnel(incidence: Float[np.ndarray, "*n"], ior: float) -> Float[np.ndarray, "*n"]:
    """Return the reflectance for unpolarised light from air (Born and Wolf 1999, 1.5.2).

    R_s = sin^2(i - t)/sin^2(i + t) and R_p = tan^2(i - t)/tan^2(i + t); at normal incidence both
    are ((n - 1)/(n + 1))^2.
    """
    tiny = np.abs(incidence) < 1e-3  # the limit differs by less than 1e-8 there
    angle = np.where(tiny, 0.5, incidence)
    refracted = refraction_angle(angle, ior)
    s = (np.sin(angle - refracted) / np.sin(angle + refracted)) ** 2
    p = (np.tan(angle - refracted) / np.tan(angle + refracted)) ** 2
    return np.where(tiny, normal_reflectance(ior), (s + p) / 2)


def normal_reflectance(ior: float) -> float:
    """Return the reflectance at normal incidence, ((n - 1)/(n + 1))^2."""
    return ((ior - 1) / (ior + 1)) ** 2


def brewster_reflectance(ior: float) -> float:
    """Return the reflectance at tan(i) = n, where R_p = 0 and R_s = ((n^2 - 1)/(n^2 + 1))^2."""
    return ((ior**2 - 1) / (ior**2 + 1)) ** 2 / 2


def diffuse_reflectance(ior: float) -> float:
    """Return a flat surface's reflectance for diffuse light from air (Walsh 1926).

    As printed by Duntley (1942), J. Opt. Soc. Am. 32, 61.
    """
    n = ior
    return (
        0.5
        + (n - 1) * (3 * n + 1) / (6 * (n + 1) ** 2)
        + n**2 * (n**2 - 1) ** 2 / (n**2 + 1) ** 3 * np.log((n - 1) / (n + 1))
        - 2 * n**3 * (n**2 + 2 * n - 1) / ((n**2 + 1) * (n**4 - 1))
        + 8 * n**4 * (n**4 + 1) / ((n**2 + 1) * (n**4 - 1) ** 2) * np.log(n)
    )


def returned_light(optical_depth: Float[np.ndarray, "*n"], ior: float) -> Float[np.ndarray, "*n"]:
    """Return the fraction of a diffuse bottom's light that comes back to it from the surface.

    Light below the surface at an angle a from the vertical passes 2 tau/cos(a). Beyond the critical
    angle it is reflected totally, within it as light from the other side is (reciprocity).
    """
    edges = np.linspace(0, np.pi / 2, 4001)
    angle = (edges[:-1] + edges[1:]) / 2
    sine = ior * np.sin(angle)
    reflected = np.where(sine < 1, fresnel(np.arcsin(np.minimum(sine, 1)), ior), 1.0)
    weight = reflected * 2 * np.sin(angle) * np.cos(angle) * np.diff(edges)
    passed = np.exp(-2 * np.asarray(optical_depth)[..., None] / np.cos(angle))
    return (weight * passed).sum(-1)


def wet_radiance(dry: float, albedo: float, ior: float) -> float:
    """Return the radiance of a diffuse bottom under clear water in diffuse light.

    1 - r_e of the light enters, and the bottom and the surface's inner side reflect it back and
    forth, which sums to 1/(1 - albedo r_i) (Lekner and Dorf 1988, Appl. Opt. 27, 1278). The light
    that leaves spreads over n^2. Reciprocity gives r_i = 1 - (1 - r_e)/n^2.
    """
    outer = diffuse_reflectance(ior)
    inner = 1 - (1 - outer) / ior**2
    return dry * (1 - outer) / ior**2 / (1 - albedo * inner)


def plane_distance(
    eye: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "*n 3"],
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float[np.ndarray, "*n"]:
    """Return the ray length to the plane through the origin; +inf for rays that miss it."""
    approach = -(directions @ np.asarray(normal))
    meets = approach > 1e-9
    return np.where(meets, (eye @ np.asarray(normal)) / np.where(meets, approach, 1.0), np.inf)
