"""Objects of the street: car, bench, table, fence, lamp post, people."""

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh, blob, box, cylinder, grid, hexahedron, merge
from tools.reference_street.terrain import ground_height

CAR_AT = (1.93, 0.9)  # world x, y of the car's centre, m; it faces +y
_LENGTH, _WIDTH = 4.15, 1.74
_AXLES = (-1.28, 1.26)  # m from the centre
_WHEEL = 0.31
_PAINT = np.array([176, 38, 40]) / 255.0


def _superellipse(u, a, b, power):
    angle = 2 * np.pi * u
    c, s = np.cos(angle), np.sin(angle)
    return a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)


def _body(u, v) -> Float[np.ndarray, "*n 3"]:
    """Return the body below the windows: u around it, v from the sill to the centre line."""
    # v in [0, 0.7] is the side from sill to shoulder, [0.7, 1] bonnet and boot.
    side = np.clip(v / 0.7, 0, 1)
    inward = np.clip((v - 0.7) / 0.3, 0, 1)
    bulge = 0.955 + 0.045 * np.sin(np.pi * np.clip(side * 0.9 + 0.1, 0, 1)) ** 0.7
    shrink = bulge * np.cos(0.5 * np.pi * inward)
    x, y = _superellipse(u, 0.5 * _WIDTH, 0.5 * _LENGTH, 5.0)
    x, y = x * shrink, y * (shrink + 0.0 * bulge)
    nose = np.clip((y - 0.55) / 1.5, 0, 1)
    tail = np.clip((-y - 1.2) / 0.9, 0, 1)
    shoulder = 0.86 - 0.13 * nose**1.3 - 0.02 * tail
    z = 0.20 + (shoulder - 0.20) * side + 0.085 * np.sin(0.5 * np.pi * inward)
    return np.stack([x, y, z], -1)


def _cabin(u, v) -> Float[np.ndarray, "*n 3"]:
    """Return the cabin: v in [0, 0.6] along the windows, [0.6, 1] over the roof."""
    up = np.clip(v / 0.6, 0, 1)
    inward = np.clip((v - 0.6) / 0.4, 0, 1)
    half_x = 0.77 - 0.17 * up**1.2
    front, back = 1.02 - 0.80 * up, -1.82 + 0.42 * up
    close = np.cos(0.5 * np.pi * inward)
    x, y = _superellipse(u, half_x * close, 0.5 * (front - back) * close, 6.0)
    z = 0.84 + 0.51 * up + 0.075 * np.sin(0.5 * np.pi * inward)
    return np.stack([x, y + 0.5 * (front + back), z], -1)


def paint_car(part: str) -> Float[np.ndarray, "h w 3"]:
    """Draw the texture of the car's body (paint, doors, lights, plates) or cabin (windows)."""
    shape = (384, 1536)
    rows, columns = ((np.arange(n) + 0.5) / n for n in shape)
    u, v = np.meshgrid(columns, rows)
    image = np.broadcast_to(_PAINT, (*shape, 3)).copy()
    if part == "body":
        x, y, z = np.moveaxis(_body(u, v), -1, 0)
        side = (np.abs(x) > 0.70) & (v < 0.7)
        image[(z < 0.30) & (v < 0.7)] = 0.11
        for axle in _AXLES:
            image[(np.hypot(y - axle, z - _WHEEL) < _WHEEL + 0.07) & side] = 0.05
        for line in (-1.0, -0.12, 0.80):
            image[(np.abs(y - line) < 0.010) & side & (z > 0.32)] *= 0.35
        for handle in (-0.85, 0.02):
            image[(np.abs(y - handle) < 0.09) & (np.abs(z - 0.72) < 0.018) & side] = 0.62
        image[(np.abs(z - 0.52) < 0.014) & side & (np.abs(y) < 0.85)] = 0.13
        front, back = y > 1.88, y < -1.88
        lamps = (np.abs(np.abs(x) - 0.58) < 0.17) & (np.abs(z - 0.62) < 0.07)
        image[front & lamps] = np.array([0.90, 0.90, 0.84])
        image[back & lamps & (z > 0.5)] = np.array([0.45, 0.05, 0.05])
        image[(front | back) & (np.abs(z - 0.36) < 0.05) & (np.abs(x) < 0.78)] = 0.13
        image[front & (np.abs(x) < 0.34) & (np.abs(z - 0.58) < 0.06)] = 0.10
        plate = (front | back) & (np.abs(x) < 0.26) & (np.abs(z - 0.45) < 0.055)
        image[plate] = np.array([0.88, 0.87, 0.80])
        image[plate & (np.abs(z - 0.45) < 0.03) & (np.mod(x + 9, 0.075) < 0.042)] = 0.12
        image[(v > 0.72) & (np.abs(y - 1.0) < 0.012)] *= 0.4
    else:
        x, y, _ = np.moveaxis(_cabin(u, v), -1, 0)
        window = (v > 0.07) & (v < 0.53)
        lean = 0.42 * np.clip(v / 0.6, 0, 1)
        on_side = np.abs(x) > 0.52
        pillars = (np.abs(y + 0.12) < 0.045) | (y > 0.90 - 1.9 * lean) | (y < -1.62 + lean)
        glass = window & (~on_side | ~pillars)
        glass &= (np.abs(x) < 0.50) | on_side
        image[glass] = np.array([0.17, 0.20, 0.23])
        shine = glass & (np.mod(u * 11 + 0.5 * v, 1.0) < 0.25)
        image[shine] = np.array([0.25, 0.29, 0.32])
    return image


def car() -> list[Mesh]:
    """Return the parked car on the slope of the road."""
    u, v = np.meshgrid(np.linspace(0, 1, 161), np.linspace(0, 1, 57))
    uv = np.stack([u, v], -1)
    body, cabin = grid(_body(u, v), uv), grid(_cabin(u, v), uv)
    tyres, discs = [], []
    for axle in _AXLES:
        for side in (-1, 1):
            inner, outer = side * 0.64, side * (0.5 * _WIDTH + 0.012)
            tyres.append(
                cylinder((inner, axle, _WHEEL), (outer, axle, _WHEEL), _WHEEL, _WHEEL, 28, False)
            )
            disc = cylinder((outer - side * 0.01, axle, _WHEEL), (outer, axle, _WHEEL), _WHEEL,
                            _WHEEL, 28, True)  # fmt: skip
            discs.append(disc)
    under = box((-0.72, -1.9, 0.19), (0.72, 1.9, 0.40))
    mirrors = [box((s * 0.86 - 0.09, 0.62, 0.86), (s * 0.86 + 0.09, 0.74, 0.99)) for s in (-1, 1)]
    parts = [
        body.tagged("car-body", "car-body", "vehicle", True),
        cabin.tagged("car-cabin", "car-cabin", "vehicle", True),
        merge(tyres + [under]).tagged("car-tyres", "rubber", "vehicle"),
        merge(discs).tagged("car-wheels", "tyre", "vehicle"),
        merge(mirrors).tagged("car-mirrors", "dark-metal", "vehicle"),
    ]
    cx, cy = CAR_AT
    ends = ground_height(np.full(2, cx), cy + np.array(_AXLES))
    slope = (ends[1] - ends[0]) / (_AXLES[1] - _AXLES[0])
    lift = ends[0] - slope * _AXLES[0]
    out = []
    for part in parts:
        vertices = part.vertices.copy()
        vertices[:, 2] += slope * vertices[:, 1] + lift  # a shear of 2 %, which is not visible
        vertices += [cx, cy, 0.0]
        out.append(
            Mesh(vertices, part.faces, part.uv, part.name, part.texture, part.label, part.smooth)
        )
    return out


def bench(x: float = -4.72, y: float = 0.6) -> list[Mesh]:
    """Return a wooden bench facing the road (+x): slatted seat and back on two stone feet."""
    z = float(ground_height(x, y))
    wood, feet = [], []
    half = 0.95
    for k in range(4):  # slats with gaps of 1 cm, which shelter the ground below
        x0 = x - 0.24 + 0.125 * k
        wood.append(box((x0, y - half, z + 0.42), (x0 + 0.115, y + half, z + 0.46)))
    for k in range(3):
        up = z + 0.55 + 0.13 * k
        back = x - 0.27 - 0.02 * k
        wood.append(box((back - 0.03, y - half, up), (back, y + half, up + 0.11)))
    for end in (-0.72, 0.62):
        feet.append(box((x - 0.22, y + end, z - 0.2), (x + 0.22, y + end + 0.10, z + 0.42)))
        feet.append(box((x - 0.36, y + end + 0.02, z), (x - 0.30, y + end + 0.08, z + 0.92)))
    return [
        merge(wood).scaled_uv(0.5, 0.5).tagged("bench-wood", "bench-wood", "object"),
        merge(feet).tagged("bench-feet", "stone", "object"),
    ]


def table(x: float = -6.35, y: float = 2.45) -> list[Mesh]:
    """Return a garden table on the lawn; its closed top shelters the ground below."""
    z = float(ground_height(x, y))
    top = [box((x - 0.42, y - 0.8, z + 0.70), (x + 0.42, y + 0.8, z + 0.745))]
    rails = [box((x - 0.36, y - 0.72, z + 0.60), (x + 0.36, y - 0.68, z + 0.70))]
    rails += [box((x - 0.36, y + 0.68, z + 0.60), (x + 0.36, y + 0.72, z + 0.70))]
    legs = [
        box((x + i * 0.36 - 0.03, y + j * 0.7 - 0.03, z - 0.15),
            (x + i * 0.36 + 0.03, y + j * 0.7 + 0.03, z + 0.70))
        for i in (-1, 1) for j in (-1, 1)
    ]  # fmt: skip
    wood = merge(top + rails + legs)
    return [wood.scaled_uv(0.5, 0.5).tagged("table", "bench-wood", "object")]


def fence(x: float = 5.55, y_range: tuple[float, float] = (-5.6, 3.0)) -> list[Mesh]:
    """Return a white picket fence along the right pavement: thin parts with gaps."""
    y0, y1 = y_range
    parts = []
    for y in np.arange(y0, y1 + 1e-6, 0.14):
        z = float(ground_height(x, y))
        post = abs((y - y0) / 1.4 - round((y - y0) / 1.4)) < 0.01
        half, out, tall = (0.045, 0.045, 1.0) if post else (0.028, 0.011, 0.85)
        bottom = z - 0.15 if post else z + 0.06
        parts.append(box((x - out, y - half, bottom), (x + out, y + half, z + tall)))
    for low in (0.25, 0.62):  # rails from post to post, following the ground
        for a in np.arange(y0, y1 - 0.7, 1.4):
            ends = [float(ground_height(x, v)) + low for v in (a, a + 1.4)]
            ring = [(x + 0.012, a), (x + 0.04, a), (x + 0.04, a + 1.4), (x + 0.012, a + 1.4)]
            rise = np.array([ends[0], ends[0], ends[1], ends[1]])
            bottom = np.c_[np.array(ring), rise]
            parts.append(hexahedron(bottom, bottom + [0, 0, 0.07]))
    return [merge(parts).tagged("fence", "white", "object")]


def person(
    name: str, at: tuple[float, float], heading: float, stride: float, coat: str
) -> list[Mesh]:
    """Return a walking person of 1.75 m; stride in m, heading in degrees from +y to +x."""
    rng = np.random.default_rng(17)
    z = float(ground_height(*at))
    half = 0.5 * stride
    legs, arms = [], []
    for side in (-1, 1):
        foot, knee, hip = (
            np.array([0.1 * side, side * half, 0.05]),
            np.array([0.1 * side, 0.6 * side * half + 0.05, 0.47]),
            np.array([0.1 * side, 0.0, 0.92]),
        )
        legs += [cylinder(foot, knee, 0.055, 0.07, 10), cylinder(knee, hip, 0.075, 0.095, 10)]
        legs.append(box(foot + [-0.05, -0.08, -0.05], foot + [0.05, 0.18, 0.04]))
        shoulder, elbow, hand = (
            np.array([0.22 * side, 0.0, 1.42]),
            np.array([0.25 * side, -0.5 * side * half, 1.13]),
            np.array([0.24 * side, -0.9 * side * half + 0.06, 0.9]),
        )
        arms += [cylinder(shoulder, elbow, 0.055, 0.05, 9), cylinder(elbow, hand, 0.048, 0.04, 9)]
    torso = merge([blob((0, 0, 1.2), (0.22, 0.15, 0.34), rng, 0.03, 12), *arms])
    head = blob((0, 0.02, 1.62), (0.09, 0.105, 0.125), rng, 0.0, 12)
    parts = [
        merge(legs).tagged(f"{name}-legs", "rubber", "person"),
        torso.tagged(f"{name}-coat", coat, "person", True),
        head.tagged(f"{name}-head", "skin", "person", True),
    ]
    return [part.moved(-heading, (*at, z)) for part in parts]


def lamp(x: float = 4.75, y: float = 10.6) -> list[Mesh]:
    """Return a lamp post with a short arm over the road."""
    z = float(ground_height(x, y))
    metal = [
        cylinder((x, y, z - 0.2), (x, y, z + 0.9), 0.085, 0.075, 14),
        cylinder((x, y, z + 0.9), (x, y, z + 4.6), 0.055, 0.04, 12),
        cylinder((x, y, z + 4.6), (x - 0.9, y, z + 4.85), 0.035, 0.03, 10),
        box((x - 1.35, y - 0.14, z + 4.80), (x - 0.8, y + 0.14, z + 4.92)),
    ]
    glass = box((x - 1.3, y - 0.11, z + 4.76), (x - 0.85, y + 0.11, z + 4.80))
    return [
        merge(metal).tagged("lamp-post", "dark-metal", "object"),
        glass.tagged("lamp-glass", "lamp-glass", "object"),
    ]
