"""The snow's ablation: rows that differ in colour alone."""

import numpy as np
import pytest
import torch
from support.study_yard import patch_shot

from climatenerf.core.errors import UserError
from climatenerf.studies import snow_ablation as a
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

SUN = Sun(elevation=np.radians(25), azimuth=np.radians(90))
WEATHER = Weather(snow=Snow(depth=0.15, light="paper"), sun=SUN)


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return patch_shot(tmp_path_factory.mktemp("yard"), WEATHER)


@pytest.fixture(scope="module")
def world(shot):
    return shot.session().world(0.0)


@pytest.fixture(scope="module")
def rows(shot):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(a, "MIN_PIXELS", 100)
        return {row.name: row for row in a.snow_ablation(shot, lambda name: None)}


def test_wrap_alone_makes_snow_flat_or_fully_diffuse(world):
    """(n.l + gamma)/(1 + gamma): 1 for an endless gamma, max(0, n.l) for none."""
    snow = a.snow_of(world)
    x = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    x[:, 2] = 0.1 + 0.1 * x[:, 2].abs()
    towards = torch.tensor([np.cos(SUN.elevation), 0.0, np.sin(SUN.elevation)]).float()
    facing = snow.normal(x) @ towards
    flat = a.with_wrap(snow, a.ENDLESS_WRAP).colour(x)
    diffuse, full = a.with_wrap(snow, 0.0).colour(x), snow.colour(x)
    torch.testing.assert_close(diffuse, flat * facing.clamp_min(0)[:, None])
    torch.testing.assert_close(full, flat * ((facing + 8) / 9)[:, None])
    assert facing.std() > 0.01 and flat.std() > 0


def test_pure_white_snow_has_one_colour(rows):
    white = rows["pure white"]
    assert white.metrics["luma_deviation_255"] == pytest.approx(0, abs=1e-9)
    assert (white.picture == 255).all(-1).mean() > 0.5


def test_all_rows_show_their_faults_and_none_equals_the_full_one(rows):
    assert tuple(rows) == a.ROWS
    for name, row in rows.items():
        assert row.shown, f"{name}: {row.fault}"
        assert name == "full" or not np.array_equal(row.picture, rows["full"].picture)


def test_the_change_with_n_l_is_that_of_wrap_lighting():
    facing = np.linspace(-0.2, 1.0, 50)
    luma = 0.7 * (facing + 8) / 9
    assert a.relative_slope(luma, facing) == pytest.approx(1 / (0.4 + 8))
    assert a.relative_slope(np.full(50, 0.7), facing) == pytest.approx(0, abs=1e-12)
    assert a.relative_slope(luma, np.full(50, 0.6)) == 0.0
    assert a.correlation(luma, facing) == pytest.approx(1.0)


GOOD = {
    "pure white": {"luma_deviation_255": 0.0},
    "varying colour only": {"relative_change_with_facing": 0.01},
    "diffuse": {"darkest_over_brightest": 0.3},
    "full": {
        "luma_deviation_255": 9.0, "relative_change_with_facing": 0.1,
        "darkest_over_brightest": 0.85,
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("pure white", {"luma_deviation_255": 0.5}),
        ("varying colour only", {"relative_change_with_facing": 0.06}),
        ("diffuse", {"darkest_over_brightest": 0.75}),
        ("full", {"darkest_over_brightest": 0.6}),
        ("diffuse", {"difference_from_full_255": 0.0}),
    ],
)
def test_a_row_whose_number_does_not_show_its_fault_is_told(name, changed):
    plain = {"difference_from_full_255": 9.0, "darkest_over_brightest": 0.9, "psnr_snow_db": 15.0}
    found = {row: plain | own for row, own in GOOD.items()}
    assert all(a.verdict(row, found)[1] for row in a.ROWS)
    assert "the best of all rows" in a.verdict("full", found)[0]
    found[name] |= changed | {"psnr_snow_db": 16.0}
    assert not a.verdict(name, found)[1]
    if name != "full":
        assert f"which {name} exceeds" in a.verdict("full", found)[0]


def test_a_picture_without_snow_is_refused(shot):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(UserError, match="too little snow"):
        patch.setattr(a, "MIN_PIXELS", 10**6)
        a.snow_ablation(shot, lambda name: None)
