"""A staff gauge and a figure in a scene, against their own signed distances and in water."""

import math

import numpy as np
import pytest
import torch
from support.holed_ground import holed, terrain_of
from support.study_yard import FIELD, LABELLED, pose, yard_place

from climatenerf.core.cameras import Camera
from climatenerf.core.samples import COMPLETED, PLACED
from climatenerf.field.inserted import NO_ID
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.placed_objects import (
    FIGURE_HEIGHT,
    Figure,
    StaffGauge,
    gauge_face,
    with_objects,
)
from climatenerf.render.session import RenderSession
from climatenerf.verification.setting import protocol_of
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather

GAUGE = StaffGauge((0.3, 4.0, 0.0), 1.6, 0.0, -math.pi / 2 + 0.2)
FIGURE = Figure((-0.6, 4.0, 0.0), 0.3)
OBJECTS = [GAUGE, FIGURE]
LIGHT = torch.tensor([1.0, 1.2, 1.4])


def rays(count=4000, seed=0):
    rng = np.random.default_rng(seed)
    o = torch.tensor(rng.uniform((-3, -1, 0.2), (3, 1, 2.5), (count, 3))).float()
    aim = torch.tensor(rng.uniform((-1, 3.7, -0.1), (0.6, 4.3, 1.9), (count, 3))).float()
    return o, torch.nn.functional.normalize(aim - o, dim=-1)


@pytest.mark.parametrize("thing", OBJECTS)
def test_rays_meet_an_object_where_sphere_tracing_does(thing):
    """The slow twin: steps as long as the distance to the surface."""
    o, d = rays()
    t = torch.zeros(len(o))
    for _ in range(400):
        t = t + thing.signed_distance(o + t[:, None] * d).clamp_min(1e-5)
    found = thing.distance(o, d)
    hit = found.isfinite()
    assert 0.05 < float(hit.float().mean()) < 0.9
    assert float(thing.signed_distance(o[hit] + found[hit, None] * d[hit]).abs().max()) < 1e-3
    traced = t < 12
    agree = hit == traced
    assert float(agree.float().mean()) > 0.995, "rays that graze"
    both = hit & traced
    assert float((found[both] - t[both]).abs().quantile(0.99)) < 0.01


def test_the_figure_is_as_tall_as_it_says():
    z = torch.linspace(0, 2, 2001)
    column = torch.tensor([*FIGURE.base[:2], 0.0]) + z[:, None] * torch.tensor([0.0, 0.0, 1.0])
    top = z[FIGURE.signed_distance(column) < 0].max()
    assert float(top) == pytest.approx(FIGURE_HEIGHT, abs=2e-3)
    rng = np.random.default_rng(1)
    x = torch.tensor(rng.uniform((-2, 3, -0.3), (1, 5, 2.2), (200_000, 3))).float()
    inside = x[FIGURE.signed_distance(x) < 0]
    assert 0.0 <= float(inside[:, 2].min()) < 0.05 and float(inside[:, 2].max()) < FIGURE_HEIGHT


def test_marks_of_the_gauge_change_every_decimetre():
    z = torch.arange(0.05, 1.5, 0.1)
    direction = torch.tensor([math.cos(GAUGE.yaw), math.sin(GAUGE.yaw), 0.0])
    left = torch.tensor([math.sin(GAUGE.yaw), -math.cos(GAUGE.yaw), 0.0])
    middle = torch.tensor([*GAUGE.base[:2], 0.0])
    for turn in range(4):
        angle = turn * math.pi / 2
        out = math.cos(angle) * direction + math.sin(angle) * -left
        edge = math.cos(angle) * left + math.sin(angle) * direction
        x = middle + 0.09 * out + 0.08 * edge + z[:, None] * torch.tensor([0.0, 0.0, 1.0])
        shade = GAUGE.albedo(x)[:, 0]
        assert (shade[::2] < 0.1).all() and (shade[1::2] > 0.6).all(), turn


def test_a_gauge_below_its_datum_has_negative_numbers():
    above, below = gauge_face(1.2, 1.0), gauge_face(0.2, 1.0)
    assert above.shape == below.shape and not np.array_equal(above, below)


def test_colours_by_number_and_by_position_agree():
    field = with_objects(protocol_of(LABELLED), OBJECTS, LIGHT)
    o, d = rays(600)
    samples = field.march(o, d, torch.zeros(600), torch.full((600,), 1e9))
    ray = samples.ray_index()
    x = o[ray] + samples.t[:, None] * d[ray]
    placed = samples.ids == PLACED
    assert int(placed.sum()) > 50
    by_id = field.colour(x, d, ray, ids=samples.ids)
    torch.testing.assert_close(field.colour(x, d, ray)[placed], by_id[placed])
    # An even white sky lights what faces up fully, and what faces sideways by half.
    top = torch.tensor([[0.3, 4.0, 1.6]])
    side = torch.tensor([[*GAUGE.base[:2], 0.65]])
    side[0, :2] += 0.09 * torch.tensor([math.cos(GAUGE.yaw), math.sin(GAUGE.yaw)])
    white = GAUGE.albedo(side) / math.pi * LIGHT * (0.5 + 0.12 * 0.5)
    torch.testing.assert_close(field.colour(side, -side), white, rtol=1e-3, atol=1e-5)
    brighter = field.colour(top, -top) / GAUGE.albedo(top) * math.pi
    torch.testing.assert_close(brighter[0], LIGHT, rtol=1e-3, atol=1e-5)
    normal, _ = field.surface_heads(o, d, samples, placed.nonzero()[:, 0])
    assert float((normal * d[ray[placed]]).sum(-1).max()) < 0.05, "normals face the eye"


def test_no_photo_shows_them():
    inner = protocol_of(FIELD)
    assert with_objects(inner, [], LIGHT) is inner
    assert with_objects(inner, OBJECTS, LIGHT).observed_only() is inner


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    place = yard_place(tmp_path_factory.mktemp("yard"))
    return RenderSession(with_objects(place.field, OBJECTS, LIGHT), place.scene, Weather())


CAMERA = Camera(240, 320, 300.0, 300.0, 120.0, 160.0)
VIEW = pose((0.08, 1.0, -0.15), (0.0, 0.0, 1.5))


def test_the_gauge_reads_the_water_level(session):
    """The lowest dry point of the gauge in the picture is at the level, to a centimetre."""
    session.change(Weather())
    dry = session.frame(CAMERA, VIEW)
    d = CAMERA.directions() @ VIEW[:3, :3].T
    o, flat = torch.tensor(VIEW[:3, 3]).float(), torch.tensor(d.reshape(-1, 3)).float()
    on_gauge = GAUGE.distance(o.expand(len(flat), 3), flat).reshape(320, 240).isfinite().numpy()
    z = VIEW[2, 3] + dry.layers["depth"] * d[..., 2]
    for level in (0.3, 0.62):
        session.change(Weather(flood=Flood(level=level, wind_speed=0.0, wet_band=0.0)))
        wet = session.frame(CAMERA, VIEW)
        shows = on_gauge & (wet.layers["mask_water"] < 0.5) & (z > 0)
        assert z[shows].min() == pytest.approx(level, abs=0.01)
        below = on_gauge & (z > 0) & (z < level - 0.01)
        assert (wet.layers["mask_water"][below] > 0.5).all()
        np.testing.assert_allclose(
            wet.layers["water_depth"][below], level - z[below], atol=0.3, rtol=0.2
        )


def test_fog_hides_them(session):
    session.change(Weather())
    dry = session.frame(CAMERA, VIEW)
    session.change(Weather(smog=Smog(visibility=8.0, light="paper")))
    foggy = session.frame(CAMERA, VIEW)
    x = torch.tensor(VIEW[:3, 3] + dry.layers["depth"][..., None] * (
        CAMERA.directions() @ VIEW[:3, :3].T)).float()  # fmt: skip
    near = torch.stack([each.signed_distance(x.reshape(-1, 3)) for each in OBJECTS]).amin(0)
    shown = (near.abs() < 1e-3).reshape(320, 240).numpy() & np.isfinite(dry.layers["depth"])
    assert shown.sum() > 500
    expected = np.exp(-math.log(20) / 8.0 * dry.layers["depth"][shown])
    np.testing.assert_allclose(foggy.layers["transmittance"][shown], expected, rtol=1e-3)


def test_they_stand_on_completed_ground():
    """Samples of the field, of completed ground and of objects keep their own colours."""
    ground = CompletedField(protocol_of(holed()), terrain_of())
    gauge = StaffGauge((0.0, 0.0, 0.0), 1.0, 0.0, 0.3)
    field = with_objects(ground, [gauge], LIGHT)
    o = torch.tensor([[0.0, -3.0, 1.2]]).repeat(3, 1)
    aim = torch.tensor([[0.0, 0.0, 0.5], [0.3, -0.3, 0.0], [3.5, -1.0, 0.0]])
    d = torch.nn.functional.normalize(aim - o, dim=-1)
    samples = field.march(o, d, torch.zeros(3), torch.full((3,), 1e9))
    ray = samples.ray_index()
    first = samples.offsets[:-1]
    assert samples.ids[first[:2]].tolist() == [PLACED, COMPLETED] and samples.ids[first[2]] == NO_ID
    x = o[ray] + samples.t[:, None] * d[ray]
    colour = field.colour(x, d, ray, ids=samples.ids)
    inner = ground.march(o[1:], d[1:], torch.zeros(2), torch.full((2,), 1e9))
    own = inner.ray_index()
    expected = ground.colour(o[1:][own] + inner.t[:, None] * d[1:][own], d[1:], own, ids=inner.ids)
    torch.testing.assert_close(colour[first[1:]], expected[inner.offsets[:-1]])
