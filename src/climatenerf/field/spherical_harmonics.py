"""Real spherical harmonics up to degree 3 (16 functions) of unit directions."""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.ops.cpu import activations as cpu


def harmonics(d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 16"]:
    """Return `spherical_harmonics`, from a kernel for float32 on a CPU without gradients."""
    if d.requires_grad or d.device.type != "cpu" or d.dtype != torch.float32:
        return spherical_harmonics(d)
    out = d.new_empty(16, d.shape[0])
    cpu.harmonics(d.contiguous().numpy(), out.numpy())
    return out.T


def spherical_harmonics(d: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 16"]:
    """Return the 16 real spherical harmonics of degrees 0 to 3, orthonormal over the sphere.

    The memory layout is feature-major, as that of the encodings' features.
    """
    x, y, z = d.unbind(-1)
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    rows = torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.48860251190291987 * y,
            0.48860251190291987 * z,
            -0.48860251190291987 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.94617469575755997 * zz - 0.31539156525252005,
            -1.0925484305920792 * xz,
            0.54627421529603959 * (xx - yy),
            0.59004358992664352 * y * (-3.0 * xx + yy),
            2.8906114426405538 * xy * z,
            0.45704579946446572 * y * (1.0 - 5.0 * zz),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.45704579946446572 * x * (1.0 - 5.0 * zz),
            1.4453057213202769 * z * (xx - yy),
            0.59004358992664352 * x * (-xx + 3.0 * yy),
        ]
    )
    return rows.movedim(0, -1)
