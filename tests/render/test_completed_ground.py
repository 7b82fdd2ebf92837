"""Ground that the terrain completes: what rays, weather and layers find on it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from support.gaussian_field import GaussianField, plain_with_stones
from support.holed_ground import GREY, HALF, POST, WIDE, LabelledField, holed, terrain_of, whole
from support.scene_builders import look_at

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import ROAD, SOLID, SOLID_OF, TERRAIN, UNKNOWN
from climatenerf.core.samples import COMPLETED
from climatenerf.field.analytic import AnalyticField, Box
from climatenerf.field.capabilities import APPEARANCE, COMPLETES, FUSED
from climatenerf.field.compositing import composited
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import ground_height, observed
from climatenerf.render.completed_ground import DROP, CompletedField, continued
from climatenerf.render.frame import traced_rays
from climatenerf.render.integrator import trace
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

CAMERA = Camera(48, 32, 30.0, 30.0, 24.0, 16.0)
C2W = look_at((0.3, -4.5, 2.0), (0.1, 0.2, 0.0))
INSIDE = HALF - 0.3
"""Half the side of the part of the hole where the raster has its own height, m."""


def completed(field=None, **terrain):
    return CompletedField(field or holed(), terrain_of(**terrain))


def camera_rays():
    o, d, angle = traced_rays(CAMERA, C2W)
    return o, d, angle


def through_hole(o, d, margin=INSIDE):
    """Whether rays meet z = 0 inside the hole, and where."""
    t = -o[:, 2] / d[:, 2]
    x = o + t[:, None] * d
    return (d[:, 2] < 0) & (x[:, :2].abs() < margin).all(-1), t


def session(field, tmp_path, **sections):
    views = tuple(View(f"{i}.png", tmp_path / f"{i}.png", 0, C2W) for i in range(3))
    return RenderSession(field, Scene(tmp_path, "test", (CAMERA,), views), Weather(**sections))


def frame(field, tmp_path, layers=("normal", "label"), **sections):
    return session(field, tmp_path, **sections).frame(CAMERA, C2W, layers=layers)


# --- rays ---------------------------------------------------------------------------------------


def test_rays_through_the_hole_meet_the_raster():
    o, d, angle = camera_rays()
    hole, t = through_hole(o, d)
    assert 0.1 < hole.float().mean() < 0.9
    before, seen = (trace(World(field), o, d, angle) for field in (holed(), completed()))
    assert (before.depth[hole] > t[hole] + 0.2).all(), "the field has nothing there"
    assert (seen.depth - t)[hole].abs().max() < 2e-3
    assert (seen.rgb[hole] - torch.tensor(GREY)).abs().max() < 1e-4
    assert (seen.layers["seen"][hole] < 1e-4).all()


def test_all_other_rays_are_those_of_the_field_to_the_bit():
    o, d, angle = camera_rays()
    near, _ = through_hole(o, d, HALF + 1.0)
    before, seen = (trace(World(field), o, d, angle) for field in (holed(), completed()))
    assert 0.1 < near.float().mean() < 0.9
    for name in ("rgb", "depth", "transmittance"):
        assert torch.equal(getattr(seen, name)[~near], getattr(before, name)[~near]), name
    assert (seen.layers["seen"][~near] == 1).all()
    samples = [f.march(o[~near], d[~near], 0 * angle[~near], 0 * angle[~near] + 1e9)
               for f in (holed(), completed())]  # fmt: skip
    assert all(torch.equal(getattr(samples[0], k), getattr(samples[1], k))
               for k in ("offsets", "t", "dt", "sigma"))  # fmt: skip


def test_no_gap_is_left_between_the_ground_and_its_completion():
    """Every ray that goes down near the hole ends, whatever the slant."""
    generator = torch.Generator().manual_seed(0)
    foot = torch.rand(4000, 3, generator=generator) * 2 * (HALF + 0.6) - HALF - 0.6
    foot[:, 2] = 0.0
    d = torch.randn(4000, 3, generator=generator)
    d[:, 2] = -d[:, 2].abs() - 0.3
    d = torch.nn.functional.normalize(d, dim=-1)
    seen = trace(World(completed()), foot - 3 * d, d, torch.full((4000,), 1e-3))
    height = (foot - 3 * d + seen.depth[:, None] * d)[:, 2]
    assert (height > -DROP - 0.02).all() and (height < 2.1).all()


def test_a_ray_has_one_sample_on_completed_ground():
    o, d, angle = camera_rays()
    hole, t = through_hole(o, d)
    field = completed()
    samples = field.march(o, d, torch.zeros_like(angle), torch.full_like(angle, torch.inf))
    assert samples.ids is not None
    own = samples.ids == COMPLETED
    ray = samples.ray_index()
    assert torch.bincount(ray[own], minlength=len(o))[hole].eq(1).all()
    assert torch.bincount(ray[own], minlength=len(o)).max() == 1
    assert torch.allclose(samples.t[own & hole[ray]], t[ray[own & hole[ray]]], atol=2e-3)
    assert (samples.sigma * samples.dt)[own].min() > 10
    for r in hole.nonzero()[::20, 0]:
        part = samples.t[samples.offsets[r] : samples.offsets[r + 1]]
        assert (part.diff() >= 0).all(), "front to back"


def test_spans_end_before_and_begin_behind_the_ground():
    field = completed()
    o = torch.tensor([[0.2, 0.1, 2.0]]).repeat(4, 1)
    d = torch.tensor([[0.0, 0.0, -1.0]]).repeat(4, 1)
    d[3, 2] = 1.0
    t_min, t_max = torch.tensor([0.0, 0.0, 2.1, 0.0]), torch.tensor([9.0, 1.9, 9.0, 9.0])
    samples = field.march(o, d, t_min, t_max)
    assert samples.offsets.diff().tolist() == [1, 0, 0, 0]
    from_below = torch.tensor([[0.2, 0.1, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    assert field.march(*from_below, t_min[:1], t_max[:1]).t.numel() == 0


def test_matter_in_front_of_the_hole_hides_its_completion():
    lid = Box((-2.5, -2.5, 0.5), (2.5, 2.5, 0.6), (0.9, 0.1, 0.1))
    o, d, angle = camera_rays()
    field = replace(holed(), solids=[*holed().solids, lid])
    seen = trace(World(completed(field)), o, d, angle)
    x = o + ((0.6 - o[:, 2]) / d[:, 2])[:, None] * d
    hidden = (x[:, :2].abs() < 2.4).all(-1) & (d[:, 2] < 0)
    assert hidden.float().mean() > 0.1
    # The lid ends at a transmittance of 3e-4.
    assert (seen.layers["seen"][hidden] > 0.999).all()
    assert (seen.rgb[hidden] - torch.tensor([0.9, 0.1, 0.1])).abs().max() < 2e-3


def test_compositing_in_several_launches_agrees_with_the_renderer():
    o, d, angle = camera_rays()
    field = completed(replace(holed(), capabilities=holed().capabilities | {FUSED}))
    assert COMPLETES in field.capabilities and FUSED not in field.capabilities
    rgb, transmittance, length = composited(field, o, d, torch.zeros_like(angle))
    same = field.composite(o, d, torch.zeros_like(angle))
    seen = trace(World(field), o, d, angle)
    assert all(torch.equal(a, b) for a, b in zip((rgb, transmittance, length), same, strict=True))
    hole, t = through_hole(o, d)
    assert torch.allclose(rgb[hole], seen.rgb[hole], atol=1e-5)
    assert transmittance[hole].max() < 1e-4 and (length - t)[hole].abs().max() < 3e-3


# --- valleys ------------------------------------------------------------------------------------


def test_nothing_is_completed_where_photos_look_through():
    """A valley: the raster spans it, and photos see what lies below."""
    valley = ~terrain_of().seen
    o, d, angle = camera_rays()
    before = trace(World(holed()), o, d, angle)
    for field in (
        completed(open=valley),
        completed(seen=np.ones_like(valley)),
    ):
        seen = trace(World(field), o, d, angle)
        assert torch.equal(seen.rgb, before.rgb)
        assert torch.allclose(seen.depth, before.depth, rtol=1e-5)
        assert (seen.layers["seen"] == 1).all()


def test_beyond_the_raster_nothing_is_completed():
    field = CompletedField(holed(half=30.0), terrain_of(half=30.0))
    o = torch.tensor([[7.9, 0.0, 2.0], [8.1, 0.0, 2.0], [0.0, -8.1, 2.0], [0.0, 7.9, 2.0]])
    d = torch.tensor([0.0, 0.0, -1.0]).repeat(4, 1)
    samples = field.march(o, d, torch.zeros(4), torch.full((4,), 1e9))
    assert samples.offsets.diff().tolist() == [1, 0, 0, 1]


# --- colours, normals, classes ------------------------------------------------------------------


def test_colours_change_smoothly_from_one_side_of_the_hole_to_the_other():
    red, blue = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)
    field = completed(holed(colours=(red, blue)))
    x = torch.zeros(41, 3)
    x[:, 0] = torch.linspace(-HALF + 0.1, HALF - 0.1, 41)
    d = torch.tensor([0.0, 0.0, -1.0]).repeat(41, 1)
    colour = field.colour(x, d, ids=torch.full((41,), COMPLETED))
    assert (colour[0] - torch.tensor(red)).abs().max() < 0.15
    assert (colour[-1] - torch.tensor(blue)).abs().max() < 0.15
    assert colour[:, 0].diff().max() < 0.01, "red decreases"
    assert colour.diff(dim=0).abs().max() < 0.1, "without an edge"
    slanted = torch.nn.functional.normalize(torch.tensor([0.5, 0.3, -1.0]), dim=0).repeat(41, 1)
    assert torch.equal(field.colour(x, slanted, ids=torch.full((41,), COMPLETED)), colour)


def test_positions_without_ids_have_the_colour_of_what_lies_there():
    field = completed()
    x = torch.tensor([[0.0, 0.0, 0.01], [4.5, 4.5, 2.0], [0.1, 0.2, 1.0]])
    d = torch.tensor([0.0, 0.0, -1.0]).repeat(3, 1)
    colour = field.colour(x, d)
    assert torch.allclose(colour[0], torch.tensor(GREY), atol=1e-4)
    assert torch.equal(colour[1:], holed().colour(x[1:], d[1:]))
    one_ray = field.colour(x, d[:1], torch.zeros(3, dtype=torch.long))
    assert torch.equal(one_ray, colour)


@dataclass(frozen=True)
class ExposedField(LabelledField):
    """Colours are multiplied by the appearance."""

    capabilities: frozenset[str] = holed().capabilities | {APPEARANCE}

    def colour(self, x, d, ray=None, *, ids=None, appearance=None):
        exposure = 1.0 if appearance is None else float(appearance)
        return exposure * super().colour(x, d, ray, ids=ids, appearance=appearance)

    def photo_appearance(self, index):
        return torch.tensor([[1.0 + index]])


def test_completed_ground_has_the_appearance_of_the_photo():
    plain = holed()
    field = completed(ExposedField(plain.solids, classes=plain.classes))
    x, d = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]])
    ids = torch.full((1,), COMPLETED)
    for index, factor in ((1, 2.0), (0, 1.0), (1, 2.0)):
        given = {"ids": ids, "appearance": field.photo_appearance(index)}
        assert torch.allclose(field.colour(x, d, **given), factor * torch.tensor([GREY]), atol=1e-4)
    assert torch.allclose(field.colour(x, d, ids=ids), torch.tensor([GREY]), atol=1e-4)


def test_normals_and_labels_are_those_of_the_terrain(tmp_path):
    label = np.full_like(terrain_of().label, UNKNOWN)
    label[terrain_of().seen] = TERRAIN
    field = completed(label=label)
    o, d, _ = camera_rays()
    hole = through_hole(o, d)[0].reshape(32, 48).numpy()
    layers = frame(field, tmp_path).layers
    assert (layers["label"][hole] == TERRAIN).all()
    away = ~through_hole(o, d, HALF + 1.0)[0].reshape(32, 48).numpy()
    assert np.array_equal(layers["label"][away], frame(holed(), tmp_path).layers["label"][away])
    assert np.allclose(layers["normal"][hole], (0, 0, 1), atol=1e-3)
    assert (layers["seen"][hole] < 1e-3).all() and (layers["seen"][away] == 1).all()


def test_normals_follow_the_slope_of_the_terrain():
    field = completed(height=lambda x, y: 0.3 * x - 0.2 * y)
    foot = torch.tensor([[0.5, 0.5, 0.0], [-0.9, 0.3, 0.0]])
    d = torch.tensor([[0.0, 0.0, -1.0]]).repeat(2, 1)
    o = foot + torch.tensor([0.0, 0.0, 3.0])
    samples = field.march(o, d, torch.zeros(2), torch.full((2,), 1e9))
    normal, logits = field.surface_heads(o, d, samples, torch.arange(2))
    expected = torch.nn.functional.normalize(torch.tensor([[-0.3, 0.2, 1.0]]), dim=-1)
    assert torch.allclose(normal, expected.expand(2, 3), atol=1e-4)
    assert SOLID[logits.argmax(-1)].tolist() == [ROAD, ROAD]
    assert torch.allclose(samples.t, 3 - torch.tensor([0.05, -0.33]), atol=2e-3)


def test_density_is_present_on_completed_ground_alone():
    field = completed()
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, -0.5], [4.5, 4.5, 1.0],
                      [5.0, -5.0, -0.3], [20.0, 0.0, 0.0]])  # fmt: skip
    assert (field.density(x) > 100).tolist() == [True, False, False, True, True, False]
    assert torch.equal(field.density(x[1:]), holed().density(x[1:]))


def test_what_no_photo_shows_is_left_out_but_completion_is_kept():
    cloud = Box((-1.0, -1.0, 0.8), (1.0, 1.0, 1.2), (0.9, 0.9, 0.9))
    inner = LabelledField(holed().solids, classes=holed().classes, unobserved=(cloud,))
    field = completed(inner)
    o, d = torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    angle = torch.full((1,), 1e-3)
    assert float(trace(World(field), o, d, angle).depth) == pytest.approx(1.8, abs=0.01)
    assert float(trace(World(observed(field)), o, d, angle).depth) == pytest.approx(3, abs=2e-3)
    assert COMPLETES in observed(field).capabilities


# --- weather ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_flood_lies_on_completed_ground(tmp_path):
    o, d, _ = camera_rays()
    level = 0.3
    flood = Flood(level=level, wind_speed=0.0)
    layers = frame(completed(), tmp_path, flood=flood).layers
    hole = through_hole(o, d)[0].reshape(32, 48).numpy()
    assert (layers["mask_water"][hole] > 0.999).all()
    # Refraction moves the bottom that the layer measures: it is that along the straight ray.
    assert np.abs(layers["water_depth"][hole] - level).max() < 5e-3
    assert (layers["seen"][hole] < 0.01).all(), "also under water"
    without = frame(holed(), tmp_path, flood=flood).layers
    assert (np.abs(without["water_depth"][hole] - level) > 0.1).mean() > 0.5


def test_snow_lies_on_completed_ground():
    """On a small patch: growing snow takes seconds a square metre."""
    patch = replace(holed(half=0.7), box=((-1.6, -1.6, -1.0), (1.6, 1.6, 1.0)))
    field = CompletedField(patch, terrain_of(half=0.7, side=1.6, cell=0.1))
    snow = bake_snow(field, Snow(depth=0.1), np.array([[0.0, 0.0, 1.5]]), np.full(3, 0.6))
    foot = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    foot[:, 2] = 0.0
    o = torch.tensor([0.1, -0.6, 1.6]).repeat(200, 1)
    d = torch.nn.functional.normalize(foot - o, dim=-1)
    seen = trace(World(field, matters=(snow,)), o, d, torch.full((200,), 2e-3))
    assert seen.layers["mask_snow"].min() > 0.99
    assert (seen.layers["snow_thickness"] - 0.1).abs().max() < 0.01
    assert ((o + seen.depth[:, None] * d)[:, 2] - 0.1).abs().max() < 0.025
    assert (seen.layers["seen"] < 0.01).all(), "the snow lies on ground that no photo shows"


@pytest.mark.slow
@pytest.mark.parametrize(
    "weather",
    [
        {},
        {"smog": Smog(visibility=20.0)},
        {"flood": Flood(level=0.2, wind_speed=0.0)},
    ],
    ids=lambda weather: next(iter(weather), "clear"),
)
def test_weather_on_completed_ground_looks_as_on_whole_ground(tmp_path, weather):
    made, wanted = (
        frame(field, tmp_path, **weather).linear.numpy() for field in (completed(), whole())
    )
    off = np.abs(made - wanted).max(-1)
    assert np.quantile(off, 0.95) < 0.01 and off.mean() < 0.01


# --- other fields -------------------------------------------------------------------------------


def sparse_gaussians() -> GaussianField:
    """The plain without the four Gaussians in its middle, and with the stones away from there."""
    field = plain_with_stones()
    keep = field.mean.abs()[:, :2].amax(-1) > 1.5
    keep[36:] &= field.mean[36:, 1] > 1.2
    parts = (field.mean, field.precision, field.peak, field.colour_mean, field.colour_slope)
    return GaussianField(*(each[keep] for each in parts))


def test_a_field_of_gaussians_is_completed_too(tmp_path):
    gaussians = sparse_gaussians()
    terrain = terrain_of(half=1.0, side=5.0)
    field = CompletedField(gaussians, terrain)
    assert COMPLETES in field.capabilities
    o, d, angle = camera_rays()
    seen, before = (trace(World(each), o, d, angle) for each in (field, gaussians))
    hole, _ = through_hole(o, d, 0.7)
    assert hole.any() and (seen.transmittance == before.transmittance).all()
    assert (seen.layers["seen"][hole] < before.layers["seen"][hole]).all()
    away, _ = through_hole(o, d, 3.0)
    assert (seen.rgb - before.rgb)[~away].abs().max() < 2e-3
    weather = {"flood": Flood(level=0.1), "smog": Smog(visibility=30.0)}
    layers = frame(field, tmp_path, (), **weather).layers
    assert np.isfinite(layers["water_depth"]).all() and layers["mask_water"].max() > 0.5


def test_gaussians_are_coloured_by_their_ids():
    """Also if all samples that are asked for belong to the first Gaussian, whose id is 0."""
    gaussians = sparse_gaussians()
    field = CompletedField(gaussians, terrain_of(half=1.0, side=5.0))
    x = torch.tensor([[0.0, 0.0, 0.0], [3.0, 2.0, 0.5], [1.0, 1.0, 2.0]])
    d = torch.nn.functional.normalize(torch.tensor([[0.3, 0.1, -1.0]]), dim=-1).repeat(3, 1)
    for ids in ([0, 0, 0], [0, 3, 5], [COMPLETED, 0, 0], [COMPLETED, 0, 7]):
        given = torch.tensor(ids)
        own = given == COMPLETED
        colour = field.colour(x, d, ids=given)
        expected = gaussians.colour(x[~own], d[~own], ids=given[~own])
        assert torch.allclose(colour[~own], expected), ids


def test_a_field_without_any_ground_can_be_completed():
    """Its colour is unknown: black."""
    terrain = terrain_of()
    field = CompletedField(
        AnalyticField([POST], box=WIDE), replace(terrain, seen=np.zeros_like(terrain.seen))
    )
    o, d, angle = camera_rays()
    seen = trace(World(field), o, d, angle)
    hole, _ = through_hole(o, d)
    assert (seen.rgb[hole] == 0).all() and (seen.layers["seen"][hole] < 1e-4).all()


# --- continuation of colours --------------------------------------------------------------------


def test_known_values_are_kept_and_constants_continued():
    random = np.random.default_rng(0)
    known = random.random((37, 52)) < 0.05
    values = random.random((37, 52, 3)).astype(np.float32)
    found = continued(values, known)
    assert np.array_equal(found[known], values[known])
    assert found.min() >= values[known].min() - 1e-5 and found.max() <= values[known].max() + 1e-5
    level = continued(np.full((37, 52, 1), 0.25, np.float32), known)
    assert np.allclose(level, 0.25, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (3, 65), (64, 64)])
def test_one_known_value_is_continued_everywhere(shape):
    known = np.zeros(shape, bool)
    known[-1, -1] = True
    assert np.allclose(continued(np.where(known, 0.7, 9.0)[..., None], known), 0.7, atol=1e-5)


def test_nothing_known_is_black():
    assert (continued(np.full((9, 9, 3), 0.5), np.zeros((9, 9), bool)) == 0).all()


def test_the_height_of_the_ground_is_known_up_to_a_gap():
    terrain = terrain_of(lambda x, y: 0.1 * x, side=8.0, cell=0.25)
    wide = np.zeros_like(terrain.seen)
    wide[:, 40:] = True  # from x = 2 m on, photos contradict the terrain
    field = CompletedField(holed(), replace(terrain, open=wide))
    xy = torch.tensor([[-3.0, 0.0], [0.5, 1.0], [2.5, 0.0], [4.5, 0.0], [30.0, 0.0]])
    found = field.ground_height(xy)
    assert found[:3].numpy() == pytest.approx([-0.3, 0.05, 0.25], abs=1e-5)
    assert torch.isnan(found[3:]).all()
    assert torch.isnan(ground_height(holed(), xy)).all(), "a field without terrain"
    assert torch.equal(ground_height(field, xy)[:3], found[:3])


def test_normals_at_a_place_on_completed_ground_are_the_terrains():
    field = CompletedField(holed(), terrain_of(lambda x, y: 0.2 * x))
    x = torch.tensor([[0.5, 0.0, 0.1], [-0.8, 0.4, -0.16]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(2, 3).contiguous()
    normal, kind = normals_at(field, x, down)
    expected = torch.nn.functional.normalize(torch.tensor([-0.2, 0.0, 1.0]), dim=0)
    assert torch.allclose(normal, expected.expand(2, 3), atol=0.02)
    assert (kind == int(SOLID_OF[ROAD])).all()
