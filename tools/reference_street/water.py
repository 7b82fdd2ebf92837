"""Flood water for the path tracer: a smooth dielectric over an absorbing medium."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Inexact

IOR = 1.333
ABSORPTION = 1.2  # 1/m, for all colours; no scattering
WIND = 3.0  # m/s
WAVE_SCALE = 4.0  # the shortest waves are 15 cm long, which the mesh resolves
SEED = 7
NEAR = ((-14.0, 14.0), (-22.0, 18.0))  # m, extent of the waves in x and y; else still water
STEP = 0.03  # m, a fifth of the shortest wave


def still(z: float) -> dict:
    """Return a level surface at height z (m) with absorbing water below."""
    return {"type": "rectangle", "to_world": _plane(z), **_water()}


def wavy(z: float, time: float, folder: Path) -> dict:
    """Write the program's waves at a time (s) as a mesh with normals; return the surface."""
    from climatenerf.weather.flood.parameters import Flood
    from climatenerf.weather.flood.waves import at_time, heights, make_waves

    waves = make_waves(Flood(level=0.0, wind_speed=WIND, wave_scale=WAVE_SCALE), SEED)
    frame = at_time(waves, time)
    (x0, x1), (y0, y1) = NEAR
    x, y = np.meshgrid(np.arange(x0, x1 + STEP / 2, STEP), np.arange(y0, y1 + STEP / 2, STEP))
    # Waves fade to still water within two metres of the border.
    border = np.minimum.reduce([x - x0, x1 - x, y - y0, y1 - y])
    calm = np.clip(border / 2.0, 0, 1) ** 2 * (3 - 2 * np.clip(border / 2.0, 0, 1))
    height, slope = np.zeros_like(x), np.zeros(x.shape, complex)
    for i, tile in enumerate(waves.tiles):
        table = heights(waves, i, time).double().numpy()
        side, n = tile.length * waves.scale, len(table)
        height += periodic(table, side, x, y)
        slope += periodic(frame.pyramids[i][: n * n].reshape(n, n).numpy(), side, x, y)
    height, slope = calm * height, calm * slope
    normals = np.stack([-slope.real, -slope.imag, np.ones_like(x)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points = np.stack([x, y, z + height], -1)
    rows, columns = x.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((a, b, c), (a, c, d))])
    # Four strips of still water around it, out to the hills.
    far, ring_points, ring_faces = 250.0, [], []
    for (u0, v0), (u1, v1) in (
        ((-far, -far), (far, y0)), ((-far, y1), (far, far)),
        ((-far, y0), (x0, y1)), ((x1, y0), (far, y1)),
    ):  # fmt: skip
        first = len(points.reshape(-1, 3)) + 4 * len(ring_points)
        ring_points.append([[u0, v0, z], [u1, v0, z], [u1, v1, z], [u0, v1, z]])
        ring_faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    points = np.concatenate([points.reshape(-1, 3), np.reshape(ring_points, (-1, 3))])
    normals = np.concatenate([normals.reshape(-1, 3), np.tile([0.0, 0.0, 1.0], (16, 1))])
    path = folder / "water.ply"
    _write(path, points, normals, np.concatenate([faces, ring_faces]))
    return {"type": "ply", "filename": str(path), **_water()}


def periodic(
    table: Inexact[np.ndarray, "n n"],
    side: float,
    x: Float[np.ndarray, "*m"],
    y: Float[np.ndarray, "*m"],
) -> Inexact[np.ndarray, "*m"]:
    """Interpolate a periodic table (rows along +y) of `side` metres bilinearly."""
    n = len(table)
    u, v = x / side * n, y / side * n
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    fx, fy = u - i, v - j
    near = table[j % n, i % n], table[j % n, (i + 1) % n]
    far = table[(j + 1) % n, i % n], table[(j + 1) % n, (i + 1) % n]
    return (near[0] * (1 - fx) + near[1] * fx) * (1 - fy) + (far[0] * (1 - fx) + far[1] * fx) * fy


def _plane(z: float):
    import mitsuba as mi

    return mi.ScalarTransform4f().translate([0, 0, z]).scale([250, 250, 1])


def _water() -> dict:
    return {
        "bsdf": {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0},
        "interior": {"type": "homogeneous", "sigma_t": ABSORPTION, "albedo": 0.0},
    }


def _write(path: Path, points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> None:
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    table = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    table["n"], table["i"] = 3, faces
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(np.concatenate([points, normals], axis=1).astype("<f4").tobytes())
        file.write(table.tobytes())
