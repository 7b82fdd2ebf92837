"""Light probes: kernel and twin, closed forms, and the light that surfaces send back."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.holed_ground import LabelledField

from climatenerf.core.classes import ROAD
from climatenerf.core.colour import luma
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.field.spherical_harmonics import harmonics
from climatenerf.ops import probes
from climatenerf.ops.probes import ProbeGrid
from climatenerf.weather.light import scene_light
from climatenerf.weather.light.probes import gather, nearest_valid
from climatenerf.weather.light.scene_light import (
    SATURATION,
    SceneLight,
    Surfaces,
    camera_balance,
    light_of_photos,
    plausible_surfaces,
    relit,
    white_balanced,
)
from climatenerf.weather.light.spherical import project, sphere_directions

UP = torch.tensor([[0.0, 0.0, 1.0]])


def random_grid(rng):
    shape = (4, 3, 5)
    count = math.prod(shape)
    valid = torch.from_numpy(rng.random(count) > 0.2)
    grid = ProbeGrid(torch.tensor([-1.0, 2.0, 0.5]), torch.tensor([2.0, 1.5, 1.0]), shape, valid)
    tables = tuple(
        torch.from_numpy(rng.normal(size=(count, 9, 3)).astype(np.float32)) for _ in range(2)
    )
    return grid, tables


def test_kernel_equals_its_twin():
    rng = np.random.default_rng(0)
    grid, tables = random_grid(rng)
    x = torch.from_numpy(rng.uniform(-4, 9, (500, 3)).astype(np.float32))
    normal = torch.nn.functional.normalize(
        torch.from_numpy(rng.normal(size=(500, 3))).float(), dim=-1
    )
    basis = harmonics(normal).T[:9].contiguous()
    fast = probes.irradiance(grid, tables, x, normal, basis)
    for found, table in zip(fast, tables, strict=True):
        expected = torch.einsum("tn,ntc->nc", basis, probes.interpolated(grid, table, x, normal))
        torch.testing.assert_close(found, expected.clamp_min(0), rtol=2e-3, atol=2e-3)


def test_probes_inside_matter_do_not_count():
    rng = np.random.default_rng(1)
    grid, (table, _) = random_grid(rng)
    poisoned = torch.where(grid.valid[:, None, None], table, 1e6)
    x = torch.tensor([[1.3, 3.1, 2.2]])
    clean = probes.interpolated(grid, table, x, UP)
    torch.testing.assert_close(probes.interpolated(grid, poisoned, x, UP), clean)


def test_between_probes_inside_matter_the_nearest_free_light_counts():
    shape = (4, 2, 2)
    valid = torch.zeros(2, 2, 4, dtype=torch.bool)
    valid[:, :, 0] = True
    grid = ProbeGrid(torch.zeros(3), torch.ones(3), shape, valid.flatten())
    source = nearest_valid(grid)
    torch.testing.assert_close(source, torch.arange(16) // 4 * 4)
    table = torch.rand(16, 9, 3)[source]
    x = torch.tensor([[2.5, 0.5, 0.5]])
    basis = harmonics(UP).T[:9].contiguous()
    (found,) = probes.irradiance(grid, (table,), x, UP, basis)
    slow = torch.einsum("tn,ntc->nc", basis, probes.interpolated(grid, table, x, UP))
    torch.testing.assert_close(found, slow.clamp_min(0), rtol=1e-4, atol=1e-5)
    assert bool(torch.isfinite(found).all()) and float(slow.abs().sum()) > 0


def test_irradiance_of_an_even_sky():
    d = sphere_directions(512)
    sky = torch.where(d[:, 2:] > 0, 1.0, 0.0).expand(-1, 3)
    coefficients = project(d, sky)
    for normal, expected in (((0, 0, 1), math.pi), ((1, 0, 0), math.pi / 2), ((0, 0, -1), 0.0)):
        basis = harmonics(torch.tensor([normal]).float())[0, :9]
        assert float(basis @ coefficients[:, 0]) == pytest.approx(expected, abs=0.03 * math.pi)


def yard(albedo, sky=1.0):
    """Level ground of an albedo under an even sky, as photos show it: radiance albedo * sky."""
    ground = HalfSpace(colour=(albedo * sky,) * 3)
    return AnalyticField(
        [ground], zenith=(sky,) * 3, horizon=(sky,) * 3, box=((-60, -60, -1), (60, 60, 12))
    )


@pytest.fixture(scope="module")
def gathered():
    return gather(yard(0.2), torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0)


def even(level):
    return lambda d: torch.full_like(d, level)


def no_sun():
    return torch.zeros(3)


def test_light_of_photos_over_open_ground(gathered):
    """E_h = pi L; a wall gets E_h (1 + albedo)/2."""
    light = light_of_photos(gathered, even(1.0), no_sun(), None)
    x = torch.tensor([[0.3, 0.2, 1.7]])
    assert float(light.irradiance(x, UP)[0, 0]) == pytest.approx(math.pi, rel=0.04)
    wall = light.irradiance(x, torch.tensor([[1.0, 0.0, 0.0]]))
    assert float(wall[0, 0]) == pytest.approx(math.pi * (1 + 0.2) / 2, rel=0.05)
    np.testing.assert_allclose(light.open_irradiance(), math.pi, rtol=0.01)
    mean = light.mean_radiance(x)
    assert float(mean[0, 0]) == pytest.approx((1 + 0.2) / 2, rel=0.05)


def test_the_balance_of_cameras_is_that_of_the_skys_light_alone(gathered):
    """Surfaces send what photos show of them, and the sky is shown as it is."""
    gains = torch.tensor([1.2, 1.0, 0.8])
    plain, balanced = (
        light_of_photos(gathered, even(1.0), no_sun(), None, gain) for gain in (1.0, gains)
    )
    torch.testing.assert_close(balanced.open_irradiance(), gains * plain.open_irradiance())
    x = torch.tensor([[0.3, 0.2, 1.7]])
    above, plainly = (light.irradiance(x, UP) for light in (balanced, plain))
    torch.testing.assert_close(above, gains * plainly, rtol=5e-3, atol=0)
    under, before = (light.irradiance(x, -UP) for light in (balanced, plain))
    torch.testing.assert_close(under, before, rtol=0.02, atol=0)
    assert torch.equal(balanced.radiance(UP), plain.radiance(UP))
    again = relit(gathered, balanced, balanced)
    torch.testing.assert_close(again.coefficients, balanced.coefficients, rtol=1e-3, atol=1e-3)


def test_white_ground_brightens_a_wall(gathered):
    """Even sky, ground .2 to .87: a wall receives (1 + .87)/(1 + .2) = 1.56 times the light."""
    old = light_of_photos(gathered, even(1.0), no_sun(), None)
    snow = Surfaces(lambda up, _: (up > 0.8).float(), 0.87)
    new = relit(gathered, old, old, snow)
    x, wall = torch.tensor([[0.3, 0.2, 1.7]]), torch.tensor([[1.0, 0.0, 0.0]])
    ratio = float((new.irradiance(x, wall) / old.irradiance(x, wall))[0, 0])
    assert ratio == pytest.approx((1 + 0.87) / (1 + 0.2), rel=0.05)
    assert float((new.irradiance(x, UP) / old.irradiance(x, UP))[0, 0]) == pytest.approx(
        1, abs=0.02
    )


def test_white_ground_under_the_overcast_sky():
    """CIE sky: E_v/E_h = .396 + albedo/2, so .12 to .85 brightens a wall 1.80 times."""

    def cie(d):
        return ((1 + 2 * d[:, 2:].clamp(0, 1)) / 3).expand(-1, 3)

    level = 7 / 9  # E_h/pi for L_z = 1
    ground = HalfSpace(colour=(0.12 * level,) * 3)
    field = AnalyticField(
        [ground], zenith=(1.0,) * 3, horizon=(1 / 3,) * 3, box=((-60, -60, -1), (60, 60, 12))
    )
    gathered = gather(field, torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0)
    old = light_of_photos(gathered, cie, no_sun(), None)
    new = relit(gathered, old, old, Surfaces(lambda up, _: (up > 0.8).float(), 0.85))
    x, wall = torch.tensor([[0.3, 0.2, 1.7]]), torch.tensor([[0.0, 1.0, 0.0]])
    ratio = float((new.irradiance(x, wall) / old.irradiance(x, wall))[0, 0])
    assert ratio == pytest.approx(1.80, rel=0.05)


def test_probes_below_the_ground_do_not_count():
    """Whatever colour its underside has; here it is glaring blue from below."""

    class BlueBelow(LabelledField):
        def colour(self, x, d, ray=None, *, ids=None, appearance=None):
            seen = super().colour(x, d, ray, ids=ids, appearance=appearance)
            below = (d if ray is None else d[ray])[:, 2:] > 0
            return torch.where(below, seen.new_tensor([0.1, 0.5, 3.0]), seen)

    field = BlueBelow(
        [Box((-60.0, -60.0, -0.2), (60.0, 60.0, 0.0), (0.2,) * 3)],
        classes=[ROAD],
        box=((-60, -60, -2.5), (60, 60, 12)),
    )
    gathered = gather(field, torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0)
    assert gathered.grid.valid.any()
    z = gathered.grid.origin[2] + gathered.grid.spacing[2] * torch.arange(gathered.grid.shape[2])
    layers = gathered.grid.valid.view(gathered.grid.shape[::-1])
    assert not layers[z < 0].any() and layers[z > 0].all()
    old = light_of_photos(gathered, even(1.0), no_sun(), None)
    new = relit(gathered, old, old, Surfaces(lambda up, _: (up > 0.8).float(), 0.87))
    seen = new.irradiance(torch.tensor([[0.3, 0.2, 0.02]]), UP)[0]
    assert seen.numpy() == pytest.approx(math.pi, rel=0.03)


def test_probes_in_a_cutting_count():
    """Its sides are ground, too, and most rays upwards end on them."""
    sides = [
        Box((low, -60.0, -2.5), (high, 60.0, 7.0), (0.2,) * 3)
        for low, high in ((-60.0, -1.5), (1.5, 60.0))
    ]
    bottom = Box((-60.0, -60.0, -2.5), (60.0, 60.0, 0.0), (0.2,) * 3)
    field = LabelledField([bottom, *sides], classes=[ROAD] * 3, box=((-60, -60, -2.6), (60, 60, 9)))
    gathered = gather(field, torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0)
    grid = gathered.grid
    nodes = (grid.origin[a] + grid.spacing[a] * torch.arange(grid.shape[a]) for a in range(3))
    x, _, z = nodes
    layers = grid.valid.view(grid.shape[::-1])
    between = (x.abs() < 1.2).nonzero()[:, 0]
    low = ((z > 0.5) & (z < 4)).nonzero()[:, 0]
    assert len(between) and len(low)
    assert layers[low][:, :, between].all()


def test_the_same_light_changes_nothing(gathered):
    old = light_of_photos(gathered, even(1.0), no_sun(), None)
    new = relit(gathered, old, old)
    torch.testing.assert_close(new.coefficients, old.coefficients, rtol=0.02, atol=0.02)


def test_twice_the_sky_is_twice_the_light(gathered):
    old = light_of_photos(gathered, even(1.0), no_sun(), None)
    new = relit(gathered, old, SceneLight(old.grid, old.coefficients, even(2.0), no_sun(), None))
    above = old.grid.valid.clone()
    above[: old.grid.shape[0] * old.grid.shape[1]] = False  # the lowest are in the ground
    torch.testing.assert_close(
        new.coefficients[above], 2 * old.coefficients[above], rtol=0.02, atol=0.06
    )


def test_surfaces_keep_part_of_their_tint_and_are_no_whiter_than_usual(gathered):
    white = torch.full((3,), math.pi)
    assert torch.allclose(
        plausible_surfaces(gathered, white).radiance, gathered.radiance, atol=1e-6
    )
    orange = replace(gathered, radiance=gathered.radiance * torch.tensor([1.5, 1.0, 0.5]))
    found = plausible_surfaces(orange, white).radiance
    met = found[..., 1] > 0.1
    torch.testing.assert_close(luma(found), luma(orange.radiance), rtol=1e-4, atol=1e-5)
    tint = found[met] / luma(found[met])[:, None]
    before = orange.radiance[met] / luma(orange.radiance[met])[:, None]
    torch.testing.assert_close(tint - 1, SATURATION * (before - 1), rtol=1e-3, atol=1e-3)
    # Albedo .2 and light that is found three times too weak: .6, where .3 is believed.
    weak = plausible_surfaces(gathered, white / 3).radiance
    torch.testing.assert_close(weak, 0.5 * gathered.radiance, rtol=0.02, atol=1e-4)
    # Under a blue light grey surfaces are blue, and stay so.
    blue = torch.tensor([0.5, 1.0, 1.5])
    grey = replace(gathered, radiance=gathered.radiance * blue)
    torch.testing.assert_close(plausible_surfaces(grey, white * blue).radiance, grey.radiance)


def test_the_tint_of_the_photos_light_is_bounded_as_cameras_balance_it():
    """A blue sky between leaves keeps a part of its tint; that of an open sky stays."""
    blue = torch.tensor([0.61, 0.93, 1.31])
    found = camera_balance(blue) * blue
    assert float(luma(found)) == pytest.approx(float(luma(blue)), rel=1e-5)
    assert 0.7 < float(found[0] / found[2]) < 0.8
    assert found[0] < found[1] < found[2]
    assert camera_balance(torch.tensor([0.0, 0.5, 1.0])).isfinite().all()
    pale = torch.tensor([1.06, 1.10, 1.14])
    assert camera_balance(pale).tolist() == pytest.approx([1, 1, 1], abs=0.003)
    red = torch.tensor([0.9, 0.5, 0.3])
    assert 1.3 < float((camera_balance(red) * red)[0] / (camera_balance(red) * red)[2]) < 1.4


def test_a_new_light_is_balanced_among_red_walls(gathered):
    warm = torch.tensor([1.2, 1.0, 0.9])
    light = light_of_photos(gathered, even(1.0), no_sun(), None)
    light = replace(light, coefficients=light.coefficients * warm)
    eyes = torch.tensor([[0.3, 0.2, 1.7], [-0.5, 0.4, 1.6]])
    found = white_balanced(light, eyes)
    sheet = found.irradiance(eyes, UP.expand(2, 3)).mean(0)
    sky = found.open_irradiance()
    assert torch.allclose(sheet / luma(sheet), torch.ones(3), atol=0.01), "as in the open before"
    assert float(sky[0] / sky[2]) == pytest.approx(0.9 / 1.2, rel=0.02)
    assert luma(sheet) == pytest.approx(
        float(luma(light.irradiance(eyes, UP.expand(2, 3)).mean(0)))
    )


def test_a_probe_inside_a_block_is_invalid():
    block = Box((-3.0, -3.0, 0.0), (3.0, 3.0, 8.0))
    field = AnalyticField([HalfSpace(), block], box=((-60, -60, -1), (60, 60, 12)))
    grid = gather(field, torch.tensor([0.0, 0.0, 1.6]), 2.0, 0.0).grid
    nodes = scene_light.probes  # the module; positions follow from the grid
    assert nodes is probes
    nx, ny, nz = grid.shape
    k, j, i = torch.meshgrid(*(torch.arange(n) for n in (nz, ny, nx)), indexing="ij")
    x = grid.origin + torch.stack([i, j, k], -1).reshape(-1, 3) * grid.spacing
    inside = (x[:, :2].abs() < 2.5).all(-1) & (x[:, 2] > 0.5) & (x[:, 2] < 7.5)
    outside = (x[:, :2].abs() > 3.5).any(-1) & (x[:, 2] > 0.5)
    assert inside.any() and not grid.valid[inside].any()
    assert grid.valid[outside].all()
