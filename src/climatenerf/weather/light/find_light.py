"""Find the light of a place from its photos: the sky that they clip or do not show, and the sun.

Surfaces of one class have one albedo on average, so how their radiance varies tells where light
comes from: each surface point sees a part of the sky, and what stands around it. Candidates for the
sky are compared by the mean deviation, over pairs of neighbouring points of one class, of log
radiance from log irradiance.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.classes import PERSON, SKY, VEGETATION, VEHICLE
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.srgb import LUMA
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.compositing import chunks, composited
from climatenerf.field.protocol import RadianceField, device_of, observed
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.weather.light.captured import (
    CLIPPED,
    COLUMNS,
    ROWS,
    CapturedLight,
    UnknownLight,
    elevation_azimuth,
)
from climatenerf.weather.light.sky_fit import (
    DARK,
    DIRECTIONS,
    SkyModel,
    fit_sky,
    gathering_directions,
)

PAIRS = 12000  # of neighbouring surface points
GATHERED_PAIRS = 2400  # whose difference is explained by candidates for the sun
TRIED_PAIRS = 200_000  # of which the few that a shadow's edge parts tell the sun's strength
SHADOW_PAIRS, MIN_SHADOW_PAIRS = 1500, 8  # of these; each alone errs by half
MIN_PAIRS = 300
TRIES = 4  # for each pair; most random pixels do not show one plane
APART = 16  # pixels of the reduced photos between the points of a pair
NEAR_PAIR, FAR_PAIR = 0.15, 2.5  # m between them
ALIKE = np.cos(np.radians(20.0))  # cosine between their normals
STEP = 5.0  # marching step of the rays that gather light
LIFT = 0.06  # m; rays begin so far above a surface, beyond its blurred density
FAR = 40.0  # m; points further from their camera are not used
AMOUNTS = np.geomspace(0.3, 12.0, 8)  # light of the sun over that of the sky, on open ground
LOWEST_SUN = 0.08  # sine of its elevation
ROUNDS = tuple(np.radians([8.0, 2.5]))  # rad, in which the sun's direction is refined
NEIGHBOURS = 61  # directions in each
MARGIN, AROUND_SUN = np.radians(2.5), 9  # of the directions in which a point is lit, or is not
PARTS = 8  # of the pairs, for the error
MIN_GAIN = 0.02  # by which a sun must lower the deviation, relative
MAX_ERROR = np.radians(8.0)
MIN_HALF = 60  # pairs of each half of the photos
TWO_SUNS, CLEAR_GAIN = np.radians(30.0), 0.03  # of suns that contradict each other
MIN_STANDARD_ERRORS = 1.5  # in the gain of each by pairs that it was not chosen by
ALMANAC_ERROR = np.radians(3.0)  # of the sun by date, time and place: north is that of GPS
MIN_SUN = 0.15  # light of a sun without sure shadows, or of a lobe, over that of the sky
MIN_SKY, MAX_SKY = 50, 1500  # pixels of the reduced photos that show sky
MIN_CLIPPED = 0.02  # fraction of the sky that photos show as white, for a lobe


@dataclass(frozen=True)
class Gathered:
    """Light that arrives at pairs of surface points from `DIRECTIONS`.

    Attributes:
        pairs: the points.
        weights: solid angle times cosine of each direction, 0 behind the surface.
        through: fraction of the sky's light that arrives.
        bounced: irradiance by surfaces.
    """

    pairs: "Pairs"
    weights: Float[np.ndarray, "n k"]
    through: Float[np.ndarray, "n k"]
    bounced: Float[np.ndarray, "n 3"]

    def ambient(self, sky: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "n 3"]:
        """Irradiance of the points under a sky."""
        return (self.weights * self.through) @ sky + self.bounced


@dataclass(frozen=True)
class Pairs:
    """Neighbouring surface points of one plane and class, two after two.

    Attributes:
        x: points, world m.
        normal: unit, towards the camera.
        radiance: towards the camera that shows them.
        late: whether they are from the later half of the photos, by name.
    """

    x: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    late: Bool[np.ndarray, "n"]

    def selected(self, pairs: Int[np.ndarray, "m"]) -> "Pairs":
        """Some of the pairs."""
        rows = np.repeat(2 * pairs, 2)
        rows[1::2] += 1
        return Pairs(self.x[rows], self.normal[rows], self.radiance[rows], self.late[rows])

    @property
    def start(self) -> Float[np.ndarray, "n 3"]:
        """Where rays from the points begin, clear of their blurred density."""
        return self.x + LIFT * self.normal


@torch.no_grad()
def find_pairs(
    field: RadianceField, photos: list[PhotoRays], count: int, rng: np.random.Generator
) -> Pairs | None:
    """Choose pairs of neighbouring pixels at random; None if there are too few.

    Args:
        field: without unobserved density.
        photos: rays of its photos.
        count: number of pairs wanted.
        rng: source of randomness.
    """
    tries, classes = TRIES * count // len(photos) + 1, CLASSES in field.capabilities
    found = [_neighbours(photo, tries, classes, rng) for photo in photos]
    x, d, eye, normal = (np.concatenate([pair[k] for pair in found]) for k in range(4))
    if len(x) < MIN_PAIRS:
        return None
    order = np.argsort(np.argsort([photo.view.name for photo in photos]))
    late = np.concatenate(
        [
            np.full((len(pair[0]), 2), rank >= len(photos) / 2)
            for rank, pair in zip(order, found, strict=True)
        ]
    )
    chosen = rng.choice(len(x), min(count, len(x)), replace=False)
    x, d, eye, normal = (v[chosen].reshape(-1, 3) for v in (x, d, eye, normal))
    radiance = to_numpy(_surface_radiance(field, _sent(eye, field), _sent(d, field)))
    valid = (radiance.min(-1) > DARK) & (radiance.max(-1) < CLIPPED)
    pairs = Pairs(x, normal, radiance, late[chosen].reshape(-1))
    usable = np.flatnonzero(valid.reshape(-1, 2).all(1))
    return pairs.selected(usable) if len(usable) >= MIN_PAIRS // 2 else None


@torch.no_grad()
def gather_light(field: RadianceField, pairs: Pairs) -> Gathered:
    """Gather the light that arrives at pairs of points in a field without unobserved density."""
    directions = gathering_directions()
    cosine = pairs.normal @ directions.T
    weights = np.where(cosine > 0.05, cosine, 0.0) * (4 * np.pi / DIRECTIONS)
    start = _sent(pairs.start, field)
    through, bounced = arriving(field, start, _sent(directions, field), weights > 0)
    return Gathered(pairs, weights, through, np.einsum("nk,nkc->nc", weights, bounced))


def _sent(values: np.ndarray, field: RadianceField) -> Tensor:
    return to_device(np.ascontiguousarray(values, np.float32), device_of(field))


def _neighbours(
    photo: PhotoRays, count: int, classes: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ends, directions, eyes and normals of pairs of pixels that show one plane of one class.

    Without `classes` the labels of a field that has learned none are left out.
    """
    height, width = photo.t.shape
    row, column = rng.integers(height, size=count), rng.integers(width, size=count)
    shift = rng.integers(-APART, APART + 1, (count, 2))
    other = row + shift[:, 0], column + shift[:, 1]
    inside = (other[0] >= 0) & (other[0] < height) & (other[1] >= 0) & (other[1] < width)
    ends = [(row[inside], column[inside]), (other[0][inside], other[1][inside])]
    x, d, normal = (
        np.stack([values[at] for at in ends], 1) for values in (photo.x, photo.d, photo.normal)
    )
    t, label = (np.stack([values[at] for at in ends], 1) for values in (photo.t, photo.label))
    with np.errstate(invalid="ignore"):
        gap = x[:, 1] - x[:, 0]
        distance = np.linalg.norm(gap, axis=-1)
        aside = np.abs((gap * normal[:, 0]).sum(-1))
    usable = np.isfinite(t).all(1) & (t.max(1) < FAR)
    if classes:
        usable &= label[:, 0] == label[:, 1]
        usable &= ~np.isin(label[:, 0], (PERSON, VEHICLE, SKY, VEGETATION))
    usable &= (normal[:, 0] * normal[:, 1]).sum(-1) > ALIKE
    usable &= (distance > NEAR_PAIR) & (distance < FAR_PAIR) & (aside < 0.15 * distance)
    eye = np.broadcast_to(photo.c2w[:3, 3], x.shape)
    return x[usable], d[usable], eye[usable], normal[usable]


def arriving(
    field: RadianceField,
    x: Float[Tensor, "n 3"],
    directions: Float[Tensor, "k 3"],
    wanted: Bool[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k 3"]]:
    """Fraction of the sky's light and radiance of surfaces that arrive at points x (world m).

    Only pairs of points and directions that are `wanted` are traced; others have 0.
    """
    through = np.zeros(wanted.shape, np.float32)
    bounced = np.zeros((*wanted.shape, 3), np.float32)
    row, column = np.nonzero(wanted)
    rows, columns = to_device(row, x.device), to_device(column, x.device)
    for chunk in chunks(rows):
        o, d = x[rows[chunk]], directions[columns[chunk]].contiguous()
        start = torch.zeros(len(o), device=o.device)
        matter, passed, _ = composited(field, o, d, start, STEP, stop=1e-2)
        through[row[chunk], column[chunk]] = to_numpy(passed)
        bounced[row[chunk], column[chunk]] = to_numpy(matter)
    return through, bounced


def _surface_radiance(
    field: RadianceField, o: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    parts = []
    for chunk in chunks(o):
        near = torch.full((len(o[chunk]),), field.near, device=o.device)
        matter, passed, _ = composited(field, o[chunk], d[chunk], near)
        parts.append(matter / (1 - passed).clamp_min(0.5)[:, None])
    return torch.cat(parts)


# --- the sky that photos show ---------------------------------------------------------------------


def shown_sky(photos: list[PhotoRays]) -> Float[np.ndarray, "rows columns"]:
    """Fraction of each cell of directions that photos show as sky."""
    counts = np.zeros((ROWS, COLUMNS))
    for photo in photos:
        clear = np.isinf(photo.t) & (photo.transmittance > 0.99) & (photo.d[..., 2] > 0)
        d = photo.d[clear]
        row = (np.arcsin(np.clip(d[:, 2], 0, 1)) / (np.pi / 2) * ROWS).astype(int)
        column = (np.arctan2(d[:, 0], d[:, 1]) % (2 * np.pi) / (2 * np.pi) * COLUMNS).astype(int)
        np.add.at(counts, (row.clip(0, ROWS - 1), column % COLUMNS), 1)
    return np.clip(counts / 4, 0, 1)


# --- which sun explains the surfaces --------------------------------------------------------------


@dataclass(frozen=True)
class HardSun:
    """A sun found from its shadows.

    Attributes:
        direction: unit vector towards it.
        error: standard error of the direction, rad.
        gain: by which it lowers the mean deviation, relative.
        halves: the suns that explain the earlier and the later half of the photos best, if these
            are two: neither half's sun explains the other half.
    """

    direction: Float[np.ndarray, "3"]
    error: float
    gain: float
    halves: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None


def deviations(
    radiance: Float[np.ndarray, "n"],
    ambient: Float[np.ndarray, "n"],
    direct: Float[np.ndarray, "n m"],
) -> Float[np.ndarray, "pairs m"]:
    """Deviation of each pair's log radiance from its log irradiance, for m candidates.

    Both points of a pair have one albedo on average, which their difference leaves out.
    """
    # 1e-4: a point that nothing reaches has no logarithm.
    log = np.log(radiance)[:, None] - np.log(np.maximum(ambient[:, None] + direct, 1e-4))
    return np.abs(log[::2] - log[1::2])


def hard_sun(field: RadianceField, gathered: Gathered, sky: Float[np.ndarray, "k 3"]) -> HardSun:
    """Return the sun whose shadows explain the surfaces best, however little it explains.

    Args:
        field: without unobserved density.
        gathered: light at surface points.
        sky: radiance of the sky in `gathering_directions`, 0 below the horizon.
    """
    pairs, directions = gathered.pairs, gathering_directions()
    radiance, ambient = pairs.radiance @ LUMA, gathered.ambient(sky) @ LUMA
    level = float(np.clip(directions[:, 2], 0, 1) @ sky @ LUMA) * 4 * np.pi / DIRECTIONS
    none = deviations(radiance, ambient, np.zeros((len(ambient), 1)))[:, 0]

    def search(
        candidates: Float[np.ndarray, "k 3"], through: Float[np.ndarray, "n k"]
    ) -> Float[np.ndarray, "pairs k"]:
        """Deviations at the best amount of each candidate."""
        best = []
        for k, candidate in enumerate(candidates):
            facing = np.clip(pairs.normal @ candidate, 0, 1) * through[:, k]
            found = deviations(radiance, ambient, facing[:, None] * AMOUNTS * level / candidate[2])
            best.append(found[:, int(found.mean(0).argmin())])
        return np.stack(best, -1)

    near = directions[directions[:, 2] > LOWEST_SUN]
    found = search(near, gathered.through[:, directions[:, 2] > LOWEST_SUN])
    halves = _contradiction(near, found, none, pairs.late[::2])
    start = _sent(pairs.start, field)
    for spread in ROUNDS:
        near = _around(near[found.mean(0).argmin()], spread, NEIGHBOURS)
        near = near[near[:, 2] > LOWEST_SUN]
        through, _ = arriving(field, start, _sent(near, field), pairs.normal @ near.T > 0.05)
        found = search(near, through)
    middle = near[found.mean(0).argmin()]
    # Jackknife: leave out one part of the pairs after another.
    parts = np.arange(len(found)) % PARTS
    left = np.stack([near[found[parts != part].mean(0).argmin()] for part in range(PARTS)])
    angles = np.arccos(np.clip(left @ middle, -1, 1))
    error = float(np.sqrt((PARTS - 1) / PARTS * (angles**2).sum() + (ROUNDS[-1] / 4) ** 2))
    return HardSun(middle, error, float(_gain(found, none).max()), halves)


def _contradiction(
    candidates: Float[np.ndarray, "k 3"],
    found: Float[np.ndarray, "pairs k"],
    none: Float[np.ndarray, "pairs"],
    late: Bool[np.ndarray, "pairs"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """The suns of both halves of the photos, if each explains its own half alone.

    Args:
        candidates: directions.
        found: deviations of pairs at each candidate.
        none: their deviations without a sun.
        late: whether pairs are of the later half.
    """
    if min(late.sum(), (~late).sum()) < MIN_HALF:
        return None
    halves = [(found[half], none[half]) for half in (~late, late)]
    first, second = (_gain(*half) for half in halves)
    a, b = int(first.argmax()), int(second.argmax())
    apart = candidates[a] @ candidates[b] < np.cos(TWO_SUNS)
    explained = min(first[a], second[b]) > CLEAR_GAIN
    explained = explained and all(_surely_explained(*half) for half in halves)
    alone = first[b] < 0 and second[a] < 0
    return (candidates[a], candidates[b]) if apart and explained and alone else None


def _gain(
    found: Float[np.ndarray, "pairs k"], none: Float[np.ndarray, "pairs"]
) -> Float[np.ndarray, "k"]:
    """By how much each candidate lowers the mean deviation, relative."""
    return 1 - found.mean(0) / max(none.mean(), 1e-9)  # pairs without any contrast: 0/0


def _surely_explained(
    found: Float[np.ndarray, "pairs k"], none: Float[np.ndarray, "pairs"]
) -> bool:
    """Whether the best candidate of every second pair lowers the others' deviations as well.

    The best of 180 candidates lowers the mean deviation of 150 noisy pairs by some 5 %. Only the
    strength of each candidate is chosen by all pairs.
    """
    less = np.empty(len(none))
    for start in (0, 1):
        chosen = np.arange(len(none)) % 2 == start
        less[~chosen] = (none - found[:, int(found[chosen].mean(0).argmin())])[~chosen]
    return bool(less.mean() > MIN_STANDARD_ERRORS * less.std() / np.sqrt(len(less)))


def sun_strength(
    field: RadianceField,
    pairs: Pairs,
    sun: Float[np.ndarray, "3"],
    sky: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, "3"]:
    """Irradiance across the sun's rays, from pairs of which one point is lit and one in shadow.

    L_lit/L_shadow = (E_lit + E_sun cos)/E_shadow for each of them. Geometry misplaces shadows a
    little, so a point counts if it is lit, or in shadow, from all directions near the sun.

    Args:
        field: without unobserved density.
        pairs: many; the few that a shadow's edge parts are chosen.
        sun: unit vector towards the sun.
        sky: radiance of the sky in `gathering_directions`, 0 below the horizon.

    Returns:
        Irradiance; 0 if no shadow is found.
    """
    facing = np.clip(pairs.normal @ sun, 0, 1)
    start = _sent(pairs.start, field)
    near = _around(sun, MARGIN, AROUND_SUN)
    wanted = np.repeat(facing[:, None] > 0.2, len(near), axis=1)
    through, _ = arriving(field, start, _sent(near, field), wanted)
    lit = np.all(through > 0.9, axis=1)
    shadow = np.all(wanted & (through < 0.1), axis=1)
    parted = (lit[::2] & shadow[1::2]) | (shadow[::2] & lit[1::2])
    chosen = np.flatnonzero(parted)[:SHADOW_PAIRS]
    if len(chosen) < MIN_SHADOW_PAIRS:
        return np.zeros(3)
    ambient = gather_light(field, pairs.selected(chosen)).ambient(sky)
    bright = 2 * np.arange(len(chosen)) + (~lit[::2])[chosen]
    dark = bright ^ 1
    radiance, cosine = pairs.selected(chosen).radiance, facing[2 * chosen + (bright & 1)]
    contrast = radiance[bright] / radiance[dark]
    strength = (contrast * ambient[dark] - ambient[bright]) / cosine[:, None]
    return np.maximum(np.median(strength, axis=0), 0.0)


def _around(middle: Float[np.ndarray, "3"], spread: float, count: int) -> Float[np.ndarray, "k 3"]:
    """A round patch of unit vectors within an angle of a direction, itself the first."""
    side = np.cross(middle, [0.0, 0.0, 1.0] if abs(middle[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(middle, side)
    i = np.arange(count)
    angle, radius = i * np.pi * (3 - np.sqrt(5)), np.tan(spread) * np.sqrt(i / count)
    out = middle + radius[:, None] * (
        np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    )
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


# --- all together ---------------------------------------------------------------------------------


@torch.no_grad()
def find_light(
    field: RadianceField,
    photos: list[PhotoRays],
    almanac: Float[np.ndarray, "3"] | None = None,
    seed: int = 0,
) -> CapturedLight | UnknownLight:
    """Find the light of a scene's photos.

    Args:
        field: the fitted field; world axes, z up.
        photos: rays of its photos on the field without unobserved density.
        almanac: unit vector towards the sun by date, time and place; None: unknown. It is used
            where shadows tell no direction.
        seed: random seed of the points that are looked at.
    """
    field = observed(field)
    shown, rng = shown_sky(photos), np.random.default_rng(seed)
    sky_d = np.concatenate(
        [p.d[np.isinf(p.t) & (p.transmittance > 0.99) & (p.d[..., 2] > 0.03)] for p in photos]
    )
    pairs = find_pairs(field, photos, PAIRS, rng)
    if len(sky_d) < MIN_SKY:
        return UnknownLight("the photos show too little sky")
    if pairs is None:
        return UnknownLight(
            "the photos show too little ground and too few walls to judge by, or the fit is too"
            " short"
        )
    sky_d = sky_d[rng.choice(len(sky_d), min(MAX_SKY, len(sky_d)), replace=False)]
    seen = to_numpy(field.sky(_sent(sky_d, field))).astype(float)
    plain = fit_sky(sky_d, seen)
    light = _assembled(plain, shown, 0.0, almanac)
    d = _sent(gathering_directions(), field)
    sky = to_numpy(light.sky(d, field.sky(d)) * (d[:, 2:] > 0)).astype(float)
    few = pairs.selected(np.arange(min(len(pairs.x) // 2, GATHERED_PAIRS)))
    sun = hard_sun(field, gather_light(field, few), sky)
    if sun.halves is not None:
        return UnknownLight(_two_suns(photos, sun.halves))
    level = float(np.clip(gathering_directions()[:, 2], 0, 1) @ sky @ LUMA) * 4 * np.pi / DIRECTIONS
    known = [(sun.direction, sun.error, 0.0)]
    if sun.gain <= MIN_GAIN or sun.error >= MAX_ERROR:
        known = []
    if almanac is not None and almanac[2] > LOWEST_SUN:
        known.append((almanac, ALMANAC_ERROR, MIN_SUN * level / almanac[2]))
    many = (find_pairs(field, photos, TRIED_PAIRS, rng) if known else None) or pairs
    for direction, error, least in known:
        strength = sun_strength(field, many, direction, sky)
        if strength.min() > 0 and strength @ LUMA > least:
            model = SkyModel(plain.horizon, plain.zenith, direction, 0.0, strength)
            return _assembled(model, shown, error, almanac)
    if (seen.max(-1) >= CLIPPED).mean() > MIN_CLIPPED:
        model = fit_sky(sky_d, seen, _level_ground(pairs), lobe=True)
        glowing = _assembled(model, shown, model.width / 3, almanac)
        if glow_share(glowing) >= MIN_SUN:
            return glowing
    return light


def _level_ground(pairs: Pairs) -> float:
    """Log-average luma of level ground; 0 if photos show too little of it."""
    flat = pairs.normal[:, 2] > 0.9
    if flat.sum() < 2 * MIN_PAIRS // 3:
        return 0.0
    return float(np.exp(np.log(pairs.radiance[flat] @ LUMA).mean()))


def glow_share(light: CapturedLight) -> float:
    """Light of the lobe on level ground over that of the sky's base."""
    d = torch.tensor(gathering_directions(), dtype=torch.float32, device="cpu")
    d = d[d[:, 2] > 0]
    glow, base = ((part @ d.new_tensor(LUMA)) @ d[:, 2] for part in (light.glow(d), light.base(d)))
    return float(glow / base)


def _by_name(photos: list[PhotoRays]) -> list[str]:
    return sorted(photo.view.name for photo in photos)


def _two_suns(
    photos: list[PhotoRays], suns: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
) -> str:
    """Say that two halves of the photos were taken under different suns."""
    second = _by_name(photos)[(len(photos) + 1) // 2]
    places = [
        "{:.0f} deg high at azimuth {:.0f} deg".format(*np.degrees(elevation_azimuth(sun)))
        for sun in suns
    ]
    return (
        f"the photos contradict one sun: in the first half of them it stands {places[0]}, in the"
        f" second half, from {second} on, {places[1]}; fit photos of one time of day"
    )


def _assembled(
    model: SkyModel,
    shown: Float[np.ndarray, "rows columns"],
    error: float,
    almanac: Float[np.ndarray, "3"] | None,
) -> CapturedLight:
    return CapturedLight(
        model.horizon, model.zenith, model.sun, model.width, model.lobe, shown, error, almanac
    )
