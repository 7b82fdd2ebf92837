"""Display sRGB and linear radiance (IEC 61966-2-1), continued linearly above 1.

The continuation keeps gradients of over-exposed pixels alive; below, the curve's linear toe keeps
the slope at black finite (12.92).
"""

import torch
from jaxtyping import Float
from torch import Tensor

_SLOPE_AT_ONE = 1.055 / 2.4  # of the encoding curve


def encode_srgb(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear radiance to display values; [0,1] to [0,1], linear above 1, clamped at 0 below."""
    x = linear.clamp_min(0.0)
    toe = 12.92 * x
    # The clamps keep the power's gradient finite where `where` does not take its value.
    curve = 1.055 * x.clamp(0.0031308, 1.0) ** (1.0 / 2.4) - 0.055
    above = 1.0 + _SLOPE_AT_ONE * (x - 1.0)
    return torch.where(x <= 0.0031308, toe, torch.where(x <= 1.0, curve, above))


def decode_srgb(display: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Inverse of `encode_srgb`."""
    x = display.clamp_min(0.0)
    toe = x / 12.92
    curve = ((x.clamp(0.04045, 1.0) + 0.055) / 1.055) ** 2.4
    above = 1.0 + (x - 1.0) / _SLOPE_AT_ONE
    return torch.where(x <= 0.04045, toe, torch.where(x <= 1.0, curve, above))


def luma(linear: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Rec. 709 luminance of linear colours."""
    return linear @ linear.new_tensor([0.2126, 0.7152, 0.0722])
