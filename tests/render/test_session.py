"""Weather that changes over time, on an analytic scene."""

import dataclasses
import math
import pickle
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf import api
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.field import compositing
from climatenerf.field.compositing import RenderCancelled
from climatenerf.render import integrator
from climatenerf.render import session as module
from climatenerf.render.frame import render_frame
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.description import (
    KeyframedWeather,
    weather_from_table,
    weather_to_table,
)
from climatenerf.weather.effect import Effect
from climatenerf.weather.flood import surface as flood_module
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.snow import lattice as lattice_module
from climatenerf.weather.snow import layer as snow_module
from climatenerf.weather.units import LENGTH, number, quantity
from climatenerf.weather.weather import Weather

CAMERA = Camera(64, 36, 40.0, 40.0, 32.0, 18.0)
C2W = np.eye(4)
C2W[:3, :3] = np.array([[1, 0, 0], [0, -0.2425, 0.9701], [0, -0.9701, -0.2425]])
C2W[:3, 3] = (0.0, -3.0, 1.6)


@dataclasses.dataclass(frozen=True)
class Scenery(AnalyticField):
    near: float = 0.0


@pytest.fixture
def session_of(monkeypatch):
    """Prepare a weather table on ground that rises along y, from -0.3 m below the camera."""
    normal = np.array([0.0, -0.1, 1.0]) / math.hypot(0.1, 1.0)
    box = ((-12.0, -12.0, -3.0), (12.0, 12.0, 4.0))
    field = Scenery([HalfSpace(tuple(normal), 0.0, (0.3, 0.3, 0.3))], box=box)
    views = tuple(View(f"{i}.png", Path(f"{i}.png"), 0, C2W) for i in range(3))
    scene = Scene(Path("."), "test", (CAMERA,), views)
    monkeypatch.setattr(module, "scene_irradiance", lambda *_: torch.full((3,), 2.0))
    # Coarser and smaller than `choose_grid` makes it, which would take seconds for each session.
    coarse = lattice_module.SnowGrid((0.0, 0.0), (-3.0, 4.0), 0.06, 64, 2)
    monkeypatch.setattr(snow_module, "choose_grid", lambda *_: coarse)

    def make(table, times):
        weather = weather_from_table(table)
        return RenderSession(field, scene, weather, C2W[None, :3, 3], np.array(times))

    return make


def seen(session, time):
    return render_frame(session.world(time), CAMERA, C2W)


def test_the_level_is_interpolated_between_keyframes(session_of):
    session = session_of({"flood": {"level": {"0 s": "-0.3 m", "4 s": "0.5 m"}}}, [0.0, 2.0, 4.0])
    assert session.world(2.0).surfaces[0].level == pytest.approx(0.1)
    coverage = [float(seen(session, t)[1]["mask_water"].mean()) for t in (0.0, 2.0, 4.0)]
    assert coverage[0] < coverage[1] - 0.05 < coverage[2] - 0.1


def test_the_snow_depth_is_interpolated_between_keyframes(session_of):
    session = session_of({"snow": {"depth": {"0 s": "5 cm", "4 s": "20 cm"}}}, [0.0, 4.0])
    for time, depth in ((0.0, 0.05), (4.0, 0.2)):
        _, layers = seen(session, time)
        snowy = layers["mask_snow"] > 0.9
        assert snowy.mean() > 0.3
        assert np.median(layers["snow_thickness"][snowy]) == pytest.approx(depth, rel=0.15)
    assert session.world(0.0).matters[0].lattice is not session.world(4.0).matters[0].lattice


def test_only_water_changes_over_time(session_of):
    session = session_of({"flood": {"level": "0 m", "wind-speed": "5 m/s"}}, [0.0, 0.5])
    (first, layers), (later, _) = seen(session, 0.0), seen(session, 0.5)
    changed = (first != later).any(-1)
    wet = layers["mask_water"] > 0.5
    assert changed[wet].mean() > 0.2
    assert not changed[layers["mask_water"] == 0].any()
    again, _ = seen(session, 0.0)
    assert np.array_equal(first, again), "the frame depends on the time only"


def test_weather_without_effect_prepares_nothing(session_of):
    world = session_of({"snow": {"depth": "0 m"}}, [0.0]).world(0.0)
    assert not (world.matters or world.surfaces or world.media)


def test_a_level_above_everything_is_refused_at_any_moment(session_of):
    with pytest.raises(UserError, match="above the whole scene"):
        session_of({"flood": {"level": {"0 s": "0 m", "4 s": "50 m"}}}, [0.0, 4.0])


def test_snow_that_lies_nowhere_is_refused_and_a_trace_of_it_is_not(session_of, monkeypatch):
    session_of({"snow": {"depth": "0.01 mm"}}, [0.0])
    monkeypatch.setattr(lattice_module.Deposits, "coverage", lambda deposits: 0.0)
    with pytest.raises(UserError, match=r"no surface of this scene catches snow.*--snow.depth$"):
        session_of({"snow": {"depth": "10 cm"}}, [0.0])
    with pytest.raises(UserError, match=r"with a smaller --snow.fall-tilt"):
        session_of({"snow": {"depth": "10 cm", "fall-tilt": "60 deg"}}, [0.0])


# --- what a change prepares again ---------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Count the expensive preparations by name."""
    counts = dict.fromkeys(("find_deposits", "grow", "make_waves", "irradiance"), 0)

    def watch(module, name, label=None):
        original = getattr(module, name)

        def count(*args, **kwargs):
            counts[label or name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(module, name, count)

    watch(snow_module, "find_deposits")
    watch(snow_module, "grow")
    watch(flood_module, "make_waves")
    return counts


CHANGES = [
    ("flood.colour", (0.1, 0.2, 0.3), {}),
    ("flood.level", 0.4, {}),
    ("flood.clarity", 2.0, {}),
    ("smog.visibility", 20.0, {}),
    ("snow.wrap", 1.0, {}),
    ("snow.soot", 2000.0, {}),
    ("snow.albedo", 0.5, {}),
    ("snow.depth", 0.25, {"grow": 1}),
    ("flood.wind_speed", 6.0, {"make_waves": 1}),
    ("snow.fall_tilt", 0.3, {"find_deposits": 1, "grow": 1}),
    ("seed", 5, {"find_deposits": 1, "grow": 1, "make_waves": 1}),
]


def test_a_pickled_session_renders_the_same_and_prepares_nothing(session_of, counted):
    weather = {"flood": {"level": "-5 cm", "wind_speed": "3 m/s"}, "snow": {"depth": "5 cm"}}
    session = session_of({**weather, "smog": {"visibility": "60 m"}}, [0.0, 1.0])
    expected = seen(session, 1.0)[0]
    session._progress = lambda what, fraction: None  # cannot be pickled
    before = dict(counted)
    copy = pickle.loads(pickle.dumps(session))
    assert np.array_equal(seen(copy, 1.0)[0], expected)
    assert copy.facts == session.facts and counted == before and before


@pytest.mark.parametrize(("name", "value", "again"), CHANGES)
def test_a_change_prepares_only_what_it_invalidates(session_of, counted, name, value, again):
    table = {
        "flood": {"level": "0 m"},
        "snow": {"depth": "10 cm"},
        "smog": {"visibility": "50 m"},
    }
    session = session_of(table, [0.0])
    session.world(0.0)
    for key in counted:
        counted[key] = 0
    changed = session.weather.base.with_value(name, value)
    session.change(changed)
    world = session.world(0.0)
    assert {key: count for key, count in counted.items() if count} == again
    # The change is effective: a new session has the same world.
    fresh = session_of(weather_to_table(changed), [0.0]).world(0.0)
    assert world.media == fresh.media
    assert (world.surfaces[0].flood, world.surfaces[0].level) == (
        fresh.surfaces[0].flood,
        fresh.surfaces[0].level,
    )
    assert world.matters[0].snow == fresh.matters[0].snow
    assert np.array_equal(world.matters[0].lattice.shade, fresh.matters[0].lattice.shade)


def test_a_refused_change_keeps_the_weather(session_of):
    session = session_of({"flood": {"level": "0 m"}}, [0.0])
    before = session.weather
    for level in (5e4, 50.0):  # outside the range, and above this scene
        with pytest.raises(UserError):
            session.change(before.base.with_value("flood.level", level))
    with pytest.raises(UserError):
        session.change(before.base.with_value("flood.wind_speed", -1.0))
    assert session.weather is before and session.world(0.0).surfaces[0].level == 0


@dataclasses.dataclass(frozen=True)
class Hail:
    """Parameters of an effect that the test defines."""

    size: Annotated[float | None, quantity(LENGTH, 0.0, 1.0, optional=True)] = None
    speed: Annotated[float, number(0.0, 50.0)] = 20.0


class HailEntity:
    """Place nothing, and refuse hail above 10 cm, which fits no scene."""

    def place(self, world, weather, time):
        return world

    def check(self, moments):
        if any(moment.hail.size > 0.1 for moment in moments):
            raise UserError("--hail.size is too large for the scene; give at most 10 cm")

    def facts(self):
        return {}


@pytest.mark.parametrize("prepared_from", [(), ("hail.size",)])
def test_an_entity_checks_the_weather_of_each_preparation(session_of, prepared_from):
    hail = Effect("hail", Hail, ("size",), lambda _: HailEntity(), prepared_from=prepared_from)
    made = session_of({"flood": {"level": "0 m"}}, [0.0])
    effects = (*EFFECTS, hail)

    def session(size):
        weather = Weather(hail=Hail(size), effects=effects)
        return RenderSession(made.field, made.scene, weather, C2W[None, :3, 3], effects=effects)

    with pytest.raises(UserError, match="too large for the scene"):
        session(0.2)
    small = session(0.05)
    with pytest.raises(UserError, match="too large for the scene"):
        small.change(small.weather.base.with_value("hail.size", 0.2))
    assert small.world(0.0) and small.weather.base.hail.size == 0.05


def test_a_section_without_its_effect_is_refused(session_of):
    """It would be dropped silently; with default values it changes nothing."""
    hail = Effect("hail", Hail, ("size",), lambda _: HailEntity())
    made = session_of({"flood": {"level": "0 m"}}, [0.0])
    known = Weather(hail=Hail(0.05), effects=(*EFFECTS, hail))
    default = known.with_value("hail.size", None)
    film = KeyframedWeather(default, {"hail.speed": ((0.0, 1.0), (4.0, 2.0))})
    for weather in (known, film):
        with pytest.raises(UserError, match="section 'hail' that no effect renders") as error:
            RenderSession(made.field, made.scene, weather)
        assert "pass effects=" in str(error.value) and "\n" not in str(error.value)
        with pytest.raises(UserError, match="section 'hail' that no effect renders"):
            api._keyframed(weather, EFFECTS)
        with pytest.raises(UserError, match="section 'hail'"):
            made.change(weather)
    assert not RenderSession(made.field, made.scene, default).world(0.0).matters


def test_a_session_uses_the_installed_effects(session_of, monkeypatch):
    """As `render_movie` does; weather made for the built-in effects gets the missing section."""
    hail = Effect("hail", Hail, ("size",), lambda _: HailEntity())
    made = session_of({"flood": {"level": "0 m"}}, [0.0])
    monkeypatch.setattr(module, "installed_effects", lambda: (*EFFECTS, hail))
    session = RenderSession(made.field, made.scene, Weather())
    assert session.weather.base.hail == Hail()
    with pytest.raises(UserError, match="too large for the scene"):
        session.change(session.weather.base.with_value("hail.size", 0.2))


def test_the_middle_of_the_shutter_interval_is_rendered(session_of):
    table = {"flood": {"level": {"0 s": "-0.3 m", "4 s": "0.5 m"}}}
    session = session_of(table, [0.0, 4.0])
    open_long = session.frame(CAMERA, C2W, 1.0, shutter=2.0)
    assert np.array_equal(open_long.picture, session.frame(CAMERA, C2W, 2.0).picture)
    assert not np.array_equal(open_long.picture, session.frame(CAMERA, C2W, 1.0).picture)


# --- cancelling -------------------------------------------------------------------------------


def test_a_cancelled_frame_starts_no_further_chunk(session_of, monkeypatch):
    """No chunk of camera rays or reflected rays starts after the flag is raised."""
    session = session_of({"flood": {"level": "0 m", "wind-speed": "5 m/s"}}, [0.0])
    flag, traced_after = [False], []
    original = integrator._trace

    def recorded(world, rays_o, *rest, **options):
        traced_after.extend([len(rays_o)] * flag[0])
        return original(world, rays_o, *rest, **options)

    monkeypatch.setattr(integrator, "_trace", recorded)
    answers = []

    def cancelled():
        answers.append(flag[0])
        flag[0] = len(answers) >= 5
        return answers[-1]

    with pytest.raises(RenderCancelled):
        session.frame(CAMERA, C2W, cancelled=cancelled)
    assert answers == [False] * 5 + [True], "called once more after the flag, then never"
    assert len(traced_after) <= 1, "at most the chunk in which the flag was raised"


def test_chunk_sizes_adapt_to_the_speed(monkeypatch):
    """At 0.02 ms per ray chunks converge to 500 rays: 10 ms of the allowed 20 ms."""
    clock = [0.0]
    monkeypatch.setattr(compositing.time, "perf_counter", lambda: clock[0])
    checkpoint, sizes = compositing.Checkpoints(lambda: False), []
    for chunk in compositing.chunks(torch.zeros(9000, 3), checkpoint):
        sizes.append(len(range(*chunk.indices(9000))))
        clock[0] += 2e-5 * sizes[-1]
    assert sum(sizes) == 9000 and max(sizes) * 2e-5 <= 0.02
    assert sizes[2] == pytest.approx(500, abs=2)
    # Checkpoints within a chunk allow a longer one.
    checkpoint, sizes = compositing.Checkpoints(lambda: False), []
    for chunk in compositing.chunks(torch.zeros(9000, 3), checkpoint):
        sizes.append(len(range(*chunk.indices(9000))))
        for _ in range(4):
            clock[0] += 5e-6 * sizes[-1]
            checkpoint()
    assert max(sizes) > 1500


def test_a_cancellable_frame_is_identical(session_of):
    session = session_of({"flood": {"level": "0 m"}, "smog": {"visibility": "50 m"}}, [0.0])
    free = session.frame(CAMERA, C2W, layers=("normal",))
    bound = session.frame(CAMERA, C2W, layers=("normal",), cancelled=lambda: False)
    assert np.array_equal(free.picture, bound.picture)
    for name, values in free.layers.items():
        assert np.allclose(values, bound.layers[name], atol=1e-5, equal_nan=True), name


def test_a_changed_session_leaves_the_first_as_it_was(session_of):
    first = session_of({"flood": {"level": "0.1 m", "wind-speed": "0 m/s"}}, [0.0])
    before = first.frame(CAMERA, C2W).picture
    other = first.changed(weather_from_table({"flood": {"level": "0.6 m"}}), np.array([0.0, 1.0]))
    assert np.array_equal(first.frame(CAMERA, C2W).picture, before)
    assert first.weather.base.flood.level == 0.1 and other.weather.base.flood.level == 0.6
    fresh = session_of({"flood": {"level": "0.6 m"}}, [0.0, 1.0])
    assert np.array_equal(other.frame(CAMERA, C2W).picture, fresh.frame(CAMERA, C2W).picture)
    with pytest.raises(UserError, match="above the whole scene"):
        first.changed(weather_from_table({"flood": {"level": "900 m"}}))
    back = other.changed(first.weather)
    assert np.array_equal(back.frame(CAMERA, C2W).picture, before)


def test_what_a_cancelled_preparation_has_found_is_kept(session_of, monkeypatch):
    counts = []
    light = torch.full((3,), 2.0)
    monkeypatch.setattr(module, "scene_irradiance", lambda *_: counts.append(1) or light)
    first = session_of({}, [0.0])
    snowy = weather_from_table({"snow": {"depth": "10 cm"}})

    def cancel(what, fraction):
        if what == "snowfall":
            raise RenderCancelled

    for _ in range(2):
        with pytest.raises(RenderCancelled):
            first.changed(snowy, progress=cancel)
    assert len(counts) == 1
