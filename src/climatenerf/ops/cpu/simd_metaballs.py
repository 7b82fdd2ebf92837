"""SIMD intrinsics: sums of metaballs around a point; see `simd.py`.

The lanes are the 4 x 4 vertices around the point in y and z, for one plane of x at a time. Files
with kernels that use this one hold the digest of both.
"""

# Numba's stubs have no types for the arguments of an intrinsic's generator.
# pyright: reportAttributeAccessIssue=false

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from climatenerf.ops.cpu.simd import (
    F32,
    FAST,
    FLOATS,
    I32,
    I64,
    INTS,
    LANES,
    arrays_of,
    broadcast,
    constant,
    multiply_add,
    shape_of,
    sums_of,
)

_OFFSETS = [
    [float(lane // 4 - 1) for lane in range(LANES)],
    [float(lane % 4 - 1) for lane in range(LANES)],
]


def _squares(b: Any, u: list[Any], support: float) -> tuple[list[Any], Any]:
    """Return the vertices' distances in y and z, and support squared less their squares."""
    distances = [
        b.fsub(broadcast(b, position), ir.Constant(FLOATS, offset), flags=FAST)
        for position, offset in zip(u[1:], _OFFSETS, strict=True)
    ]
    rest = constant(FLOATS, support * support)
    for d in distances:
        rest = b.fsub(rest, b.fmul(d, d, flags=FAST), flags=FAST)
    return distances, rest


def _planes(b: Any, u: list[Any], rest: Any) -> Any:
    """Yield each plane in x: its number, its distance, and support² - r² of the vertices, or 0."""
    for plane in range(4):
        d = broadcast(b, b.fsub(u[0], ir.Constant(F32, plane - 1.0), flags=FAST))
        q = b.fsub(rest, b.fmul(d, d, flags=FAST), flags=FAST)
        zero = constant(FLOATS, 0.0)
        yield plane, d, b.select(b.fcmp_ordered(">", q, zero), q, zero)


def _vertices(b: Any, array: Any, cell: list[Any], plane: int) -> Any:
    """Return the values at a plane's vertices of an integer array [brick, x, y, z], as floats."""
    sides = shape_of(b, array)
    kind = array.data.type.pointee
    run = ir.IntType(4 * kind.width)
    rows = ir.Constant(ir.VectorType(run, 4), ir.Undefined)
    brick, i, j, m = cell
    for row in range(4):
        at = b.add(b.mul(brick, sides[1]), b.add(i, I64(plane)))
        at = b.add(b.mul(at, sides[2]), b.add(j, I64(row)))
        at = b.add(b.mul(at, sides[3]), m)
        four = b.load(b.bitcast(b.gep(array.data, [at]), run.as_pointer()), align=1)
        rows = b.insert_element(rows, four, I32(row))
    values = b.bitcast(rows, ir.VectorType(kind, LANES))
    wide = b.zext if kind.width == 8 else b.sext  # bytes are unsigned here, longer integers signed
    return b.sitofp(wide(values, INTS), FLOATS)


def _cell_and_position(b: Any, arguments: Any, first: int) -> tuple[list[Any], list[Any]]:
    """Return brick, x, y, z of a point's cell, and its position in the cell (spacings)."""
    return list(arguments[first : first + 4]), list(arguments[first + 4 : first + 7])


WHERE = (types.int64,) * 4 + (types.float32,) * 3


def _ball_sums(support: float) -> Any:
    """Generate `ball_sums(fill, brick, i, j, m, ux, uy, uz)`: kernel sums around a point.

    K = (support² - r²)³. It returns sums over the 64 vertices around the point: of K and K f; of
    the slope (support² - r²)² times dx, dy and dz; and of that times f.
    """

    @intrinsic
    def ball_sums(typing_context, fill, brick, i, j, m, ux, uy, uz):
        result = types.UniTuple(types.float32, 8)

        def generate(context, b, signature, arguments):
            (fills,) = arrays_of(context, b, signature, arguments, (0,))
            cell, u = _cell_and_position(b, arguments, 1)
            (dy, dz), rest = _squares(b, u, support)
            names = ("k", "kf", "x", "xf", "all", "allf")
            sums = dict.fromkeys(names, constant(FLOATS, 0.0))
            for plane, dx, q in _planes(b, u, rest):
                f = _vertices(b, fills, cell, plane)
                slope = b.fmul(q, q, flags=FAST)
                slope_f = b.fmul(slope, f, flags=FAST)
                terms = ((slope, q), (slope_f, q), (slope, dx), (slope_f, dx))
                for name, (one, other) in zip(names, terms, strict=False):
                    sums[name] = multiply_add(b, one, other, sums[name])
                sums["all"] = b.fadd(sums["all"], slope, flags=FAST)
                sums["allf"] = b.fadd(sums["allf"], slope_f, flags=FAST)
            yz = [b.fmul(sums[kind], d, flags=FAST) for kind in ("all", "allf") for d in (dy, dz)]
            k, kf, x, xf = (sums[name] for name in names[:4])
            halves = sums_of(b, [k, kf, x, yz[0]]), sums_of(b, [yz[1], xf, yz[2], yz[3]])
            values = [b.extract_element(half, I32(n)) for half in halves for n in range(4)]
            return context.make_tuple(b, signature.return_type, values)

        return result(fill, *WHERE), generate

    return ball_sums


def _ball_means(support: float) -> Any:
    """Generate `ball_means(fill, height, shade, brick, ...)`, as `ball_sums`.

    It returns sums of K f; of that times height; times dz; times shade.
    """

    @intrinsic
    def ball_means(typing_context, fill, height, shade, brick, i, j, m, ux, uy, uz):
        result = types.UniTuple(types.float32, 4)

        def generate(context, b, signature, arguments):
            arrays = arrays_of(context, b, signature, arguments, (0, 1, 2))
            cell, u = _cell_and_position(b, arguments, 3)
            (_, dz), rest = _squares(b, u, support)
            total, heights, shades = (constant(FLOATS, 0.0) for _ in range(3))
            for plane, _, q in _planes(b, u, rest):
                f, over, bright = (_vertices(b, array, cell, plane) for array in arrays)
                cube = b.fmul(b.fmul(q, q, flags=FAST), q, flags=FAST)
                weight = b.fmul(cube, f, flags=FAST)
                total = b.fadd(total, weight, flags=FAST)
                heights = multiply_add(b, weight, over, heights)
                shades = multiply_add(b, weight, bright, shades)
            four = sums_of(b, [total, heights, b.fmul(total, dz, flags=FAST), shades])
            values = [b.extract_element(four, I32(n)) for n in range(4)]
            return context.make_tuple(b, signature.return_type, values)

        return result(fill, height, shade, *WHERE), generate

    return ball_means


BALL_SUPPORT = 2.0  # radius of the support of a metaball's kernel, lattice spacings
ball_sums, ball_means = _ball_sums(BALL_SUPPORT), _ball_means(BALL_SUPPORT)
