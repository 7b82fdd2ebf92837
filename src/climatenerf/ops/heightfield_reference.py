"""First crossing of rays with a height field, slow and obvious: the oracle of `heightfield`."""

import torch
from jaxtyping import Float
from torch import Tensor

SUBSTEPS = 8  # a cell
BISECTIONS = 30


def bilinear(
    values: Float[Tensor, "rows columns"], at: Float[Tensor, "*n 2"]
) -> Float[Tensor, "*n"]:
    """Interpolate node values at positions (x, y) in cells; the border continues outwards."""
    rows, columns = values.shape
    x, y = at[..., 0].clamp(0, columns - 1), at[..., 1].clamp(0, rows - 1)
    column, row = x.long().clamp_max(columns - 2), y.long().clamp_max(rows - 2)
    u, v = x - column, y - row
    lower = values[row, column] * (1 - u) + values[row, column + 1] * u
    upper = values[row + 1, column] * (1 - u) + values[row + 1, column + 1] * u
    return lower * (1 - v) + upper * v


def first_crossing(
    height: Float[Tensor, "rows columns"],
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    span: Float[Tensor, "n 2"],
) -> Float[Tensor, "n"]:
    """Return where rays first pass from above a height field to below it, on the raster.

    Args:
        height: at the nodes; lengths in cells, node (row, column) at (x, y) = (column, row).
        rays_o: origins, cells.
        rays_d: unit directions.
        span: ray lengths at which each ray begins and ends, cells; the end may be infinite.

    Returns:
        Ray length, cells; +inf without a crossing.
    """
    rows, columns = height.shape
    found = torch.full_like(span[:, 0], torch.inf)
    for ray in range(rays_o.shape[0]):
        o, d = rays_o[ray], rays_d[ray]
        begin, end = (float(each) for each in span[ray])
        for axis, side in ((0, columns - 1), (1, rows - 1)):
            if d[axis] == 0:
                if not 0 <= o[axis] <= side:
                    end = begin
            else:
                faces = sorted((float((0 - o[axis]) / d[axis]), float((side - o[axis]) / d[axis])))
                begin, end = max(begin, faces[0]), min(end, faces[1])
        if d[2] < 0:  # below the lowest node nothing more is crossed
            end = min(end, float((height.min() - o[2]) / d[2]) + 1.0)
        elif d[2] > 0:  # above the highest node neither
            end = min(end, float((height.max() - o[2]) / d[2]) + 1.0)
        if not begin < end:
            continue
        count = int((end - begin) * SUBSTEPS) + 2
        t = torch.linspace(begin, end, count, dtype=o.dtype, device=o.device)
        above = (o[2] + t * d[2]) - bilinear(height, o[:2] + t[:, None] * d[:2])
        crossed = ((above[:-1] > 0) & (above[1:] <= 0)).nonzero()
        if not crossed.numel():
            continue
        index = int(crossed[0, 0])
        low, high = float(t[index]), float(t[index + 1])
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            x = o + middle * d
            if x[2] - bilinear(height, x[:2]) > 0:
                low = middle
            else:
                high = middle
        found[ray] = (low + high) / 2
    return found
