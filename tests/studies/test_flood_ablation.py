"""The flood's ablation: each row leaves out one part, and its number shows that."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.study_yard import FIELD, PITCH, yard_shot

from climatenerf.core.errors import UserError
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.render.integrator import trace
from climatenerf.studies import flood_ablation as a
from climatenerf.weather.flood import fresnel
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import PARTS, Water
from climatenerf.weather.flood.waves import at_time, make_waves
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import SurfaceHits, World

BLACK, WHITE, OPAQUE = (0.0,) * 3, (1.0,) * 3, (1e3,) * 3
FLOOD = Flood(level=0.3, wind_speed=3.0)
ANGLES = torch.deg2rad(torch.tensor([10.0, 40.0, 60.0, 75.0, 85.0]))


def still_water(**changed) -> Water:
    flood = Flood(level=0.0, wind_speed=0.0, colour=BLACK, attenuation=OPAQUE, **changed)
    return Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.full((3,), 3.0))


def fan():
    """Rays from 1 m over the water at known angles of incidence."""
    zero = torch.zeros_like(ANGLES)
    d = torch.stack([zero, ANGLES.sin(), -ANGLES.cos()], dim=-1)
    o = torch.tensor([0.0, 0.0, 1.0]).expand_as(d).contiguous()
    return o, d, torch.full_like(ANGLES, 1e-3)


def world_of(water):
    """A white sky over black water without a visible bottom."""
    ground = HalfSpace(offset=-2.0, colour=BLACK)
    field = AnalyticField([ground], zenith=WHITE, horizon=WHITE, box=((-60, -60, -5), (60, 60, 6)))
    return World(field, surfaces=(water,))  # pyright: ignore[reportArgumentType]


# --- the changed surfaces -------------------------------------------------------------------------


def test_the_probe_finds_the_reflectance_of_still_water():
    water, (o, d, angle) = still_water(), fan()
    t = 1 / ANGLES.cos()
    hits = SurfaceHits(o, d, t, torch.zeros_like(t), angle)
    black, share = a.split_by_reflection(water.shade, world_of(water), hits)
    expected = fresnel.reflectance(ANGLES.cos(), 1.333)
    torch.testing.assert_close(share[:, 0], expected, rtol=1e-5, atol=1e-6)
    assert black.abs().max() < 1e-5, "black water in a black world"


def test_water_without_fresnel_reflects_the_same_at_all_angles():
    o, d, angle = fan()
    full = trace(world_of(still_water()), o, d, angle).rgb[:, 0]
    torch.testing.assert_close(full, fresnel.reflectance(ANGLES.cos(), 1.333), rtol=1e-3, atol=1e-4)
    even = trace(world_of(a.as_kind(a.EvenWater, still_water(), 0.37)), o, d, angle).rgb
    assert even == pytest.approx(0.37, rel=1e-3)


def test_water_without_fresnel_keeps_what_it_shows_below_its_surface():
    """Muddy water under a black sky: (1 - R) times its body, R being even."""
    flood = Flood(level=0.0, wind_speed=0.0, colour=WHITE, attenuation=OPAQUE)
    water = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.full((3,), np.pi))
    ground = HalfSpace(offset=-2.0, colour=BLACK)
    box = ((-60, -60, -5), (60, 60, 6))
    dark = AnalyticField([ground], zenith=BLACK, horizon=BLACK, box=box)
    o, d, angle = fan()
    world = World(dark, surfaces=(a.as_kind(a.EvenWater, water, 0.37),))  # pyright: ignore
    assert trace(world, o, d, angle).rgb == pytest.approx(0.63, rel=1e-3)


def test_water_without_gloss_reflects_one_ray():
    flood = replace(FLOOD, level=0.0)
    rough = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.ones(3))
    assert rough.reflected_rays() == PARTS > 1
    assert a.as_kind(a.Mirror, rough).reflected_rays() == 1
    assert still_water().reflected_rays() == 1


def test_water_without_filter_looks_waves_up_at_a_point():
    """A pixel of 0.2 rad filters waves of centimetres; a point does not."""
    flood = replace(FLOOD, level=0.0)
    rough = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.ones(3))
    o, d, angle = fan()
    coarse, fine = torch.full_like(angle, 0.2), torch.full_like(angle, a.POINT)
    unfiltered = a.as_kind(a.UnfilteredWater, rough)
    assert torch.equal(unfiltered.distance(o, d, coarse), rough.distance(o, d, fine))
    normals = []
    for water, width in ((rough, coarse), (unfiltered, coarse), (rough, fine)):
        t = rough.distance(o, d, fine)
        hits = SurfaceHits(o, d, t, torch.zeros_like(t), width)
        normals.append(
            water.shade(world_of(water), hits, lambda o, d, angle: torch.ones_like(o))[1]
        )
    torch.testing.assert_close(normals[1], normals[2])
    assert (normals[0] - normals[2]).abs().max() > 0.01


# --- the numbers ----------------------------------------------------------------------------------


def seen(shot, depth, normal=(0.0, 0.0, 1.0), grey=None):
    """A picture that is all water, at some ray lengths."""
    shape = depth.shape
    layers = {
        "depth": depth,
        "mask_water": np.ones(shape),
        "normal": np.broadcast_to(np.array(normal), (*shape, 3)),
    }
    linear = (
        torch.zeros(*shape, 3) if grey is None else torch.from_numpy(grey)[..., None] * WHITE[0]
    )
    return a.Seen(World(FIELD), shot.c2w, linear.expand(*shape, 3), layers)  # pyright: ignore


def test_the_tilt_is_that_of_the_plane_through_the_water(tmp_path):
    shot = yard_shot(tmp_path, Weather(flood=FLOOD))
    for degrees in (0.0, 2.0, 10.0):
        slope = np.tan(np.radians(degrees))
        normal = np.array([slope * 0.6, slope * 0.8, 1.0])  # of z = -1.2 - slope (.6 x + .8 y)
        depth = -1.2 / (shot.directions() @ normal)
        depth = np.where(depth > 0, depth, np.nan)
        row = seen(shot, depth)
        row.layers["mask_water"] = np.isfinite(depth) & (depth < 30)
        assert a.plane_tilt(row, shot) == pytest.approx(degrees, abs=1e-4)


def test_normals_that_agree_do_not_deviate(tmp_path):
    shot = yard_shot(tmp_path, Weather(flood=FLOOD))
    row = seen(shot, np.ones((4, 6)), (0.0, 0.6, 0.8))
    assert a.normal_deviation(row) == pytest.approx(0.0, abs=1e-6)
    level = seen(shot, np.ones((4, 6)))
    assert a.normal_deviation(level) == 0.0
    tilted = np.zeros((4, 6, 3))
    tilted[..., 2] = np.cos(0.1)
    tilted[::2, :, 0], tilted[1::2, :, 0] = np.sin(0.1), -np.sin(0.1)
    level.layers["normal"] = tilted
    assert a.normal_deviation(level) == pytest.approx(np.degrees(0.1), rel=1e-6)


def test_ranks_tell_any_rising_curve_and_constants_have_none():
    x = np.linspace(0, 1, 50)
    assert a.rank_correlation(np.exp(5 * x), x) == pytest.approx(1.0)
    assert a.rank_correlation(-x, x) == pytest.approx(-1.0)
    assert a.rank_correlation(np.full(50, 0.23) + 1e-7 * x, x) == 0.0


def test_the_gradient_energy_is_that_of_neighbours_in_water(tmp_path):
    shot = yard_shot(tmp_path, Weather(flood=FLOOD))
    stripes = np.zeros((6, 8), np.float32)
    stripes[:, ::2] = 1.0  # black and white columns: every horizontal pair differs by 1
    row = seen(shot, np.ones((6, 8)), grey=stripes)
    assert a.gradient_energy(row) == pytest.approx(42 / (42 + 40))
    row.layers["mask_water"] = np.zeros((6, 8))
    row.layers["mask_water"][:, 0] = 1
    assert a.gradient_energy(row) == 0.0, "one column alone"


GOOD = {
    "tilted plane": {"tilt_deg": 1.5, "water_share": 0.5, "psnr_water_db": 21.0},
    "no waves": {"normal_deviation_deg": 0.0, "mirror_psnr_db": 32.0, "psnr_water_db": 17.0},
    "no Fresnel": {"reflectance_correlation": 0.0, "psnr_water_db": 19.0},
    "no gloss": {"gradient_energy": 3.0, "psnr_water_db": 22.0},
    "no anti-aliasing": {"far_error": 2.5, "psnr_water_db": 25.0},
    "full": {
        "tilt_deg": 0.1, "water_share": 0.5, "normal_deviation_deg": 6.0, "far_error": 1.0,
        "reflectance_correlation": 0.95, "gradient_energy": 1.0, "psnr_water_db": 27.0,
    },
}  # fmt: skip


def metrics(**changed):
    found = {name: {"difference_from_full_255": 9.0, **row} for name, row in GOOD.items()}
    for name, row in changed.items():
        found[name.replace("_", " ")] |= row
    return found


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("tilted plane", {"tilted plane": {"tilt_deg": 0.2}}),
        ("tilted plane", {"full": {"tilt_deg": 0.6}, "tilted plane": {"tilt_deg": 9.0}}),
        ("no waves", {"no waves": {"normal_deviation_deg": 0.1}}),
        ("no waves", {"no waves": {"mirror_psnr_db": 15.0}}),
        ("no Fresnel", {"no Fresnel": {"reflectance_correlation": 0.2}}),
        ("no Fresnel", {"full": {"reflectance_correlation": 0.8}}),
        ("no gloss", {"no gloss": {"gradient_energy": 1.05}}),
        ("no anti-aliasing", {"no anti-aliasing": {"far_error": 1.9}}),
        ("full", {"full": {"tilt_deg": 0.7}}),
        ("no gloss", {"no gloss": {"difference_from_full_255": 0.0}}),
    ],
)
def test_a_row_whose_number_does_not_show_its_fault_is_told(name, changed):
    assert all(a.verdict(row, metrics())[1] for row in a.ROWS)
    assert not a.verdict(name, metrics(**changed))[1]


def test_rows_that_beat_the_full_one_are_named():
    assert "the best of all rows" in a.verdict("full", metrics())[0]
    text = a.verdict("full", metrics(**{"no gloss": {"psnr_water_db": 28.0}}))[0]
    assert "27.00 dB, which no gloss exceeds" in text


def test_up_is_the_mean_of_the_cameras_own(tmp_path):
    """Both cameras look down by the same angle, the second 5.7 degrees to the side."""
    shot = yard_shot(tmp_path, Weather(flood=FLOOD))
    up = a.mean_camera_up(shot.place.scene)
    assert np.degrees(np.arccos(up[2])) == pytest.approx(np.degrees(np.arctan(PITCH)), abs=0.1)
    turn = a.turn_of(shot.place.scene, 0.3)
    assert turn.rotation @ up == pytest.approx([0, 0, 1])
    assert turn.pivot == pytest.approx([0.25, -0.25, 0.3])


def test_all_rows_of_a_yard_show_their_faults(tmp_path):
    rows = a.flood_ablation(yard_shot(tmp_path, Weather(flood=FLOOD)), lambda name: None)
    assert tuple(row.name for row in rows) == a.ROWS
    full = rows[-1].picture
    for row in rows[:-1]:
        assert not np.array_equal(row.picture, full) and row.shown, row.fault
    assert rows[1].metrics["mirror_psnr_db"] == a.EXACT, "a mirror image, exactly"
    assert rows[-1].metrics["mirror_psnr_db"] < 35
    tilt = rows[0].metrics["tilt_deg"]
    assert tilt == pytest.approx(np.degrees(np.arctan(PITCH)), abs=0.2)


def test_a_picture_without_water_is_refused(tmp_path):
    shot = yard_shot(tmp_path, Weather(flood=replace(FLOOD, level=-0.5)))
    with pytest.raises(UserError, match="too little water"):
        a.flood_ablation(shot, lambda name: None)
