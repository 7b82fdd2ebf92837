"""Optics of flood water: parts of pixels, reflection, refraction and attenuation.

World frame, metres, z up. Directions are unit vectors. `below` is True for rays whose origin is
under water. Radiance is *basic* radiance, L/n^2: a flat interface only splits it into the fractions
R and 1 - R, so white surroundings stay white on both sides. Normals point up; slopes are
(dz/dx, dz/dy). Shapes: n rays, last axis the components.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.srgb import linear_colour
from climatenerf.weather.flood.fresnel import (
    diffuse_reflectances,
    reflectance,
    slope_averaged,
)
from climatenerf.weather.flood.parameters import Flood

# Koschmieder's law for the path down and up: a white disc at the depth `clarity` keeps 2 % of its
# contrast.
_CLARITY = -math.log(0.02) / 2
# Relative absorption of red, green and blue by suspended clay and dissolved matter; mean 1.
_MUD = (0.75, 0.95, 1.3)
# Absorption of pure water, 1/m (Pope and Fry 1997, mean over the band of each sRGB primary).
_PURE = (0.3, 0.06, 0.01)
DEEP = ((0.3, (0.488, 0.406, 0.32)), (6.0, (0.1, 0.26, 0.3)))  # m of clarity, display sRGB
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples spread evenly over columns
_RETURNED_NODES = 10  # for each part of the hemisphere


def plane_distance(
    rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], z: float
) -> Float[Tensor, "n"]:
    """Return the ray length in m to the horizontal plane at height `z` (m), from either side.

    The result is +inf for rays that miss the plane or start in it.
    """
    dz = rays_d[:, 2]
    horizontal = dz.abs() < 1e-9  # no 0/0 for horizontal rays, nor in their gradient
    t = (z - rays_o[:, 2]) / torch.where(horizontal, torch.ones_like(dz), dz)
    return torch.where(horizontal | (t <= 0), torch.full_like(t, torch.inf), t)


def footprint(
    t: Float[Tensor, "n"], rays_d: Float[Tensor, "n 3"], pixel_angle: Float[Tensor, "n"] | float
) -> Float[Tensor, "n"]:
    """Return the size in m of a pixel on the water: geometric mean of its width and its length.

    At grazing angles a pixel's footprint is long and narrow. Its width alone would alias waves
    along the footprint; its length alone would blur away waves across it.

    Args:
        t: ray length to the water, m.
        rays_d: unit ray directions.
        pixel_angle: angle that a pixel spans, rad.
    """
    return t * pixel_angle / torch.sqrt(rays_d[:, 2].abs().clamp(min=1e-4))  # horizontal ray: x/0


def shore_coverage(
    t_plane: Float[Tensor, "n"],
    t_ground: Float[Tensor, "n"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"] | float,
    ground_normal: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "n"]:
    """Return the fraction of each pixel that water covers.

    It is 1/2 at the waterline, and 0 or 1 at half a pixel or more from it.
    The distance to the waterline in pixels is (t_ground - t_plane) over its change per pixel, which
    follows from the two planes. It increases with the water level for every ray, so a higher level
    floods a superset of pixels.

    Args:
        t_plane: ray length to the water plane, m; +inf for rays that miss it.
        t_ground: ray length to the solid surface, m; +inf for sky.
        rays_d: unit ray directions.
        pixel_angle: angle that a pixel spans, rad.
        ground_normal: unit normal of that surface; None: it faces the ray.

    Returns:
        Coverage in [0, 1].
    """
    finite = torch.isfinite(t_plane) & torch.isfinite(t_ground)
    tg = torch.where(finite, t_ground, torch.ones_like(t_ground))
    tp = torch.where(finite, t_plane, torch.zeros_like(t_plane))
    up = torch.zeros_like(rays_d)
    up[:, 2] = 1
    change = _relative_length_gradient(rays_d, up)
    if ground_normal is not None:
        change = change - _relative_length_gradient(rays_d, ground_normal)
    # The floor, a tenth of a pixel seen head-on, is for ground parallel to the water: 0/0.
    per_pixel = (change.norm(dim=-1)).clamp(min=0.1) * tg * pixel_angle
    soft = (0.5 + (tg - tp) / per_pixel.clamp(min=1e-9)).clamp(0, 1)
    return torch.where(finite, soft, torch.isfinite(t_plane).to(soft.dtype))


def _relative_length_gradient(
    d: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Return (1/t) dt/d(angle) of the ray length t to a plane, 1/rad, as a vector across the ray.

    It is minus the normal's component across the ray over its component along the ray; the sign
    cancels in `shore_coverage`, which takes the norm.
    """
    along = (d * normal).sum(-1, keepdim=True)
    # For a plane seen edge-on the gradient is unbounded; 1e-3 keeps it finite.
    safe = torch.where(along < 0, along.clamp(max=-1e-3), along.clamp(min=1e-3))
    return (normal - along * d) / safe


def normal_of(slope: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
    """Return the upward unit normal of a surface with the slope (dz/dx, dz/dy)."""
    raw = torch.cat([-slope, torch.ones_like(slope[..., :1])], dim=-1)
    return raw / raw.norm(dim=-1, keepdim=True)


def mirror(d: Float[Tensor, "*#n 3"], normal: Float[Tensor, "*#n 3"]) -> Float[Tensor, "*#n 3"]:
    """Return the direction of the mirrored ray."""
    return d - 2 * (d * normal).sum(-1, keepdim=True) * normal


def refract(
    d: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], ior: float, below: Bool[Tensor, "n"]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Refract rays by Snell's law into the water, or out of it for rays from below.

    Args:
        d: unit ray directions.
        normal: upward unit normals.
        ior: refractive index of the water (air is 1).
        below: True for rays that arrive from under water.

    Returns:
        Unit direction on the other side; and True where the ray is totally reflected (then the
        direction runs along the surface and transmits no light).
    """
    facing = torch.where(below[:, None], -normal, normal)
    eta = torch.where(below, torch.full_like(d[:, 0], ior), torch.full_like(d[:, 0], 1 / ior))
    cos = -(d * facing).sum(-1)
    cos2_t = 1 - eta**2 * (1 - cos**2)
    # The floor keeps the gradient of the square root finite at the critical angle.
    bend = eta * cos - torch.sqrt(cos2_t.clamp(min=1e-12))
    out = eta[:, None] * d + bend[:, None] * facing
    return out / out.norm(dim=-1, keepdim=True), cos2_t <= 0


def subpixels(
    rays_d: Float[Tensor, "n 3"], pixel_angle: Float[Tensor, "n"], count: int
) -> Float[Tensor, "n k 3"]:
    """Return directions spread over each pixel: a lattice of rank 1, finest along the view.

    A pixel's footprint on water is longer than wide, so rows matter most.

    Args:
        rays_d: unit directions through the pixels' centres.
        pixel_angle: angle that a pixel spans, rad.
        count: directions a pixel; 1: its centre.
    """
    k = torch.arange(count, device=rays_d.device) + 0.5
    row, column = k / count - 0.5, (k * _GOLDEN) % 1 - 0.5
    across = _across(rays_d)
    within = torch.linalg.cross(rays_d, across)
    offset = row[:, None] * within[:, None] + (column - column.mean())[:, None] * across[:, None]
    d = rays_d[:, None] + pixel_angle[:, None, None] * offset
    return d / d.norm(dim=-1, keepdim=True)


def part_width(count: int) -> float:
    """Return the width to which waves are filtered for one of a pixel's parts, in pixels.

    Parts lie in as many rows and columns as there are, and share the area of one pixel.
    """
    return count**-0.75


def facets(
    rays_d: Float[Tensor, "n k 3"],
    slope: Float[Tensor, "n k 2"],
    variance: Float[Tensor, "n k"],
    flood: Flood,
    below: Bool[Tensor, "n"],
) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, "n k"]]:
    """Return one reflected ray for each part of a pixel, and its share of the pixel's light.

    Each part has a facet of its own: its resolved slope and a draw from those unresolved slopes
    that the viewer can see. The draws have the mean and the variance of these
    (`fresnel.slope_averaged`), and are the same in all pixels. A facet counts by its own Fresnel
    reflectance; what the draws err in the mean reflectance is corrected. Tilting a facet by sigma
    rotates the reflection by 2 sigma, so the spread 1/gloss of the reflection lobe is a slope
    variance of 1/(4 gloss).

    Args:
        rays_d: unit directions of the rays that arrive at the surface.
        slope: resolved slope (dz/dx, dz/dy) where they do.
        variance: unresolved slope variance per axis.
        flood: gloss and refractive index.
        below: True for rays that arrive from under water.

    Returns:
        Unit directions of the reflected rays, and their shares; the sum of a pixel's shares is its
        reflectance.
    """
    count = rays_d.shape[1]
    side = torch.where(below, -1.0, 1.0).to(rays_d)[:, None]
    facing = -(rays_d * normal_of(slope)).sum(-1) * side
    unresolved = variance.mean(1) + 1 / (4 * flood.gloss)
    average, tilt, visible = slope_averaged(facing.mean(1), unresolved, flood.ior, below)
    # Visible facets are tilted towards the viewer: above water they rise away from the viewer.
    flat = rays_d[..., :2]
    away = flat / flat.norm(dim=-1, keepdim=True).clamp_min(1e-6)  # 0/0 at the nadir
    across = torch.stack([-away[..., 1], away[..., 0]], dim=-1)
    draws = _draws(count, rays_d.device)
    # The floors keep the gradients of the square roots finite.
    along = tilt[:, None] * side + visible.clamp_min(1e-20).sqrt()[:, None] * draws[:, 0]
    cross = unresolved.clamp_min(1e-20).sqrt()[:, None] * draws[:, 1]
    drawn = along[..., None] * away + cross[..., None] * across
    under = below[:, None].expand_as(facing)

    def seen(normal: Tensor) -> Float[Tensor, "n k"]:
        return reflectance(-(rays_d * normal).sum(-1) * side, flood.ior, under)

    # A few draws err in the mean; at the mean slope the mean is known. 1e-9: no reflection, 0/0.
    usual = seen(normal_of(slope.mean(1, keepdim=True) + drawn)).mean(1)
    normal = normal_of(slope + drawn)
    share = seen(normal) * (average / usual.clamp_min(1e-9) / count)[:, None]
    # What is seen from behind reflects as if edge-on.
    return _clip_to_horizon(mirror(rays_d, normal), below[:, None]), share


def _draws(count: int, device: torch.device) -> Float[Tensor, "k 2"]:
    """Slopes in standard deviations: mean 0, variance 1 along each axis; 0 for a single one."""
    if count == 1:
        return torch.zeros(1, 2, device=device)
    k = torch.arange(count - 1, device=device)
    # Neighbouring rows of the pixel get slopes of opposite sides.
    angle = 2 * math.pi * 3 * k / (count - 1)
    ring = math.sqrt(2 * count / (count - 1)) * torch.stack([angle.cos(), angle.sin()], -1)
    middle = count // 2
    return torch.cat([ring[:middle], torch.zeros(1, 2, device=device), ring[middle:]])


def _across(d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Horizontal unit vectors across directions; any for a vertical one."""
    across = torch.stack([-d[:, 1], d[:, 0], torch.zeros_like(d[:, 0])], dim=-1)
    length = across.norm(dim=-1, keepdim=True)
    east = torch.tensor([1.0, 0, 0], dtype=d.dtype, device=d.device)
    return torch.where(length > 1e-6, across / length.clamp(min=1e-6), east)


def _clip_to_horizon(d: Float[Tensor, "*n 3"], below: Bool[Tensor, "*#n"]) -> Float[Tensor, "*n 3"]:
    """Project rays that point through the water plane onto it."""
    z = torch.where(below, d[..., 2].clamp(max=0), d[..., 2].clamp(min=0))
    flat = torch.cat([d[..., :2], z[..., None]], dim=-1)
    return flat / flat.norm(dim=-1, keepdim=True).clamp(min=1e-6)  # vertical ray: 0/0


def attenuation(flood: Flood) -> tuple[float, float, float]:
    """Return the attenuation beta of red, green and blue in 1/m; mud absorbs blue most."""
    if flood.attenuation is not None:
        return flood.attenuation
    mud = _CLARITY / flood.clarity
    red, green, blue = (p + mud * m for p, m in zip(_PURE, _MUD, strict=True))
    return red, green, blue


def clarity_of(flood: Flood) -> float:
    """Return the depth in m at which a white disc keeps 2 % of its contrast in green light."""
    if flood.attenuation is None:
        return flood.clarity
    # 1e-6: water without attenuation shows a disc at any depth.
    return _CLARITY / max(flood.attenuation[1], 1e-6)


def light_cosine(flood: Flood, sun_elevation: float | None) -> float:
    """Return the cosine of the light's angle to the vertical under water.

    Args:
        flood: refractive index.
        sun_elevation: elevation of the sun, rad, refracted by Snell's law; None or at most 0: light
            of a uniform sky.
    """
    if sun_elevation is None or sun_elevation <= 0:
        return 0.83  # the mean of 1/cos over refracted diffuse light is 1.2
    return math.sqrt(1 - (math.cos(sun_elevation) / flood.ior) ** 2)


def water_transmittance(
    beta: Float[Tensor, "3"],
    path: Float[Tensor, "n"],
    depth: Float[Tensor, "n"],
    light_cos: float,
) -> Float[Tensor, "n 3"]:
    """Return t_c = exp(-beta_c (D + d/cos)) for the way of light down to a point and to the viewer.

    Args:
        beta: attenuation of each channel, 1/m.
        path: length D of the view path under water, m; may be +inf.
        depth: vertical depth d of the point, m.
        light_cos: cosine of the light's angle under water, see `light_cosine`.
    """
    total = (path + depth.clamp(min=0) / light_cos).clamp(0, 1e6)  # 0 * inf would be NaN
    return torch.exp(-beta * total[:, None])


def bottom_radiance(
    dry: Float[Tensor, "*n 3"],
    irradiance: Float[Tensor, "*#n 3"],
    ior: float,
    entering: float | None = None,
    optical_depth: Float[Tensor, "*n 3"] | None = None,
    body: Float[Tensor, "*#n 3"] | None = None,
) -> Float[Tensor, "*n 3"]:
    """Return the radiance of the bottom under water from the radiance of the dry ground.

    L_bottom = L_t (1 - r_e)/(n^2 (1 - rho r_i)): 1 - r_e of the light enters, the surface reflects
    the fraction r_i of the light from the bottom back down, and the rest spreads over n^2 when it
    leaves. The albedo rho = pi L_t/E is clamped to [0, 1]. For rho = 1 the factor is exactly 1,
    since 1 - r_e = n^2 (1 - r_i). What the first way down and the way to the viewer absorb is not
    included; see `water_transmittance`.

    Args:
        dry: linear radiance L_t of the dry ground.
        irradiance: E on horizontal ground, linear, per channel.
        ior: refractive index of the water.
        entering: fraction of the light that enters the water; None: 1 - r_e, for diffuse light. For
            sunlight it is 1 - R at the sun's angle.
        optical_depth: of the water above the bottom, which light between surface and bottom
            crosses again and again; None: 0.
        body: radiance c_w of deep water, which replaces what is absorbed on that way; None: 0.
    """
    r_e, r_i = diffuse_reflectances(ior)
    albedo = (math.pi * dry / irradiance.clamp(min=1e-6)).clamp(0, 1)  # a black scene: 0/0
    entering = 1 - r_e if entering is None else entering
    if optical_depth is None:
        return dry * entering / (ior**2 * (1 - albedo * r_i))
    back = returned(optical_depth, ior)
    own = 0.0 if body is None else albedo * (r_i - back).clamp_min(0) * body
    return (dry * entering / ior**2 + own) / (1 - albedo * back)


def returned(optical_depth: Float[Tensor, "*n 3"], ior: float) -> Float[Tensor, "*n 3"]:
    """Return the fraction of a diffuse bottom's light that the surface sends back to it.

    The integral of 2 mu R(mu) exp(-2 tau/mu) over the cosine mu, with the reflectance R from below.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_RETURNED_NODES)
    critical = math.sqrt(1 - 1 / ior**2)  # flatter rays are reflected totally
    parts = ((0.0, critical), (critical, 1.0))
    mu = optical_depth.new_tensor(np.concatenate([a + (b - a) * (nodes + 1) / 2 for a, b in parts]))
    width = optical_depth.new_tensor(np.concatenate([(b - a) * weights / 2 for a, b in parts]))
    weight = 2 * mu * width * reflectance(mu, ior, below=True)
    weight = weight * (diffuse_reflectances(ior)[1] / weight.sum())  # exact without absorption
    return (weight * torch.exp(-2 * optical_depth[..., None].clamp_max(50.0) / mu)).sum(-1)


def body_colour(flood: Flood, irradiance: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Return the radiance c_w of deep water: its colour times that of a lit white diffuser.

    Args:
        flood: colour of the water.
        irradiance: E on horizontal ground, linear, per channel.
    """
    return irradiance.new_tensor(deep_colour(flood)) * irradiance / math.pi


def deep_colour(flood: Flood) -> tuple[float, float, float]:
    """Return the linear colour of deep water under a white sky: as asked, else by its clarity.

    It goes from brown to blue-green and darkens as the water clears, as on the scale of Forel and
    Ule; muddy and clear water are the ends of a mixture over the logarithm of the clarity.
    """
    if flood.colour is not None:
        return linear_colour(flood.colour)
    low, high = (math.log(clarity) for clarity, _ in DEEP)
    mud, clear = (linear_colour(colour) for _, colour in DEEP)
    part = min(max((math.log(clarity_of(flood)) - low) / (high - low), 0.0), 1.0)
    red, green, blue = (m + part * (c - m) for m, c in zip(mud, clear, strict=True))
    return red, green, blue


def shade(
    reflected: Float[Tensor, "*n 3"],
    reflectance: Float[Tensor, "*n"],
    background: Float[Tensor, "*n 3"],
    transmittance: Float[Tensor, "*n 3"],
    body: Float[Tensor, "*#n 3"],
) -> Float[Tensor, "*n 3"]:
    """Return c = R L_r + (1 - R)(L_b t_c + (1 - t_c) c_w), linear radiance.

    Args:
        reflected: weighted sum L_r of the reflected rays' radiance.
        reflectance: mean reflectance R.
        background: radiance L_b on the other side: the bottom's, or under water the radiance in air
            along the refracted ray.
        transmittance: transmittance t_c of the water in front of it; ones under water.
        body: c_w, see `body_colour`.
    """
    reflectance = reflectance[:, None]
    transmitted = background * transmittance + (1 - transmittance) * body
    return reflectance * reflected + (1 - reflectance) * transmitted
