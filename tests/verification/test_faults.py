"""Every check can fail: a fault in the physics fails the checks that it concerns, and no other."""

import dataclasses
import itertools

import pytest
import torch

from climatenerf.verification.suite import verify_program
from climatenerf.weather import media
from climatenerf.weather.flood import fresnel, optics
from climatenerf.weather.flood import surface as flood
from climatenerf.weather.smog import entity as smog
from climatenerf.weather.smog import medium
from climatenerf.weather.snow import layer as snow


def scaled(factor):
    """Replaces a function by one that returns its values times a factor."""

    def change(original):
        return lambda *args, **options: original(*args, **options) * factor

    return change


def denser_smog(original):
    def make(*args):
        air = original(*args)
        return air and dataclasses.replace(air, sigma=1.05 * air.sigma)

    return make


def glowing(original):
    def attenuate(media_, radiance, rays_o, rays_d, t):
        seen = original(media_, radiance, rays_o, rays_d, t)
        return seen + 0.02 * (1 - media.transmittance(media_, rays_o, rays_d, t))[:, None]

    return attenuate


def schlick(original):
    def reflectance(cos, ior, below=False):
        least = ((ior - 1) / (ior + 1)) ** 2
        return least + (1 - least) * (1 - cos.clamp(0, 1)) ** 5

    return reflectance


def everything_passes(original):
    def shade(reflected, reflectance, background, transmittance, body):
        return reflectance[:, None] * reflected + background * transmittance

    return shade


def denser_glass(original):
    return lambda d, normal, ior, below: original(d, normal, 1.008 * ior, below)


def flipped(original):
    return lambda d, normal: original(d, normal) * torch.tensor([-1.0, 1.0, 1.0])


def losing_water_as_it_rises(factor):
    def change(original):
        def fraction_behind(self, *args):
            return original(self, *args) * (factor if 0.04 < self.level < 0.1 else 1.0)

        return fraction_behind

    return change


def flooding_from_below(original):
    def fraction_behind(self, *args):
        behind = original(self, *args)
        return torch.ones_like(behind) if self.level < -0.5 else behind

    return fraction_behind


def deeper_layer(original):
    def shade(self, *args):
        rgb, normal, layers = original(self, *args)
        return rgb, normal, {"water_depth": 1.2 * layers["water_depth"]}

    return shade


def of_one_seed(original):
    return lambda parameters, seed, **options: original(parameters, 0, **options)


def of_any_seed(original):
    seeds = itertools.count()
    return lambda parameters, seed, **options: original(parameters, next(seeds), **options)


def never_nothing(original):
    def optical_depth(air, rays_o, rays_d, t):
        return original(air, rays_o, rays_d, t) + (1e-3 if air.sigma == 0 else 0)

    return optical_depth


def dry_bottom(original):
    return lambda dry, *light, **water: dry


def gamma(original):
    return lambda display: tuple(each**2 for each in display)


SMOG = {"transmittance", "airlight", "visibility", "fall-off to ground", "fall-off to sky"}
FAULTS = {
    "5 % denser smog": (smog, "medium", denser_smog, {f"smog {name}" for name in SMOG}),
    "visibility": (medium, "sigma_from_visibility", scaled(1.05), {"smog visibility"}),
    "gamma of the smog's colour": (medium, "linear_colour", gamma, {"smog airlight"}),
    "fall-off of finite rays": (
        medium,
        "_decaying_length",
        scaled(1.05),
        {"smog fall-off to ground"},
    ),
    "fall-off of infinite rays": (
        medium,
        "_infinite_equivalent_length",
        scaled(1.05),
        {"smog fall-off to sky"},
    ),
    "smog that emits": (
        media,
        "attenuate",
        glowing,
        {"smog airlight", "white furnace smog", "no effect of faint smog"},
    ),
    "Schlick's approximation": (
        fresnel,
        "reflectance",
        schlick,
        {"Fresnel reflectance", "Fresnel at Brewster's angle"},
    ),
    "2 % more reflection": (
        fresnel,
        "reflectance",
        scaled(1.02),
        {"Fresnel reflectance", "Fresnel at Brewster's angle", "Fresnel normal incidence"},
    ),
    "light that is reflected and passes too": (
        optics,
        "shade",
        everything_passes,
        {"Fresnel energy", "water wet bottom", "white furnace water"},
    ),
    "refraction by another index": (
        optics,
        "refract",
        denser_glass,
        {"Snell direction", "Snell apparent depth"},
    ),
    "5 % more absorption": (
        optics,
        "attenuation",
        lambda original: lambda asked: tuple(1.05 * each for each in original(asked)),
        {"water absorption"},
    ),
    # The bottom of the absorption's check is wet as well.
    "the dry bottom": (
        optics,
        "bottom_radiance",
        dry_bottom,
        {"water absorption", "water wet bottom"},
    ),
    "a flipped mirror": (optics, "mirror", flipped, {"mirror image"}),
    "mud that is darker": (optics, "body_colour", scaled(0.9), {"white furnace water"}),
    "snow that is darker": (snow.BakedSnow, "_shaded", scaled(0.95), {"white furnace snow"}),
    "a fifth more snow": (
        snow,
        "grow",
        lambda original: lambda deposits, depth: original(deposits, 1.2 * depth),
        {"snow depth"},
    ),
    "a wrong snow layer": (snow.BakedSnow, "thickness", scaled(1.2), {"snow layer"}),
    "less water at a higher level": (
        flood.Water,
        "fraction_behind",
        losing_water_as_it_rises(0.4),
        {"flood levels nested", "flood coverage"},
    ),
    "a little less water at a higher level": (
        flood.Water,
        "fraction_behind",
        losing_water_as_it_rises(0.98),
        {"flood coverage"},
    ),
    "a wrong water layer": (flood.Water, "shade", deeper_layer, {"flood water depth"}),
    "one seed for all": (flood, "make_waves", of_one_seed, {"other seed"}),
    "a seed of its own": (flood, "make_waves", of_any_seed, {"same seed"}),
    "smog without extinction": (
        medium,
        "optical_depth",
        never_nothing,
        {"no effect", "no effect on layers"},
    ),
    "a longest visibility": (
        medium,
        "sigma_from_visibility",
        lambda original: lambda *args: max(original(*args), 0.02),
        {"no effect of faint smog"},
    ),
    "water through the ground": (
        flood.Water,
        "fraction_behind",
        flooding_from_below,
        {"no effect of faint flood"},
    ),
    "a least depth of snow": (
        snow,
        "grow",
        lambda original: lambda deposits, depth: original(deposits, max(depth, 0.02)),
        {"no effect of faint snow"},
    ),
}


def failing(checks):
    return {check.name for check in checks if not check.passed}


@pytest.fixture(scope="module", autouse=True)
def deposits_are_found_once():
    """Where snow lands does not depend on any fault below, and takes half of the time."""
    find, found = snow.find_deposits, {}

    def find_once(field, parameters, grid, light, cameras, seed, progress=None, appearance=None):
        key = repr((field, dataclasses.replace(parameters, depth=0.0), grid, light, seed))
        if key not in found:
            found[key] = find(field, parameters, grid, light, cameras, seed)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snow, "find_deposits", find_once)
        yield


@pytest.fixture(scope="module")
def checks(deposits_are_found_once):
    return verify_program()


def test_every_check_passes_with_figures_well_within_the_thresholds(checks):
    assert not failing(checks)
    names = [check.name for check in checks]
    assert len(set(names)) == len(names)
    assert all(check.threshold is not None and check.source for check in checks)


def test_every_check_has_a_fault_that_fails_it(checks):
    covered = set().union(*(names for *_, names in FAULTS.values()))
    assert covered == {check.name for check in checks}


# Each runs the whole suite, for four seconds; every ninth is among the quick tests.
TRIALS = [
    pytest.param(fault, marks=[] if i % 9 == 0 else pytest.mark.slow)
    for i, fault in enumerate(FAULTS)
]


@pytest.mark.parametrize("fault", TRIALS)
def test_a_fault_fails_exactly_the_matching_checks(fault, monkeypatch):
    where, name, change, expected = FAULTS[fault]
    fresnel.diffuse_reflectances(1.333)  # cached, so that no fault changes what it keeps
    monkeypatch.setattr(where, name, change(getattr(where, name)))
    assert failing(verify_program()) == expected
