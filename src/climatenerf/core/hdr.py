"""Conversion of HDR signals (ITU-R BT.2100: HLG and PQ) to display sRGB. No torch.

1. A signal becomes linear light; 1 is reference white, a white paper. HLG stores light of the
   scene: the inverse OETF (BT.2100-2, table 5). PQ stores light of a display: the EOTF (table 4).
2. Primaries become BT.709. Colours outside of it are mixed with grey of equal luminance.
3. Light up to `KNEE` is unchanged. Above it, a curve compresses `PEAK` to 1. It acts on the
   largest channel and scales all three alike, so that the hue is kept.

The OOTF of HLG, which gives a display more contrast than the scene, is left out: photos stand for
the light of a scene here, and its system gamma falls to 1 near the luminance of SDR displays. By
BT.2408, table 1, a grey card of 18 % is recorded as 38 % of HLG, and returns as 18 % of white.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.srgb import to_display

Transfer = Literal["HLG", "PQ"]

REFERENCE_WHITE = 203.0
"""Luminance of a white paper in PQ, cd/m2: 58 % of the signal (BT.2408, table 1)."""
HLG_WHITE = 0.75
"""HLG signal of a white paper (BT.2408, table 1)."""
PEAK = 1000 / REFERENCE_WHITE
"""Light over reference white that becomes 1: that of a nominal display of 1000 cd/m2."""
KNEE = 0.8
"""Light over reference white up to which tone mapping changes nothing."""
HLG_A, HLG_B, HLG_C = 0.17883277, 0.28466892, 0.55991073
PQ_M1, PQ_M2 = 2610 / 16384, 2523 / 4096 * 128
PQ_C1, PQ_C2, PQ_C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
PQ_PEAK = 10000.0
"""Light of the PQ signal 1, cd/m2."""

PRIMARIES: dict[str, tuple[tuple[float, float], ...]] = {
    "bt709": ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    "bt2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "p3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
"""Chromaticities x, y of red, green and blue (BT.709, BT.2020, SMPTE EG 432-1); white is D65."""
D65 = (0.3127, 0.3290)

_STRIP = 1 << 18  # pixels that are converted at once: 3 MB for each temporary array


def hlg_inverse_oetf(signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the scene light E in [0, 1] of an HLG signal in [0, 1] (BT.2100-2, table 5)."""
    low = signal**2 / 3
    return np.where(signal <= 0.5, low, (np.exp((signal - HLG_C) / HLG_A) + HLG_B) / 12)


def pq_eotf(signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the display light, cd/m2, of a PQ signal in [0, 1] (BT.2100-2, table 4)."""
    power = signal ** (1 / PQ_M2)
    ratio = np.maximum(power - PQ_C1, 0) / (PQ_C2 - PQ_C3 * power)
    return PQ_PEAK * ratio ** (1 / PQ_M1)


def to_bt709(primaries: str) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear RGB of `PRIMARIES[primaries]` to linear BT.709."""
    return np.linalg.inv(_to_xyz("bt709")) @ _to_xyz(primaries)


def linear_light(
    signal: Float[np.ndarray, "*n 3"], transfer: Transfer, primaries: str = "bt2020"
) -> Float[np.ndarray, "*n 3"]:
    """Return linear BT.709 over reference white; a channel outside of the gamut is negative.

    Args:
        signal: non-linear R'G'B', full range, in [0, 1].
        transfer: "HLG" or "PQ".
        primaries: key of `PRIMARIES`.
    """
    if transfer == "PQ":
        light = pq_eotf(signal) / REFERENCE_WHITE
    else:
        light = hlg_inverse_oetf(signal) / float(hlg_inverse_oetf(np.array(HLG_WHITE)))
    return light @ to_bt709(primaries).astype(signal.dtype).T


def tone_map(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Map light over reference white to [0, 1]; colours in gamut up to `KNEE` are unchanged.

    Args:
        linear: linear BT.709; 1 is reference white.
    """
    grey = np.maximum(_luminance(linear), 0)
    least = linear.min(axis=-1, keepdims=True)
    # The largest weight of the colour beside grey that leaves no channel negative.
    weight = np.where(least < 0, grey / np.maximum(grey - least, 1e-9), 1)
    linear = np.maximum(grey + weight * (linear - grey), 0)
    brightest = linear.max(axis=-1, keepdims=True)
    # Rational curve with slope 1 at the knee that reaches 1 at the peak.
    excess = np.maximum(brightest - KNEE, 0) / (1 - KNEE)
    excess_of_peak = (PEAK - KNEE) / (1 - KNEE)
    compressed = KNEE + (1 - KNEE) * excess / (1 + (1 - 1 / excess_of_peak) * excess)
    return np.where(
        brightest > KNEE, linear * (np.minimum(compressed, 1) / np.maximum(brightest, KNEE)), linear
    )


def to_sdr(
    signal: Float[np.ndarray, "*n 3"], transfer: Transfer, primaries: str = "bt2020"
) -> Float[np.ndarray, "*n 3"]:
    """Return display sRGB in [0, 1] of an HDR signal; arguments as for `linear_light`."""
    return to_display(tone_map(linear_light(np.clip(signal, 0, 1), transfer, primaries)))


def image_to_sdr(
    values: np.ndarray, full_scale: float, transfer: Transfer, primaries: str = "bt2020"
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an HDR image [h w 3] as 8-bit sRGB, in strips that bound the memory.

    Args:
        values: signal, integers or floats.
        full_scale: value of the signal 1.
        transfer: "HLG" or "PQ".
        primaries: key of `PRIMARIES`.
    """
    out = np.empty(values.shape, np.uint8)
    rows = max(1, _STRIP // max(values.shape[1], 1))
    for start in range(0, len(values), rows):
        signal = values[start : start + rows].astype(np.float32) / np.float32(full_scale)
        out[start : start + rows] = np.rint(to_sdr(signal, transfer, primaries) * 255)
    return out


def cube_lut(transfer: Transfer, primaries: str = "bt2020", size: int = 65) -> str:
    """Return `to_sdr` as the text of a three-dimensional lookup table (.cube, red fastest)."""
    axis = np.linspace(0, 1, size)
    blue, green, red = np.meshgrid(axis, axis, axis, indexing="ij")
    values = to_sdr(np.stack([red, green, blue], axis=-1), transfer, primaries).reshape(-1, 3)
    lines = [f"{r:.6f} {g:.6f} {b:.6f}" for r, g, b in values.tolist()]
    return "\n".join([f"LUT_3D_SIZE {size}", *lines, ""])


def _luminance(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 1"]:
    """Return the luminance of linear BT.709."""
    return linear @ _to_xyz("bt709")[1, :, None].astype(linear.dtype)


def _to_xyz(primaries: str) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear RGB to XYZ, with luminance 1 for white (SMPTE RP 177)."""
    xyz = np.array([(x / y, 1.0, (1 - x - y) / y) for x, y in (*PRIMARIES[primaries], D65)]).T
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
