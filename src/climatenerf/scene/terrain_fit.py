"""A smooth ground through uncertain heights: a robust tension spline on a raster.

Minimises a robust loss of the data plus bending energy (thin plate) plus a little stretching energy
(membrane), which keeps the continuation beyond the data from tilting away (Smith & Wessel 1990,
"Gridding with continuous curvature splines in tension"). Bending beyond a limit costs linearly, so
kerbs, steps and banks stay. Solved from coarse to fine by conjugate gradients.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import ndimage, sparse
from scipy.sparse import linalg

from climatenerf.scene.terrain import nearest_known

Matrix = Any
"""A sparse array of SciPy, whose type stubs lose the shape of products."""

COARSEST = 17  # nodes along the longer side, where the solution begins
ROUNDS = 4  # of reweighted least squares on each raster
STEPS = 40  # of conjugate gradients a round, at most
TOLERANCE = 1e-9  # of their residual, relative
BENDING = 3.0  # weight of the squared second difference over 1 m, m^-2
TENSION = 0.02  # weight of the squared slope; heights are forgotten over sqrt(BENDING/TENSION) m
BEND_LIMIT = 0.05  # 1/m; curvature beyond it costs linearly: a kerb, a step, the edge of a bank
OUTLIER = 2.0  # standard errors beyond which a height is an outlier
BELOW = 0.5  # factor of a squared outlier below the surface, which is rarer than one above
FINE = 1.2  # m; cells from which on outliers cost their logarithm
MAX_COUNT = 8.0  # heights in one of the finest cells that count as independent
GROWTH = 0.04  # m of standard error a metre away from the nearest height, on level ground
MIN_ERROR = 0.01  # m
SPREAD = 1.25  # standard errors in the mean distance of heights from the ground
MAX_RESIDUAL = 0.3  # m; larger ones are errors of the data, not of the ground
DATA_AREA = 1e-3  # m^4; a height of standard error s weighs this over s^2 against the energies
SPARSE_DATA_AREA = 2e-3  # m^4; with outliers the heights that are left must still carry a bank
DIRECT = 6000  # nodes up to which systems are solved directly


@dataclass(frozen=True)
class Heights:
    """Measured heights of ground."""

    x: Float[np.ndarray, "n 3"]
    """Positions, world m."""
    error: Float[np.ndarray, "n"]
    """Standard error of each height, m."""

    def with_more(self, others: "Heights") -> "Heights":
        """Return these heights and others."""
        return Heights(
            np.concatenate([self.x, others.x]), np.concatenate([self.error, others.error])
        )


def fit_heights(
    heights: Heights,
    origin: tuple[float, float],
    cell: float,
    shape: tuple[int, int],
    discard_outliers: bool = False,
) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
    """Fit a ground to heights.

    Args:
        heights: of the ground, with outliers; at least one on the raster.
        origin: world x and y of the first node, m.
        cell: distance between nodes, m.
        shape: rows and columns of nodes.
        discard_outliers: whether many heights may be wrong, most of them too high: points of leaves
            and walls.

    Returns:
        Height and its standard error at each node, m.
    """
    end = np.array(origin) + cell * (np.array(shape[::-1]) - 1)
    inside = ((heights.x[:, :2] >= origin) & (heights.x[:, :2] <= end)).all(-1)
    heights = Heights(heights.x[inside], heights.error[inside])
    factor = 1
    while max(shape) / factor > 2 * COARSEST:
        factor *= 2
    solution = None
    middle = float(np.median(heights.x[:, 2]))
    while True:
        size = tuple(-(-(n - 1) // factor) + 1 for n in shape)
        start = np.zeros(size) if solution is None else _enlarged(solution, size)
        data = _binned(heights, origin, cell * factor, start, middle, MAX_COUNT * factor**2)
        solution = _solve(data, start, cell * factor, discard_outliers)
        if factor == 1:
            break
        factor //= 2
    error = _standard_error(data, solution, cell)
    return (solution + middle).astype(np.float32), error.astype(np.float32)


@dataclass(frozen=True)
class _Cells:
    """The heights in the cells around nodes."""

    row: Int[np.ndarray, "k"]
    """Flat index of each node that has heights."""
    z: Float[np.ndarray, "k"]
    """Their weighted median, m."""
    weight: Float[np.ndarray, "k"]
    """Inverse variance, 1/m^2."""


def _binned(
    heights: Heights,
    origin: tuple[float, float],
    cell: float,
    trend: Float[np.ndarray, "r c"],
    middle: float,
    most: float,
) -> _Cells:
    """Return the median height around each node, relative to `middle`.

    Heights are moved to their node along a trend, else the median of a steep cell is biased by
    where its heights lie. At most `most` heights of a node count as independent.
    """
    exact = (heights.x[:, :2] - np.array(origin)) / cell
    at = np.rint(exact).astype(np.int64)
    rows, columns = trend.shape
    inside = ((at >= 0) & (at < (columns, rows))).all(-1)
    exact, (column, row) = exact[inside], at[inside].T
    here = ndimage.map_coordinates(trend, exact.T[::-1], order=1, mode="nearest")
    z = heights.x[inside, 2] - middle - here + trend[row, column]
    row, error = row * columns + column, heights.error[inside]
    order = np.lexsort((z, row))
    row, z, weight = row[order], z[order], 1 / error[order] ** 2
    nodes, start, count = np.unique(row, return_index=True, return_counts=True)
    total = np.add.reduceat(weight, start) if len(start) else np.zeros(0)
    summed = np.cumsum(weight)
    before = summed[start] - weight[start]
    half = np.searchsorted(summed, before + 0.5 * total)
    median = z[np.clip(half, start, start + count - 1)]
    return _Cells(nodes, median, total / count * np.minimum(count, most))


def _enlarged(
    coarse: Float[np.ndarray, "r c"], size: tuple[int, ...]
) -> Float[np.ndarray, "rows columns"]:
    """Interpolate a solution at the nodes of a raster with half the cell."""
    row, column = (
        np.minimum(np.arange(n) / 2, m - 1) for n, m in zip(size, coarse.shape, strict=True)
    )
    at = np.stack(np.meshgrid(row, column, indexing="ij"))
    return ndimage.map_coordinates(coarse, at, order=1, mode="nearest")


def _solve(
    data: _Cells, start: Float[np.ndarray, "r c"], cell: float, discard_outliers: bool
) -> Float[np.ndarray, "r c"]:
    """Minimise on one raster, from a start, by reweighted least squares.

    Outliers cost linearly (Huber). Those that may be discarded cost only their logarithm (Cauchy)
    on fine rasters, and heights above the surface less than those below.
    """
    bends, slopes = _differences(start.shape, cell)
    area = cell**2
    stretching = TENSION * area * (slopes.T @ slopes)
    data_area = SPARSE_DATA_AREA if discard_outliers else DATA_AREA
    h: Any = start.reshape(-1)
    for k in range(ROUNDS):
        residual = (data.z - h[data.row]) * np.sqrt(data.weight) / OUTLIER
        cauchy = 1 + np.where(residual > 0, 1, BELOW) * residual**2
        discard = discard_outliers and k > 0 and cell < FINE
        trust = data.weight / (cauchy if discard else np.maximum(np.abs(residual), 1))
        curvature = np.abs(bends @ h)
        stiffness: Any = BENDING * area / np.maximum(curvature / BEND_LIMIT, 1)
        matrix: Matrix = (bends.T @ sparse.diags_array(stiffness) @ bends + stretching).tocsr()
        own, target = np.zeros(h.size), np.zeros(h.size)
        own[data.row] = trust * data_area
        target[data.row] = trust * data_area * data.z
        matrix = matrix + sparse.diags_array(own)
        if h.size <= DIRECT:
            h = linalg.spsolve(matrix.tocsc(), target)
        else:
            scale: Matrix = sparse.diags_array(1 / matrix.diagonal())  # Jacobi's preconditioner
            h = linalg.cg(matrix, target, h, rtol=TOLERANCE, maxiter=STEPS, M=scale)[0]
    return h.reshape(start.shape)


def _differences(shape: tuple[int, ...], cell: float) -> tuple[Matrix, Matrix]:
    """Return the operators of second differences (xx, yy, and xy twice) and of slopes."""

    def first(n: int) -> Matrix:
        forward: Matrix = sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n)
        return forward.tocsr() / cell

    def second(n: int) -> Matrix:
        outer = sparse.eye_array(n - 2, n) + sparse.eye_array(n - 2, n, k=2)
        stencil: Matrix = outer - 2 * sparse.eye_array(n - 2, n, k=1)
        return stencil.tocsr() / cell**2

    rows, columns = shape
    one_row: Matrix = sparse.eye_array(rows)
    one_column: Matrix = sparse.eye_array(columns)
    twist = np.sqrt(2) * sparse.kron(first(rows), first(columns))
    bends: list[Matrix] = [
        sparse.kron(one_row, second(columns)),
        sparse.kron(second(rows), one_column),
        twist,
    ]
    slopes: list[Matrix] = [
        sparse.kron(one_row, first(columns)),
        sparse.kron(first(rows), one_column),
    ]
    stacked: tuple[Matrix, Matrix] = sparse.vstack(bends), sparse.vstack(slopes)
    return stacked[0].tocsr(), stacked[1].tocsr()


def _standard_error(
    data: _Cells, solution: Float[np.ndarray, "r c"], cell: float
) -> Float[np.ndarray, "r c"]:
    """Return the error of the heights: the data's spread near by, growing away from the data.

    On a slope it grows faster, since tension forgets the slope: at a distance x from the data,
    x^2 / 2 over the length of forgetting is missing for each unit of slope.
    """
    known = np.zeros(solution.size, bool)
    known[data.row] = True
    known = known.reshape(solution.shape)
    residual = np.zeros(solution.size)
    residual[data.row] = np.minimum(np.abs(solution.reshape(-1)[data.row] - data.z), MAX_RESIDUAL)
    radius = max(round(1.0 / cell), 1)  # nodes; a metre
    share, mean, uphill, across = (
        ndimage.uniform_filter(each.astype(float), 2 * radius + 1, mode=mode)
        for each, mode in (
            (known, "constant"),
            (residual.reshape(solution.shape), "constant"),
            *((slope, "nearest") for slope in np.gradient(solution, cell)),
        )
    )
    distance, nearest = nearest_known(known, cell)
    spread = (mean / np.maximum(share, 1e-9))[nearest]  # at data the share is above 0
    growth = GROWTH * distance
    forgotten = np.hypot(uphill, across)[nearest] * distance**2 / (2 * np.sqrt(BENDING / TENSION))
    return np.sqrt(np.maximum(SPREAD * spread, MIN_ERROR) ** 2 + growth**2 + forgotten**2)
