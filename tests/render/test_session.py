"""Weather that changes over time, on a scene in closed form."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.render import session as module
from climatenerf.render.frame import render_frame
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.description import weather_from_table

CAMERA = Camera(64, 36, 40.0, 40.0, 32.0, 18.0)
C2W = np.eye(4)
C2W[:3, :3] = np.array([[1, 0, 0], [0, -0.2425, 0.9701], [0, -0.9701, -0.2425]])
C2W[:3, 3] = (0.0, -3.0, 1.6)


@dataclasses.dataclass(frozen=True)
class Place(AnalyticField):
    near: float = 0.0


@pytest.fixture
def session_of(monkeypatch):
    """Prepares a weather table on ground that rises along y from -0.3 m at the camera's foot."""
    normal = np.array([0.0, -0.1, 1.0]) / math.hypot(0.1, 1.0)
    box = ((-12.0, -12.0, -3.0), (12.0, 12.0, 4.0))
    place = Place([HalfSpace(tuple(normal), 0.0, (0.3, 0.3, 0.3))], box=box)
    views = tuple(View(f"{i}.png", Path(f"{i}.png"), 0, C2W) for i in range(3))
    scene = Scene(Path("."), "test", (CAMERA,), views)
    monkeypatch.setattr(module, "scene_irradiance", lambda *_: torch.full((3,), 2.0))

    def make(table, times):
        weather = weather_from_table(table)
        return RenderSession(place, scene, weather, C2W[None, :3, 3], np.array(times))

    return make


def seen(session, time):
    return render_frame(session.world(time), CAMERA, C2W)


def test_a_keyframed_level_rises(session_of):
    session = session_of({"flood": {"level": {"0 s": "-0.3 m", "4 s": "0.5 m"}}}, [0.0, 2.0, 4.0])
    assert session.world(2.0).surfaces[0].level == pytest.approx(0.1)
    shares = [float(seen(session, t)[1]["mask_water"].mean()) for t in (0.0, 2.0, 4.0)]
    assert shares[0] < shares[1] - 0.05 < shares[2] - 0.1


def test_keyframed_snow_grows(session_of):
    session = session_of({"snow": {"depth": {"0 s": "5 cm", "4 s": "20 cm"}}}, [0.0, 4.0])
    for time, depth in ((0.0, 0.05), (4.0, 0.2)):
        _, layers = seen(session, time)
        snowy = layers["mask_snow"] > 0.9
        assert snowy.mean() > 0.3
        assert np.median(layers["snow_thickness"][snowy]) == pytest.approx(depth, rel=0.15)
    assert session.world(0.0).matters[0].lattice is not session.world(4.0).matters[0].lattice


def test_waves_move_and_nothing_else_does(session_of):
    session = session_of({"flood": {"level": "0 m", "wind-speed": "5 m/s"}}, [0.0, 0.5])
    (first, layers), (later, _) = seen(session, 0.0), seen(session, 0.5)
    changed = (first != later).any(-1)
    wet = layers["mask_water"] > 0.5
    assert changed[wet].mean() > 0.2
    assert not changed[layers["mask_water"] == 0].any()
    again, _ = seen(session, 0.0)
    assert np.array_equal(first, again), "time alone decides"


def test_weather_without_effect_prepares_nothing(session_of):
    world = session_of({"snow": {"depth": "0 m"}}, [0.0]).world(0.0)
    assert not (world.matters or world.surfaces or world.media)


def test_a_level_above_everything_is_refused_at_any_moment(session_of):
    with pytest.raises(UserError, match="above the whole scene"):
        session_of({"flood": {"level": {"0 s": "0 m", "4 s": "50 m"}}}, [0.0, 4.0])
