"""Flood water for the path tracer: a smooth dielectric over an absorbing medium."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Inexact

from tools.reference_street.terrain import ground_height

IOR = 1.333
ABSORPTION = 1.2  # 1/m, for all colours; no scattering
WIND = 3.0  # m/s
WAVE_SCALE = 4.0  # the shortest waves are 15 cm long, which the mesh resolves
SPREADING = "donelan-banner"
SEED = 7
EXTENT = ((-26.0, 26.0), (-48.0, 19.0))  # m, in x and y: all ground below the flood and its waves
STEP = 0.03  # m, a fifth of the shortest wave
MARGIN = 0.3  # m; where the ground lies higher above the water than this, no wave is needed
MUD_SCATTERING = 20.0  # 1/m, isotropic; the ground is lost from view below some 10 cm
MUD_ABSORPTION = (4.0, 6.7, 16.0)  # 1/m, of red, green, blue


def still(z: float, mud: bool = False) -> dict:
    """Return a level surface at height z (m) with absorbing or muddy water below."""
    return {"type": "rectangle", "to_world": _plane(z), **_water(mud)}


def wavy(z: float, time: float, folder: Path) -> dict:
    """Write the program's waves at a time (s) as a mesh with normals; return the surface."""
    from climatenerf.weather.flood.parameters import Flood
    from climatenerf.weather.flood.waves import at_time, make_waves

    flood = Flood(level=0.0, wind_speed=WIND, wave_scale=WAVE_SCALE, spreading=SPREADING)
    maps = at_time(make_waves(flood, SEED), time)
    (x0, x1), (y0, y1) = EXTENT
    x, y = np.meshgrid(np.arange(x0, x1 + STEP / 2, STEP), np.arange(y0, y1 + STEP / 2, STEP))
    surface, n = np.zeros((3, *x.shape)), 1 << maps.top  # of height and both slopes
    for start, side in zip(maps.start.tolist(), maps.side.tolist(), strict=True):
        finest = maps.texels[start : start + n * n].double().numpy().reshape(n, n, 3)
        surface += [periodic(table, side, x, y) for table in np.moveaxis(finest, -1, 0)]
    height, slope_x, slope_y = surface
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points = np.stack([x, y, z + height], -1)
    rows, columns = x.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    wet = (ground_height(x, y) < z + MARGIN)[:-1, :-1]
    a, b, c, d = (
        corner[wet] for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    faces = np.concatenate([np.stack(f, -1) for f in ((a, b, c), (a, c, d))])
    path = folder / "water.ply"
    _write(path, points.reshape(-1, 3), normals.reshape(-1, 3), faces)
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


def _water(mud: bool = False) -> dict:
    medium = mud_medium() if mud else {"sigma_t": ABSORPTION, "albedo": 0.0}
    return {
        "bsdf": {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0},
        "interior": {"type": "homogeneous", **medium},
    }


def mud_extinction() -> Float[np.ndarray, "3"]:
    """Return the extinction of mud, 1/m."""
    return MUD_SCATTERING + np.array(MUD_ABSORPTION)


def mud_medium() -> dict:
    """Return the extinction and single-scattering albedo of mud for a homogeneous medium."""
    extinction = mud_extinction()
    return {
        "sigma_t": {"type": "rgb", "value": (extinction / extinction.max()).tolist()},
        "scale": float(extinction.max()),  # of sigma_t
        "albedo": {"type": "rgb", "value": (MUD_SCATTERING / extinction).tolist()},
    }


def mud_colour(photons: int = 200_000, seed: int = 0) -> Float[np.ndarray, "3"]:
    """Return the diffuse reflectance of deep mud below its surface, as display sRGB.

    It is defined by the light that leaves deep mud: radiance (1 - R) reflectance E/pi under an even
    sky, where R is the reflectance of the surface. Photons are followed through a half-space until
    they leave; total internal reflection and Fresnel's equations hold at its surface.
    """
    rng = np.random.default_rng(seed)
    cosine = np.sqrt(rng.random(photons))  # an even sky
    entering = 1 - fresnel(cosine, 1 / IOR)
    weight = np.repeat(entering[:, None], 3, axis=1)
    down = np.sqrt(1 - (1 - cosine**2) / IOR**2)  # Snell's law
    depth, escaped = np.zeros(photons), np.zeros(3)
    while len(depth):
        # Scattering is the same in all channels; absorption along the path is a weight.
        free = rng.exponential(1 / MUD_SCATTERING, len(depth))
        to_surface = np.where(down < 0, depth / np.maximum(-down, 1e-9), np.inf)
        leaves = to_surface < free
        path = np.minimum(free, to_surface)
        weight = weight * np.exp(-np.array(MUD_ABSORPTION) * path[:, None])
        depth = np.maximum(depth + path * down, 0.0)
        reflected = fresnel(np.abs(down), IOR)
        out = leaves & (rng.random(len(depth)) >= reflected)
        escaped += weight[out].sum(0)
        down = np.where(leaves, np.abs(down), rng.uniform(-1, 1, len(depth)))
        keep = ~out & (weight.max(1) > 1e-4)
        depth, down, weight = depth[keep], down[keep], weight[keep]
    mu = (np.arange(1000) + 0.5) / 1000
    transmitted = float(np.mean(2 * mu * (1 - fresnel(mu, 1 / IOR))))
    reflectance = escaped / photons / transmitted
    return 1.055 * np.maximum(reflectance, 0.0031308) ** (1 / 2.4) - 0.055


def fresnel(cosine: Float[np.ndarray, "*n"], ratio: float) -> Float[np.ndarray, "*n"]:
    """Return the unpolarised reflectance of a flat dielectric, 1 beyond the critical angle.

    `ratio` is the refractive index on this side over that on the other side.
    """
    squared = 1 - ratio**2 * (1 - cosine**2)
    other = np.sqrt(np.maximum(squared, 0.0))
    s = (ratio * cosine - other) / (ratio * cosine + other)
    p = (cosine - ratio * other) / (cosine + ratio * other)
    return np.where(squared <= 0, 1.0, 0.5 * (s**2 + p**2))


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
