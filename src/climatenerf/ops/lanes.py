"""Hash lookups and the density's network for `LANES` points at once, in vector registers.

Numba's compiler does not make vectors of loops that read a table at computed places. So these few
steps are spelled out in LLVM's vector instructions, which it translates for whatever processor it
runs on (AVX-512, AVX2, Neon). Values in lanes lie in rows, [what, LANES].
"""

# Numba's stubs do not know what an intrinsic's generator is given.
# pyright: reportAttributeAccessIssue=false

from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
PRIME_Y = 2654435761
PRIME_Z = 805459861
UNITS = 4  # hidden units of the network computed together: a multiple of it is wanted

_F, _I, _L = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS, _LONGS = (ir.VectorType(kind, LANES) for kind in (_F, _I, _L))
_FAST = ("fast",)  # sums may be reordered and products fused, as in the other kernels


def _all(b: Any, scalar: Any) -> Any:
    """A vector with the scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    nothing = ir.Constant(kind, ir.Undefined)
    first = b.insert_element(nothing, scalar, _I(0))
    return b.shuffle_vector(first, nothing, ir.Constant(_INTS, [0] * LANES))


def _same(kind: ir.VectorType, value: float) -> Any:
    return ir.Constant(kind, [value] * LANES)


def _row(b: Any, array: Any, row: Any) -> Any:
    """Address of a row of lanes."""
    start = b.gep(array, [b.mul(row, _L(LANES))])
    return b.bitcast(start, _FLOATS.as_pointer())


def _load(b: Any, array: Any, row: Any) -> Any:
    return b.load(_row(b, array, row), align=4)


def _multiply_add(b: Any, x: Any, y: Any, z: Any) -> Any:
    return b.fadd(b.fmul(x, y, flags=_FAST), z, flags=_FAST)


def _pairs(b: Any, table: Any, index: Any) -> tuple[Any, Any]:
    """Both features of some rows of a table [rows, 2]: read as one number of 64 bits each."""
    where = ir.VectorType(ir.PointerType(), LANES)
    yes = ir.VectorType(ir.IntType(1), LANES)
    start = _all(b, b.ptrtoint(table, _L))
    places = b.inttoptr(b.add(start, b.shl(b.zext(index, _LONGS), _same(_LONGS, 3))), where)
    gather = cgutils.get_or_insert_function(
        b.module,
        ir.FunctionType(_LONGS, [where, yes, _LONGS]),
        f"llvm.masked.gather.v{LANES}i64.v{LANES}p0",
    )
    both = b.call(gather, [places, _same(yes, 1), ir.Constant(_LONGS, ir.Undefined)])
    low, high = b.trunc(both, _INTS), b.trunc(b.lshr(both, _same(_LONGS, 32)), _INTS)
    return b.bitcast(low, _FLOATS), b.bitcast(high, _FLOATS)


def _lookup(hashed: bool) -> Any:
    """Generates the trilinear lookup of a level that is hashed, or fits its table."""

    @intrinsic
    def lookup(typing_context, places, table, level, resolution, out, row):
        kinds = (places, table, types.int64, types.int64, out, types.int64)

        def generate(context, b, signature, arguments):
            at, table, result = (
                context.make_array(signature.args[i])(context, b, arguments[i]) for i in (0, 1, 4)
            )
            at, result = at.data, result.data
            size = cgutils.unpack_tuple(b, table.shape, 3)[1]
            rows = b.gep(table.data, [b.mul(b.mul(arguments[2], size), _L(2))])
            across, side = arguments[3], b.add(b.trunc(arguments[3], _I), _I(1))
            scale = _all(b, b.sitofp(across, _F))
            low, inside = [], []
            for axis in range(3):
                p = b.fmul(_load(b, at, _L(axis)), scale, flags=_FAST)
                low.append(b.fptosi(p, _INTS))
                inside.append(b.fsub(p, b.sitofp(low[-1], _FLOATS), flags=_FAST))
            if hashed:
                strides = [_same(_INTS, 1), _same(_INTS, PRIME_Y), _same(_INTS, PRIME_Z)]
                combine = b.xor
            else:
                strides = [_same(_INTS, 1), _all(b, side), _all(b, b.mul(side, side))]
                combine = b.add
            starts = [b.mul(p, stride) for p, stride in zip(low, strides, strict=True)]
            index = [(s, b.add(s, stride)) for s, stride in zip(starts, strides, strict=True)]
            weight = [(b.fsub(_same(_FLOATS, 1.0), f, flags=_FAST), f) for f in inside]
            limit = _all(b, b.sub(b.trunc(size, _I), _I(1)))
            totals = [_same(_FLOATS, 0.0)] * 2
            for corner in range(8):
                x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
                where = combine(combine(index[1][y], index[2][z]), index[0][x])
                features = _pairs(b, rows, b.and_(where, limit) if hashed else where)
                w = b.fmul(b.fmul(weight[1][y], weight[2][z], flags=_FAST), weight[0][x], _FAST)
                totals = [_multiply_add(b, w, f, t) for f, t in zip(features, totals, strict=True)]
            for k, total in enumerate(totals):
                b.store(total, _row(b, result, b.add(arguments[5], _L(k))), align=4)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return lookup


_lookup_hashed, _lookup_dense = _lookup(True), _lookup(False)


@njit(cache=True, fastmath=True, inline="always")
def look_up(places, table, level, resolution, out, row):
    """One level's features at places [3, LANES] in the unit cube: table [L, T, 2] → rows of out."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _lookup_dense(places, table, level, resolution, out, row)
    else:
        _lookup_hashed(places, table, level, resolution, out, row)


def _network() -> Any:
    """Generates `network`, the density's: one hidden layer with ReLU and one output.

    features [inputs, LANES], w1 [hidden, inputs], b1 and w2 [hidden], b2 → the first row of out.
    `hidden` is a multiple of `UNITS`, so that a row of features is loaded once for so many.
    """

    @intrinsic
    def network(typing_context, features, w1, b1, w2, b2, out):

        def generate(context, b, signature, arguments):
            x, first, bias, second, result = (
                context.make_array(signature.args[i])(context, b, arguments[i]).data
                for i in (0, 1, 2, 3, 5)
            )
            shape = context.make_array(signature.args[1])(context, b, arguments[1]).shape
            hidden, inputs = cgutils.unpack_tuple(b, shape, 2)

            def number(array: Any, place: Any) -> Any:
                return _all(b, b.load(b.gep(array, [place])))

            total = cgutils.alloca_once_value(b, _all(b, arguments[4]))
            units = [cgutils.alloca_once(b, _FLOATS) for _ in range(UNITS)]
            with cgutils.for_range_slice(b, _L(0), hidden, _L(UNITS), intp=_L) as (unit, _):
                places = [b.add(unit, _L(k)) for k in range(UNITS)]
                for own, place in zip(units, places, strict=True):
                    b.store(number(bias, place), own)
                with cgutils.for_range(b, inputs, intp=_L) as loop:
                    row = _load(b, x, loop.index)
                    for own, place in zip(units, places, strict=True):
                        w = number(first, b.add(b.mul(place, inputs), loop.index))
                        b.store(_multiply_add(b, w, row, b.load(own)), own)
                for own, place in zip(units, places, strict=True):
                    value, zero = b.load(own), _same(_FLOATS, 0.0)
                    lit = b.select(b.fcmp_ordered(">", value, zero), value, zero)
                    b.store(_multiply_add(b, number(second, place), lit, b.load(total)), total)
            b.store(b.load(total), _row(b, result, _L(0)), align=4)
            return context.get_dummy_value()

        return types.void(features, w1, b1, w2, types.float32, out), generate

    return network


network = _network()
