"""Display sRGB and linear radiance (IEC 61966-2-1), continued linearly above 1.

The continuation keeps gradients of over-exposed pixels alive; below, the curve's linear toe keeps
the slope at black finite (12.92).
"""

import torch
from jaxtyping import Float
from torch import Tensor

_SLOPE_AT_ONE = 1.055 / 2.4  # of the encoding curve


class _Encode(torch.autograd.Function):
    """With the slope from the value: PyTorch's own way back takes the power a second time."""

    @staticmethod
    def forward(ctx, linear):
        x = linear.clamp_min(0.0)
        curve = 1.055 * x.clamp(0.0031308, 1.0) ** (1.0 / 2.4) - 0.055
        above = 1.0 + _SLOPE_AT_ONE * (x - 1.0)
        value = torch.where(x <= 0.0031308, 12.92 * x, torch.where(x <= 1.0, curve, above))
        ctx.save_for_backward(linear, value)
        return value

    @staticmethod
    def backward(ctx, grad):
        linear, value = ctx.saved_tensors
        # The clamp keeps what `where` does not take finite.
        curve = (value + 0.055) / (2.4 * linear.clamp_min(0.0031308))
        slope = torch.where(linear <= 1.0, curve, _SLOPE_AT_ONE)
        slope = torch.where(linear <= 0.0031308, 12.92, slope)
        return grad * slope * (linear >= 0.0)


class _Decode(torch.autograd.Function):
    """As `_Encode`."""

    @staticmethod
    def forward(ctx, display):
        x = display.clamp_min(0.0)
        curve = ((x.clamp(0.04045, 1.0) + 0.055) / 1.055) ** 2.4
        above = 1.0 + (x - 1.0) / _SLOPE_AT_ONE
        value = torch.where(x <= 0.04045, x / 12.92, torch.where(x <= 1.0, curve, above))
        ctx.save_for_backward(display, value)
        return value

    @staticmethod
    def backward(ctx, grad):
        display, value = ctx.saved_tensors
        curve = 2.4 * value / (display.clamp_min(0.04045) + 0.055)
        slope = torch.where(display <= 1.0, curve, 1.0 / _SLOPE_AT_ONE)
        slope = torch.where(display <= 0.04045, 1.0 / 12.92, slope)
        return grad * slope * (display >= 0.0)


def encode_srgb(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear radiance to display values; [0,1] to [0,1], linear above 1, clamped at 0 below."""
    return _Encode.apply(linear)


def decode_srgb(display: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Inverse of `encode_srgb`."""
    return _Decode.apply(display)


def luma(linear: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Rec. 709 luminance of linear colours."""
    return linear @ linear.new_tensor([0.2126, 0.7152, 0.0722])
