"""Snow on a fence, a car, a sill and a gable roof, at a wall, and on scenes that catch none."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.holed_ground import LabelledField

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, ROAD, TERRAIN, VEGETATION, VEHICLE
from climatenerf.core.errors import UserError
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.scene.terrain import Terrain
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.light.probes import gather
from climatenerf.weather.light.scene_light import light_of_photos
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow

BOX = ((-8.0, -8.0, -1.0), (8.0, 8.0, 4.0))
GRID = SnowGrid((0.013, 0.027), (-1.0, 4.0), 0.05, 64)
CAMERAS = np.array([[0.0, 0.0, 1.6]])


def snow_on(solids, classes, depth=0.1, grid=GRID, **snow):
    field = LabelledField(solids, classes=classes, box=BOX)
    baked = bake_snow(field, Snow(depth=depth, **snow), CAMERAS, np.ones(3), grid=grid)
    assert baked is not None
    return baked


def thickness(baked, x, y, z):
    """Height up to which snow is dense, above points at height z, m; scanned in millimetres."""
    x, y, z = (torch.as_tensor(each, dtype=torch.float32) for each in np.broadcast_arrays(x, y, z))
    steps = torch.arange(0.002, 0.5, 0.002)
    points = torch.stack([each[:, None].expand(-1, len(steps)) for each in (x, y, z)], -1).clone()
    points[..., 2] += steps
    dense = baked.density(points.reshape(-1, 3)).view(len(x), -1) > 1
    return ((dense * steps).amax(1)).numpy()


def dense_within(baked, low, high, n=4000):
    """Fraction of the points of a box that lie in snow."""
    draw = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    low, high = torch.tensor(low), torch.tensor(high)
    return float((baked.density(low + draw * (high - low)) > 1).float().mean())


def step(height):
    return [HalfSpace(), Box((0.5, -8.0, -1.0), (8.0, 8.0, height))]


@pytest.mark.parametrize("height", [0.12, 0.14, 0.16, 0.2])
def test_deep_snow_has_no_holes_at_the_foot_of_a_step(height):
    for right, down in ((0.0, 0.0), (0.02, 0.01), (0.0, 0.03), (0.02, 0.04)):
        grid = SnowGrid((0.013 + right, 0.027), (-1.0 - down, 4.0), 0.05, 64)
        baked = snow_on(step(height), [ROAD, ROAD], grid=grid)
        assert dense_within(baked, (0.44, -1.0, 0.02), (0.49, 1.0, 0.09), 20_000) > 0.98


@pytest.mark.parametrize(("depth", "height"), [(0.1, 0.25), (0.15, 0.3)])
def test_deep_snow_does_not_climb_the_face_of_a_step(depth, height):
    baked = snow_on(step(height), [ROAD, ROAD], depth)
    z = torch.arange(0.05, height, 0.002)
    for y in np.linspace(-1, 1, 20):
        face = torch.stack([torch.full_like(z, 0.495), torch.full_like(z, float(y)), z], -1)
        bare = (baked.density(face) < 1).nonzero()[:, 0]
        assert float(z[bare[0]]) == pytest.approx(depth, abs=0.03)


def test_a_fence_stands_in_level_snow_with_a_small_cap():
    fence = Box((-8.0, 0.3, -1.0), (8.0, 0.34, 1.2))
    baked = snow_on([HalfSpace(), fence], [ROAD, BUILDING])
    x = np.linspace(-1, 1, 60)
    for y in (0.05, 0.6):
        assert thickness(baked, x, y, 0.0) == pytest.approx(0.1, abs=0.015)
    assert dense_within(baked, (-1.0, 0.0, 0.2), (1.0, 0.65, 1.1)) == 0, "nothing hangs on it"
    assert thickness(baked, x, 0.32, 1.2).max() < 0.1


def test_a_car_carries_snow_on_what_is_level_and_shelters_the_road():
    body = Box((-0.8, -1.3, 0.3), (0.8, 1.3, 0.8))
    cabin = Box((-0.7, -0.6, 0.8), (0.7, 0.9, 1.4))
    baked = snow_on([HalfSpace(), body, cabin], [ROAD, VEHICLE, VEHICLE])
    x = np.linspace(-0.4, 0.4, 20)
    assert thickness(baked, x, 0.1, 1.4) == pytest.approx(0.1, abs=0.015), "roof"
    assert thickness(baked, x, -1.0, 0.8) == pytest.approx(0.1, abs=0.02), "bonnet"
    assert dense_within(baked, (-0.7, -1.2, 0.02), (0.7, 1.2, 0.28)) < 0.05, "below"
    for side in (0.83, -0.95):
        assert dense_within(baked, (side, -0.5, 0.35), (side + 0.12, 0.5, 0.75)) == 0, "doors"


def test_a_sill_carries_snow_before_a_bare_wall():
    wall = Box((-8.0, 0.5, -1.0), (8.0, 2.5, 3.0))
    sill = Box((-0.5, 0.3, 0.9), (0.5, 0.5, 1.0))
    baked = snow_on([HalfSpace(), wall, sill], [ROAD, BUILDING, BUILDING])
    assert thickness(baked, np.linspace(-0.3, 0.3, 20), 0.4, 1.0).min() > 0.04
    assert dense_within(baked, (-0.4, 0.3, 0.3), (0.4, 0.49, 0.88)) == 0, "below"
    assert dense_within(baked, (-0.4, 0.3, 1.25), (0.4, 0.49, 2.9)) == 0, "the wall above"


@dataclasses.dataclass(frozen=True)
class Gable:
    """A house whose roof of two planes of 40 degrees has its ridge along x, 3 m high."""

    colour = (0.5, 0.2, 0.1)
    checker = 0.0
    slope = math.tan(math.radians(40))

    def planes(self):
        cosine = math.cos(math.radians(40))
        sine = math.sin(math.radians(40))
        return [HalfSpace((0.0, side * sine, cosine), 3.0 * cosine) for side in (-1, 1)]

    def interval(self, origins, directions):
        box = Box((-3.0, -2.0, -1.0), (3.0, 2.0, 3.2))
        parts = [each.interval(origins, directions) for each in (box, *self.planes())]
        enter = torch.stack([part[0] for part in parts]).amax(0)
        return enter, torch.stack([part[1] for part in parts]).amin(0)

    def distance(self, x):
        box = Box((-3.0, -2.0, -1.0), (3.0, 2.0, 3.2))
        return torch.stack([each.distance(x) for each in (box, *self.planes())]).amax(0)


def test_snow_is_continuous_over_a_ridge():
    """40 degrees keep two thirds (EN 1991-1-3); no peg on the ridge and no pit beside it."""
    baked = snow_on([HalfSpace(), Gable()], [ROAD, BUILDING])
    y = np.linspace(-1.2, 1.2, 121)
    found = thickness(baked, np.zeros(121), y, 3.0 - Gable.slope * np.abs(y))
    away = np.abs(y) > 0.35
    assert found[away] == pytest.approx(0.1 * 2 / 3, abs=0.025)
    assert found.min() > 0.03 and found.max() < 0.13
    assert np.abs(np.diff(found)).max() < 0.03, "the surface has no step"


def test_snow_is_continuous_where_completed_ground_begins():
    """The field ends at x = 0, beyond which the terrain stands in, 3 cm higher."""
    n = 81
    height = np.full((n, n), 0.03, np.float32)
    label, yes = np.full((n, n), TERRAIN, np.uint8), np.ones((n, n), bool)
    terrain = Terrain((-8.0, -8.0), 0.2, height, height, label, yes, ~yes)
    half = Box((-8.0, -8.0, -1.0), (0.0, 8.0, 0.0))
    field = CompletedField(LabelledField([half], classes=[ROAD], box=BOX), terrain)
    baked = bake_snow(field, Snow(depth=0.1), CAMERAS, np.ones(3), grid=GRID)
    assert baked is not None
    x = np.linspace(-1.0, 1.0, 201)
    for y in (-0.5, 0.4):
        top = thickness(baked, x, y, 0.0)
        assert top[:50] == pytest.approx(0.1, abs=0.02)
        assert top[-50:] == pytest.approx(0.13, abs=0.02)
        assert np.abs(np.diff(top)).max() < 0.02, "the seam shows no step"


@dataclasses.dataclass(frozen=True)
class HalfSun:
    """Light of the open, half of it on level ground by a sun."""

    elevation: float | None

    def irradiance(self, x, normal, diffuse=None):
        if self.elevation is None:
            return torch.full_like(x, math.pi)
        sun = torch.tensor([math.cos(self.elevation), 0.0, math.sin(self.elevation)])
        facing = (normal @ sun / sun[2]).clamp_min(0)[:, None]
        sky = 1.0 if diffuse is None else diffuse[:, None]
        return math.pi * (0.5 * sky + 0.5 * facing).expand_as(x)


def test_level_snow_is_the_same_for_any_sun():
    """The light of level ground has the sun's in it already, also that of the bake."""
    y = torch.linspace(-1, 1, 201)
    x = torch.stack([0.3 * y, y, torch.full_like(y, 0.1)], -1)
    field = LabelledField([HalfSpace()], classes=[ROAD], box=BOX)
    seen = []
    for elevation in (None, 10.0, 40.0):
        turn = None if elevation is None else math.radians(elevation)
        sun = None if turn is None else np.array([math.cos(turn), 0.0, math.sin(turn)])
        baked = bake_snow(field, Snow(depth=0.1), CAMERAS, np.ones(3), sun, grid=GRID)
        assert baked is not None
        lit = dataclasses.replace(baked, place_light=HalfSun(turn))
        seen.append([float(baked.colour(x).mean()), float(lit.colour(x).mean())])
    assert seen[1] == pytest.approx(seen[0], rel=0.02)
    assert seen[2] == pytest.approx(seen[0], rel=0.02)


def test_snow_is_darker_at_a_wall():
    """A wall up to the elevation a leaves (1 + cos a)/2 of an even sky, and sends .3 of it back."""
    wall = Box((1.0, -40.0, -1.0), (1.4, 40.0, 3.0), (0.3, 0.3, 0.3))
    field = AnalyticField(
        [HalfSpace(colour=(0.2,) * 3), wall],
        zenith=(1.0,) * 3,
        horizon=(1.0,) * 3,
        box=((-40, -40, -1), (40, 40, 12)),
    )
    gathered = gather(field, torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0)
    light = light_of_photos(gathered, lambda d: torch.ones_like(d), torch.zeros(3), None)
    baked = bake_snow(field, Snow(depth=0.1), CAMERAS, np.ones(3), grid=GRID)
    assert baked is not None
    lit = dataclasses.replace(baked, place_light=light)
    away = torch.tensor([0.1, 0.3, 0.7, 1.0, 6.0])
    y = torch.linspace(-0.5, 0.5, 11)
    seen = [lit.colour(torch.stack([1 - a + 0 * y, y, 0.1 + 0 * y], -1)).mean() for a in away]
    sky = (1 + torch.cos(torch.atan2(torch.tensor(2.9), away))) / 2
    exact = sky + 0.3 * (1 - sky)
    ratio = np.array([float(each / seen[-1]) for each in seen[:-1]])
    assert ratio == pytest.approx((exact[:-1] / exact[-1]).numpy(), abs=0.09)


def session(field, tmp_path, depth="10 cm", season="captured", **snow):
    c2w = np.eye(4)
    c2w[:3, 3] = (0, 0, 1.6)
    views = (View("a.png", tmp_path / "a.png", 0, c2w),)
    scene = Scene(tmp_path, "test", (Camera(8, 8, 8, 8, 4, 4),), views)
    table = {"snow": {"depth": depth, **snow}, "season": {"kind": season}}
    return RenderSession(field, scene, weather_from_table(table))


@pytest.mark.parametrize(
    ("case", "tilt", "slope"),
    [
        ("only a wall", "0 deg", "none"),
        ("only a wall", "60 deg", "none"),
        ("only a steep plane", "0 deg", "none"),
        ("only a steep plane", "0 deg", "20 deg"),
    ],
)
def test_scenes_without_ground_are_refused_in_one_sentence(tmp_path, case, tilt, slope):
    steep = HalfSpace((math.sin(1.4), 0.0, math.cos(1.4)), -2.0)
    wall = Box((-8.0, 2.0, -2.0), (8.0, 2.2, 5.0))
    solids = [wall] if case == "only a wall" else [steep]
    field = AnalyticField(solids, box=((-4.0, -4.0, -1.0), (4.0, 4.0, 3.0)))
    with pytest.raises(UserError, match="no surface of this scene catches snow") as error:
        session(field, tmp_path, **{"fall-tilt": tilt, "slope": slope})
    assert "\n" not in str(error.value)
    assert ("smaller --snow.fall-tilt" in str(error.value)) == (tilt != "0 deg")
    assert ("without --snow.slope" in str(error.value)) == (slope != "none")


def test_the_papers_grey_is_that_of_the_styled_ground():
    """(g + c0)/(1 + c0), with the ground as the moment shows it."""
    baked = snow_on([HalfSpace(colour=(0.0,) * 3)], [ROAD], light="paper")
    x = torch.tensor([[0.3, 0.2, 0.1]])
    assert baked.colour(x).numpy() == pytest.approx(0.8, rel=0.02)
    white = LabelledField([HalfSpace(colour=(1.0,) * 3)], classes=[ROAD], box=BOX)
    assert dataclasses.replace(baked, ground=white).colour(x).numpy() == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("light", ["scene", "paper"])
def test_thin_snow_shows_the_ground_in_the_colours_of_the_season(tmp_path, light):
    lawn = HalfSpace(colour=(0.05, 0.3, 0.05))
    field = LabelledField([lawn], classes=[VEGETATION], box=BOX)
    x = torch.tensor([[0.3, 0.2, 0.001]])
    seen = {}
    for kind in ("captured", "winter"):
        made = session(field, tmp_path, depth="1 mm", light=light, season=kind)
        seen[kind] = made.world(0.0).matters[0].colour(x)[0]
    assert float((seen["winter"] - seen["captured"]).abs().max()) > 0.02
