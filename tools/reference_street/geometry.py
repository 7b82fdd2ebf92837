"""Triangle meshes and the solids of the street (NumPy only; metres, z up)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

# The seven merged classes of the paper; "sky" and "person" have no mesh here.
LABELS = ("road", "building", "vegetation", "terrain", "sky", "person", "vehicle", "object")


@dataclass(frozen=True)
class Mesh:
    """Triangles with one texture and one class label.

    `uv` counts texture repeats; row 0 of a texture lies at v = 0, so v up means row index up.
    """

    vertices: Float[np.ndarray, "n 3"]  # metres
    faces: Int[np.ndarray, "m 3"]
    uv: Float[np.ndarray, "n 2"]
    name: str = ""
    texture: str = ""  # one of textures.NAMES
    label: str = ""  # one of LABELS
    smooth: bool = False  # shaded with interpolated vertex normals

    def tagged(self, name: str, texture: str, label: str, smooth: bool = False) -> "Mesh":
        """Return the same triangles with a name, a texture and a label."""
        if label not in LABELS:
            raise ValueError(f"unknown label {label!r}")
        return Mesh(self.vertices, self.faces, self.uv, name, texture, label, smooth)

    def moved(self, rotation_degrees: float, offset: tuple[float, float, float]) -> "Mesh":
        """Rotate about z by `rotation_degrees` (counter-clockwise from above), then translate."""
        a = np.deg2rad(rotation_degrees)
        rotation = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        vertices = self.vertices @ rotation.T + np.asarray(offset)
        return Mesh(vertices, self.faces, self.uv, self.name, self.texture, self.label, self.smooth)

    def scaled_uv(self, su: float, sv: float) -> "Mesh":
        """Return the same triangles with uv multiplied by (su, sv)."""
        uv = self.uv * np.array([su, sv])
        return Mesh(self.vertices, self.faces, uv, self.name, self.texture, self.label, self.smooth)


def merge(parts: list[Mesh]) -> Mesh:
    """Join meshes into one without name, texture and label."""
    counts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + c for p, c in zip(parts, counts, strict=True)]),
        np.concatenate([p.uv for p in parts]),
    )


def grid(points: Float[np.ndarray, "r c 3"], uv: Float[np.ndarray, "r c 2"]) -> Mesh:
    """Triangulate a rectangular grid of points."""
    rows, cols = points.shape[:2]
    index = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    return Mesh(points.reshape(-1, 3).astype(float), faces, uv.reshape(-1, 2).astype(float))


def quad(corner, edge_u, edge_v, uv_origin=(0.0, 0.0)) -> Mesh:
    """Return a parallelogram; uv in metres along the two edges, starting at `uv_origin`."""
    corner, edge_u, edge_v = (np.asarray(a, float) for a in (corner, edge_u, edge_v))
    vertices = np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v])
    w, h = np.linalg.norm(edge_u), np.linalg.norm(edge_v)
    uv = np.array([[0, 0], [w, 0], [w, h], [0, h]]) + np.asarray(uv_origin)
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv)


def triangle(a, b, c, uv) -> Mesh:
    """Return one triangle with given uv (three pairs)."""
    return Mesh(np.array([a, b, c], float), np.array([[0, 1, 2]]), np.asarray(uv, float))


def hexahedron(bottom: Float[np.ndarray, "4 3"], top: Float[np.ndarray, "4 3"]) -> Mesh:
    """Return a solid with quadrilateral bottom and top (same orientation); uv in metres."""
    bottom, top = np.asarray(bottom, float), np.asarray(top, float)
    sides = []
    for i in range(4):
        j = (i + 1) % 4
        sides.append(_patch(bottom[i], bottom[j], top[j], top[i]))
    sides.append(_patch(*bottom[::-1]))
    sides.append(_patch(*top))
    return merge(sides)


def _patch(a, b, c, d) -> Mesh:
    w = 0.5 * (np.linalg.norm(b - a) + np.linalg.norm(c - d))
    h = 0.5 * (np.linalg.norm(d - a) + np.linalg.norm(c - b))
    uv = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    return Mesh(np.stack([a, b, c, d]), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(lower, upper) -> Mesh:
    """Return an axis-aligned box; uv in metres on every face."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)
    return hexahedron(np.c_[ring, np.full(4, z0)], np.c_[ring, np.full(4, z1)])


def cylinder(start, end, r_start: float, r_end: float, sides: int = 16, cap: bool = True) -> Mesh:
    """Return a cone frustum from `start` to `end`; u goes once around, v is in metres along it."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = end - start
    length = np.linalg.norm(axis)
    axis = axis / length
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    e1 = np.cross(axis, helper)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(axis, e1)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    around = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    u = np.linspace(0, 1, sides + 1)
    rows = [start + r_start * around, end + r_end * around]
    parts = [
        grid(
            np.stack(rows),
            np.stack([np.stack([u, 0 * u], -1), np.stack([u, 0 * u + length], -1)]),
        )
    ]
    if cap:
        for centre, row in ((start, rows[0]), (end, rows[1])):
            disc_uv = 0.5 + 0.5 * np.stack([np.cos(angle), np.sin(angle)], -1)
            middle = np.broadcast_to(centre, row.shape)
            parts.append(
                grid(np.stack([middle, row]), np.stack([np.full_like(disc_uv, 0.5), disc_uv]))
            )
    return merge(parts)


def blob(centre, radii, rng: np.random.Generator, bump: float = 0.0, cells: int = 20) -> Mesh:
    """Return an ellipsoid with smooth random bumps of relative size `bump`; uv in metres."""
    theta = np.linspace(0, np.pi, cells + 1)
    phi = np.linspace(0, 2 * np.pi, 2 * cells + 1)
    th, ph = np.meshgrid(theta, phi, indexing="ij")
    direction = np.stack([np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)], -1)
    scale = np.ones(th.shape)
    if bump:
        for frequency in (3.0, 5.0, 9.0, 14.0):
            for _ in range(4):
                wave = rng.normal(size=3)
                wave *= frequency / np.linalg.norm(wave)
                scale += bump * 2.0 / frequency * np.sin(direction @ wave + rng.uniform(0, 6.28))
    points = np.asarray(centre) + direction * np.asarray(radii) * scale[..., None]
    size = float(np.mean(radii))
    return grid(points, np.stack([ph * size, th * size], -1))


def leaves(
    centres: Float[np.ndarray, "n 3"],
    outward: Float[np.ndarray, "n 3"],
    size: tuple[float, float],
    rng: np.random.Generator,
    shade: Float[np.ndarray, " n"] | None = None,
) -> Mesh:
    """Return one pointed leaf (two folded triangles) per centre; u selects its palette colour.

    Leaf normals scatter around `outward`. `shade` in [0, 1] is the palette position (default
    random).
    """
    n = len(centres)
    normal = outward + 0.9 * rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along = np.cross(normal, rng.normal(size=(n, 3)))
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(normal, along)
    length = rng.uniform(*size, size=(n, 1))
    fold = 0.15 * length * normal
    half = 0.36 * length
    vertices = np.stack(
        [
            centres - 0.5 * length * along,
            centres + half * across + fold,
            centres + 0.5 * length * along,
            centres - half * across + fold,
        ],
        axis=1,
    ).reshape(-1, 3)
    first = 4 * np.arange(n)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    shade = rng.uniform(size=n) if shade is None else np.clip(shade, 0.01, 0.99)
    uv = np.repeat(np.stack([shade, np.full(n, 0.5)], -1), 4, axis=0)
    return Mesh(vertices, faces, uv)
