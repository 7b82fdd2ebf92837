"""Hash lookups, matrix products and sums of metaballs, `LANES` at once, in vector registers.

Numba's compiler does not make vectors of loops that read a table at computed places, and makes
short ones of products. So these few steps are spelled out in LLVM's vector instructions, which it
translates for whatever processor it runs on (AVX-512, AVX2, Neon). Values of points lie in rows,
[what, points], and rows are whole vectors long. All arrays are float32, C-contiguous, as everywhere
in the kernels.

Numba keeps compiled kernels until their own file changes, and knows nothing of this one. So files
with kernels that use it carry its digest, which a test compares: a change here changes them.
"""

# Numba's stubs do not know what an intrinsic's generator is given.
# pyright: reportAttributeAccessIssue=false

from typing import Any

from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
PRIME_Y = 2654435761
PRIME_Z = 805459861
UNITS, VECTORS = 4, 2  # rows and vectors of a product that are held in registers

_F, _I, _L = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS, _LONGS = (ir.VectorType(kind, LANES) for kind in (_F, _I, _L))
_WHERE = ir.VectorType(ir.PointerType(), LANES)
_FAST = ("fast",)  # sums may be reordered and products fused, as in the other kernels


def _arrays(context: Any, b: Any, signature: Any, arguments: Any, which: tuple) -> list[Any]:
    return [context.make_array(signature.args[i])(context, b, arguments[i]) for i in which]


def _sides(b: Any, array: Any) -> list[Any]:
    return cgutils.unpack_tuple(b, array.shape)


def _all(b: Any, scalar: Any) -> Any:
    """A vector with the scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    nothing = ir.Constant(kind, ir.Undefined)
    first = b.insert_element(nothing, scalar, _I(0))
    return b.shuffle_vector(first, nothing, ir.Constant(_INTS, [0] * LANES))


def _same(kind: ir.VectorType, value: float) -> Any:
    return ir.Constant(kind, [value] * LANES)


def _at(b: Any, data: Any, place: Any) -> Any:
    """Address of the lanes that begin at a place of an array."""
    return b.bitcast(b.gep(data, [place]), _FLOATS.as_pointer())


def _multiply_add(b: Any, x: Any, y: Any, z: Any) -> Any:
    return b.fadd(b.fmul(x, y, flags=_FAST), z, flags=_FAST)


# --- lookups -------------------------------------------------------------------------------------


def _pairs(b: Any, table: Any, index: Any) -> tuple[Any, Any]:
    """Both features of some rows of a table [rows, 2]: read as one number of 64 bits each."""
    yes = ir.VectorType(ir.IntType(1), LANES)
    start = _all(b, b.ptrtoint(table, _L))
    places = b.inttoptr(b.add(start, b.shl(b.zext(index, _LONGS), _same(_LONGS, 3))), _WHERE)
    given = {_WHERE: places, yes: _same(yes, 1), _LONGS: ir.Constant(_LONGS, ir.Undefined)}
    if binding.llvm_version_info[0] < 22:  # there the alignment is an argument
        given = {_WHERE: places, _I: _I(4), **given}
    gather = cgutils.get_or_insert_function(
        b.module,
        ir.FunctionType(_LONGS, list(given)),
        f"llvm.masked.gather.v{LANES}i64.v{LANES}p0",
    )
    both = b.call(gather, list(given.values()))
    low, high = b.trunc(both, _INTS), b.trunc(b.lshr(both, _same(_LONGS, 32)), _INTS)
    return b.bitcast(low, _FLOATS), b.bitcast(high, _FLOATS)


class _Cells:
    """The lattice cells of one level in which points lie: code that computes them."""

    def __init__(self, b: Any, places: Any, table: Any, level: Any, resolution: Any, hashed: bool):
        size = _sides(b, table)[1]
        self.rows = b.gep(table.data, [b.mul(b.mul(level, size), _L(2))])
        side = b.add(b.trunc(resolution, _I), _I(1))
        self.scale = _all(b, b.sitofp(resolution, _F))
        low, inside = [], []
        for axis in range(3):
            p = b.load(_at(b, places.data, _L(axis * LANES)), align=4)
            p = b.fmul(p, self.scale, flags=_FAST)
            low.append(b.fptosi(p, _INTS))
            inside.append(b.fsub(p, b.sitofp(low[-1], _FLOATS), flags=_FAST))
        if hashed:
            strides = [_same(_INTS, 1), _same(_INTS, PRIME_Y), _same(_INTS, PRIME_Z)]
        else:
            strides = [_same(_INTS, 1), _all(b, side), _all(b, b.mul(side, side))]
        starts = [b.mul(p, stride) for p, stride in zip(low, strides, strict=True)]
        self.index = [(s, b.add(s, stride)) for s, stride in zip(starts, strides, strict=True)]
        self.weight = [(b.fsub(_same(_FLOATS, 1.0), f, flags=_FAST), f) for f in inside]
        self.last = _all(b, b.sub(b.trunc(size, _I), _I(1)))
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
            at, tables, result = _arrays(context, b, signature, arguments, (0, 1, 4))
            level, resolution, row, slopes = (arguments[i] for i in (2, 3, 5, 6))
            cells = _Cells(b, at, tables, level, resolution, hashed)
            # The slope of the weight along an axis: of the far corner's, and against it.
            change = b.fneg(cells.scale), cells.scale
            totals = [_same(_FLOATS, 0.0)] * (8 if sloped else 2)
            for x, y, z in CORNERS:
                pair = _pairs(b, cells.rows, cells.row(b, x, y, z))
                own = [cells.weight[0][x], cells.weight[1][y], cells.weight[2][z]]
                yz = b.fmul(own[1], own[2], flags=_FAST)
                shares = [b.fmul(yz, own[0], flags=_FAST)]
                if sloped:
                    xz = b.fmul(own[0], own[2], flags=_FAST)
                    xy = b.fmul(own[0], own[1], flags=_FAST)
                    for rest, far in ((yz, x), (xz, y), (xy, z)):
                        shares.append(b.fmul(rest, change[far], flags=_FAST))
                products = [(shares[0], f) for f in pair]
                products += [(share, f) for f in pair for share in shares[1:]]
                totals = [
                    _multiply_add(b, share, f, total)
                    for (share, f), total in zip(products, totals, strict=True)
                ]
            for k, total in enumerate(totals):
                at_row = b.add(row, _L(k)) if k < 2 else b.add(slopes, _L(k - 2))
                place = b.mul(at_row, _L(LANES))
                b.store(total, _at(b, result.data, place), align=4)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return lookup


def _spreading(hashed: bool) -> Any:
    """Generates what adds a gradient to the rows that a lookup has read."""
    pair = ir.VectorType(_F, 2)

    @intrinsic
    def spread(typing_context, places, grad, table, level, resolution):
        def generate(context, b, signature, arguments):
            at, given, tables = _arrays(context, b, signature, arguments, (0, 1, 2))
            cells = _Cells(b, at, tables, arguments[3], arguments[4], hashed)
            ours = [b.load(_at(b, given.data, _L(k * LANES)), align=4) for k in (0, 1)]
            # Lanes may share a row, so they add one after the other, from a list.
            rows = cgutils.alloca_once(b, _INTS, size=8)
            sums = cgutils.alloca_once(b, _FLOATS, size=16)
            for corner, (x, y, z) in enumerate(CORNERS):
                yz = b.fmul(cells.weight[1][y], cells.weight[2][z], flags=_FAST)
                share = b.fmul(yz, cells.weight[0][x], flags=_FAST)
                first, second = (b.fmul(share, g, flags=_FAST) for g in ours)
                b.store(cells.row(b, x, y, z), b.gep(rows, [_L(corner)]))
                for half in (0, 1):
                    mixed = [i // 2 + i % 2 * LANES + half * LANES // 2 for i in range(LANES)]
                    both = b.shuffle_vector(first, second, ir.Constant(_INTS, mixed))
                    b.store(both, b.gep(sums, [_L(2 * corner + half)]))
            rows, sums = b.bitcast(rows, _I.as_pointer()), b.bitcast(sums, pair.as_pointer())
            with cgutils.for_range(b, _L(8 * LANES), intp=_L) as loop:
                row = b.zext(b.load(b.gep(rows, [loop.index])), _L)
                place = b.bitcast(b.gep(cells.rows, [b.shl(row, _L(1))]), pair.as_pointer())
                own = b.load(b.gep(sums, [loop.index]))
                b.store(b.fadd(b.load(place, align=4), own), place, align=4)
            return context.get_dummy_value()

        return types.void(places, grad, table, types.int64, types.int64), generate

    return spread


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
    start = _L(0)
    for size in sizes:
        stop = b.mul(b.udiv(count, _L(size)), _L(size))
        with cgutils.for_range_slice(b, start, stop, _L(size), intp=_L) as (index, _):
            yield index, size
        start = stop


def _sums(b: Any, vectors: list[Any]) -> Any:
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
    kind = ir.VectorType(_I, len(first))
    halves = (
        b.shuffle_vector(vectors[0], vectors[-1], ir.Constant(kind, [i + shift for i in first]))
        for shift in (0, group // 2)
    )
    return b.fadd(*halves, flags=_FAST)


def _add_product() -> Any:
    """Generates `add_product`: out [m, *] += weight [m, k] @ rows [k, *].

    For the first `vectors` vectors of LANES points; rows are at least as long.
    """

    @intrinsic
    def add_product(typing_context, weight, rows, out, vectors):
        def generate(context, b, signature, arguments):
            weight, rows, out = _arrays(context, b, signature, arguments, (0, 1, 2))
            m, k = _sides(b, weight)
            across, along = _sides(b, rows)[1], _sides(b, out)[1]
            for unit, units in _blocks(b, m, (UNITS, 1)):
                for vector, several in _blocks(b, arguments[3], (VECTORS, 1)):
                    block = [(u, v) for u in range(units) for v in range(several)]
                    place = b.mul(vector, _L(LANES))
                    results, totals = {}, {}
                    for u, v in block:
                        start = b.add(b.mul(b.add(unit, _L(u)), along), place)
                        results[u, v] = _at(b, out.data, b.add(start, _L(v * LANES)))
                        totals[u, v] = cgutils.alloca_once(b, _FLOATS)
                        b.store(b.load(results[u, v], align=4), totals[u, v])
                    with cgutils.for_range(b, k, intp=_L) as loop:
                        start = b.add(b.mul(loop.index, across), place)
                        values = [
                            b.load(_at(b, rows.data, b.add(start, _L(v * LANES))), align=4)
                            for v in range(several)
                        ]
                        for u in range(units):
                            at = b.add(b.mul(b.add(unit, _L(u)), k), loop.index)
                            w = _all(b, b.load(b.gep(weight.data, [at])))
                            for v in range(several):
                                total = b.load(totals[u, v])
                                b.store(_multiply_add(b, w, values[v], total), totals[u, v])
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
            left, right, out = _arrays(context, b, signature, arguments, (0, 1, 2))
            (m, across), (n, along) = _sides(b, left), _sides(b, right)
            width = _sides(b, out)[1]
            for i, rows in _blocks(b, m, (UNITS, 1)):
                for j, columns in _blocks(b, n, (UNITS, 1)):
                    block = [(r, c) for r in range(rows) for c in range(columns)]
                    totals = {}
                    for each in block:
                        totals[each] = cgutils.alloca_once(b, _FLOATS)
                        b.store(_same(_FLOATS, 0.0), totals[each])
                    with cgutils.for_range(b, arguments[3], intp=_L) as loop:
                        place = b.mul(loop.index, _L(LANES))
                        ours, theirs = (
                            [
                                b.load(
                                    _at(b, of.data, b.add(b.mul(b.add(at, _L(r)), long), place)),
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
                            b.store(_multiply_add(b, ours[r], theirs[c], total), totals[r, c])
                    for r in range(rows):
                        at = b.add(b.mul(b.add(i, _L(r)), width), j)
                        own = [b.load(totals[r, c]) for c in range(columns)]
                        sums = _sums(b, own)
                        place = b.bitcast(b.gep(out.data, [at]), sums.type.as_pointer())
                        known = b.load(place, align=4)
                        b.store(b.fadd(known, sums, flags=_FAST), place, align=4)
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
            given = _arrays(context, b, signature, arguments, (0, 1, 2, 3, 5))
            hidden, inputs = _sides(b, given[1])
            x, first, bias, second, out = (each.data for each in given)
            total = cgutils.alloca_once_value(b, _all(b, arguments[4]))

            def number(data: Any, place: Any) -> Any:
                return _all(b, b.load(b.gep(data, [place])))

            for unit, units in _blocks(b, hidden, (UNITS, 1)):
                places = [b.add(unit, _L(u)) for u in range(units)]
                sums = [cgutils.alloca_once_value(b, number(bias, place)) for place in places]
                with cgutils.for_range(b, inputs, intp=_L) as loop:
                    row = b.load(_at(b, x, b.mul(loop.index, _L(LANES))), align=4)
                    for own, place in zip(sums, places, strict=True):
                        w = number(first, b.add(b.mul(place, inputs), loop.index))
                        b.store(_multiply_add(b, w, row, b.load(own)), own)
                for own, place in zip(sums, places, strict=True):
                    value, zero = b.load(own), _same(_FLOATS, 0.0)
                    lit = b.select(b.fcmp_ordered(">", value, zero), value, zero)
                    b.store(_multiply_add(b, number(second, place), lit, b.load(total)), total)
            b.store(b.load(total), _at(b, out, _L(0)), align=4)
            return context.get_dummy_value()

        return types.void(features, w1, b1, w2, types.float32, out), generate

    return network


add_product, add_outer, network = _add_product(), _add_outer(), _network()


# --- metaballs: the lanes are 4 x 4 vertices about a point in y and z, for one plane of x at a time

_NEAR = [
    [float(lane // 4 - 1) for lane in range(LANES)],
    [float(lane % 4 - 1) for lane in range(LANES)],
]


def _squares(b: Any, u: list[Any], reach: float) -> tuple[list[Any], Any]:
    """Distances of the vertices in y and z, and reach squared less their squares."""
    beside = [
        b.fsub(_all(b, own), ir.Constant(_FLOATS, near), flags=_FAST)
        for own, near in zip(u[1:], _NEAR, strict=True)
    ]
    rest = _same(_FLOATS, reach * reach)
    for d in beside:
        rest = b.fsub(rest, b.fmul(d, d, flags=_FAST), flags=_FAST)
    return beside, rest


def _planes(b: Any, u: list[Any], rest: Any) -> Any:
    """For each of the planes in x: its number, distance, and how far within reach vertices are."""
    for plane in range(4):
        d = _all(b, b.fsub(u[0], ir.Constant(_F, plane - 1.0), flags=_FAST))
        q = b.fsub(rest, b.fmul(d, d, flags=_FAST), flags=_FAST)
        zero = _same(_FLOATS, 0.0)
        yield plane, d, b.select(b.fcmp_ordered(">", q, zero), q, zero)


def _vertices(b: Any, array: Any, place: list[Any], plane: int) -> Any:
    """Values at a plane's vertices: [brick, x, y, z] of whole numbers, in floats."""
    sides = _sides(b, array)
    kind = array.data.type.pointee
    run = ir.IntType(4 * kind.width)
    rows = ir.Constant(ir.VectorType(run, 4), ir.Undefined)
    brick, i, j, m = place
    for row in range(4):
        at = b.add(b.mul(brick, sides[1]), b.add(i, _L(plane)))
        at = b.add(b.mul(at, sides[2]), b.add(j, _L(row)))
        at = b.add(b.mul(at, sides[3]), m)
        four = b.load(b.bitcast(b.gep(array.data, [at]), run.as_pointer()), align=1)
        rows = b.insert_element(rows, four, _I(row))
    values = b.bitcast(rows, ir.VectorType(kind, LANES))
    wide = b.zext if kind.width == 8 else b.sext  # bytes have no sign here, longer ones have
    return b.sitofp(wide(values, _INTS), _FLOATS)


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
            (fills,) = _arrays(context, b, signature, arguments, (0,))
            place, u = _given(b, arguments, 1)
            (dy, dz), rest = _squares(b, u, reach)
            names = ("k", "kf", "x", "xf", "all", "allf")
            sums = dict.fromkeys(names, _same(_FLOATS, 0.0))
            for plane, dx, q in _planes(b, u, rest):
                f = _vertices(b, fills, place, plane)
                slope = b.fmul(q, q, flags=_FAST)
                slope_f = b.fmul(slope, f, flags=_FAST)
                terms = ((slope, q), (slope_f, q), (slope, dx), (slope_f, dx))
                for name, (one, other) in zip(names, terms, strict=False):
                    sums[name] = _multiply_add(b, one, other, sums[name])
                sums["all"] = b.fadd(sums["all"], slope, flags=_FAST)
                sums["allf"] = b.fadd(sums["allf"], slope_f, flags=_FAST)
            yz = [b.fmul(sums[kind], d, flags=_FAST) for kind in ("all", "allf") for d in (dy, dz)]
            k, kf, x, xf = (sums[name] for name in names[:4])
            halves = _sums(b, [k, kf, x, yz[0]]), _sums(b, [yz[1], xf, yz[2], yz[3]])
            own = [b.extract_element(half, _I(n)) for half in halves for n in range(4)]
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
            arrays = _arrays(context, b, signature, arguments, (0, 1, 2))
            place, u = _given(b, arguments, 3)
            (_, dz), rest = _squares(b, u, reach)
            total, high, lit = (_same(_FLOATS, 0.0) for _ in range(3))
            for plane, _, q in _planes(b, u, rest):
                f, over, bright = (_vertices(b, array, place, plane) for array in arrays)
                cube = b.fmul(b.fmul(q, q, flags=_FAST), q, flags=_FAST)
                weight = b.fmul(cube, f, flags=_FAST)
                total = b.fadd(total, weight, flags=_FAST)
                high = _multiply_add(b, weight, over, high)
                lit = _multiply_add(b, weight, bright, lit)
            four = _sums(b, [total, high, b.fmul(total, dz, flags=_FAST), lit])
            own = [b.extract_element(four, _I(n)) for n in range(4)]
            return context.make_tuple(b, signature.return_type, own)

        return result(fill, height, shade, *WHERE), generate

    return ball_means


BALL_REACH = 2.0  # of a metaball's kernel, lattice spacings
ball_sums, ball_means = _ball_sums(BALL_REACH), _ball_means(BALL_REACH)
