"""Spectrum of wind waves: variance of height and slope as a function of wavenumber.

TMA spectrum: JONSWAP (fetch-limited wind sea) times Kitaigorodskii's depth factor times a
directional spreading, as collected by Horvath, "Empirical directional wave spectra for computer
graphics" (2015). numpy, float64; k is a wavenumber in rad/m, omega an angular frequency in rad/s.

The slope variance of JONSWAP's omega^-5 tail is unbounded, and at the short fetch of a street it
exceeds measurements at sea. So the spectrum is multiplied by exp(-(k/k_c)^2). The cutoff
k_c <= 370 rad/m (where capillary waves begin) is chosen so that the mean-square slope does not
exceed that of Cox and Munk (1954).
"""

import math

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from climatenerf.weather.flood.parameters import Flood

GRAVITY = 9.81  # m/s^2
TENSION = 0.074 / 1000  # surface tension over density, m^3/s^2
MAX_CUTOFF = 370.0  # rad/m; waves of 1.7 cm, the slowest: JONSWAP does not hold for shorter waves
MIN_PEAK_RATIO = 0.36  # lowest wavenumber over the peak's; JONSWAP is exp(-9.6) of its peak there


def dispersion(k: Float[np.ndarray, "*n"], depth: float) -> Float[np.ndarray, "*n"]:
    """Return omega(k) of gravity-capillary waves in water of `depth` d metres, rad/s.

    omega^2 = (g k + (tau/rho) k^3) tanh(k d).
    """
    return np.sqrt((GRAVITY * k + TENSION * k**3) * np.tanh(k * depth))


def group_velocity(k: Float[np.ndarray, "*n"], depth: float) -> Float[np.ndarray, "*n"]:
    """Return d omega / d k in m/s, for k > 0 and water of `depth` metres."""
    tanh = np.tanh(k * depth)
    slope = (GRAVITY + 3 * TENSION * k**2) * tanh
    slope += (GRAVITY * k + TENSION * k**3) * depth * (1 - tanh**2)
    return slope / (2 * dispersion(k, depth))


def peak_frequency(wind_speed: float, fetch: float) -> float:
    """Return the peak frequency of JONSWAP, omega_p = 22 (g^2 / (U F))^(1/3), in rad/s.

    Args:
        wind_speed: U, 10 m above the water, m/s, > 0.
        fetch: F, m.
    """
    return 22 * (GRAVITY**2 / (wind_speed * fetch)) ** (1 / 3)


def tma(
    omega: Float[np.ndarray, "*n"], wind_speed: float, fetch: float, depth: float
) -> Float[np.ndarray, "*n"]:
    """Return the TMA frequency spectrum S(omega) in m^2 s: JONSWAP times Kitaigorodskii's factor.

    Args:
        omega: angular frequency, rad/s, >= 0.
        wind_speed: 10 m above the water, m/s, > 0.
        fetch: length of open water upwind, m.
        depth: water depth, m.
    """
    peak = peak_frequency(wind_speed, fetch)
    alpha = 0.076 * (wind_speed**2 / (fetch * GRAVITY)) ** 0.22
    s = np.where(omega <= peak, 0.07, 0.09)
    r = np.exp(-((omega - peak) ** 2) / (2 * s**2 * peak**2))
    ratio = peak / np.maximum(omega, 1e-3 * peak)  # no overflow at omega = 0, where S is 0
    jonswap = alpha * GRAVITY**2 / peak**5 * ratio**5 * np.exp(-1.25 * ratio**4) * 3.3**r
    w = np.clip(omega * math.sqrt(depth / GRAVITY), 0, 2)
    factor = np.where(w <= 1, w**2 / 2, 1 - (2 - w) ** 2 / 2)  # Thompson and Vincent (1983)
    return jonswap * factor


def spreading(
    omega: Float[np.ndarray, "*n"], angle: Float[np.ndarray, "*n"], flood: Flood
) -> Float[np.ndarray, "*n"]:
    """Return the directional spreading: fraction of the energy per radian; its integral is 1.

    Args:
        omega: angular frequency, rad/s.
        angle: direction of the wave relative to downwind, rad, in [-pi, pi].
        flood: wind speed, fetch and the law of `flood.spreading`.
    """
    peak = peak_frequency(flood.wind_speed, flood.fetch)
    if flood.spreading == "donelan-banner":
        return donelan_banner(omega / peak, angle)
    return hasselmann(omega / peak, angle, flood.wind_speed * peak / GRAVITY)


def hasselmann(
    omega_over_peak: Float[np.ndarray, "*n"], angle: Float[np.ndarray, "*n"], wind_over_peak: float
) -> Float[np.ndarray, "*n"]:
    """Return cos^2s(angle/2) over its integral, by Hasselmann, Dunckel and Ewing (1980).

    s falls with the frequency above the peak, the faster the younger the waves. Short waves spread
    almost evenly, so the slopes along and across the wind differ as little as Cox and Munk (1954)
    found.

    Args:
        omega_over_peak: frequency over the peak frequency.
        angle: direction of the wave relative to downwind, rad.
        wind_over_peak: wind speed over the phase speed of the peak's waves.
    """
    r = omega_over_peak
    above = 9.77 * np.maximum(r, 1) ** (-2.33 - 1.45 * (wind_over_peak - 1.17))
    s = np.where(r <= 1, 6.97 * r**4.06, above)
    log_integral = math.log(2 * math.sqrt(math.pi)) + gammaln(s + 0.5) - gammaln(s + 1)
    return np.cos(angle / 2) ** (2 * s) / np.exp(log_integral)


def donelan_banner(
    omega_over_peak: Float[np.ndarray, "*n"], angle: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Return the spreading of Donelan, Hamilton and Hui (1985), with Banner's (1990) high range.

    Crests are three times as long as by `hasselmann` on a street's fetch.

    Args:
        omega_over_peak: frequency over the peak frequency.
        angle: direction of the wave relative to downwind, rad.
    """
    r = np.maximum(omega_over_peak, 0.56)
    high = 10 ** (-0.4 + 0.8393 * np.exp(-0.567 * np.log(r**2)))
    beta = np.where(r < 0.95, 2.61 * r**1.3, np.where(r < 1.6, 2.28 * r**-1.3, high))
    return beta / (2 * np.tanh(beta * math.pi)) / np.cosh(beta * angle) ** 2


def cox_munk(wind_speed: float) -> float:
    """Return the mean-square slope of the sea, both axes together: .003 + .00512 U.

    The constant .003 is scaled down linearly below 1 m/s, so that there are no waves without wind.
    """
    return 0.003 * min(wind_speed, 1.0) + 0.00512 * wind_speed


def wavenumber_spectrum(
    k: Float[np.ndarray, "*n"], flood: Flood, cutoff: float
) -> Float[np.ndarray, "*n"]:
    """Return the variance of height per unit of |k|, summed over directions, in m^3.

    Args:
        k: wavenumber, rad/m.
        flood: wind speed, fetch and depth.
        cutoff: k_c of the factor exp(-(k/k_c)^2), rad/m.
    """
    k = np.maximum(k, 1e-9)  # group velocity is 0/0 at k = 0
    energy = tma(dispersion(k, flood.depth), flood.wind_speed, flood.fetch, flood.depth)
    return energy * group_velocity(k, flood.depth) * np.exp(-((k / cutoff) ** 2))


def cutoff_wavenumber(flood: Flood) -> float:
    """Return the cutoff k_c at which the mean-square slope equals Cox and Munk's, in rad/m.

    The result is at most MAX_CUTOFF. Bisection on a logarithmic axis.
    """
    k, low, high = log_axis(flood), 1e-3, MAX_CUTOFF
    target = cox_munk(flood.wind_speed)

    def slope(cutoff: float) -> float:
        return float(np.trapezoid(k**3 * wavenumber_spectrum(k, flood, cutoff), np.log(k)))

    if slope(high) <= target:
        return high
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if slope(middle) < target else (low, middle)
    return high


def peak_wavenumber(flood: Flood) -> float:
    """Return the wavenumber of the spectrum's peak, rad/m."""
    k = np.geomspace(1e-5, 1e5, 4000)
    omega = dispersion(k, flood.depth)
    return float(np.interp(peak_frequency(flood.wind_speed, flood.fetch), omega, k))


def log_axis(flood: Flood) -> Float[np.ndarray, "n"]:
    """Return log-spaced wavenumbers that cover all the energy of the spectrum, rad/m."""
    low = min(MIN_PEAK_RATIO * peak_wavenumber(flood), MAX_CUTOFF)
    return np.geomspace(low, 4 * MAX_CUTOFF, 2000)
