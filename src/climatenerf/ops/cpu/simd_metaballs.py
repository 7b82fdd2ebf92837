"""Sums of metaballs about a point, in vector registers; see `lanes.py`.

The lanes are 4 x 4 vertices about the point in y and z, for one plane of x at a time. As there,
files with kernels that use this one carry its digest.
"""

# Numba's stubs do not know what an intrinsic's generator is given.
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
    constant,
    everywhere,
    multiply_add,
    sides_of,
    sums_of,
)

_NEAR = [
    [float(lane // 4 - 1) for lane in range(LANES)],
    [float(lane % 4 - 1) for lane in range(LANES)],
]


def _squares(b: Any, u: list[Any], reach: float) -> tuple[list[Any], Any]:
    """Distances of the vertices in y and z, and reach squared less their squares."""
    beside = [
        b.fsub(everywhere(b, own), ir.Constant(FLOATS, near), flags=FAST)
        for own, near in zip(u[1:], _NEAR, strict=True)
    ]
    rest = constant(FLOATS, reach * reach)
    for d in beside:
        rest = b.fsub(rest, b.fmul(d, d, flags=FAST), flags=FAST)
    return beside, rest


def _planes(b: Any, u: list[Any], rest: Any) -> Any:
    """For each of the planes in x: its number, distance, and how far within reach vertices are."""
    for plane in range(4):
        d = everywhere(b, b.fsub(u[0], ir.Constant(F32, plane - 1.0), flags=FAST))
        q = b.fsub(rest, b.fmul(d, d, flags=FAST), flags=FAST)
        zero = constant(FLOATS, 0.0)
        yield plane, d, b.select(b.fcmp_ordered(">", q, zero), q, zero)


def _vertices(b: Any, array: Any, place: list[Any], plane: int) -> Any:
    """Values at a plane's vertices: [brick, x, y, z] of whole numbers, in floats."""
    sides = sides_of(b, array)
    kind = array.data.type.pointee
    run = ir.IntType(4 * kind.width)
    rows = ir.Constant(ir.VectorType(run, 4), ir.Undefined)
    brick, i, j, m = place
    for row in range(4):
        at = b.add(b.mul(brick, sides[1]), b.add(i, I64(plane)))
        at = b.add(b.mul(at, sides[2]), b.add(j, I64(row)))
        at = b.add(b.mul(at, sides[3]), m)
        four = b.load(b.bitcast(b.gep(array.data, [at]), run.as_pointer()), align=1)
        rows = b.insert_element(rows, four, I32(row))
    values = b.bitcast(rows, ir.VectorType(kind, LANES))
    wide = b.zext if kind.width == 8 else b.sext  # bytes have no sign here, longer ones have
    return b.sitofp(wide(values, INTS), FLOATS)


def _given(b: Any, arguments: Any, first: int) -> tuple[list[Any], list[Any]]:
    """Where a point is: brick, x, y, z of its cell; and its place in the cell, in spacings."""
    return list(arguments[first : first + 4]), list(arguments[first + 4 : first + 7])


WHERE = (types.int64,) * 4 + (types.float32,) * 3


def _ball_sums(reach: float) -> Any:
    """Generates `ball_sums(fill, brick, i, j, m, ux, uy, uz)`: kernels' sums about a point.

    K = (reach² - r²)³. Returns sums over the 64 vertices about it of K and K f, then of the slope
    (reach² - r²)² times dx, dy and dz, and of that times f.
    """

    @intrinsic
    def ball_sums(typing_context, fill, brick, i, j, m, ux, uy, uz):
        result = types.UniTuple(types.float32, 8)

        def generate(context, b, signature, arguments):
            (fills,) = arrays_of(context, b, signature, arguments, (0,))
            place, u = _given(b, arguments, 1)
            (dy, dz), rest = _squares(b, u, reach)
            names = ("k", "kf", "x", "xf", "all", "allf")
            sums = dict.fromkeys(names, constant(FLOATS, 0.0))
            for plane, dx, q in _planes(b, u, rest):
                f = _vertices(b, fills, place, plane)
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
            own = [b.extract_element(half, I32(n)) for half in halves for n in range(4)]
            return context.make_tuple(b, signature.return_type, own)

        return result(fill, *WHERE), generate

    return ball_sums


def _ball_means(reach: float) -> Any:
    """Generates `ball_means(fill, height, shade, brick, ...)`: as `ball_sums`.

    Returns sums of K f; of that times height; times dz; times shade.
    """

    @intrinsic
    def ball_means(typing_context, fill, height, shade, brick, i, j, m, ux, uy, uz):
        result = types.UniTuple(types.float32, 4)

        def generate(context, b, signature, arguments):
            arrays = arrays_of(context, b, signature, arguments, (0, 1, 2))
            place, u = _given(b, arguments, 3)
            (_, dz), rest = _squares(b, u, reach)
            total, high, lit = (constant(FLOATS, 0.0) for _ in range(3))
            for plane, _, q in _planes(b, u, rest):
                f, over, bright = (_vertices(b, array, place, plane) for array in arrays)
                cube = b.fmul(b.fmul(q, q, flags=FAST), q, flags=FAST)
                weight = b.fmul(cube, f, flags=FAST)
                total = b.fadd(total, weight, flags=FAST)
                high = multiply_add(b, weight, over, high)
                lit = multiply_add(b, weight, bright, lit)
            four = sums_of(b, [total, high, b.fmul(total, dz, flags=FAST), lit])
            own = [b.extract_element(four, I32(n)) for n in range(4)]
            return context.make_tuple(b, signature.return_type, own)

        return result(fill, height, shade, *WHERE), generate

    return ball_means


BALL_REACH = 2.0  # of a metaball's kernel, lattice spacings
ball_sums, ball_means = _ball_sums(BALL_REACH), _ball_means(BALL_REACH)
