"""Hash lookups, matrix products and the optimiser's steps, `LANES` at once, in vector registers.

Numba's compiler does not make vectors of loops that read a table at computed places, and makes
short ones of products. So these few steps are spelled out in LLVM's vector instructions, which it
translates for whatever processor it runs on (AVX-512, AVX2, Neon). Values of points lie in rows,
[what, points], and rows are whole vectors long. All arrays are C-contiguous, and float32 but for
indices, as everywhere in the kernels.

Numba keeps compiled kernels until their own file changes, and knows nothing of this one. So files
with kernels that use it carry its digest, which a test compares: a change here changes them.
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
NEAR_ROWS = 2**17  # of a level, 1 MB: what a core's own cache holds as a rule
UNITS, VECTORS = 4, 2  # rows and vectors of a product that are held in registers

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS, LONGS = (ir.VectorType(kind, LANES) for kind in (F32, I32, I64))
FAST = ("fast",)  # sums may be reordered and products fused, as in the other kernels


def arrays_of(context: Any, b: Any, signature: Any, arguments: Any, which: tuple) -> list[Any]:
    """The arrays among an intrinsic's arguments: their data, shapes and strides."""
    return [context.make_array(signature.args[i])(context, b, arguments[i]) for i in which]


def sides_of(b: Any, array: Any) -> list[Any]:
    """An array's shape."""
    return cgutils.unpack_tuple(b, array.shape)


def everywhere(b: Any, scalar: Any) -> Any:
    """A vector with the scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    nothing = ir.Constant(kind, ir.Undefined)
    first = b.insert_element(nothing, scalar, I32(0))
    return b.shuffle_vector(first, nothing, ir.Constant(INTS, [0] * LANES))


def constant(kind: ir.VectorType, value: float) -> Any:
    """A vector of one number."""
    return ir.Constant(kind, [value] * LANES)


def lanes_at(b: Any, data: Any, place: Any) -> Any:
    """Address of the lanes that begin at a place of an array."""
    return b.bitcast(b.gep(data, [place]), FLOATS.as_pointer())


def multiply_add(b: Any, x: Any, y: Any, z: Any) -> Any:
    """X times y, plus z."""
    return b.fadd(b.fmul(x, y, flags=FAST), z, flags=FAST)


# --- lookups -------------------------------------------------------------------------------------


def _pairs(b: Any, table: Any, index: Any) -> tuple[Any, Any]:
    """Both features of some rows of a table [rows, 2]: read as one number of 64 bits each.

    One after the other: a processor's own gathering of them took up to a quarter longer.
    """
    start = everywhere(b, b.ptrtoint(table, I64))
    places = b.add(start, b.shl(b.zext(index, LONGS), constant(LONGS, 3)))
    both = ir.Constant(LONGS, ir.Undefined)
    for lane in range(LANES):
        place = b.inttoptr(b.extract_element(places, I32(lane)), I64.as_pointer())
        both = b.insert_element(both, b.load(place, align=4), I32(lane))
    low, high = b.trunc(both, INTS), b.trunc(b.lshr(both, constant(LONGS, 32)), INTS)
    return b.bitcast(low, FLOATS), b.bitcast(high, FLOATS)


class _Cells:
    """The lattice cells of one level in which points lie: code that computes them."""

    def __init__(self, b: Any, places: Any, table: Any, level: Any, resolution: Any, hashed: bool):
        size = sides_of(b, table)[1]
        self.rows = b.gep(table.data, [b.mul(b.mul(level, size), I64(2))])
        side = b.add(b.trunc(resolution, I32), I32(1))
        self.scale = everywhere(b, b.sitofp(resolution, F32))
        low, inside = [], []
        for axis in range(3):
            p = b.load(lanes_at(b, places.data, I64(axis * LANES)), align=4)
            p = b.fmul(p, self.scale, flags=FAST)
            low.append(b.fptosi(p, INTS))
            inside.append(b.fsub(p, b.sitofp(low[-1], FLOATS), flags=FAST))
        if hashed:
            strides = [constant(INTS, 1), constant(INTS, PRIME_Y), constant(INTS, PRIME_Z)]
        else:
            strides = [constant(INTS, 1), everywhere(b, side), everywhere(b, b.mul(side, side))]
        starts = [b.mul(p, stride) for p, stride in zip(low, strides, strict=True)]
        self.index = [(s, b.add(s, stride)) for s, stride in zip(starts, strides, strict=True)]
        self.weight = [(b.fsub(constant(FLOATS, 1.0), f, flags=FAST), f) for f in inside]
        self.last = everywhere(b, b.sub(b.trunc(size, I32), I32(1)))
        self.combine = b.xor if hashed else b.add
        self.hashed = hashed

    def row(self, b: Any, x: int, y: int, z: int) -> Any:
        """The table's row of the corner on the far (1) or near (0) side along each axis."""
        row = self.combine(self.combine(self.index[1][y], self.index[2][z]), self.index[0][x])
        if self.hashed:
            return b.and_(row, self.last)
        # A place that is no number must not lead out of the table.
        return b.select(b.icmp_unsigned("<", row, self.last), row, self.last)


CORNERS = [(corner & 1, corner >> 1 & 1, corner >> 2) for corner in range(8)]


def _lookup(hashed: bool, sloped: bool) -> Any:
    """Generates the trilinear lookup of a level that is hashed, or fits its table.

    With `sloped` the first feature's slopes along x, y and z and then the second's go to rows from
    `slopes` on.
    """

    @intrinsic
    def lookup(typing_context, places, table, level, resolution, out, row, slopes):
        kinds = (places, table, types.int64, types.int64, out, types.int64, types.int64)

        def generate(context, b, signature, arguments):
            at, tables, result = arrays_of(context, b, signature, arguments, (0, 1, 4))
            level, resolution, row, slopes = (arguments[i] for i in (2, 3, 5, 6))
            cells = _Cells(b, at, tables, level, resolution, hashed)
            # The slope of the weight along an axis: of the far corner's, and against it.
            change = b.fneg(cells.scale), cells.scale
            totals = [constant(FLOATS, 0.0)] * (8 if sloped else 2)
            for x, y, z in CORNERS:
                pair = _pairs(b, cells.rows, cells.row(b, x, y, z))
                own = [cells.weight[0][x], cells.weight[1][y], cells.weight[2][z]]
                yz = b.fmul(own[1], own[2], flags=FAST)
                shares = [b.fmul(yz, own[0], flags=FAST)]
                if sloped:
                    xz = b.fmul(own[0], own[2], flags=FAST)
                    xy = b.fmul(own[0], own[1], flags=FAST)
                    for rest, far in ((yz, x), (xz, y), (xy, z)):
                        shares.append(b.fmul(rest, change[far], flags=FAST))
                products = [(shares[0], f) for f in pair]
                products += [(share, f) for f in pair for share in shares[1:]]
                totals = [
                    multiply_add(b, share, f, total)
                    for (share, f), total in zip(products, totals, strict=True)
                ]
            for k, total in enumerate(totals):
                at_row = b.add(row, I64(k)) if k < 2 else b.add(slopes, I64(k - 2))
                place = b.mul(at_row, I64(LANES))
                b.store(total, lanes_at(b, result.data, place), align=4)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return lookup


def _spreading(hashed: bool) -> Any:
    """Generates what adds a gradient to the rows that a lookup has read."""
    pair = ir.VectorType(F32, 2)

    @intrinsic
    def spread(typing_context, places, grad, table, level, resolution):
        def generate(context, b, signature, arguments):
            at, given, tables = arrays_of(context, b, signature, arguments, (0, 1, 2))
            cells = _Cells(b, at, tables, arguments[3], arguments[4], hashed)
            ours = [b.load(lanes_at(b, given.data, I64(k * LANES)), align=4) for k in (0, 1)]
            # Lanes may share a row, so they add one after the other, from a list.
            rows = cgutils.alloca_once(b, INTS, size=8)
            sums = cgutils.alloca_once(b, FLOATS, size=16)
            for corner, (x, y, z) in enumerate(CORNERS):
                yz = b.fmul(cells.weight[1][y], cells.weight[2][z], flags=FAST)
                share = b.fmul(yz, cells.weight[0][x], flags=FAST)
                first, second = (b.fmul(share, g, flags=FAST) for g in ours)
                b.store(cells.row(b, x, y, z), b.gep(rows, [I64(corner)]))
                for half in (0, 1):
                    mixed = [i // 2 + i % 2 * LANES + half * LANES // 2 for i in range(LANES)]
                    both = b.shuffle_vector(first, second, ir.Constant(INTS, mixed))
                    b.store(both, b.gep(sums, [I64(2 * corner + half)]))
            rows, sums = b.bitcast(rows, I32.as_pointer()), b.bitcast(sums, pair.as_pointer())
            with cgutils.for_range(b, I64(8 * LANES), intp=I64) as loop:
                row = b.zext(b.load(b.gep(rows, [loop.index])), I64)
                place = b.bitcast(b.gep(cells.rows, [b.shl(row, I64(1))]), pair.as_pointer())
                own = b.load(b.gep(sums, [loop.index]))
                b.store(b.fadd(b.load(place, align=4), own), place, align=4)
            return context.get_dummy_value()

        return types.void(places, grad, table, types.int64, types.int64), generate

    return spread


def _touching(hashed: bool) -> Any:
    """Generates what asks for the rows that a lookup will read, without waiting for them."""

    @intrinsic
    def touch(typing_context, places, table, level, resolution):
        def generate(context, b, signature, arguments):
            at, tables = arrays_of(context, b, signature, arguments, (0, 1))
            cells = _Cells(b, at, tables, arguments[2], arguments[3], hashed)
            byte = ir.IntType(8).as_pointer()
            kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
            fetch = cgutils.get_or_insert_function(b.module, kind, "llvm.prefetch.p0i8")
            start = everywhere(b, b.ptrtoint(cells.rows, I64))
            for y, z in ((0, 0), (1, 0), (0, 1), (1, 1)):
                # Its neighbour along x is next to it, as a rule in the same line of the caches.
                row = b.zext(cells.row(b, 0, y, z), LONGS)
                address = b.add(start, b.shl(row, constant(LONGS, 3)))
                for lane in range(LANES):
                    place = b.inttoptr(b.extract_element(address, I32(lane)), byte)
                    b.call(fetch, [place, I32(0), I32(3), I32(1)])
            return context.get_dummy_value()

        return types.void(places, table, types.int64, types.int64), generate

    return touch


_touch_hashed, _touch_dense = _touching(True), _touching(False)
_hashed, _dense = _lookup(True, False), _lookup(False, False)
_hashed_sloped, _dense_sloped = _lookup(True, True), _lookup(False, True)
_spread_hashed, _spread_dense = _spreading(True), _spreading(False)


@njit(cache=True, fastmath=True, inline="always")
def look_up(places, table, level, resolution, out, row):
    """One level's features: places [3, LANES] in the unit cube, table [L, T, 2] → 2 rows of out."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _dense(places, table, level, resolution, out, row, 0)
    else:
        _hashed(places, table, level, resolution, out, row, 0)


@njit(cache=True, fastmath=True, inline="always")
def is_far(table, resolution):
    """Whether a core's own cache holds but part of a level, so that it pays to `touch` it."""
    side = resolution + 1
    return min(side * side * side, table.shape[1]) > NEAR_ROWS


@njit(cache=True, fastmath=True, inline="always")
def touch(places, table, level, resolution):
    """Asks for the rows that `look_up` or `spread` will want of a level."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _touch_dense(places, table, level, resolution)
    else:
        _touch_hashed(places, table, level, resolution)


@njit(cache=True, fastmath=True, inline="always")
def look_up_slopes(places, table, level, resolution, out, row, slopes):
    """The same; slopes along x, y, z of the first feature, then of the second → 6 rows of out."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _dense_sloped(places, table, level, resolution, out, row, slopes)
    else:
        _hashed_sloped(places, table, level, resolution, out, row, slopes)


@njit(cache=True, fastmath=True, inline="always")
def spread(places, grad, table, level, resolution):
    """Adds grad [2, LANES] of one level's features to the rows of table that they come from."""
    side = resolution + 1
    if side * side * side <= table.shape[1]:
        _spread_dense(places, grad, table, level, resolution)
    else:
        _spread_hashed(places, grad, table, level, resolution)


# --- products ------------------------------------------------------------------------------------


def _blocks(b: Any, count: Any, sizes: tuple[int, ...]) -> Any:
    """Loops that go through 0..count in steps of the first size, then of the next, for the rest."""
    start = I64(0)
    for size in sizes:
        whole = b.mul(b.udiv(b.sub(count, start), I64(size)), I64(size))
        stop = b.add(start, whole)
        with cgutils.for_range_slice(b, start, stop, I64(size), intp=I64) as (index, _):
            yield index, size
        start = stop


def sums_of(b: Any, vectors: list[Any]) -> Any:
    """The sum of each of some vectors, 1, 2 or 4, as a short vector.

    Halves of two vectors are added side by side, so that all sums take little more than one.
    """
    group, length = LANES, LANES  # lanes that belong to one sum, and in all
    while len(vectors) > 1:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors, group = [_folded(b, pair, length, group) for pair in pairs], group // 2
    own = vectors[0]
    while group > 1:
        own, length, group = _folded(b, (own,), length, group), length // 2, group // 2
    return own


def _folded(b: Any, vectors: tuple, length: int, group: int) -> Any:
    """The first halves of all groups of lanes plus the second, of one or two vectors in a row."""
    first = [i for i in range(len(vectors) * length) if i % group < group // 2]
    kind = ir.VectorType(I32, len(first))
    halves = (
        b.shuffle_vector(vectors[0], vectors[-1], ir.Constant(kind, [i + shift for i in first]))
        for shift in (0, group // 2)
    )
    return b.fadd(*halves, flags=FAST)


def _add_product() -> Any:
    """Generates `add_product`: out [m, *] += weight [m, k] @ rows [k, *].

    For the first `vectors` vectors of LANES points; rows are at least as long.
    """

    @intrinsic
    def add_product(typing_context, weight, rows, out, vectors):
        def generate(context, b, signature, arguments):
            weight, rows, out = arrays_of(context, b, signature, arguments, (0, 1, 2))
            m, k = sides_of(b, weight)
            across, along = sides_of(b, rows)[1], sides_of(b, out)[1]
            for unit, units in _blocks(b, m, (UNITS, 1)):
                for vector, several in _blocks(b, arguments[3], (VECTORS, 1)):
                    block = [(u, v) for u in range(units) for v in range(several)]
                    place = b.mul(vector, I64(LANES))
                    results, totals = {}, {}
                    for u, v in block:
                        start = b.add(b.mul(b.add(unit, I64(u)), along), place)
                        results[u, v] = lanes_at(b, out.data, b.add(start, I64(v * LANES)))
                        totals[u, v] = cgutils.alloca_once(b, FLOATS)
                        b.store(b.load(results[u, v], align=4), totals[u, v])
                    with cgutils.for_range(b, k, intp=I64) as loop:
                        start = b.add(b.mul(loop.index, across), place)
                        values = [
                            b.load(lanes_at(b, rows.data, b.add(start, I64(v * LANES))), align=4)
                            for v in range(several)
                        ]
                        for u in range(units):
                            at = b.add(b.mul(b.add(unit, I64(u)), k), loop.index)
                            w = everywhere(b, b.load(b.gep(weight.data, [at])))
                            for v in range(several):
                                total = b.load(totals[u, v])
                                b.store(multiply_add(b, w, values[v], total), totals[u, v])
                    for each in block:
                        b.store(b.load(totals[each]), results[each], align=4)
            return context.get_dummy_value()

        return types.void(weight, rows, out, types.int64), generate

    return add_product


def _add_outer() -> Any:
    """Generates `add_outer`: out [a, b] += left [a, *] @ right [b, *]ᵀ.

    Over the first `vectors` vectors of LANES points; rows are at least as long.
    """

    @intrinsic
    def add_outer(typing_context, left, right, out, vectors):
        def generate(context, b, signature, arguments):
            left, right, out = arrays_of(context, b, signature, arguments, (0, 1, 2))
            (m, across), (n, along) = sides_of(b, left), sides_of(b, right)
            width = sides_of(b, out)[1]
            for i, rows in _blocks(b, m, (UNITS, 3, 1)):
                for j, columns in _blocks(b, n, (UNITS, 1)):
                    block = [(r, c) for r in range(rows) for c in range(columns)]
                    totals = {}
                    for each in block:
                        totals[each] = cgutils.alloca_once(b, FLOATS)
                        b.store(constant(FLOATS, 0.0), totals[each])
                    with cgutils.for_range(b, arguments[3], intp=I64) as loop:
                        place = b.mul(loop.index, I64(LANES))
                        ours, theirs = (
                            [
                                b.load(
                                    lanes_at(
                                        b, of.data, b.add(b.mul(b.add(at, I64(r)), long), place)
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
                            b.store(multiply_add(b, ours[r], theirs[c], total), totals[r, c])
                    for r in range(rows):
                        at = b.add(b.mul(b.add(i, I64(r)), width), j)
                        own = [b.load(totals[r, c]) for c in range(columns)]
                        sums = sums_of(b, own)
                        place = b.bitcast(b.gep(out.data, [at]), sums.type.as_pointer())
                        known = b.load(place, align=4)
                        b.store(b.fadd(known, sums, flags=FAST), place, align=4)
            return context.get_dummy_value()

        return types.void(left, right, out, types.int64), generate

    return add_outer


def _network() -> Any:
    """Generates `network`, the density's, for LANES points: one hidden layer with ReLU, one output.

    features [inputs, LANES], w1 [hidden, inputs], b1 [hidden], w2 [1, hidden], b2 → out [1, LANES].
    The hidden layer never leaves the registers.
    """

    @intrinsic
    def network(typing_context, features, w1, b1, w2, b2, out):
        def generate(context, b, signature, arguments):
            given = arrays_of(context, b, signature, arguments, (0, 1, 2, 3, 5))
            hidden, inputs = sides_of(b, given[1])
            x, first, bias, second, out = (each.data for each in given)
            total = cgutils.alloca_once_value(b, everywhere(b, arguments[4]))

            def number(data: Any, place: Any) -> Any:
                return everywhere(b, b.load(b.gep(data, [place])))

            for unit, units in _blocks(b, hidden, (UNITS, 1)):
                places = [b.add(unit, I64(u)) for u in range(units)]
                sums = [cgutils.alloca_once_value(b, number(bias, place)) for place in places]
                with cgutils.for_range(b, inputs, intp=I64) as loop:
                    row = b.load(lanes_at(b, x, b.mul(loop.index, I64(LANES))), align=4)
                    for own, place in zip(sums, places, strict=True):
                        w = number(first, b.add(b.mul(place, inputs), loop.index))
                        b.store(multiply_add(b, w, row, b.load(own)), own)
                for own, place in zip(sums, places, strict=True):
                    value, zero = b.load(own), constant(FLOATS, 0.0)
                    lit = b.select(b.fcmp_ordered(">", value, zero), value, zero)
                    b.store(multiply_add(b, number(second, place), lit, b.load(total)), total)
            b.store(b.load(total), lanes_at(b, out, I64(0)), align=4)
            return context.get_dummy_value()

        return types.void(features, w1, b1, w2, types.float32, out), generate

    return network


add_product, add_outer, network = _add_product(), _add_outer(), _network()


# --- rows that runs of points share --------------------------------------------------------------


def _turned(b: Any, rows: list[Any]) -> list[Any]:
    """LANES vectors with rows and columns exchanged, a bit of their numbers at a time."""
    width = 1
    while width < LANES:
        first = [c if not c & width else LANES + (c ^ width) for c in range(LANES)]
        second = [c ^ width if not c & width else LANES + c for c in range(LANES)]
        turned = list(rows)
        for low in (r for r in range(LANES) if not r & width):
            pair = rows[low], rows[low | width]
            turned[low] = b.shuffle_vector(*pair, ir.Constant(INTS, first))
            turned[low | width] = b.shuffle_vector(*pair, ir.Constant(INTS, second))
        rows, width = turned, 2 * width
    return rows


def _add_shared(back: bool) -> Any:
    """Generates `add_shared`: points [unit.., point..] += rows [which [point..], unit..].

    For LANES units and points from `unit` and `point` on. `back`: the rows get the points' instead.
    """

    @intrinsic
    def add_shared(typing_context, points, rows, which, unit, point):
        def generate(context, b, signature, arguments):
            points, rows, which = arrays_of(context, b, signature, arguments, (0, 1, 2))
            unit, point = arguments[3:]
            width, along = sides_of(b, rows)[1], sides_of(b, points)[1]
            by_point, by_unit = [], []
            for k in range(LANES):
                row = b.load(b.gep(which.data, [b.add(point, I64(k))]))
                by_point.append(lanes_at(b, rows.data, b.add(b.mul(row, width), unit)))
                place = b.add(b.mul(b.add(unit, I64(k)), along), point)
                by_unit.append(lanes_at(b, points.data, place))
            given, taking = (by_unit, by_point) if back else (by_point, by_unit)
            values = _turned(b, [b.load(place, align=4) for place in given])
            for place, value in zip(taking, values, strict=True):
                b.store(b.fadd(b.load(place, align=4), value, flags=FAST), place, align=4)
            return context.get_dummy_value()

        return types.void(points, rows, which, types.int64, types.int64), generate

    return add_shared


add_shared, add_to_shared = _add_shared(False), _add_shared(True)


# --- the optimiser -------------------------------------------------------------------------------


def _adam() -> Any:
    """Generates `adam`: its step for LANES entries from `place` on of flat arrays.

    Entries without gradient keep what they had, and where all are nothing more is read. rates:
    (1 - share kept) and share kept of the first moment, of the second; step length; factor on the
    second moment; epsilon. The gradient is cleared.
    """

    @intrinsic
    def adam(typing_context, parameter, gradient, first, second, place, rates):
        def generate(context, b, signature, arguments):
            flat = arrays_of(context, b, signature, arguments, (0, 1, 2, 3))
            at_p, at_g, at_m, at_v = (lanes_at(b, each.data, arguments[4]) for each in flat)
            new1, old1, new2, old2, length, grow, epsilon = (
                everywhere(b, each) for each in cgutils.unpack_tuple(b, arguments[5])
            )
            nothing = constant(FLOATS, 0.0)
            g = b.load(at_g, align=4)
            given = b.fcmp_unordered("!=", g, nothing)
            bits = ir.IntType(LANES)
            with b.if_then(b.icmp_unsigned("!=", b.bitcast(given, bits), bits(0))):
                p, m, v = (b.load(at, align=4) for at in (at_p, at_m, at_v))
                mean = multiply_add(b, new1, g, b.fmul(old1, m))
                square = multiply_add(b, new2, b.fmul(g, g), b.fmul(old2, v))
                kind = ir.FunctionType(FLOATS, [FLOATS])
                root = cgutils.get_or_insert_function(b.module, kind, f"llvm.sqrt.v{LANES}f32")
                # Exact: quick roots of a square that has vanished are no numbers.
                below = b.fadd(b.call(root, [b.fmul(square, grow)]), epsilon)
                step = b.fdiv(b.fmul(length, mean), below)
                b.store(b.select(given, mean, m), at_m, align=4)
                b.store(b.select(given, square, v), at_v, align=4)
                b.store(b.select(given, b.fsub(p, step), p), at_p, align=4)
                b.store(nothing, at_g, align=4)
            return context.get_dummy_value()

        return types.void(parameter, gradient, first, second, types.int64, rates), generate

    return adam


adam = _adam()
