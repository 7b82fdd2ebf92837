"""First crossing of rays with a height field. No gradients.

Far above the ground: sphere tracing with the field's steepest slope as its Lipschitz bound (Hart
1996); a ray at height a can advance by a over the fastest rate at which the two can approach each
other. Where that step would end within a cell of the raster, the crossing with the cell's bilinear
surface is the root of a quadratic, and the ray advances to the next cell. So a ray takes no more
steps than it passes cells, however near to the ground it runs.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.ops import dispatch

HIT = 1e-3  # cells above the ground at which a ray has arrived
GAP = 1e-3  # cells behind a cell's face, to be in the next cell despite rounding


def steepest_slope(height: Float[Tensor, "rows columns"]) -> float:
    """Return a bound of the gradient's length between the nodes (lengths in cells)."""
    along_x = (height[:, 1:] - height[:, :-1]).abs().max()
    along_y = (height[1:] - height[:-1]).abs().max()
    return float(torch.hypot(along_x, along_y))


def first_crossing(
    height: Float[Tensor, "rows columns"],
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    span: Float[Tensor, "n 2"],
    slope: float | None = None,
) -> Float[Tensor, "n"]:
    """Return where rays first pass from above a height field to below it.

    See `heightfield_reference.first_crossing`. A caller that asks often can keep the height field's
    `steepest_slope` and give it.
    """
    slope = steepest_slope(height) if slope is None else slope
    if dispatch.backend(height, rays_o, rays_d, span) == "cpu":
        from climatenerf.ops.cpu import heightfield as kernels

        found = torch.empty_like(span[:, 0])
        given = dispatch.kernel_arrays(height, rays_o, rays_d, span, found)
        kernels.first_crossing(given[0], given[1], given[2], given[3], slope, given[4])
        return found
    return _first_crossing(height, rays_o, rays_d, span, slope)


def _first_crossing(
    height: Tensor, rays_o: Tensor, rays_d: Tensor, span: Tensor, slope: float
) -> Float[Tensor, "n"]:
    """Trace all rays together, on any device: as the kernel in `ops.cpu.heightfield`."""
    rows, columns = height.shape
    side = torch.tensor([columns - 1.0, rows - 1.0], device=height.device, dtype=height.dtype)
    flat = rays_d[:, :2]
    # An axis along which a ray does not move: 0/0 at a face. It is inside or outside for good.
    still = flat == 0
    safe = torch.where(still, torch.ones_like(flat), flat)
    low, high = (-rays_o[:, :2]) / safe, (side - rays_o[:, :2]) / safe
    inside = (rays_o[:, :2] >= 0) & (rays_o[:, :2] <= side)
    enter = torch.where(still, torch.where(inside, -torch.inf, torch.inf), torch.minimum(low, high))
    leave = torch.where(still, torch.inf, torch.maximum(low, high))
    begin = torch.maximum(span[:, 0], enter.amax(-1))
    end = torch.minimum(span[:, 1], leave.amin(-1))
    climb = slope * flat.norm(dim=-1)
    found = torch.full_like(begin, torch.inf)
    alive = (begin < end) & (climb > rays_d[:, 2]) & rays_o.isfinite().all(-1)
    ray = alive.nonzero()[:, 0]
    o, d, end = rays_o[ray] + begin[ray, None] * rays_d[ray], rays_d[ray], (end - begin)[ray]
    climb, t, before = climb[ray], torch.zeros_like(end), torch.full_like(end, -1.0)
    for _ in range(4 * (rows + columns)):
        if not ray.numel():
            break
        at = torch.minimum((o[:, :2] + t[:, None] * d[:, :2]).clamp_min(0), side)
        column, row = (torch.minimum(at, side - 1).long()).unbind(-1)
        u, v = at[:, 0] - column, at[:, 1] - row
        corner = height[row, column]
        along_x, along_y = height[row, column + 1] - corner, height[row + 1, column] - corner
        twist = height[row + 1, column + 1] - corner - along_x - along_y
        above = o[:, 2] + t * d[:, 2] - (corner + along_x * u + along_y * v + twist * u * v)
        arrived = (before > HIT) & (above <= HIT)
        rise = climb + d[:, 2]
        free = torch.where(
            above > HIT,
            above / (climb - d[:, 2]),
            # Below the ground for good if the ray falls faster than the ground can.
            torch.where(rise > 0, (-above).clamp_min(0) / rise, torch.inf),
        )
        face = torch.minimum(_to_face(u, d[:, 0]), _to_face(v, d[:, 1]))
        rate = d[:, 2] - along_x * d[:, 0] - along_y * d[:, 1]
        rate = rate - twist * (u * d[:, 1] + v * d[:, 0])
        bend = -twist * d[:, 0] * d[:, 1]
        ahead = _crossing_in_cell(above, rate, bend, torch.minimum(face, end - t))
        ahead = torch.where(free < face, ahead, torch.inf)
        ahead = torch.where(arrived, torch.zeros_like(ahead), ahead)
        met = ahead.isfinite()
        found[ray[met]] = begin[ray[met]] + (t + ahead)[met]
        t = t + torch.where(free < face, face + GAP, free)
        rest = (~met & (t < end)).nonzero()[:, 0]
        ray, o, d, end, climb = ray[rest], o[rest], d[rest], end[rest], climb[rest]
        t, before = t[rest], above[rest]
    return found


def _to_face(place: Float[Tensor, "n"], d: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return ray lengths from places in a cell, [0, 1], to the cell's faces along one axis."""
    ahead = torch.where(d > 0, 1 - place, place)
    return torch.where(d == 0, torch.inf, ahead / d.abs())


def _crossing_in_cell(
    a: Float[Tensor, "n"], b: Float[Tensor, "n"], c: Float[Tensor, "n"], length: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Return where a + b s + c s^2 first passes below 0 in (0, length]; +inf if nowhere."""
    square = b.square() - 4 * a * c
    # The roots q / c and a / q; either denominator may be 0, and the root is infinite or NaN.
    q = -0.5 * (b + torch.copysign(square.clamp_min(0).sqrt(), b))
    first, second = (torch.nan_to_num(x, torch.inf, torch.inf, -torch.inf) for x in (q / c, a / q))
    nearest = torch.minimum(
        torch.where(first > 0, first, torch.inf), torch.where(second > 0, second, torch.inf)
    )
    rises = (c < 0) & (b > 0) & (a - b.square() / (4 * c) > HIT)
    farthest = torch.where(rises, torch.maximum(first, second), torch.inf)
    s = torch.where(a > HIT, nearest, farthest)
    return torch.where((square >= 0) & (s <= length), s, torch.inf)
