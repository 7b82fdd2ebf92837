"""SIMD intrinsics: hash lookups, matrix products and optimiser steps, `LANES` values at a time.

Numba's compiler does not vectorise loops that read a table at computed addresses, and uses short
vectors for products. These steps are therefore written as LLVM vector instructions, which LLVM
compiles for the processor at hand (AVX-512, AVX2, Neon). Values of points are feature-major,
[features, points], and the number of points is a multiple of LANES. Arrays are C-contiguous and
float32, except for indices.

Numba caches a compiled kernel until its own file changes; a change of this file is not noticed.
Files with kernels that use it therefore hold its digest (SIMD_DIGEST), which a test compares.
"""

# Numba's stubs have no types for the arguments of an intrinsic's generator.
# pyright: reportAttributeAccessIssue=false

from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
PRIME_Y = 2654435761
PRIME_Z = 805459861
CACHED_ROWS = 2**17  # rows of a level that a core's own cache holds as a rule (1 MB)
UNITS, VECTORS = 4, 2  # rows and vectors of a product that stay in registers

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS, LONGS = (ir.VectorType(kind, LANES) for kind in (F32, I32, I64))
FAST = ("fast",)  # allows reordered sums and fused products, as in the other kernels


def arrays_of(context: Any, b: Any, signature: Any, arguments: Any, which: tuple) -> list[Any]:
    """Return the arrays among an intrinsic's arguments, with data, shape and strides."""
    return [context.make_array(signature.args[i])(context, b, arguments[i]) for i in which]


def shape_of(b: Any, array: Any) -> list[Any]:
    """Return the shape of an array."""
    return cgutils.unpack_tuple(b, array.shape)


def broadcast(b: Any, scalar: Any) -> Any:
    """Return a vector with the scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    undefined = ir.Constant(kind, ir.Undefined)
    first = b.insert_element(undefined, scalar, I32(0))
    return b.shuffle_vector(first, undefined, ir.Constant(INTS, [0] * LANES))


def constant(kind: ir.VectorType, value: float) -> Any:
    """Return a constant vector with one value in every lane."""
    return ir.Constant(kind, [value] * LANES)


def vector_pointer(b: Any, data: Any, index: Any) -> Any:
    """Return a pointer to the vector that begins at an index of an array."""
    return b.bitcast(b.gep(data, [index]), FLOATS.as_pointer())


def multiply_add(b: Any, x: Any, y: Any, z: Any) -> Any:
    """Return x·y + z."""
    return b.fadd(b.fmul(x, y, flags=FAST), z, flags=FAST)


# --- lookups -------------------------------------------------------------------------------------


def _pairs(b: Any, table: Any, index: Any) -> tuple[Any, Any]:
    """Load both features of LANES rows of a table [rows, 2], as one 64-bit number each.

    One load after the other: the processor's gather instruction took up to a quarter longer.
    """
    start = broadcast(b, b.ptrtoint(table, I64))
    addresses = b.add(start, b.shl(b.zext(index, LONGS), constant(LONGS, 3)))
    both = ir.Constant(LONGS, ir.Undefined)
    for lane in range(LANES):
        pointer = b.inttoptr(b.extract_element(addresses, I32(lane)), I64.as_pointer())
        both = b.insert_element(both, b.load(pointer, align=4), I32(lane))
    low, high = b.trunc(both, INTS), b.trunc(b.lshr(both, constant(LONGS, 32)), INTS)
    return b.bitcast(low, FLOATS), b.bitcast(high, FLOATS)


class _Cells:
    """Code for the lattice cells of one level that hold LANES points."""

    def __init__(self, b: Any, points: Any, table: Any, level: Any, resolution: Any, hashed: bool):
        size = shape_of(b, table)[1]
        self.rows = b.gep(table.data, [b.mul(b.mul(level, size), I64(2))])
        side = b.add(b.trunc(resolution, I32), I32(1))
        self.scale = broadcast(b, b.sitofp(resolution, F32))
        low, inside = [], []
        for axis in range(3):
            p = b.load(vector_pointer(b, points.data, I64(axis * LANES)), align=4)
            p = b.fmul(p, self.scale, flags=FAST)
            low.append(b.fptosi(p, INTS))
            inside.append(b.fsub(p, b.sitofp(low[-1], FLOATS), flags=FAST))
        if hashed:
            strides = [constant(INTS, 1), constant(INTS, PRIME_Y), constant(INTS, PRIME_Z)]
        else:
            strides = [constant(INTS, 1), broadcast(b, side), broadcast(b, b.mul(side, side))]
        starts = [b.mul(p, stride) for p, stride in zip(low, strides, strict=True)]
        self.index = [(s, b.add(s, stride)) for s, stride in zip(starts, strides, strict=True)]
        self.weight = [(b.fsub(constant(FLOATS, 1.0), f, flags=FAST), f) for f in inside]
        self.last = broadcast(b, b.sub(b.trunc(size, I32), I32(1)))
        self.combine = b.xor if hashed else b.add
        self.hashed = hashed

    def row(self, b: Any, x: int, y: int, z: int) -> Any:
        """Return the table rows of the corner on the upper (1) or lower (0) side of each axis."""
        row = self.combine(self.combine(self.index[1][y], self.index[2][z]), self.index[0][x])
        if self.hashed:
            return b.and_(row, self.last)
        # NaN positions must not lead to an address outside the table.
        return b.select(b.icmp_unsigned("<", row, self.last), row, self.last)


CORNERS = [(corner & 1, corner >> 1 & 1, corner >> 2) for corner in range(8)]


def _lookup(hashed: bool, sloped: bool) -> Any:
    """Generate the trilinear lookup of a level that is hashed, or that fits its table.

    With `sloped` the slopes of the first feature along x, y and z, then those of the second, are
    written to the rows from `slopes` on.
    """

    @intrinsic
    def lookup(typing_context, points, table, level, resolution, out, row, slopes):
        kinds = (points, table, types.int64, types.int64, out, types.int64, types.int64)

        def generate(context, b, signature, arguments):
            at, tables, result = arrays_of(context, b, signature, arguments, (0, 1, 4))
            level, resolution, row, slopes = (arguments[i] for i in (2, 3, 5, 6))
            cells = _Cells(b, at, tables, level, resolution, hashed)
            # Slope of a corner's weight along an axis: lower corner, upper corner.
            change = b.fneg(cells.scale), cells.scale
            totals = [constant(FLOATS, 0.0)] * (8 if sloped else 2)
            for x, y, z in CORNERS:
                pair = _pairs(b, cells.rows, cells.row(b, x, y, z))
                wx, wy, wz = cells.weight[0][x], cells.weight[1][y], cells.weight[2][z]
                yz = b.fmul(wy, wz, flags=FAST)
                weights = [b.fmul(yz, wx, flags=FAST)]
                if sloped:
                    xz = b.fmul(wx, wz, flags=FAST)
                    xy = b.fmul(wx, wy, flags=FAST)
                    for product, upper in ((yz, x), (xz, y), (xy, z)):
                        weights.append(b.fmul(product, change[upper], flags=FAST))
                products = [(weights[0], f) for f in pair]
                products += [(weight, f) for f in pair for weight in weights[1:]]
                totals = [
                    multiply_add(b, weight, f, total)
                    for (weight, f), total in zip(products, totals, strict=True)
                ]
            for k, total in enumerate(totals):
                at_row = b.add(row, I64(k)) if k < 2 else b.add(slopes, I64(k - 2))
                index = b.mul(at_row, I64(LANES))
                b.store(total, vector_pointer(b, result.data, index), align=4)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return lookup


def _scatterer(hashed: bool) -> Any:
    """Generate the addition of a gradient to the rows that a lookup reads."""
    pair = ir.VectorType(F32, 2)

    @intrinsic
    def scatter(typing_context, points, grad, table, level, resolution):
        def generate(context, b, signature, arguments):
            at, gradient, tables = arrays_of(context, b, signature, arguments, (0, 1, 2))
            cells = _Cells(b, at, tables, arguments[3], arguments[4], hashed)
            grads = [
                b.load(vector_pointer(b, gradient.data, I64(k * LANES)), align=4) for k in (0, 1)
            ]
            # Points may share a row, so the lanes add one after the other.
            rows = cgutils.alloca_once(b, INTS, size=8)
            sums = cgutils.alloca_once(b, FLOATS, size=16)
            for corner, (x, y, z) in enumerate(CORNERS):
                yz = b.fmul(cells.weight[1][y], cells.weight[2][z], flags=FAST)
                weight = b.fmul(yz, cells.weight[0][x], flags=FAST)
                first, second = (b.fmul(weight, g, flags=FAST) for g in grads)
                b.store(cells.row(b, x, y, z), b.gep(rows, [I64(corner)]))
                for half in (0, 1):
                    interleaved = [i // 2 + i % 2 * LANES + half * LANES // 2 for i in range(LANES)]
                    both = b.shuffle_vector(first, second, ir.Constant(INTS, interleaved))
                    b.store(both, b.gep(sums, [I64(2 * corner + half)]))
            rows, sums = b.bitcast(rows, I32.as_pointer()), b.bitcast(sums, pair.as_pointer())
            with cgutils.for_range(b, I64(8 * LANES), intp=I64) as loop:
                row = b.zext(b.load(b.gep(rows, [loop.index])), I64)
                entry = b.bitcast(b.gep(cells.rows, [b.shl(row, I64(1))]), pair.as_pointer())
                addend = b.load(b.gep(sums, [loop.index]))
                b.store(b.fadd(b.load(entry, align=4), addend), entry, align=4)
            return context.get_dummy_value()

        return types.void(points, grad, table, types.int64, types.int64), generate

    return scatter


def _prefetcher(hashed: bool) -> Any:
    """Generate the prefetch of the rows that a lookup will read."""

    @intrinsic
    def prefetch(typing_context, points, table, level, resolution):
        def generate(context, b, signature, arguments):
            at, tables = arrays_of(context, b, signature, arguments, (0, 1))
            cells = _Cells(b, at, tables, arguments[2], arguments[3], hashed)
            byte = ir.IntType(8).as_pointer()
            kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
            fetch = cgutils.get_or_insert_function(b.module, kind, "llvm.prefetch.p0i8")
            start = broadcast(b, b.ptrtoint(cells.rows, I64))
            for y, z in ((0, 0), (1, 0), (0, 1), (1, 1)):
                # The neighbour along x is adjacent, as a rule in the same cache line.
                row = b.zext(cells.row(b, 0, y, z), LONGS)
                address = b.add(start, b.shl(row, constant(LONGS, 3)))
                for lane in range(LANES):
                    pointer = b.inttoptr(b.extract_element(address, I32(lane)), byte)
                    b.call(fetch, [pointer, I32(0), I32(3), I32(1)])
            return context.get_dummy_value()

        return types.void(points, table, types.int64, types.int64), generate

    return prefetch


_prefetch_hashed, _prefetch_dense = _prefetcher(True), _prefetcher(False)
_hashed, _dense = _lookup(True, False), _lookup(False, False)
_hashed_sloped, _dense_sloped = _lookup(True, True), _lookup(False, True)
_scatter_hashed, _scatter_dense = _scatterer(True), _scatterer(False)


@njit(cache=True, fastmath=True, inline="always")
def look_up(points, table, level, resolution, out, row):
    """Write a level's features: unit-cube points [3, LANES], table [L, T, 2] → 2 rows of out."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _dense(points, table, level, resolution, out, row, 0)
    else:
        _hashed(points, table, level, resolution, out, row, 0)


@njit(cache=True, fastmath=True, inline="always")
def exceeds_cache(table, resolution):
    """Return whether a level is larger than a core's own cache, so that `prefetch` pays."""
    side = resolution + 1
    return min(side * side * side, table.shape[1]) > CACHED_ROWS


@njit(cache=True, fastmath=True, inline="always")
def prefetch(points, table, level, resolution):
    """Prefetch the rows of a level that `look_up` or `scatter` will use."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _prefetch_dense(points, table, level, resolution)
    else:
        _prefetch_hashed(points, table, level, resolution)


@njit(cache=True, fastmath=True, inline="always")
def look_up_slopes(points, table, level, resolution, out, row, slopes):
    """Write features and their slopes along x, y, z, first feature first → 2 + 6 rows of out."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _dense_sloped(points, table, level, resolution, out, row, slopes)
    else:
        _hashed_sloped(points, table, level, resolution, out, row, slopes)


@njit(cache=True, fastmath=True, inline="always")
def scatter(points, grad, table, level, resolution):
    """Add grad [2, LANES] of one level's features to the rows of table that they come from."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _scatter_dense(points, grad, table, level, resolution)
    else:
        _scatter_hashed(points, grad, table, level, resolution)


# --- products ------------------------------------------------------------------------------------


def _blocks(b: Any, count: Any, sizes: tuple[int, ...]) -> Any:
    """Loop over 0..count in steps of the first size, then over the remainder in the next ones."""
    start = I64(0)
    for size in sizes:
        whole = b.mul(b.udiv(b.sub(count, start), I64(size)), I64(size))
        stop = b.add(start, whole)
        with cgutils.for_range_slice(b, start, stop, I64(size), intp=I64) as (index, _):
            yield index, size
        start = stop


def sums_of(b: Any, vectors: list[Any]) -> Any:
    """Return the sums of 1, 2 or 4 vectors as a short vector.

    Halves of two vectors are added side by side, so that all sums take little more than one.
    """
    group, length = LANES, LANES  # lanes of one sum, and of the vector
    while len(vectors) > 1:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors, group = [_folded(b, pair, length, group) for pair in pairs], group // 2
    total = vectors[0]
    while group > 1:
        total, length, group = _folded(b, (total,), length, group), length // 2, group // 2
    return total


def _folded(b: Any, vectors: tuple, length: int, group: int) -> Any:
    """Add the second half of each group of lanes to the first, for one or two vectors."""
    first = [i for i in range(len(vectors) * length) if i % group < group // 2]
    kind = ir.VectorType(I32, len(first))
    halves = (
        b.shuffle_vector(vectors[0], vectors[-1], ir.Constant(kind, [i + shift for i in first]))
        for shift in (0, group // 2)
    )
    return b.fadd(*halves, flags=FAST)


def _add_product() -> Any:
    """Generate `add_product`: out [m, *] += weight [m, k] @ rows [k, *].

    For the first `vectors` vectors of LANES points; rows are at least as long.
    """

    @intrinsic
    def add_product(typing_context, weight, rows, out, vectors):
        def generate(context, b, signature, arguments):
            weight, rows, out = arrays_of(context, b, signature, arguments, (0, 1, 2))
            m, k = shape_of(b, weight)
            across, along = shape_of(b, rows)[1], shape_of(b, out)[1]
            for unit, units in _blocks(b, m, (UNITS, 1)):
                for vector, several in _blocks(b, arguments[3], (VECTORS, 1)):
                    block = [(u, v) for u in range(units) for v in range(several)]
                    offset = b.mul(vector, I64(LANES))
                    results, totals = {}, {}
                    for u, v in block:
                        start = b.add(b.mul(b.add(unit, I64(u)), along), offset)
                        results[u, v] = vector_pointer(b, out.data, b.add(start, I64(v * LANES)))
                        totals[u, v] = cgutils.alloca_once(b, FLOATS)
                        b.store(b.load(results[u, v], align=4), totals[u, v])
                    with cgutils.for_range(b, k, intp=I64) as loop:
                        start = b.add(b.mul(loop.index, across), offset)
                        values = [
                            b.load(
                                vector_pointer(b, rows.data, b.add(start, I64(v * LANES))), align=4
                            )
                            for v in range(several)
                        ]
                        for u in range(units):
                            at = b.add(b.mul(b.add(unit, I64(u)), k), loop.index)
                            w = broadcast(b, b.load(b.gep(weight.data, [at])))
                            for v in range(several):
                                total = b.load(totals[u, v])
                                b.store(multiply_add(b, w, values[v], total), totals[u, v])
                    for each in block:
                        b.store(b.load(totals[each]), results[each], align=4)
            return context.get_dummy_value()

        return types.void(weight, rows, out, types.int64), generate

    return add_product


def _add_outer() -> Any:
    """Generate `add_outer`: out [a, b] += left [a, *] @ right [b, *]ᵀ.

    Over the first `vectors` vectors of LANES points; rows are at least as long.
    """

    @intrinsic
    def add_outer(typing_context, left, right, out, vectors):
        def generate(context, b, signature, arguments):
            left, right, out = arrays_of(context, b, signature, arguments, (0, 1, 2))
            (m, across), (n, along) = shape_of(b, left), shape_of(b, right)
            width = shape_of(b, out)[1]
            for i, rows in _blocks(b, m, (UNITS, 3, 1)):
                for j, columns in _blocks(b, n, (UNITS, 1)):
                    block = [(r, c) for r in range(rows) for c in range(columns)]
                    totals = {}
                    for each in block:
                        totals[each] = cgutils.alloca_once(b, FLOATS)
                        b.store(constant(FLOATS, 0.0), totals[each])
                    with cgutils.for_range(b, arguments[3], intp=I64) as loop:
                        offset = b.mul(loop.index, I64(LANES))
                        left_rows, right_rows = (
                            [
                                b.load(
                                    vector_pointer(
                                        b, of.data, b.add(b.mul(b.add(at, I64(r)), long), offset)
                                    ),
                                    align=4,
                                )
                                for r in range(several)
                            ]
                            for of, at, long, several in (
                                (left, i, across, rows),
                                (right, j, along, columns),
                            )
                        )
                        for r, c in block:
                            total = b.load(totals[r, c])
                            b.store(
                                multiply_add(b, left_rows[r], right_rows[c], total), totals[r, c]
                            )
                    for r in range(rows):
                        at = b.add(b.mul(b.add(i, I64(r)), width), j)
                        sums = sums_of(b, [b.load(totals[r, c]) for c in range(columns)])
                        pointer = b.bitcast(b.gep(out.data, [at]), sums.type.as_pointer())
                        before = b.load(pointer, align=4)
                        b.store(b.fadd(before, sums, flags=FAST), pointer, align=4)
            return context.get_dummy_value()

        return types.void(left, right, out, types.int64), generate

    return add_outer


def _network() -> Any:
    """Generate `network` for LANES points: one hidden layer with ReLU, one output.

    features [inputs, LANES], w1 [hidden, inputs], b1 [hidden], w2 [1, hidden], b2 → out [1, LANES].
    The hidden layer stays in registers.
    """

    @intrinsic
    def network(typing_context, features, w1, b1, w2, b2, out):
        def generate(context, b, signature, arguments):
            arrays = arrays_of(context, b, signature, arguments, (0, 1, 2, 3, 5))
            hidden, inputs = shape_of(b, arrays[1])
            x, first, bias, second, out = (array.data for array in arrays)
            total = cgutils.alloca_once_value(b, broadcast(b, arguments[4]))

            def element(data: Any, index: Any) -> Any:
                return broadcast(b, b.load(b.gep(data, [index])))

            for unit, units in _blocks(b, hidden, (UNITS, 1)):
                indices = [b.add(unit, I64(u)) for u in range(units)]
                sums = [cgutils.alloca_once_value(b, element(bias, index)) for index in indices]
                with cgutils.for_range(b, inputs, intp=I64) as loop:
                    row = b.load(vector_pointer(b, x, b.mul(loop.index, I64(LANES))), align=4)
                    for hidden_sum, index in zip(sums, indices, strict=True):
                        w = element(first, b.add(b.mul(index, inputs), loop.index))
                        b.store(multiply_add(b, w, row, b.load(hidden_sum)), hidden_sum)
                for hidden_sum, index in zip(sums, indices, strict=True):
                    value, zero = b.load(hidden_sum), constant(FLOATS, 0.0)
                    active = b.select(b.fcmp_ordered(">", value, zero), value, zero)
                    b.store(multiply_add(b, element(second, index), active, b.load(total)), total)
            b.store(b.load(total), vector_pointer(b, out, I64(0)), align=4)
            return context.get_dummy_value()

        return types.void(features, w1, b1, w2, types.float32, out), generate

    return network


add_product, add_outer, network = _add_product(), _add_outer(), _network()


# --- rows that consecutive points share ----------------------------------------------------------


def _transposed(b: Any, rows: list[Any]) -> list[Any]:
    """Transpose LANES vectors: exchange one bit of row and column index after the other."""
    width = 1
    while width < LANES:
        first = [c if not c & width else LANES + (c ^ width) for c in range(LANES)]
        second = [c ^ width if not c & width else LANES + c for c in range(LANES)]
        result = list(rows)
        for low in (r for r in range(LANES) if not r & width):
            pair = rows[low], rows[low | width]
            result[low] = b.shuffle_vector(*pair, ir.Constant(INTS, first))
            result[low | width] = b.shuffle_vector(*pair, ir.Constant(INTS, second))
        rows, width = result, 2 * width
    return rows


def _add_shared(back: bool) -> Any:
    """Generate `add_shared`: points [unit.., point..] += rows [which [point..], unit..].

    For LANES units and points from `unit` and `point` on. `back`: add the points to the rows.
    """

    @intrinsic
    def add_shared(typing_context, points, rows, which, unit, point):
        def generate(context, b, signature, arguments):
            points, rows, which = arrays_of(context, b, signature, arguments, (0, 1, 2))
            unit, point = arguments[3:]
            width, along = shape_of(b, rows)[1], shape_of(b, points)[1]
            by_point, by_unit = [], []
            for k in range(LANES):
                row = b.load(b.gep(which.data, [b.add(point, I64(k))]))
                by_point.append(vector_pointer(b, rows.data, b.add(b.mul(row, width), unit)))
                index = b.add(b.mul(b.add(unit, I64(k)), along), point)
                by_unit.append(vector_pointer(b, points.data, index))
            sources, targets = (by_unit, by_point) if back else (by_point, by_unit)
            values = _transposed(b, [b.load(source, align=4) for source in sources])
            for target, value in zip(targets, values, strict=True):
                b.store(b.fadd(b.load(target, align=4), value, flags=FAST), target, align=4)
            return context.get_dummy_value()

        return types.void(points, rows, which, types.int64, types.int64), generate

    return add_shared


add_shared, add_to_shared = _add_shared(False), _add_shared(True)


# --- the optimiser -------------------------------------------------------------------------------


def _adam() -> Any:
    """Generate `adam`: its step for LANES entries of flat arrays, from `start` on.

    Entries without gradient stay as they are; where none has one, nothing else is read. rates:
    1 - beta and beta of the first moment, of the second; step length; factor on the second moment;
    epsilon. The gradient is cleared.
    """

    @intrinsic
    def adam(typing_context, parameter, gradient, first, second, start, rates):
        def generate(context, b, signature, arguments):
            flat = arrays_of(context, b, signature, arguments, (0, 1, 2, 3))
            at_p, at_g, at_m, at_v = (vector_pointer(b, each.data, arguments[4]) for each in flat)
            new1, old1, new2, old2, length, grow, epsilon = (
                broadcast(b, each) for each in cgutils.unpack_tuple(b, arguments[5])
            )
            zero = constant(FLOATS, 0.0)
            g = b.load(at_g, align=4)
            nonzero = b.fcmp_unordered("!=", g, zero)
            bits = ir.IntType(LANES)
            with b.if_then(b.icmp_unsigned("!=", b.bitcast(nonzero, bits), bits(0))):
                p, m, v = (b.load(at, align=4) for at in (at_p, at_m, at_v))
                mean = multiply_add(b, new1, g, b.fmul(old1, m))
                square = multiply_add(b, new2, b.fmul(g, g), b.fmul(old2, v))
                kind = ir.FunctionType(FLOATS, [FLOATS])
                root = cgutils.get_or_insert_function(b.module, kind, f"llvm.sqrt.v{LANES}f32")
                # Exact: approximate roots of a second moment of 0 are NaN.
                below = b.fadd(b.call(root, [b.fmul(square, grow)]), epsilon)
                step = b.fdiv(b.fmul(length, mean), below)
                b.store(b.select(nonzero, mean, m), at_m, align=4)
                b.store(b.select(nonzero, square, v), at_v, align=4)
                b.store(b.select(nonzero, b.fsub(p, step), p), at_p, align=4)
                b.store(zero, at_g, align=4)
            return context.get_dummy_value()

        return types.void(parameter, gradient, first, second, types.int64, rates), generate

    return adam


adam = _adam()
