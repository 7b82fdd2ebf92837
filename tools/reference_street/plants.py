"""Trees, hedges, shrubs and the distant tree line."""

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh, blob, cylinder, hexahedron, leaves, merge
from tools.reference_street.terrain import ground_height


def _on_sphere(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def _coat(solid: Mesh, count: int, size: tuple[float, float], rng: np.random.Generator) -> Mesh:
    """Return `count` leaves spread evenly over a closed surface, brighter towards its top."""
    corners = solid.vertices[solid.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=count)
    centres = np.einsum("nk,nkd->nd", weights, corners[face])
    outward = centres - solid.vertices.mean(0)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    centres += outward * rng.uniform(-0.3, 0.5, size=(count, 1)) * size[1]
    shade = 0.42 + 0.3 * outward[:, 2] + 0.22 * rng.normal(size=count)
    return leaves(centres, outward + [0, 0, 0.3], size, rng, shade)


def tree(
    name: str,
    at: tuple[float, float],
    trunk: tuple[float, float],
    crown: tuple[float, float],
    leaf_count: int,
    leaf_texture: str,
    seed: int,
) -> list[Mesh]:
    """Return a broad-leaved tree: trunk, branches, clumps of leaves around dark cores.

    Args:
        name: prefix of the mesh names.
        at: world x, y of the foot, metres.
        trunk: height to the first fork and radius at the foot, metres.
        crown: horizontal and vertical radius of the crown, metres.
        leaf_count: total number of leaves.
        leaf_texture: palette of the leaves.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    x, y = at
    z = float(ground_height(x, y))
    fork, radius = trunk
    wide, tall = crown
    foot = np.array([x, y, z])
    bend = np.array([0.10, -0.06, 0.0])
    middle, top = foot + [0, 0, 0.5 * fork] + bend, foot + [0, 0, fork]
    wood = [
        cylinder(foot - [0, 0, 0.3], foot + [0, 0, 0.25], 1.7 * radius, 1.1 * radius, 14, False),
        cylinder(foot + [0, 0, 0.25], middle, 1.1 * radius, 0.95 * radius, 14, False),
        cylinder(middle, top, 0.95 * radius, 0.8 * radius, 14, False),
    ]
    centre = top + [0, 0, 0.62 * tall]
    clumps = []
    azimuth = rng.uniform(0, 2 * np.pi)
    rings = ((-0.42, 0.62, 6), (0.0, 0.66, 7), (0.45, 0.48, 5), (0.75, 0.0, 1), (0.1, 0.0, 1))
    for height, radial, number in rings:
        for k in range(number):
            a = azimuth + 2 * np.pi * (k + 0.3 * rng.uniform(-1, 1)) / number
            r = radial * wide * rng.uniform(0.85, 1.1)
            lift = height * tall + 0.1 * tall * rng.uniform(-1, 1)
            clumps.append(centre + [r * np.cos(a), r * np.sin(a), lift])
        azimuth += 1.1
    clumps = np.array(clumps)
    for clump in clumps:
        knee = top + 0.45 * (clump - top) + [0, 0, 0.12 * tall]
        wood.append(cylinder(top, knee, 0.36 * radius, 0.22 * radius, 8, False))
        wood.append(cylinder(knee, clump, 0.22 * radius, 0.08 * radius, 6, False))
    size = 0.42 * min(wide, tall) * rng.uniform(0.85, 1.15, size=len(clumps))
    which = rng.integers(len(clumps), size=leaf_count)
    out = _on_sphere(leaf_count, rng)
    distance = size[which] * rng.uniform(0.55, 1.08, size=leaf_count)
    centres = clumps[which] + out * distance[:, None] * [1, 1, 0.85]
    # Leaves at the bottom of a clump are darker.
    shade = 0.45 + 0.3 * out[:, 2] + 0.25 * rng.normal(size=leaf_count)
    leafage = leaves(centres, out + [0, 0, 0.4], (0.13, 0.22), rng, shade)
    cores = merge([blob(c, [0.72 * s] * 3, rng, 0.25, 12) for c, s in zip(clumps, size)])  # noqa: B905
    return [
        merge(wood).scaled_uv(1.0, 0.8).tagged(f"{name}-wood", "bark", "vegetation", True),
        leafage.tagged(f"{name}-leaves", leaf_texture, "vegetation"),
        cores.scaled_uv(0.25, 0.25).tagged(f"{name}-core", "foliage-tree", "vegetation"),
    ]


def hedge(
    name: str, x_range: tuple[float, float], y_range: tuple[float, float], height: float, seed: int
) -> list[Mesh]:
    """Return a clipped hedge along y that follows the ground: a dark core below leaves."""
    rng = np.random.default_rng(seed)
    (x0, x1), (y0, y1) = x_range, y_range
    ys = np.linspace(y0, y1, max(2, int((y1 - y0) / 0.5)) + 1)
    parts = []
    inset = 0.07
    for a, b in zip(ys, ys[1:], strict=False):
        ring = np.array([[x0 + inset, a], [x1 - inset, a], [x1 - inset, b], [x0 + inset, b]])
        base = ground_height(ring[:, 0], ring[:, 1])
        bottom = np.c_[ring, base - 0.2]
        parts.append(hexahedron(bottom, np.c_[ring, base + height - inset]))
    length, width = y1 - y0, x1 - x0
    areas = np.array([length * height, length * height, length * width, width * height * 2])
    counts = (areas * 210).astype(int)
    groups = []
    for side, n in enumerate(counts):
        u, v = rng.uniform(size=(2, n))
        y = y0 + u * length
        h = 0.04 + v * (height - 0.04)
        ends = rng.integers(2, size=n)
        x, normal = {
            0: (np.full(n, x0), [-1, 0, 0]),
            1: (np.full(n, x1), [1, 0, 0]),
            2: (x0 + v * width, [0, 0, 1]),
            3: (x0 + u * width, [0, 1, 0]),
        }[side]
        if side == 2:
            h = np.full(n, height)
        if side == 3:
            y = np.where(ends == 0, y0, y1)
        wave = 0.04 * np.sin(3.1 * y + 2 * h) + 0.03 * np.sin(7.3 * y + 1.0)
        out = np.broadcast_to(np.array(normal, float), (n, 3))
        base = np.stack([x, y, ground_height(x, y) + h], -1)
        groups.append((base + out * (wave + 0.04 * rng.normal(size=n))[:, None], out, h))
    centres, outward = (np.concatenate([g[i] for g in groups]) for i in (0, 1))
    lift = np.concatenate([g[2] for g in groups]) / height
    shade = 0.25 + 0.45 * lift + 0.22 * rng.normal(size=len(lift))
    coat = leaves(centres, outward + [0, 0, 0.3], (0.08, 0.15), rng, shade)
    return [
        merge(parts).scaled_uv(0.25, 0.25).tagged(f"{name}-core", "foliage-hedge", "vegetation"),
        coat.tagged(f"{name}-leaves", "leaf-hedge", "vegetation"),
    ]


def far_trees(seed: int = 5) -> list[Mesh]:
    """Return distant trees behind the gardens, on the meadow and at the ends of the road."""
    rng = np.random.default_rng(seed)
    crowns, trunks, coats = [], [], []
    spots = []
    for side in (-1, 1):
        for y in np.arange(-66, 70, 4.2):  # belt behind the gardens
            spots.append((side * (27 + rng.uniform(-2.5, 6)), y + rng.uniform(-2, 2)))
        for x in np.arange(-26, 27, 4.0):  # two rows across each end of the street
            spots.append((x + rng.uniform(-1, 1), side * rng.uniform(80, 88)))
            spots.append((x + 2, side * rng.uniform(92, 100)))
    for _ in range(110):  # scattered farther away
        r, a = rng.uniform(52, 150), rng.uniform(0, 2 * np.pi)
        x, y = r * np.cos(a), r * np.sin(a)
        if abs(x) > 9:
            spots.append((x, y))
    for x, y in spots:
        z = float(ground_height(x, y))
        radius = rng.uniform(2.0, 3.6)
        stem = rng.uniform(0.5, 1.4)
        if abs(y) > 75 and abs(x) < 30:
            stem = 0.1  # no gap below the crowns at the ends of the road
        middle = (x, y, z + stem + radius * 1.05)
        radii = (radius, radius, radius * rng.uniform(1.0, 1.35))
        crown = blob(middle, radii, rng, 0.22, 14)
        crowns.append(crown)
        coats.append(_coat(crown, 620, (0.42, 0.75), rng))
        trunks.append(cylinder((x, y, z - 0.3), (x, y, z + stem + radius), 0.22, 0.16, 8, False))
    return [
        merge(crowns).scaled_uv(0.25, 0.25).tagged("far-crowns", "foliage-far", "vegetation", True),
        merge(trunks).tagged("far-trunks", "bark", "vegetation", True),
        merge(coats).tagged("far-leaves", "leaf-far", "vegetation"),
    ]


def shrubs(seed: int = 6) -> list[Mesh]:
    """Return shrubs at the house walls and in the gardens."""
    rng = np.random.default_rng(seed)
    cores, coats = [], []
    for x, y, r in (
        (-10.0, 1.2, 0.5), (-10.1, -5.2, 0.42), (-9.9, -0.6, 0.36), (9.5, 12.2, 0.5),
        (9.5, 5.0, 0.55), (9.6, 6.3, 0.4), (-13.5, 5.5, 0.9), (13.0, 0.5, 0.8), (-15, 9.0, 1.2),
        (14.5, -6.0, 1.3), (18.0, -2.0, 1.1), (-19.5, -11.5, 1.4), (-12.5, -14.0, 0.9),
    ):  # fmt: skip
        z = float(ground_height(x, y))
        core = blob((x, y, z + 0.75 * r), (r, r, 0.95 * r), rng, 0.2, 14)
        cores.append(core)
        coats.append(_coat(core, int(900 * min(r, 1.0)) + 500, (0.08, 0.17), rng))
    return [
        merge(cores).scaled_uv(0.6, 0.6).tagged("shrubs-core", "foliage-tree", "vegetation", True),
        merge(coats).tagged("shrubs-leaves", "leaf-hedge", "vegetation"),
    ]
