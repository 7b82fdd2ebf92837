"""Two houses with gabled roofs, eaves, recessed windows, a door and a step."""

from dataclasses import dataclass

import numpy as np

from tools.reference_street.geometry import Mesh, box, cylinder, hexahedron, merge, quad, triangle
from tools.reference_street.terrain import ground_height


@dataclass(frozen=True)
class Opening:
    """A window or door: lower left corner along the wall and above the floor, m; size, m."""

    along: float
    up: float
    width: float
    height: float
    kind: str = "window"


@dataclass(frozen=True)
class House:
    """A house in its local frame: front wall on y = 0 facing -y, x to the right along it."""

    name: str
    width: float  # m, along the front
    depth: float  # m
    eaves: float  # m above the floor
    pitch: float  # degrees
    ridge_along_front: bool
    corner: tuple[float, float]  # world x, y of local (0, 0)
    rotation: float  # degrees about z
    wall: str  # textures
    gable: str
    roof: str
    openings: dict  # wall name (front, back, left, right) → tuple of Opening

    @property
    def floor(self) -> float:
        """Floor height, world m: 0.25 m above the ground at the middle of the front."""
        a = np.deg2rad(self.rotation)
        x = self.corner[0] + 0.5 * self.width * np.cos(a)
        y = self.corner[1] + 0.5 * self.width * np.sin(a)
        return float(ground_height(x, y)) + 0.25


_FRONT_A = (
    Opening(0.8, 0.9, 1.5, 1.35),
    Opening(3.9, 0.0, 1.05, 2.15, "door"),
    Opening(6.3, 0.9, 1.9, 1.35),
)
_FRONT_B = (
    Opening(0.9, 0.85, 1.7, 1.4),
    Opening(3.95, 0.0, 1.1, 2.15, "door"),
    Opening(6.4, 0.85, 1.7, 1.4),
    Opening(1.2, 3.2, 1.2, 1.25),
    Opening(3.9, 3.2, 1.2, 1.25),
    Opening(6.6, 3.2, 1.2, 1.25),
)
_SIDE = (Opening(1.4, 0.9, 1.2, 1.3), Opening(4.6, 0.9, 1.2, 1.3))
_SIDE_TALL = (*_SIDE, Opening(1.4, 3.2, 1.2, 1.2), Opening(4.6, 3.2, 1.2, 1.2))

HOUSES = (
    House(
        "house-a", 9.0, 7.5, 2.9, 42.0, True, (-10.5, -7.0), 90.0, "brick", "boards",
        "tiles-red", {"front": _FRONT_A, "left": _SIDE, "right": _SIDE, "back": ()},
    ),
    House(
        "house-b", 9.0, 7.0, 4.9, 38.0, False, (10.0, 13.0), -90.0, "plaster", "boards",
        "tiles-grey", {"front": _FRONT_B, "left": _SIDE_TALL, "right": _SIDE_TALL, "back": ()},
    ),
)  # fmt: skip
_TEXTURE_SIZE = {"brick": (3.84, 3.2), "plaster": (6.0, 6.0), "boards": (2.0, 2.0)}
_RECESS = 0.13  # m, glass behind the wall face
_BASEMENT = -0.9  # m, lower end of the walls relative to the floor


def _wall(start, along, inward, width, eaves, openings) -> dict[str, list[Mesh]]:
    """Return one wall from `start` along the unit vector `along`, with recessed openings."""
    start, along, inward = (np.asarray(a, float) for a in (start, along, inward))
    up = np.array([0, 0, 1.0])
    parts: dict[str, list[Mesh]] = {k: [] for k in ("wall", "white", "glass", "door", "stone")}
    us = sorted({0.0, width, *(o.along for o in openings), *(o.along + o.width for o in openings)})
    vs = sorted({_BASEMENT, eaves, *(o.up for o in openings), *(o.up + o.height for o in openings)})

    def at(u, v, inside=0.0):
        return start + u * along + v * up + inside * inward

    def bar(u0, u1, v0, v1, outer, inner):
        ring = [(u0, outer), (u1, outer), (u1, inner), (u0, inner)]
        bottom = np.array([at(u, v0, d) for u, d in ring])
        top = np.array([at(u, v1, d) for u, d in ring])
        return hexahedron(bottom, top)

    for u0, u1 in zip(us, us[1:], strict=False):
        for v0, v1 in zip(vs, vs[1:], strict=False):
            um, vm = 0.5 * (u0 + u1), 0.5 * (v0 + v1)
            hole = any(
                o.along < um < o.along + o.width and o.up < vm < o.up + o.height for o in openings
            )
            if not hole:
                parts["wall"].append(
                    quad(at(u0, v0), (u1 - u0) * along, (v1 - v0) * up, (u0, v0 - _BASEMENT))
                )
    for o in openings:
        u0, u1, v0, v1 = o.along, o.along + o.width, o.up, o.up + o.height
        deep = _RECESS * inward
        for corner, edge in (
            (at(u0, v0), (v1 - v0) * up),
            (at(u1, v0), (v1 - v0) * up),
            (at(u0, v0), (u1 - u0) * along),
            (at(u0, v1), (u1 - u0) * along),
        ):
            parts["white"].append(quad(corner, edge, deep))
        pane = quad(at(u0, v0, _RECESS), (u1 - u0) * along, (v1 - v0) * up)
        pane = pane.scaled_uv(1 / (u1 - u0), 1 / (v1 - v0))  # one texture per pane
        parts["door" if o.kind == "door" else "glass"].append(pane)
        front, back = _RECESS - 0.05, _RECESS - 0.005
        w = 0.07
        # 3 mm between frame and reveal: coplanar faces would shadow each other.
        u0, u1, v0, v1 = u0 + 0.003, u1 - 0.003, v0 + 0.003, v1 - 0.003
        parts["white"] += [
            bar(u0, u0 + w, v0, v1, front, back),
            bar(u1 - w, u1, v0, v1, front, back),
            bar(u0 + w, u1 - w, v1 - w, v1, front, back),
        ]
        if o.kind == "window":
            mid = 0.5 * (u0 + u1)
            parts["white"] += [
                bar(u0 + w, u1 - w, v0, v0 + w, front, back),
                bar(mid - 0.03, mid + 0.03, v0 + w, v1 - w, front, back),
                bar(u0 + w, mid - 0.03, v1 - 0.42, v1 - 0.37, front, back),
                bar(mid + 0.03, u1 - w, v1 - 0.42, v1 - 0.37, front, back),
            ]
            parts["stone"].append(bar(u0 - 0.08, u1 + 0.08, v0 - 0.09, v0 - 0.006, -0.08, 0.05))
        parts["stone"].append(bar(u0 - 0.12, u1 + 0.12, v1 + 0.006, v1 + 0.18, -0.025, 0.05))
    parts["stone"].append(bar(0.0, width, _BASEMENT, -0.06, -0.05, 0.05))  # plinth
    return parts


def _roof(span, length, eaves, pitch, roof_texture) -> dict[str, list[Mesh]]:
    """Return a gabled roof over local x in [0, span] (slopes) and y in [0, length] (ridge)."""
    slope = np.tan(np.deg2rad(pitch))
    over, gable_over, thick = 0.5, 0.35, 0.14
    ridge_z = eaves + 0.5 * span * slope
    low_z = eaves - over * slope
    y0, y1 = -gable_over, length + gable_over
    parts: dict[str, list[Mesh]] = {k: [] for k in (roof_texture, "white", "dark-metal")}
    for side in (0, 1):
        x_low = -over if side == 0 else span + over
        low, top = np.array([x_low, y0, low_z]), np.array([0.5 * span, y0, ridge_z])
        lift = np.array([0, 0, thick])
        edge = np.array([0, y1 - y0, 0])
        # u along the ridge, v up the slope, in metres.
        upper = quad(low + lift, edge, top - low).scaled_uv(1 / 3.52, 1 / 3.52)
        parts[roof_texture].append(upper)
        under = quad(low, edge, top - low)
        fascia = quad(low, edge, lift)
        verges = [quad(low, top - low, lift), quad(low + edge, top - low, lift)]
        parts["white"] += [under, fascia, *verges]
        drip = low + np.array([-0.05 if side == 0 else 0.05, 0, 0.07])
        parts["dark-metal"].append(cylinder(drip, drip + edge, 0.065, 0.065, 10))
    ridge = np.array([0.5 * span, y0 - 0.02, ridge_z + thick - 0.02])
    cap = cylinder(ridge, ridge + [0, y1 - y0 + 0.04, 0], 0.11, 0.11, 12)
    parts[roof_texture].append(cap.scaled_uv(1.0, 1 / 3.52))
    return parts


def _chimney(x, y, z0, z1) -> dict[str, list[Mesh]]:
    return {
        "brick": [box((x - 0.35, y - 0.35, z0), (x + 0.35, y + 0.35, z1)).scaled_uv(0.26, 0.31)],
        "stone": [box((x - 0.42, y - 0.42, z1), (x + 0.42, y + 0.42, z1 + 0.1))],
        "tiles-red": [cylinder((x, y, z1 + 0.1), (x, y, z1 + 0.5), 0.13, 0.11, 12)],
    }


def _add(into: dict, parts: dict) -> None:
    for key, meshes in parts.items():
        into.setdefault(key, []).extend(meshes)


def house_meshes(house: House) -> list[Mesh]:
    """Return all parts of one house in world metres, one mesh per texture."""
    w, d, e = house.width, house.depth, house.eaves
    ground = house.floor
    parts: dict[str, list[Mesh]] = {}
    walls = {
        "front": ((0, 0, 0), (1, 0, 0), (0, 1, 0), w),
        "right": ((w, 0, 0), (0, 1, 0), (-1, 0, 0), d),
        "back": ((w, d, 0), (-1, 0, 0), (0, -1, 0), w),
        "left": ((0, d, 0), (0, -1, 0), (1, 0, 0), d),
    }
    for name, (start, along, inward, length) in walls.items():
        _add(parts, _wall(start, along, inward, length, e, house.openings.get(name, ())))
    # The roof is built with its ridge along local y; x and y are swapped for a ridge along x.
    span, length = (d, w) if house.ridge_along_front else (w, d)
    roof = _roof(span, length, e, house.pitch, house.roof)
    rise = 0.5 * span * np.tan(np.deg2rad(house.pitch))
    gables = [
        triangle(
            (0, y, e), (span, y, e), (0.5 * span, y, e + rise),
            [(0, e), (span, e), (0.5 * span, e + rise)],
        )
        for y in (0.0, length)
    ]  # fmt: skip
    roof["gable"] = gables
    roof["white"].append(box((0.5 * span - 0.3, -0.03, e + 0.9), (0.5 * span + 0.3, 0, e + 1.5)))
    _add(roof, _chimney(0.5 * span + 0.9, 0.72 * length, e, e + rise + 0.7))
    if house.ridge_along_front:
        swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]])
        roof = {
            key: [Mesh(m.vertices @ swap.T, m.faces, m.uv) for m in meshes]
            for key, meshes in roof.items()
        }
    _add(parts, roof)
    door = next(o for o in house.openings["front"] if o.kind == "door")
    left, right = door.along - 0.35, door.along + door.width + 0.35
    _add(
        parts,
        {
            "stone": [
                box((left, -0.95, _BASEMENT), (right, 0.0, -0.13)),
                box((left + 0.1, -0.5, -0.13), (right - 0.1, 0.05, -0.015)),
            ],
            "dark-metal": [
                cylinder((w - 0.25, -0.09, _BASEMENT), (w - 0.25, -0.09, e - 0.25), 0.045, 0.045)
            ],
            "white": [box((left - 0.1, -0.75, 2.32), (right + 0.1, 0.0, 2.42))],  # canopy
        },
    )
    out = []
    for key, meshes in parts.items():
        texture = {"wall": house.wall, "gable": house.gable}.get(key, key)
        mesh = merge(meshes)
        if key in ("wall", "gable"):
            size = _TEXTURE_SIZE[texture]
            mesh = mesh.scaled_uv(1 / size[0], 1 / size[1])
        moved = mesh.moved(house.rotation, (*house.corner, ground))
        out.append(moved.tagged(f"{house.name}-{key}", texture, "building"))
    return out
