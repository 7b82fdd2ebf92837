"""Pictures for one viewer: order, cancellation, bit identity, and the end of the threads."""

import copy
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from support.study_yard import BOX, patch_shot, pose, yard_place

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.field.compositing import RenderCancelled
from climatenerf.render.session import RenderSession
from climatenerf.verification.setting import protocol_of
from climatenerf.viewer import live
from climatenerf.viewer.live import MOMENTS, LiveView, Wanted, _moments
from climatenerf.viewer.measure import measure
from climatenerf.viewer.overlays import LAYERS, legend, picture_of
from climatenerf.viewer.warp import warped
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

CAMERA = Camera(96, 54, 80.0, 80.0, 48.0, 27.0)
HERE = pose((0.0, 1.0, -0.1))


class Viewer:
    """Receives pictures as a browser tab does."""

    def __init__(self, session):
        self.pictures, self.told = [], []
        self.live = LiveView(session, self.pictures.append, self.told.append)

    def until(self, condition, seconds=60):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, [p.state for p in self.pictures[-5:]]
            time.sleep(0.01)

    def full_of(self, wanted):
        def last_is_full():
            last = self.pictures[-1] if self.pictures else None
            return last is not None and last.state == "full" and last.wanted is wanted

        self.until(last_is_full)
        return self.pictures[-1]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return yard_place(tmp_path_factory.mktemp("yard"))


@pytest.fixture
def viewer(place):
    made = Viewer(RenderSession(place.field, place.scene, Weather()))
    yield made
    made.live.close()


def flooded(level, c2w=HERE, layer=""):
    weather = Weather(flood=Flood(level=level, wind_speed=0.0))
    return Wanted(CAMERA, c2w, weather, layer, asked=time.monotonic())


def test_the_full_picture_is_that_of_a_render_bit_for_bit(viewer, place):
    wanted = flooded(0.4)
    viewer.live.ask(wanted)
    found = viewer.full_of(wanted)
    session = RenderSession(place.field, place.scene, wanted.weather)
    assert np.array_equal(found.picture, session.frame(CAMERA, HERE).picture)
    states = [each.state for each in viewer.pictures]
    assert states.index("coarse") < states.index("full")


def test_the_last_of_ten_quick_changes_stays(viewer):
    asked = [flooded(0.05 * i) for i in range(1, 11)]
    for wanted in asked:
        viewer.live.ask(wanted)
        time.sleep(0.005)
    viewer.full_of(asked[-1])
    finished = [each for each in viewer.pictures if each.state == "full"]
    assert finished[-1].wanted is asked[-1] and len(finished) < 10, "some were cancelled"
    time.sleep(0.3)
    assert viewer.pictures[-1].wanted is asked[-1]


def test_a_newer_request_cancels_the_finer_passes_of_an_older_one(viewer):
    large = CAMERA.resized(768, 432)
    older, newer = (replace(flooded(level), camera=large) for level in (0.3, 0.5))
    viewer.live.ask(older)
    viewer.until(lambda: any(each.wanted is older for each in viewer.pictures))
    viewer.live.ask(newer)
    viewer.full_of(newer)
    assert not any(each.wanted is older and each.state == "full" for each in viewer.pictures)


def test_pictures_follow_a_moving_camera(viewer):
    first = flooded(0.3)
    viewer.live.ask(first)
    viewer.full_of(first)
    begin, warped = len(viewer.pictures), []
    for i in range(600):  # as many as a busy machine needs
        wanted = flooded(0.3, pose((0.01 * (i % 50), 1.0, -0.1)))
        viewer.live.ask(wanted)
        time.sleep(0.025)
        warped = [each for each in viewer.pictures[begin:] if each.state == "warped"]
        if len(warped) >= 10:
            break
    assert len(warped) >= 10
    order = [each.wanted.asked for each in warped]
    assert order == sorted(order) and len(set(order)) > 8, "each shows a newer pose"
    assert viewer.full_of(wanted).wanted is wanted


def test_what_does_not_fit_is_told_and_the_viewer_goes_on(viewer):
    viewer.live.ask(flooded(900.0))
    viewer.until(lambda: any("level" in sentence for sentence in viewer.told))
    good = flooded(0.2)
    viewer.live.ask(good)
    viewer.full_of(good)


def test_closing_ends_the_threads(place):
    before = threading.active_count()
    made = Viewer(RenderSession(place.field, place.scene, Weather()))
    made.live.ask(flooded(0.4))
    assert threading.active_count() == before + 3
    made.live.close()
    assert threading.active_count() == before
    count = len(made.pictures)
    time.sleep(0.1)
    assert len(made.pictures) == count


def test_the_left_part_can_show_the_place_without_weather(viewer, place):
    after = flooded(0.4)
    split = replace(after, split=0.5)
    viewer.live.ask(split)
    found = viewer.full_of(split).picture
    session = RenderSession(place.field, place.scene, after.weather)
    wet = session.frame(CAMERA, HERE).picture
    session.change(Weather())
    dry = session.frame(CAMERA, HERE).picture
    assert np.array_equal(found[:, :48], dry[:, :48])
    assert np.array_equal(found[:, 48:], wet[:, 48:]) and not np.array_equal(wet, dry)


def test_a_newer_fit_is_followed(viewer, place):
    wanted = flooded(0.4)
    viewer.live.ask(wanted)
    viewer.full_of(wanted)
    newer = AnalyticField([HalfSpace(colour=(0.9, 0.1, 0.1))], box=BOX)
    viewer.live.use(RenderSession(protocol_of(newer), place.scene, Weather()))
    expected = RenderSession(protocol_of(newer), place.scene, wanted.weather)
    picture = expected.frame(CAMERA, HERE).picture
    viewer.until(lambda: viewer.pictures[-1].state == "full"
                 and np.array_equal(viewer.pictures[-1].picture, picture))  # fmt: skip


@pytest.mark.parametrize("layer", ["depth", "normal", "water_depth", "snow_thickness"])
def test_layers_are_shown_in_place_of_the_picture(patch_viewer, layer):
    viewer, shot = patch_viewer
    wanted = Wanted(shot.camera, shot.c2w, shot.weather, layer)
    viewer.live.ask(wanted)
    found = viewer.full_of(wanted)
    session = RenderSession(shot.place.field, shot.place.scene, shot.weather)
    frame = session.frame(shot.camera, shot.c2w, layers=(layer,))
    assert np.array_equal(found.picture, picture_of(layer, frame))
    assert np.abs(found.picture.astype(int) - frame.picture).mean() > 3
    coarse = next(each for each in viewer.pictures if each.state == "coarse")
    assert np.abs(coarse.picture.mean((0, 1)) - found.picture.mean((0, 1))).max() < 30
    assert set(LAYERS) >= {layer} and legend(layer)


@pytest.fixture
def patch_viewer(tmp_path):
    weather = Weather(snow=Snow(depth=0.1), flood=Flood(level=0.05, wind_speed=0.0))
    shot = patch_shot(tmp_path, weather)
    made = Viewer(RenderSession(shot.place.field, shot.place.scene, Weather()))
    yield made, shot
    made.live.close()


def test_a_layer_that_is_absent_shows_the_picture(place):
    session = RenderSession(place.field, place.scene, Weather())
    frame = session.frame(CAMERA, HERE)
    assert picture_of("label", frame) is frame.picture


def test_clicks_trace_their_ray(place):
    """Ground at 0 m from an eye at 1.6 m, under 0.4 m of water: closed form."""
    session = RenderSession(place.field, place.scene, flooded(0.4).weather)
    down = np.array([0.0, 0.5, -1.0])
    found = measure(session, HERE[:3, 3], 3 * down)
    length = np.linalg.norm(down)
    assert found.distance == pytest.approx(1.2 * length, abs=2e-3)
    assert found.height == pytest.approx(0.0, abs=5e-3)
    assert found.water_depth == pytest.approx(0.4, abs=0.01)
    assert "water 0.4" in found.sentence and "deep" in found.sentence
    assert measure(session, HERE[:3, 3], np.array([0.0, 0.1, 1.0])).sentence == "sky"
    unsure = measure(session, HERE[:3, 3], 3 * down, depth_error=0.1)
    assert unsure.distance_error == pytest.approx(0.1 * unsure.distance)
    assert unsure.height_error == pytest.approx(0.1 * 1.6, abs=1e-3), "1.6 m down the ray"
    assert unsure.water_error == unsure.height_error
    assert "water 0.40 ± 0.16 m deep" in unsure.sentence


class SlowSession:
    """A session whose changes report progress until they are released or cancelled."""

    def __init__(self, session):
        self.session, self.released, self.cancelled = session, threading.Event(), []

    def frame(self, *arguments, **options):
        return self.session.frame(*arguments, **options)

    def world(self, moment):
        return self.session.world(moment)

    @property
    def weather(self):
        return self.session.weather

    @property
    def field(self):
        return self.session.field

    def changed(self, weather, times, progress):
        made = copy.copy(self)
        made.session = self.session.changed(weather, times)
        if weather != Weather():
            for step in range(100_000):
                try:
                    progress("snow", min(step / 1000, 1))
                except RenderCancelled:
                    self.cancelled.append(weather)
                    raise
                if self.released.wait(0.005):
                    break
        return made


def test_pictures_go_on_while_weather_is_prepared(place):
    slow = SlowSession(RenderSession(place.field, place.scene, Weather()))
    viewer = Viewer(slow)
    try:
        dry = Wanted(CAMERA, HERE, Weather())
        viewer.live.ask(dry)
        before = viewer.full_of(dry).picture
        wet, moved = flooded(0.4), flooded(0.4, pose((0.4, 1.0, -0.1)))
        viewer.live.ask(wet)
        viewer.until(lambda: any("preparing snow" in each for each in viewer.told))
        viewer.live.ask(moved)
        viewer.until(lambda: viewer.pictures[-1].state == "coarse"
                     and viewer.pictures[-1].wanted.same_place(moved))  # fmt: skip
        assert viewer.pictures[-1].weather.at(0.0) == Weather(), "that of before"
        slow.released.set()
        found = viewer.full_of(moved)
        assert found.weather.at(0.0) == moved.weather and viewer.told[-1] == ""
        assert not slow.cancelled, "the same weather in another pose is no reason to begin again"
        assert not np.array_equal(found.picture, before)
    finally:
        viewer.live.close()


def test_no_warped_picture_follows_a_rendered_one_of_the_same_pose(place, monkeypatch):
    slow = SlowSession(RenderSession(place.field, place.scene, Weather()))
    viewer = Viewer(slow)
    moved = flooded(0.4, pose((0.4, 1.0, -0.1)))
    late = threading.Event()

    def rendered():
        return [each.state for each in viewer.pictures if each.wanted.same_place(moved)]

    def warped_late(*given):
        viewer.until(lambda: "coarse" in rendered())
        late.set()
        return warped(*given)

    monkeypatch.setattr(live, "warped", warped_late)
    monkeypatch.setattr(live, "STILL", 30.0)  # for the thread that warps to begin in time
    try:
        dry = Wanted(CAMERA, HERE, Weather())
        viewer.live.ask(dry)
        viewer.full_of(dry)
        viewer.live.ask(moved)  # in other weather, which is not prepared: the coarse one stays
        assert late.wait(60)
        time.sleep(0.5)
        assert set(rendered()) == {"coarse"}
    finally:
        slow.released.set()
        viewer.live.close()


def test_newer_weather_cancels_the_preparation_of_older(place):
    slow = SlowSession(RenderSession(place.field, place.scene, Weather()))
    viewer = Viewer(slow)
    try:
        older, newer = flooded(0.3), flooded(0.5)
        viewer.live.ask(older)
        viewer.until(lambda: viewer.told)
        viewer.live.ask(newer)
        viewer.until(lambda: slow.cancelled)
        slow.released.set()
        assert viewer.full_of(newer).weather.at(0.0) == newer.weather
        assert slow.cancelled == [older.weather]
    finally:
        viewer.live.close()


def test_refused_weather_leaves_that_of_before_in_the_picture(viewer):
    good = flooded(0.2)
    viewer.live.ask(good)
    viewer.full_of(good)
    viewer.live.ask(flooded(900.0))
    viewer.until(lambda: viewer.told and "level" in viewer.told[-1])
    moved = flooded(900.0, pose((0.3, 1.0, -0.1)))
    viewer.live.ask(moved)
    assert viewer.full_of(moved).weather.at(0.0) == good.weather


def test_a_film_is_shown_at_its_moment(viewer, place):
    keyframes = {"flood.level": ((0.0, 0.1), (2.0, 0.5))}
    film = KeyframedWeather(Weather(flood=Flood(level=0.1, wind_speed=3.0)), keyframes)
    wanted = Wanted(CAMERA, HERE, film, time=1.5)
    viewer.live.ask(wanted)
    found = viewer.full_of(wanted).picture
    session = RenderSession(place.field, place.scene, film, times=np.arange(49) / 24)
    assert np.array_equal(found, session.frame(CAMERA, HERE, 1.5).picture)
    assert not np.array_equal(found, session.frame(CAMERA, HERE, 0.0).picture)


def test_a_long_film_is_prepared_for_a_bounded_number_of_moments():
    dry = Weather()
    short = KeyframedWeather(dry, {"flood.level": ((0.0, 0.1), (2.0, 0.5))})
    assert np.array_equal(_moments(short), np.arange(49) / 24)
    long = KeyframedWeather(dry, {"flood.level": ((0.0, 0.1), (3600.0, 0.5))})
    found = _moments(long)
    assert len(found) == MOMENTS + 1 and found[-1] == pytest.approx(3600.0)
    assert np.array_equal(_moments(dry), [0.0])


def test_a_layer_is_shown_while_weather_is_prepared(place):
    slow = SlowSession(RenderSession(place.field, place.scene, Weather()))
    viewer = Viewer(slow)
    try:
        dry = Wanted(CAMERA, HERE, Weather())
        viewer.live.ask(dry)
        viewer.full_of(dry)
        viewer.live.ask(flooded(0.4))
        viewer.until(lambda: any("preparing snow" in each for each in viewer.told))
        viewer.live.ask(flooded(0.4, layer="depth"))
        viewer.until(lambda: viewer.pictures[-1].wanted.layer == "depth")
        assert viewer.pictures[-1].weather.at(0.0) == Weather()
    finally:
        viewer.live.close()


def test_a_newer_fit_that_cannot_be_prepared_leaves_the_older_one(viewer, place):
    class Broken(SlowSession):
        def changed(self, weather, times, progress):
            raise UserError("the newer fit has no ground")

    good = flooded(0.4)
    viewer.live.ask(good)
    before = viewer.full_of(good).picture
    session = viewer.live.session
    newer = AnalyticField([HalfSpace(colour=(0.9, 0.1, 0.1))], box=BOX)
    viewer.live.use(Broken(RenderSession(protocol_of(newer), place.scene, Weather())))
    viewer.until(lambda: viewer.told[-1] == "the newer fit has no ground")
    assert viewer.live.session is session
    again = flooded(0.4)
    viewer.live.ask(again)
    assert np.array_equal(viewer.full_of(again).picture, before)


def test_a_film_is_refused_for_what_it_becomes(viewer):
    keyframes = {"flood.level": ((0.0, 0.1), (2.0, 900.0))}
    film = KeyframedWeather(Weather(flood=Flood(level=0.1, wind_speed=0.0)), keyframes)
    viewer.live.ask(Wanted(CAMERA, HERE, film))
    viewer.until(lambda: any("above the whole scene" in sentence for sentence in viewer.told), 20)
