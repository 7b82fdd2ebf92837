"""Display sRGB and linear radiance of tensors, continued linearly above 1, with gradients.

`core/srgb.py` defines the curve. The continuation keeps gradients of over-exposed pixels non-zero;
the curve's linear toe keeps the slope at black finite (12.92).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.srgb import DISPLAY_TOE, EXPONENT, LINEAR_TOE, LUMA, OFFSET, SCALE, TOE_SLOPE

_SLOPE_AT_ONE = SCALE / EXPONENT  # of the encoding curve


class _Encode(torch.autograd.Function):
    """Compute the slope from the value: autograd would evaluate the power a second time."""

    @staticmethod
    def forward(ctx, linear):
        x = linear.clamp_min(0.0)
        curve = SCALE * x.clamp(LINEAR_TOE, 1.0) ** (1.0 / EXPONENT) - OFFSET
        above = 1.0 + _SLOPE_AT_ONE * (x - 1.0)
        value = torch.where(x <= LINEAR_TOE, TOE_SLOPE * x, torch.where(x <= 1.0, curve, above))
        ctx.save_for_backward(linear, value)
        return value

    @staticmethod
    def backward(ctx, grad):
        linear, value = ctx.saved_tensors
        # The clamp keeps finite what `where` discards.
        curve = (value + OFFSET) / (EXPONENT * linear.clamp_min(LINEAR_TOE))
        slope = torch.where(linear <= 1.0, curve, _SLOPE_AT_ONE)
        slope = torch.where(linear <= LINEAR_TOE, TOE_SLOPE, slope)
        return grad * slope * (linear >= 0.0)


class _Decode(torch.autograd.Function):
    """Compute the slope from the value, as `_Encode` does."""

    @staticmethod
    def forward(ctx, display):
        x = display.clamp_min(0.0)
        curve = ((x.clamp(DISPLAY_TOE, 1.0) + OFFSET) / SCALE) ** EXPONENT
        above = 1.0 + (x - 1.0) / _SLOPE_AT_ONE
        value = torch.where(x <= DISPLAY_TOE, x / TOE_SLOPE, torch.where(x <= 1.0, curve, above))
        ctx.save_for_backward(display, value)
        return value

    @staticmethod
    def backward(ctx, grad):
        display, value = ctx.saved_tensors
        curve = EXPONENT * value / (display.clamp_min(DISPLAY_TOE) + OFFSET)
        slope = torch.where(display <= 1.0, curve, 1.0 / _SLOPE_AT_ONE)
        slope = torch.where(display <= DISPLAY_TOE, 1.0 / TOE_SLOPE, slope)
        return grad * slope * (display >= 0.0)


def encode_srgb(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return display values of linear radiance: [0,1] to [0,1], linear above 1, 0 below 0."""
    return _Encode.apply(linear)


def decode_srgb(display: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the linear radiance of display values; the inverse of `encode_srgb`."""
    return _Decode.apply(display)


def luma(linear: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Return the Rec. 709 luminance of linear colours."""
    return linear @ linear.new_tensor(LUMA)
