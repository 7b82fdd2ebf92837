"""GPU kernel in Triton: the step of Adam for tables whose gradients are mostly zero."""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import launch

ENTRIES = 1024  # per program


@triton.jit(do_not_specialize=["n", "rate", "correction1", "correction2"])
def _adam(
    parameter,
    gradient,
    first,
    second,
    n,
    rate,
    beta1,
    beta2,
    epsilon,
    correction1,
    correction2,
    BLOCK: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    g = tl.load(gradient + i, mask=i < n, other=0.0)
    nonzero = g != 0.0
    m = beta1 * tl.load(first + i, mask=nonzero, other=0.0) + (1.0 - beta1) * g
    v = beta2 * tl.load(second + i, mask=nonzero, other=0.0) + (1.0 - beta2) * g * g
    tl.store(first + i, m, mask=nonzero)
    tl.store(second + i, v, mask=nonzero)
    move = rate * (m / correction1) / (tl.sqrt(v / correction2) + epsilon)
    tl.store(parameter + i, tl.load(parameter + i, mask=nonzero, other=0.0) - move, mask=nonzero)
    tl.store(gradient + i, tl.zeros_like(g), mask=nonzero)


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *rates: float) -> None:
    """Take one Adam step over flat arrays; entries without gradient stay as they are.

    rates: rate, beta1, beta2, epsilon, and the bias corrections of both moments.
    """
    n = parameter.shape[0]
    launch(_adam, n, ENTRIES)(
        parameter, gradient, first, second, n, *map(float, rates), BLOCK=ENTRIES
    )
