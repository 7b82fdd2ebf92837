"""Snow on analytic scenes: thickness, coverage, shelter, brightness, wind and cascades."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace, ground, table
from support.holed_ground import LabelledField
from support.threads import threads

from climatenerf.core.classes import BUILDING, ROAD
from climatenerf.core.errors import UserError
from climatenerf.ops.cpu import metaballs
from climatenerf.weather.snow.fall_rays import fall_directions
from climatenerf.weather.snow.lattice import SnowGrid, choose_grid
from climatenerf.weather.snow.layer import SnowEntity, bake_snow
from climatenerf.weather.snow.optics import albedo_of, over_ground, slab_reflectance
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.sliding import PACKED
from climatenerf.weather.weather import Weather

CAMERAS = np.array([[0.0, 0.0, 1.6]])
WHITE = np.ones(3)
GRID = SnowGrid((0.013, 0.027), (-1.0, 3.0), 0.05, 32)


@dataclasses.dataclass(frozen=True)
class Roof:
    """The part of a box below a plane."""

    box: Box
    plane: HalfSpace
    colour = (0.5, 0.2, 0.1)
    checker = 0.0

    def interval(self, origins, directions):
        (enter, leave), (first, last) = (
            part.interval(origins, directions) for part in (self.box, self.plane)
        )
        return torch.maximum(enter, first), torch.minimum(leave, last)

    def distance(self, x):
        return torch.maximum(self.box.distance(x), self.plane.distance(x))


def bake(solids, depth=0.1, grid=GRID, illumination=WHITE, sun=None, seed=0, **snow):
    field = AnalyticField(solids, box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    return bake_snow(field, Snow(depth=depth, **snow), CAMERAS, illumination, sun, seed, grid)


def on_plane(plane: HalfSpace, n: int, half: float = 1.3, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    xy = (2 * torch.rand(n, 2, generator=generator) - 1) * half
    normal = torch.tensor(plane.normal)
    z = (plane.offset - xy @ normal[:2]) / normal[2]
    return torch.cat([xy, z[:, None]], -1)


def mean_hit(snow, rays_o, rays_d, t_max=math.inf):
    """Mean point of each ray over its rendering weights, and its opacity."""
    zero = torch.zeros(len(rays_o))
    samples = snow.march(rays_o, rays_d, zero, zero + t_max)
    points, opacities = [], []
    for r in range(len(rays_o)):
        part = slice(int(samples.offsets[r]), int(samples.offsets[r + 1]))
        depth = torch.cat([zero[:1], (samples.sigma[part] * samples.dt[part]).cumsum(0)])
        weight = torch.exp(-depth[:-1]) - torch.exp(-depth[1:])
        opacities.append(float(weight.sum()))
        t = (weight * samples.t[part]).sum() / max(opacities[-1], 1e-9)
        points.append(rays_o[r] + t * rays_d[r])
    return torch.stack(points), torch.tensor(opacities)


def depth_over(snow, ground, top=None):
    """Thickness of the snow up to a height `top` over points of the ground, m; 0: bare ground."""
    top = top or 1.5 * snow.snow.depth + 2 * float(snow.lattice.spacing[0])
    down = torch.tensor([0.0, 0.0, -1.0]).expand_as(ground)
    points, opacity = mean_hit(snow, ground - top * down, down, top)
    return torch.where(opacity > 0.5, points[:, 2] - ground[:, 2], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("case", range(28))
def test_thickness_over_planes(case):
    """Random offsets, headings and spacings, and tilts up to 5 degrees."""
    rng = np.random.default_rng(case)
    depth = (0.02, 0.03, 0.05, 0.1, 0.2, 0.4, 1.0)[case % 7]
    plane = ground(
        math.radians(rng.uniform(0, 5)), rng.uniform(0, 2 * math.pi), rng.uniform(-0.2, 0.2)
    )
    spacing = rng.uniform(0.03, 0.06)
    grid = SnowGrid(tuple(rng.uniform(-0.1, 0.1, 2)), (-1.0, 2.0), spacing, 48 if depth < 1 else 96)
    snow = bake([plane], depth, grid, seed=case)
    feet = on_plane(plane, 60, 0.6, seed=case)
    assert depth_over(snow, feet).numpy() == pytest.approx(np.full(60, depth), rel=0.1)
    # The same for rays from the side.
    origin = torch.tensor(rng.normal(0, 1.0, (60, 3)), dtype=torch.float32)
    origin[:, 2] = 2.0
    direction = -origin / origin.norm(dim=1, keepdim=True)
    points, opacity = mean_hit(snow, feet - (1.2 + 2 * depth) * direction, direction)
    height = plane.distance(points) / plane.normal[2]
    assert opacity.min() > 0.998
    assert height.numpy() == pytest.approx(np.full(60, depth), rel=0.1)
    assert height.mean() == pytest.approx(depth, rel=0.06)
    assert snow.thickness(points).numpy() == pytest.approx(height.numpy(), abs=0.002)
    normal = snow.normal(points)
    # Quantised fractions and the lattice tilt the normal by a few degrees at most.
    assert (normal @ torch.tensor(plane.normal)).min() > math.cos(math.radians(6))


SHARES = ((20.0, 1.0), (35.0, 0.83), (42.0, 0.6), (50.0, 0.33), (55.0, 0.167), (65.0, 0.0))
"""Slopes (deg) and the fraction of the snow that they keep, EN 1991-1-3, 5.3."""


@pytest.mark.parametrize(("slope", "share"), SHARES)
def test_slopes_keep_a_share_of_the_depth(slope, share):
    plane = ground(math.radians(slope), 0.7)
    box = ((-8.0, -8.0, -4.0), (8.0, 8.0, 4.0))
    grid = SnowGrid((0.013, 0.027), (-3.0, 3.0), 0.05, 32)
    snow = bake_snow(AnalyticField([plane], box=box), Snow(depth=0.1), CAMERAS, WHITE, grid=grid)
    assert snow is not None
    feet = on_plane(plane, 100, 0.5)
    depth = depth_over(snow, feet).numpy()
    assert depth == pytest.approx(np.full(100, share * 0.1), rel=0.1, abs=3e-3)
    if share:
        within = 5e-3 if slope <= 50 else 7e-3
        found = snow.thickness(feet + torch.tensor([0.0, 0.0, share * 0.1])).numpy()
        assert found == pytest.approx(np.full(100, share * 0.1), abs=within), "also the layer"


def test_the_papers_slope_is_an_option():
    logistic = 1 / (1 + math.exp(-50 * (math.cos(math.radians(35)) - math.cos(math.radians(37)))))
    for slope, share in ((20.0, 1.0), (35.0, logistic), (45.0, 0.0)):
        plane = ground(math.radians(slope), 0.7)
        snow = bake([plane], 0.1, slope=math.radians(37))
        depth = depth_over(snow, on_plane(plane, 100, 0.5)).numpy()
        assert depth == pytest.approx(np.full(100, share * 0.1), rel=0.1, abs=4e-3)


def test_ground_is_bare_under_a_roof_and_covered_in_the_open():
    roof = [
        Box((-0.8, -1.5, 2.0), (0.8, 0.7, 2.1)),
        Box((-0.8, -1.5, -1.0), (-0.7, -1.4, 2.0)),
    ]
    snow = bake([ground(), *roof])
    feet = on_plane(ground(), 6000, 1.4)
    covered = depth_over(snow, feet) > 0
    x, y = feet[:, 0], feet[:, 1]
    under = (x.abs() < 0.7) & (y < 0.6)
    outside = (x.abs() > 0.9) | (y > 0.8)
    assert covered[under].float().mean() < 0.02
    assert covered[outside].float().mean() > 0.95
    top = torch.stack([x, y, torch.full_like(x, 2.1)], -1)[(x.abs() < 0.75) & (y < 0.65)]
    depth = depth_over(snow, top)
    assert (depth > 0).float().mean() > 0.95
    assert depth.mean() == pytest.approx(0.1, rel=0.1)


def test_no_snow_hangs_below_a_thin_table():
    for depth in (0.02, 0.1, 0.3):
        snow = bake([ground(), *table()], depth)
        xy = 2.2 * torch.rand(4000, 2, generator=torch.Generator().manual_seed(1)) - 1.1
        for z in (0.69, 0.66, 0.6, 0.5):
            below = torch.cat([xy, torch.full((4000, 1), z)], -1)
            if z < 0.61 and depth > 0.2:  # a heap of what slid off the table lies around it
                below = below[(xy.abs() < 0.35).all(1)]
            assert snow.density(below).max() == 0
        on_top = torch.cat([xy, torch.full((4000, 1), 0.75)], -1)[(xy.abs() < 0.3).all(1)]
        assert depth_over(snow, on_top).numpy() == pytest.approx(depth, rel=0.1)


def test_thickness_increases_with_depth():
    rocks = [Box((x, x / 2, -1), (x + 0.3, x / 2 + 0.4, x / 4 + 0.3)) for x in (-1.0, -0.4, 0.3)]
    slope = HalfSpace((-math.sin(0.6), 0.0, math.cos(0.6)), -0.4)
    field = [ground(0.05, 1.0), slope, *rocks]
    snow = bake(field, 0.4)
    feet = on_plane(ground(0.05, 1.0), 500, 1.4)
    thickness = []
    for depth in (1e-6, 0.001, 0.003, 0.006, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4):
        thickness.append(depth_over(snow.with_depth(depth), feet))
    steps = torch.stack(thickness).diff(dim=0)
    assert thickness[0].max() == 0
    assert steps.min() > -1e-3  # error of the march; the lattice itself is monotone
    assert (thickness[-1] > 0.3).float().mean() > 0.7
    assert torch.equal(depth_over(snow, feet), thickness[-1])


def test_vanishing_depth_gives_no_snow():
    assert bake([ground()], None) is None
    assert bake([ground()], 0.0) is None
    snow = bake([ground()], 1e-4)
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(200, 3)
    feet = on_plane(ground(), 200)
    _, opacity = mean_hit(snow, feet - 2 * down, down)
    assert opacity.max() < 1e-4


def test_empty_scene_and_extreme_parameters_stay_finite():
    nothing = bake([], 0.1)
    assert nothing is not None
    assert depth_over(nothing, on_plane(ground(), 5)).tolist() == [0.0] * 5
    for extreme in (
        {"fall_tilt": math.radians(80), "wind_direction": 1.0},
        {"slope": 0.0, "slope_sharpness": 1000.0},
        {"slope": math.pi / 2, "albedo_offset": 0.0, "wrap": 0.0},
    ):
        snow = bake([ground(), *table()], 2.0, sun=np.array([0.0, 0.8, 0.6]), **extreme)
        for catch in snow.deposits.cascades[0]:
            used = catch.weight > 0
            assert np.isfinite(catch.position[used]).all()
            assert np.isfinite(catch.of_fall).all() and np.isfinite(catch.of_held).all()
        points = torch.rand(3000, 3) * torch.tensor([2.4, 2.4, 3.5]) - torch.tensor([1.2, 1.2, 0.5])
        for value in (snow.density(points), snow.colour(points), snow.normal(points)):
            assert torch.isfinite(value).all()
        assert (snow.colour(points) >= 0).all()
        assert not torch.isnan(snow.thickness(points)).any()


@pytest.mark.all_cores
def test_snow_depends_on_the_seed_but_not_on_threads():
    scene = [ground(0.04, 2.0), *table()]
    rays_o = torch.tensor([[0.1, 0.2, 2.0]]).repeat(300, 1)
    rays_d = torch.nn.functional.normalize(torch.randn(300, 3) * 0.3 + torch.tensor([0, 0, -1.0]))
    zero = torch.zeros(300)
    first = bake(scene, seed=3)
    expected = first.march(rays_o, rays_d, zero, zero + 9)
    with threads(1):
        second = bake(scene, seed=3)
        again = second.march(rays_o, rays_d, zero, zero + 9)
    for one, other in zip(first.lattice, second.lattice, strict=True):
        assert np.array_equal(one, other)
    assert torch.equal(expected.t, again.t)
    assert torch.equal(expected.sigma, again.sigma)
    other = bake(scene, seed=4).deposits.cascades[0][0]
    assert not np.array_equal(first.deposits.cascades[0][0].position, other.position)


def test_the_papers_brightness_over_white_and_black_ground():
    white = HalfSpace(colour=(1.0, 1.0, 1.0))
    feet = on_plane(white, 50)
    top = feet + torch.tensor([0.0, 0.0, 0.1])
    # Snow on white ground has the radiance of a white surface in the scene's light.
    light = np.array([0.02, 0.03, 0.05])
    dim = bake([white], illumination=light / 10, light="paper")
    expected = np.broadcast_to(light / 10, (50, 3))
    assert dim.colour(top).numpy() == pytest.approx(expected, rel=0.02)
    assert bake([white], illumination=light, light="paper").colour(top).numpy() == pytest.approx(
        np.broadcast_to(light, (50, 3)), rel=0.02
    )
    # On black ground: (0 + c0)/(1 + c0).
    dark = bake([HalfSpace(colour=(0.0, 0.0, 0.0))], light="paper").colour(top)
    assert dark.numpy() == pytest.approx(0.8, rel=0.02)


def test_the_papers_sun_shadow_darkens_snow():
    wall = Box((0.5, -8.0, -1.0), (0.7, 8.0, 1.0))
    sun = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    snow = bake([HalfSpace(colour=(1.0, 1.0, 1.0)), wall], sun=sun, light="paper")
    wrap = (math.sqrt(0.5) + 8) / 9
    shadowed = snow.colour(torch.tensor([[0.1, 0.0, 0.1], [-0.2, 0.3, 0.1]]))
    lit = snow.colour(torch.tensor([[-0.9, 0.0, 0.1], [1.2, 0.3, 0.1]]))
    assert shadowed.numpy() == pytest.approx(0.3 * wrap, rel=0.02)
    assert lit.numpy() == pytest.approx(wrap, rel=0.02)


def test_the_colour_of_snow_is_its_albedo_in_the_light():
    light = np.array([0.2, 0.3, 0.5])
    top = on_plane(ground(), 50) + torch.tensor([0.0, 0.0, 0.3])
    for snow in (Snow(depth=0.3), Snow(depth=0.3, albedo=0.6)):
        colour = bake([ground()], 0.3, illumination=light, albedo=snow.albedo).colour(top)
        expected = np.broadcast_to(light * albedo_of(snow), (50, 3))
        assert colour.numpy() == pytest.approx(expected, rel=0.01)


def test_thin_snow_lets_the_ground_through_and_deep_snow_hides_it():
    """A board of squares, dark and light: its contrast fades with depth, monotonously."""
    board = HalfSpace(colour=(0.8, 0.8, 0.8), checker=0.5)
    field = AnalyticField([board], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    feet = on_plane(board, 400, 1.2)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(400, 3).contiguous()
    bare = field.colour(feet, down)[:, 0]
    dark, light = bare < 0.1, bare > 0.7
    assert dark.any() and light.any()
    deposits = bake([board], 0.1)
    contrast, mean = [], []
    for depth in (2.5e-4, 1e-3, 2e-3, 3e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.15):
        snow = dataclasses.replace(deposits.with_depth(depth), ground=field)
        seen = snow.colour(feet + torch.tensor([0.0, 0.0, depth]))[:, 0]
        contrast.append(float((seen[light].mean() - seen[dark].mean()) / seen.mean()))
        mean.append(float(seen[dark].mean()))
    fading = np.diff(contrast)
    assert np.all(fading[:-1] < 0) and fading[-1] <= 0  # nothing is left to fade in the end
    assert contrast[0] > 0.4
    assert contrast[-1] < 0.01
    assert np.all(np.diff(mean) >= 0)
    assert mean[0] == pytest.approx(float(bare[dark].mean()), abs=0.12)


def test_contact_shade_ends_above_the_ground():
    snow = dataclasses.replace(bake([ground()], 0.3), ground=None)
    height = torch.tensor([0.05, 0.6, 30.0])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    half, all_of_it = (
        snow._in_light_of_place(up, up, height, torch.full((3,), share))[:, 0]
        for share in (0.5, 1.0)
    )
    assert half / all_of_it == pytest.approx([0.5, 1 - 0.5 * math.exp(-1), 1.0], abs=1e-5)


def test_brightness_has_no_steps_in_depth():
    ground_colour = HalfSpace(colour=(0.12, 0.12, 0.12))
    field = AnalyticField([ground_colour], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    baked = dataclasses.replace(bake([ground_colour], 0.1), ground=field)
    feet = on_plane(ground_colour, 40, 1.0)
    seen = [0.12]
    for depth in np.arange(1, 30) * 5e-4:
        snow = dataclasses.replace(baked.with_depth(float(depth)), ground=field)
        seen.append(float(snow.colour(feet + torch.tensor([0.0, 0.0, float(depth)])).mean()))
    assert np.all(np.diff(seen) > -2e-3)
    # The first millimetre of snow whitens dark ground by a little more than a tenth.
    per_millimetre = np.array(seen[2:]) - np.array(seen[:-2])
    assert per_millimetre[0] < 0.14
    assert per_millimetre[2:].max() < 0.1


def test_a_dusting_is_as_even_as_it_fell():
    """A millimetre, stored in steps of a part of one, shows no rings on level ground."""
    plane = ground(0.01, 0.3)
    field = AnalyticField([plane], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    grid = SnowGrid((0.013, 0.027), (-1.0, 3.0), 0.4, 32)
    snow = dataclasses.replace(bake([plane], 0.001, grid), ground=field)
    feet = on_plane(plane, 2000, 2.0)
    seen = snow.colour(feet + torch.tensor([0.0, 0.0, 0.001]))
    bare = field.colour(feet, torch.tensor([[0.0, 0.0, -1.0]]).expand(2000, 3))
    slab = slab_reflectance(torch.tensor([[0.001]]), snow.snow.grain)
    white = over_ground(slab, torch.tensor(albedo_of(snow.snow)).float(), bare)
    assert seen == pytest.approx(white.numpy(), abs=2e-3)


def test_thin_snow_on_slopes_has_no_ripples():
    plane = ground(math.radians(40), 0.5)
    snow = bake([plane], 0.03)
    down = torch.tensor([[-0.25, 0.54, -0.8]]).expand(4000, 3)
    points, opacity = mean_hit(snow, on_plane(plane, 4000, 1.0) - 0.4 * down, down, 1.0)
    points = points[opacity > 0.9].numpy()
    rough = metaballs.evaluate(points, snow.lattice)[2][:, 0]
    normals, heights = metaballs.smooth_surface(points, snow.lattice)
    alone, zero = metaballs.smooth_surface(points, snow.lattice, False)
    assert np.array_equal(alone, normals) and not zero.any()
    assert heights.mean() == pytest.approx(0.03 * 2 / 3, rel=0.1)
    assert heights.std() < 0.75 * rough.std()
    assert np.quantile(normals @ np.array(plane.normal), 0.02) > 0.998
    away = metaballs.smooth_surface(np.array([[0.0, 0.0, 2.9]], np.float32), snow.lattice)
    assert away[0][0].tolist() == [0, 0, 1] and away[1][0] == 0


def test_a_steep_roof_sheds_its_snow_to_the_ground_below():
    """A roof of 50 degrees keeps a third; two thirds lie before its eaves."""
    slope = math.radians(50)
    normal = (math.sin(slope), 0.0, math.cos(slope))
    roof = Roof(Box((0.0, -8.0, 0.5), (1.0, 8.0, 2.6)), HalfSpace(normal, 2.2 * math.cos(slope)))
    box = ((-8.0, -8.0, -1.0), (8.0, 8.0, 3.5))
    field = LabelledField([ground(), roof], classes=[ROAD, BUILDING], box=box)
    grid = SnowGrid((0.0, 0.0), (-1.0, 3.2), 0.05, 64)
    snow = bake_snow(field, Snow(depth=0.1), CAMERAS, WHITE, grid=grid)
    assert snow is not None
    xs = torch.linspace(1.025, 2.525, 61)
    rows = torch.linspace(-0.3, 0.3, 7)
    feet = torch.stack([*torch.meshgrid(xs, rows, indexing="ij"), torch.zeros(61, 7)], -1)
    before = depth_over(snow, feet.reshape(-1, 3), 0.8).view(61, 7).mean(1).numpy()
    arrived = float(np.trapezoid(before - 0.1, xs.numpy()))
    assert arrived == pytest.approx(PACKED * 2 / 3 * 0.1 * 1.0, rel=0.2)
    # It lies at the foot of the wall, no steeper than snow stands, not spread over the ground.
    assert before[:4].mean() > 0.15
    assert np.all(before[xs.numpy() > 1.6] < 0.12)
    assert np.abs(np.diff(before) / np.diff(xs.numpy())).max() < 1
    behind = depth_over(snow, on_plane(ground(), 40, 0.2) - torch.tensor([2.5, 0.0, 0.0]))
    assert behind.numpy() == pytest.approx(0.1, rel=0.1)


def test_a_rough_roof_carries_an_even_layer():
    """Bumps of 4 cm and of other slopes on a roof, as a fit has them, do not show in the snow."""
    slope = math.radians(35)
    normal = (math.sin(slope), 0.0, math.cos(slope))
    inside = Box((-2.0, -2.0, 0.5), (1.0, 2.0, 3.0))
    plane = HalfSpace(normal, 1.5 * math.cos(slope))
    rng = np.random.default_rng(0)
    roofs = [Roof(inside, plane)]
    for x, y, tilt in rng.uniform([-1.8, -1.8, 0.45], [0.8, 1.8, 0.8], (90, 3)):
        bump = Box((x - 0.09, y - 0.09, 0.5), (x + 0.09, y + 0.09, 3.0))
        up = (math.sin(tilt), 0.0, math.cos(tilt))
        top = 1.54 - x * math.tan(slope)
        roofs.append(Roof(bump, HalfSpace(up, up[0] * x + up[2] * top)))
    box = ((-4.0, -4.0, -1.0), (4.0, 4.0, 3.5))
    field = LabelledField([ground(), *roofs], classes=[ROAD, *[BUILDING] * len(roofs)], box=box)
    grid = SnowGrid((0.0, 0.0), (-1.0, 3.2), 0.05, 64)
    snow = bake_snow(field, Snow(depth=0.1), CAMERAS, WHITE, grid=grid)
    assert snow is not None
    catch = snow.deposits.cascades[0][0]
    x, y, z = np.moveaxis(catch.position, -1, 0)
    roof = (catch.weight > 0) & (x > -1.5) & (x < 0.5) & (np.abs(y) < 1.5)
    over = z[roof] - (1.5 - x[roof] * math.tan(slope))
    assert 0 < over.mean() < 0.02
    assert over.std() < 0.009  # .013 where roofs are smoothed as ground is
    assert catch.of_fall[roof].std() < 0.03
    assert catch.of_fall[roof].mean() == pytest.approx(25 / 30, abs=0.08)


def test_deep_snow_on_a_post_and_a_bench_ends_in_steep_slopes():
    post = Box((-0.05, -0.05, -1.0), (0.05, 0.05, 0.8))
    bench = Box((0.6, -0.4, -1.0), (1.4, 0.4, 0.5))
    snow = bake([ground(), post, bench], 0.6, SnowGrid((0.013, 0.027), (-1.0, 2.0), 0.05, 48))
    over_post = depth_over(snow, torch.tensor([[0.0, 0.0, 0.8]]))
    assert float(over_post) < 0.25, "no tower"
    x = torch.linspace(0.65, 1.35, 15)
    top = torch.stack([x, 0 * x, torch.full_like(x, 0.5)], -1)
    height = depth_over(snow, top).numpy()
    assert height.max() > 0.3
    steepest = np.abs(np.diff(height) / np.diff(x.numpy())).max()
    assert steepest < math.tan(math.radians(60))


def test_snow_melts_in_water_and_stays_on_dry_ground():
    """Ground 5 cm under water shows none of 10 cm of snow; ground 5 cm above it shows all."""
    step = Box((0.0, -8.0, -1.0), (8.0, 8.0, 0.1))
    snow = bake([ground(), step]).above(0.05)
    under = on_plane(ground(), 100, 0.4) - torch.tensor([0.8, 0.0, 0.0])
    dry = on_plane(ground(height=0.1), 100, 0.4) + torch.tensor([0.8, 0.0, 0.0])
    assert depth_over(snow, under).max() == 0
    assert not snow.covers(under + torch.tensor([0.0, 0.0, 0.02])).any()
    assert depth_over(snow, dry).numpy() == pytest.approx(0.1, rel=0.1)


def test_tilted_fall_leaves_the_lee_of_a_wall_bare():
    wall = Box((-0.1, -8.0, -1.0), (0.1, 8.0, 0.8))
    # From +x (90 degrees clockwise from +y), 45 degrees from the vertical.
    snow = bake([ground(), wall], fall_tilt=math.radians(45), wind_direction=math.radians(90))
    y = torch.linspace(-1, 1, 50)

    def line(x):
        return torch.stack([torch.full_like(y, x), y, torch.zeros_like(y)], -1)

    assert not (depth_over(snow, line(-0.5)) > 0).any()
    assert (depth_over(snow, line(0.5)) > 0).all()
    assert (depth_over(snow, line(-1.3)) > 0).all()
    assert depth_over(snow, line(0.6)).mean() == pytest.approx(0.1, rel=0.1)


def test_fall_directions_are_spread_about_the_wind():
    directions = fall_directions(Snow(depth=0.1), 0)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1)
    assert directions.mean(0)[:2] == pytest.approx([0, 0], abs=1e-12)
    assert np.arccos(-directions[:, 2]) == pytest.approx(0.05 / math.sqrt(2), rel=0.01)
    windy = fall_directions(Snow(depth=0.1, fall_tilt=0.3, wind_direction=math.pi / 2), 1)
    assert windy.mean(0) == pytest.approx([-math.sin(0.3), 0, -math.cos(0.3)], abs=2e-3)
    assert not np.allclose(fall_directions(Snow(depth=0.1), 5), directions)


def test_no_snow_below_the_water_level():
    snow = bake([ground(), Box((-0.5, -0.5, -1.0), (0.5, 0.5, 0.6))]).above(0.3)
    feet = on_plane(ground(), 300)
    depth = depth_over(snow, feet)
    assert (depth == 0).all()
    top = torch.tensor([[0.0, 0.1, 0.6]])
    assert depth_over(snow, top).item() == pytest.approx(0.1, rel=0.1)
    # A ray upwards from under water, and horizontal rays above and below the water level.
    o = torch.tensor([[1.0, 1.0, 0.2], [2.0, 0.0, 0.65], [2.0, 0.0, 0.05]])
    d = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    samples = snow.march(o, d, torch.zeros(3), torch.full((3,), 9.0))
    counts = samples.offsets.diff()
    assert counts[0] == 0
    assert counts[1] > 0
    assert counts[2] == 0


def test_thickness_is_continuous_across_cascades():
    grid = SnowGrid((0.0, 0.0), (-1.0, 2.0), 0.05, 16, 3)  # 0.8, 1.6 and 3.2 m
    snow = bake([ground(0.03, 0.4)], 0.1, grid)
    plane = ground(0.03, 0.4)
    feet = on_plane(plane, 3000, 3.1)
    assert depth_over(snow, feet).numpy() == pytest.approx(0.1, rel=0.1)
    # An oblique ray through all three cascades hits the snow at the right height.
    direction = torch.tensor([[0.95, 0.1, -0.3]])
    direction /= direction.norm()
    points, opacity = mean_hit(snow, torch.tensor([[-2.9, 0.1, 0.6]]), direction)
    assert opacity > 0.99
    assert plane.distance(points).item() == pytest.approx(0.1, abs=0.01)


def test_depth_is_measured_from_the_half_transmittance_of_blurred_ground():
    """A fitted surface is blurred; its height is where the transmittance from above is 1/2."""
    field = AnalyticField([ground()], extinction=40.0, box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    snow = bake_snow(field, Snow(depth=0.1), CAMERAS, WHITE, grid=GRID)
    assert snow is not None
    surface = on_plane(ground(0, 0, -math.log(2) / 40), 300)
    assert depth_over(snow, surface).numpy() == pytest.approx(0.1, rel=0.1)


def test_grid_adapts_to_path_and_scene():
    lower, upper = np.array([-190.0, -190.0, -190.0]), np.array([190.0, 190.0, 190.0])
    street = np.stack([np.linspace(-8, 8, 20), np.zeros(20), np.full(20, 1.6)], 1)
    grid = choose_grid(lower, upper, street)
    assert 0.04 <= grid.spacing <= 0.06
    assert grid.half_side(0) > 12
    assert grid.half_side(grid.cascades - 1) >= 190
    assert grid.z_range[0] > -30
    assert grid.z_range[1] < 50
    long = choose_grid(lower * 5, upper * 5, street * 40)
    assert long.cascades <= 5
    small = choose_grid(np.full(3, -2.0), np.full(3, 2.0), CAMERAS)
    assert small.cascades == 1
    assert small.half_side(0) >= 2.0
    with pytest.raises(ValueError, match="multiple of 16"):
        SnowGrid((0.0, 0.0), (0.0, 1.0), 0.05, 40)


def test_progress_increases_to_one():
    seen: list[float] = []
    field = AnalyticField([ground()], box=((-2.0, -2.0, -1.0), (2.0, 2.0, 3.0)))
    bake_snow(field, Snow(depth=0.1), CAMERAS, WHITE, grid=GRID, progress=seen.append)
    assert seen[-1] == pytest.approx(1)
    assert all(np.diff(seen) > 0)


def test_snow_over_the_heads_of_all_cameras_is_refused():
    eyes = np.array([[0.0, 0.0, 1.5], [3.0, 0.0, 2.6]])
    scene = type("Scene", (), {"ground_z": 1.0})()
    given = type("Given", (), {"moments": (), "camera_positions": eyes, "scene": scene})()
    entity = SnowEntity(given)
    thin, deep = (Weather(snow=Snow(depth=depth)) for depth in (0.2, 1.8))
    with pytest.raises(UserError, match="buries all cameras"):
        entity.check((deep,))
    entity.check((thin, deep))
