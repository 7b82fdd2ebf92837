"""What the networks' outputs mean: radiance, and density.

Plain PyTorch says what it is; on a CPU, in 32 bits, the same in one pass through memory.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import decode_srgb
from climatenerf.core.vectors import length
from climatenerf.ops.cpu import activations as cpu_pointwise
from climatenerf.ops.cpu.activations import BLACK, LARGEST_RAW, MIN_SLOPE, SHARPNESS


def radiance(raw: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """See `plain_radiance`."""
    if _is_plain(raw):  # in rows, as networks leave it
        return _Radiance.apply(raw.T.contiguous()).T
    return plain_radiance(raw)


def plain_radiance(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Network output to linear radiance: a display value >= 0 and unbounded, decoded.

    Softplus with sharpness 8 is nearly the identity from 0.3 up.
    """
    return decode_srgb(_Brightness.apply(raw + 0.5))


def thinned_density(raw: Float[Tensor, "n"], u: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """See `plain_thinned_density`."""
    if _is_plain(raw, u) and not u.requires_grad:
        return _ThinnedDensity.apply(raw.contiguous(), u.contiguous())
    return plain_thinned_density(raw, u)


def plain_thinned_density(raw: Float[Tensor, "n"], u: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Density (1/grid unit) at unit-cube coordinates from its logarithm per contracted length.

    It is thinned by 1/|q|^2 outside the core (see `reference.density`), from the contracted radius
    2 - 1/|q|.
    """
    # 1e-4: the outermost shell, where rounding could make it negative.
    shell = (2.0 - length(4.0 * u - 2.0)).clamp(1e-4, 1.0)
    return raw.clamp_max(LARGEST_RAW).exp() * shell.square()


def _is_plain(*tensors: Tensor) -> bool:
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)


class _Brightness(torch.autograd.Function):
    """Softplus out of whose flat part there is a way back.

    Where it is black its slope vanishes. Adam makes steps of full length of vanishing gradients, so
    colours that darken for a while would sink ever deeper and never return: a fit in which the sky
    shone through the haze stayed black for good.
    """

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.nn.functional.softplus(x, beta=SHARPNESS)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        slope = torch.sigmoid(SHARPNESS * x)
        # Steps go against the gradient: negative ones brighten.
        return grad * torch.where(grad < 0, slope.clamp_min(MIN_SLOPE), slope * (x > BLACK))


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows):
        out = torch.empty_like(rows)
        cpu_pointwise.radiance_forward(*_flat(rows, out))
        ctx.save_for_backward(rows, out)
        return out

    @staticmethod
    def backward(ctx, grad):
        rows, out = ctx.saved_tensors
        grad_rows = torch.empty_like(rows)
        cpu_pointwise.radiance_backward(*_flat(rows, out, grad.contiguous(), grad_rows))
        return grad_rows


class _ThinnedDensity(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raw, u):
        out = torch.empty_like(raw)
        cpu_pointwise.density_forward(raw.numpy(), u.numpy(), out.numpy())
        ctx.save_for_backward(raw, out)
        return out

    @staticmethod
    def backward(ctx, grad):
        raw, out = ctx.saved_tensors
        grad_raw = torch.empty_like(raw)
        cpu_pointwise.density_backward(*_flat(raw, out, grad.contiguous(), grad_raw))
        return grad_raw, None


def _flat(*tensors: Tensor) -> list:
    """The numbers of tensors that lie in order."""
    return [each.detach().view(-1).numpy() for each in tensors]
