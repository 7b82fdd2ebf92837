"""Flood water: where rays meet it, where they go on, and what comes back.

Directions are unit length, z is up, `below` marks rays whose eye is in the water. Radiance is
*basic* radiance, L/n^2, which a flat interface only splits into R and 1 - R: so white surroundings
stay white on both sides. Normals point up; slopes are (dz/dx, dz/dy).
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.weather.flood.fresnel import diffuse_reflectances, slope_averaged
from climatenerf.weather.parameters import Flood, linear_colour

# Koschmieder for the path down and up: a white disc at the clarity keeps 2 % of its contrast.
_CLARITY = -math.log(0.02) / 2
# Suspended clay and dissolved matter take more blue than red, on average 1.
_MUD = (0.75, 0.95, 1.3)
# Pure water itself, 1/m (Pope and Fry 1997, mean of each sRGB primary's band).
_PURE = (0.3, 0.06, 0.01)
_WIDEST = math.pi / 3  # sigma points farther out would lie behind the reflection


def plane_distance(
    rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], z: float
) -> Float[Tensor, "n"]:
    """Ray length to the level plane at height `z`, from either side; +inf where it is missed."""
    dz = rays_d[:, 2]
    flat = dz.abs() < 1e-9  # no 0/0 for level rays, nor in their gradient
    t = (z - rays_o[:, 2]) / torch.where(flat, torch.ones_like(dz), dz)
    return torch.where(flat | (t <= 0), torch.full_like(t, torch.inf), t)


def footprint(
    t: Float[Tensor, "n"], rays_d: Float[Tensor, "n 3"], pixel_angle: Float[Tensor, "n"] | float
) -> Float[Tensor, "n"]:
    """Width in m that a pixel has on the water: geometric mean of its width and its length.

    At grazing a pixel is long and narrow; its width alone would let the waves along it alias, its
    length alone would blur away the ones across it.
    """
    return t * pixel_angle / torch.sqrt(rays_d[:, 2].abs().clamp(min=1e-4))  # level rays: x/0


def shore_coverage(
    t_plane: Float[Tensor, "n"],
    t_ground: Float[Tensor, "n"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"] | float,
    ground_normal: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "n"]:
    """Share of a pixel that water covers: 1/2 at the waterline, 0 and 1 half a pixel from it.

    The distance to the waterline is (t_ground - t_plane) over its change from pixel to pixel, which
    follows from the two planes. It rises with the level for any ray, so flooded sets are nested.

    Args:
        t_plane: ray length to the water plane, m; +inf where it is missed.
        t_ground: ray length to the solid surface, m; +inf for sky.
        rays_d: ray directions.
        pixel_angle: angle that a pixel spans, rad.
        ground_normal: unit normal of that surface; None: it faces the eye.

    Returns:
        Coverage in [0, 1].
    """
    ends = torch.isfinite(t_plane) & torch.isfinite(t_ground)
    tg = torch.where(ends, t_ground, torch.ones_like(t_ground))
    tp = torch.where(ends, t_plane, torch.zeros_like(t_plane))
    up = torch.zeros_like(rays_d)
    up[:, 2] = 1
    change = _slant(rays_d, up)
    if ground_normal is not None:
        change = change - _slant(rays_d, ground_normal)
    # The floor, a tenth of a head-on pixel, is for ground level with the water: 0/0.
    per_pixel = (change.norm(dim=-1)).clamp(min=0.1) * tg * pixel_angle
    soft = (0.5 + (tg - tp) / per_pixel.clamp(min=1e-9)).clamp(0, 1)
    return torch.where(ends, soft, torch.isfinite(t_plane).to(soft.dtype))


def _slant(d: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Change of a plane's ray length per angle, over that length: the normal across the ray."""
    along = (d * normal).sum(-1, keepdim=True)
    # A plane seen edge on changes without bound; 1e-3 keeps it finite.
    safe = torch.where(along < 0, along.clamp(max=-1e-3), along.clamp(min=1e-3))
    return (normal - along * d) / safe


def normal_of(slope: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Upward unit normal of a surface with the given slope."""
    raw = torch.cat([-slope, torch.ones_like(slope[:, :1])], dim=-1)
    return raw / raw.norm(dim=-1, keepdim=True)


def mirror(d: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Direction of the reflected ray."""
    return d - 2 * (d * normal).sum(-1, keepdim=True) * normal


def refract(
    d: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], ior: float, below: Bool[Tensor, "n"]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Snell's law into the water, or out of it for eyes below.

    Returns:
        Unit direction on the other side, and whether the ray is totally reflected instead (then
        the direction runs along the surface and carries nothing).
    """
    facing = torch.where(below[:, None], -normal, normal)
    eta = torch.where(below, torch.full_like(d[:, 0], ior), torch.full_like(d[:, 0], 1 / ior))
    cos = -(d * facing).sum(-1)
    cos2_t = 1 - eta**2 * (1 - cos**2)
    # The floor keeps the gradient of the square root finite at the critical angle.
    bend = eta * cos - torch.sqrt(cos2_t.clamp(min=1e-12))
    out = eta[:, None] * d + bend[:, None] * facing
    return out / out.norm(dim=-1, keepdim=True), cos2_t <= 0


def pixel_roll(pixel: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """An angle in [0, pi/2) for each pixel that differs from its neighbours' (Jimenez 2014).

    Turning the glossy rays by it trades the five ghost images of a fixed set for fine grain, which
    supersampling averages away. It depends on the pixel alone, so on no chunk or thread.
    """
    x, y = pixel[:, 0].double(), pixel[:, 1].double()
    noise = (52.9829189 * (0.06711056 * x + 0.00583715 * y).frac()).frac()
    return (noise * math.pi / 2).to(pixel.dtype)


def glossy_rays(
    reflected: Float[Tensor, "n 3"],
    tall: Float[Tensor, "n"],
    wide: Float[Tensor, "n"],
    below: Bool[Tensor, "n"],
    roll: Float[Tensor, "n"] | None = None,
) -> tuple[Float[Tensor, "n 5 3"], Float[Tensor, "5"]]:
    """Sigma-point set of the reflection's lobe: five rays that stand for all of it.

    With `tall` = `wide` = 1/lambda these are the specification's: the lobe's axis and four rays
    sqrt(3/lambda) from it.

    Args:
        reflected: axis of the lobe.
        tall: variance of the lobe within the vertical plane, rad^2.
        wide: variance across it, rad^2.
        below: eyes in the water; their rays are kept at or below the horizon, others above it.
        roll: turn of the four rays about the axis, rad; the set's variances do not depend on it.

    Returns:
        Directions (the axis first) and their weights, 1/3 and four times 1/6.
    """
    zeros = torch.zeros_like(tall)
    across = torch.stack([-reflected[:, 1], reflected[:, 0], zeros], dim=-1)
    length = across.norm(dim=-1, keepdim=True)
    east = torch.tensor([1.0, 0, 0], dtype=across.dtype, device=across.device)
    across = torch.where(length > 1e-6, across / length.clamp(min=1e-6), east)  # straight up: any
    within = torch.linalg.cross(reflected, across)
    roll = zeros if roll is None else roll
    up, side = _sigma_angle(tall)[:, None] * within, _sigma_angle(wide)[:, None] * across
    rays = [reflected]
    for quarter in range(4):
        turn = (roll + quarter * math.pi / 2)[:, None]
        offset = torch.cos(turn) * up + torch.sin(turn) * side
        angle = offset.norm(dim=-1, keepdim=True)  # > 0, see _sigma_angle
        rays.append(torch.cos(angle) * reflected + torch.sin(angle) / angle * offset)
    weights = torch.tensor([1 / 3] + 4 * [1 / 6], dtype=tall.dtype, device=tall.device)
    return _clip_to_horizon(torch.stack(rays, dim=1), below[:, None]), weights


def _sigma_angle(spread: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    return torch.sqrt((3 * spread).clamp(min=1e-20)).clamp(max=_WIDEST)  # sqrt'(0) is infinite


def _clip_to_horizon(d: Float[Tensor, "*n 3"], below: Bool[Tensor, "*n"]) -> Float[Tensor, "*n 3"]:
    """Turn rays that cross the water plane to run along it."""
    z = torch.where(below, d[..., 2].clamp(max=0), d[..., 2].clamp(min=0))
    flat = torch.cat([d[..., :2], z[..., None]], dim=-1)
    return flat / flat.norm(dim=-1, keepdim=True).clamp(min=1e-6)  # straight down: nothing left


def reflection(
    rays_d: Float[Tensor, "n 3"],
    slope: Float[Tensor, "n 2"],
    variance: Float[Tensor, "n"],
    flood: Flood,
    below: Bool[Tensor, "n"],
    roll: Float[Tensor, "n"] | None = None,
) -> tuple[Float[Tensor, "n 5 3"], Float[Tensor, "5"], Float[Tensor, "n"]]:
    """All that a hit on the water needs for its reflection.

    A facet's tilt by sigma turns the reflection by 2 sigma within the plane of incidence and by
    2 sigma cos across it. At the nadir both give 1/lambda = 1/lambda_0 + 4 sigma^2; at grazing the
    lobe is tall and narrow, which is why lights on water draw streaks.

    Args:
        rays_d: rays that arrive at the surface.
        slope: resolved slope there.
        variance: slope variance per axis that is not resolved.
        flood: gloss and refractive index.
        below: eyes in the water.
        roll: see `glossy_rays`.

    Returns:
        Five directions, their weights, and the mean reflectance R, all for the facets that the
        eye can see.
    """
    side = torch.where(below, -torch.ones_like(variance), torch.ones_like(variance))
    cos = -(rays_d * normal_of(slope)).sum(-1) * side
    share, tilt, seen = slope_averaged(cos, variance, flood.ior, below)
    flat = rays_d[:, :2]
    away = flat / flat.norm(dim=-1, keepdim=True).clamp(min=1e-6)  # 0/0 at the nadir
    # Facets that lean towards an eye above rise away from it.
    normal = normal_of(slope + (tilt * side)[:, None] * away)
    cos = (-(rays_d * normal).sum(-1) * side).clamp(0, 1)
    tall, wide = 1 / flood.gloss + 4 * seen, 1 / flood.gloss + 4 * variance * cos**2
    return *glossy_rays(mirror(rays_d, normal), tall, wide, below, roll), share


def attenuation(flood: Flood) -> tuple[float, float, float]:
    """Attenuation beta of red, green and blue in 1/m; muddy water takes blue first."""
    if flood.attenuation is not None:
        return flood.attenuation
    mud = _CLARITY / flood.clarity
    red, green, blue = (p + mud * m for p, m in zip(_PURE, _MUD, strict=True))
    return red, green, blue


def light_cosine(flood: Flood, sun_elevation: float | None) -> float:
    """Cosine in water of the light's angle: the sun's by Snell's law, or that of an even sky."""
    if sun_elevation is None or sun_elevation <= 0:
        return 0.83  # mean of 1/cos over refracted diffuse light is 1.2
    return math.sqrt(1 - (math.cos(sun_elevation) / flood.ior) ** 2)


def water_transmittance(
    beta: Float[Tensor, "3"],
    path: Float[Tensor, "n"],
    depth: Float[Tensor, "n"],
    light_cos: float,
) -> Float[Tensor, "n 3"]:
    """t_c = exp(-beta_c (D + d/cos)): light down through depth d, and along the view path D; m."""
    total = (path + depth.clamp(min=0) / light_cos).clamp(0, 1e6)  # 0 times an endless path is NaN
    return torch.exp(-beta * total[:, None])


def bed_radiance(
    dry: Float[Tensor, "n 3"],
    irradiance: Float[Tensor, "3"],
    ior: float,
    entering: float | None = None,
) -> Float[Tensor, "n 3"]:
    """Radiance L_bed of ground under clear water, from the same ground's dry radiance.

    L_t (1 - r_e)/(n^2 (1 - rho r_i)): less light gets in, part of what the bed returns is turned
    back inside, and it spreads over n^2 when it leaves. The albedo rho = pi L_t/E is held to
    [0, 1]. With rho = 1 the factor is exactly 1, since 1 - r_e = n^2 (1 - r_i).

    Args:
        dry: linear radiance of the dry ground, L_t.
        irradiance: E on level ground, linear.
        ior: refractive index of the water.
        entering: share of the light that enters the water; None: diffuse light, 1 - r_e; for the
            sun 1 - R of its angle.
    """
    r_e, r_i = diffuse_reflectances(ior)
    albedo = (math.pi * dry / irradiance.clamp(min=1e-6)).clamp(0, 1)  # a black scene: 0/0
    share = 1 - r_e if entering is None else entering
    return dry * share / (ior**2 * (1 - albedo * r_i))


def body_colour(flood: Flood, irradiance: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """c_w: radiance of deep water, its colour lit like a white sheet by the scene."""
    return irradiance.new_tensor(linear_colour(flood.colour)) * irradiance / math.pi


def shade(
    reflected: Float[Tensor, "n 3"],
    share: Float[Tensor, "n"],
    behind: Float[Tensor, "n 3"],
    through: Float[Tensor, "n 3"],
    body: Float[Tensor, "3"],
) -> Float[Tensor, "n 3"]:
    """c = R L_r + (1 - R)(L_bed t_c + (1 - t_c) c_w).

    Args:
        reflected: weighted sum of the glossy rays' radiance, L_r.
        share: mean reflectance R.
        behind: radiance on the other side: the bed's, or for eyes below what the refracted ray
            sees in the air.
        through: transmittance t_c of the water before it; ones for eyes below.
        body: c_w.
    """
    share = share[:, None]
    return share * reflected + (1 - share) * (behind * through + (1 - through) * body)
