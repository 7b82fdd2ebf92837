"""The viewer in Chromium: drag, sliders, text, click, two tabs, saving, and foreign pages."""

import functools
import http.server
import json
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from support.browser import chromium
from support.random_run import random_run, small
from support.study_yard import BOX, yard_place

from climatenerf.api import load_run
from climatenerf.core.errors import UserError
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.paths.nerfstudio import read_drawn_path
from climatenerf.render.session import RenderSession
from climatenerf.studies.shot import Place
from climatenerf.verification.setting import protocol_of
from climatenerf.weather.description import read_weather

pytest.importorskip("viser", reason="needs viser (make setup installs it)")
SIZE = {"width": 640, "height": 420}


@pytest.fixture(scope="module")
def browser():
    with chromium("--use-angle=swiftshader", "--enable-unsafe-swiftshader") as started:
        yield started


@pytest.fixture
def app(tmp_path):
    from climatenerf.viewer.app import ViewerApp

    place = yard_place(tmp_path)
    (tmp_path / "run").mkdir()
    made = ViewerApp(tmp_path / "run", place, 0)
    yield made
    made.close()


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "in vain"
        time.sleep(0.02)


def opened(browser, app, size=SIZE):
    """Open a tab, and wait until its picture is full."""
    known = set(app.tabs)
    page = browser.new_context(viewport=size).new_page()
    page.set_default_timeout(20_000)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.goto(f"http://localhost:{app.port}")
    until(lambda: set(app.tabs) - known and page.wait_for_timeout(20) is None)
    (number,) = set(app.tabs) - known
    tab = app.tabs[number]
    canvas = page.locator("canvas").first
    if size["width"] >= 640:  # a wide page docks its panel, and the canvas shrinks
        until(lambda: page.wait_for_timeout(20) is None
              and canvas.bounding_box()["width"] < size["width"])  # fmt: skip
    until(lambda: page.wait_for_timeout(20) is None and fits(page, tab))
    settled(page, tab)
    return page, tab


def fits(page, tab):
    canvas = page.locator("canvas").first.bounding_box()
    camera = tab.wanted().camera
    return abs(camera.width / camera.height - canvas["width"] / canvas["height"]) < 0.01


def settled(page, tab):
    def is_full():
        page.wait_for_timeout(20)
        shown = tab.shown
        return shown is not None and shown.state == "full" and shown.wanted is tab.live.wanted

    until(is_full)


def test_a_tab_shows_a_full_picture_that_is_a_render(browser, app):
    page, tab = opened(browser, app)  # whose camera has the canvas's aspect
    wanted = tab.shown.wanted
    session = RenderSession(app.place.field, app.place.scene, wanted.weather)
    assert np.array_equal(tab.shown.picture, session.frame(wanted.camera, wanted.c2w).picture)
    assert fits(page, tab)
    assert page.problems == []
    page.context.close()


def test_dragging_turns_the_view_with_pictures_meanwhile(browser, app):
    page, tab = opened(browser, app)
    before, count = tab.shown.wanted.c2w.copy(), []
    show = tab._show
    tab.live._show = lambda shown: (count.append(shown.state), show(shown))
    page.mouse.move(120, 260)
    page.mouse.down()
    for i in range(800):  # as many as a busy machine needs
        page.mouse.move(120 + 2 * (i % 40), 260 + i % 40)
        page.wait_for_timeout(25)
        if i >= 30 and i % 40 > 20 and count.count("warped") >= 8:
            break
    page.mouse.up()
    assert count.count("warped") >= 8
    settled(page, tab)
    assert not np.allclose(tab.shown.wanted.c2w, before, atol=1e-2)
    assert count[-1] == "full"
    page.context.close()


@pytest.mark.slow
def test_sliders_and_texts_change_the_weather(browser, app):
    page, tab = opened(browser, app)
    slider = page.get_by_role("slider").first
    slider.focus()
    page.keyboard.press("ArrowRight")
    until(
        lambda: page.wait_for_timeout(20) is None and tab.controls.weather.flood.level is not None
    )
    first = tab.controls.weather.flood.level
    assert first == pytest.approx(float(slider.get_attribute("aria-valuenow")), abs=1e-6)
    box = page.locator("input[type=text], input:not([type])").filter(visible=True)
    values = [box.nth(i).input_value() for i in range(box.count())]
    index = next(i for i, value in enumerate(values) if value.endswith(" m"))
    box.nth(index).fill("20 in")
    box.nth(index).press("Enter")
    until(lambda: page.wait_for_timeout(20) is None
          and abs(tab.controls.weather.flood.level - 0.508) < 1e-6)  # fmt: skip
    box.nth(index).fill("")
    box.nth(index).press_sequentially("0.305 m", delay=80)
    until(lambda: page.wait_for_timeout(20) is None
          and abs(tab.controls.weather.flood.level - 0.305) < 1e-6)  # fmt: skip
    assert box.nth(index).input_value() == "0.305 m", "nothing is rewritten while one types"
    box.nth(index).fill("20 in")
    settled(page, tab)
    until(lambda: page.wait_for_timeout(20) is None
          and abs(tab.controls.weather.flood.level - 0.508) < 1e-6)  # fmt: skip
    settled(page, tab)
    assert tab.shown.wanted.weather.flood.level == pytest.approx(0.508)
    assert "--flood.level=0.508" in tab._command.value
    page.context.close()


@pytest.mark.slow
def test_a_click_measures(browser, app):
    page, tab = opened(browser, app)
    tab.controls.set("flood.level", 0.4)
    settled(page, tab)
    page.mouse.click(150, 380)
    until(lambda: page.wait_for_timeout(20) is None and "distance" in tab._measured.content)
    assert "deep" in tab._measured.content
    page.context.close()


@pytest.mark.slow
def test_tabs_have_weather_of_their_own_and_end_with_their_page(browser, app):
    before = threading.active_count()
    first, one = opened(browser, app)
    second, two = opened(browser, app)
    one.controls.set("flood.level", 0.3)
    settled(first, one)
    assert two.controls.weather.flood.level is None and len(app.tabs) == 2
    first.context.close()
    until(lambda: len(app.tabs) == 1 and second.wait_for_timeout(20) is None)
    assert not any(thread.is_alive() for thread in one.live._threads)
    second.reload()
    until(lambda: two not in app.tabs.values() and len(app.tabs) == 1
          and second.wait_for_timeout(20) is None)  # fmt: skip
    second.context.close()
    until(lambda: not app.tabs)
    until(lambda: threading.active_count() <= before + 2)  # those of the server itself


@pytest.mark.slow
def test_pictures_and_paths_are_saved_into_the_run_alone(browser, app, tmp_path):
    page, tab = opened(browser, app)
    tab.controls.set("flood.level", 0.3)
    settled(page, tab)
    first, second = tab.save_picture(), tab.save_picture()
    assert [each.name for each in (first, second)] == ["view-0001.png", "view-0002.png"]
    assert np.array_equal(np.asarray(Image.open(first)), tab.shown.picture)
    sidecar = json.loads(first.with_suffix(".json").read_text())
    assert sidecar["simulated"] and sidecar["weather"]["flood"]["level"] == "0.3 m"
    assert sidecar["time_s"] == 0.0
    path = tab.add_key_pose()
    assert path.name == "path-0001.json"
    drawn = read_drawn_path(path, app.place.scene)
    np.testing.assert_allclose(drawn.c2w[0], tab.wanted().c2w, atol=1e-6)
    assert tab.add_key_pose() == path
    assert read_drawn_path(path, app.place.scene).c2w.shape == (25, 4, 4)
    tab.remove_key_pose()
    assert read_drawn_path(path, app.place.scene).c2w.shape == (1, 4, 4)
    assert {each.parent for each in (tmp_path / "run").rglob("*.*")} == {tmp_path / "run" / "views"}
    page.context.close()


def test_a_browser_without_webgl_is_told(browser, app):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(f"http://localhost:{app.port}")
    told = page.get_by_role("alert").filter(has_text="no WebGL 2")
    told.wait_for(timeout=20_000)
    assert "climatenerf page" in told.inner_text()
    page.close()
    until(lambda: not app.tabs)
    other, _ = opened(browser, app)
    assert other.get_by_role("alert").filter(has_text="no WebGL 2").count() == 0
    other.context.close()


def test_a_foreign_page_cannot_open_the_socket(browser, app, tmp_path):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text(
        f"<script>const s = new WebSocket('ws://localhost:{app.port}', 'viser-v1.1.1');"
        "s.onopen = () => document.title = 'open'; s.onerror = () => document.title = 'refused';"
        "</script>"
    )
    handler = functools.partial(
        http.server.SimpleHTTPRequestHandler, directory=str(tmp_path / "site")
    )
    handler.log_message = lambda *args: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        page = browser.new_page()
        page.goto(f"http://localhost:{site.server_address[1]}/index.html")
        until(lambda: page.wait_for_timeout(20) is None and page.title() in ("open", "refused"))
        assert page.title() == "refused" and not app.tabs
        page.close()
        site.shutdown()


@pytest.mark.slow
def test_the_arrow_draws_the_water_up(browser, app):
    page, tab = opened(browser, app, {"width": 1200, "height": 700})
    tab._gui_handle.value = True
    page.wait_for_timeout(500)
    wanted = tab.wanted()
    scale = page.locator("canvas").first.bounding_box()["width"] / wanted.camera.width

    def pixel(height):
        local = wanted.c2w[:3, :3].T @ (np.array([*at[:2], at[2] + height]) - wanted.c2w[:3, 3])
        return scale * wanted.camera.project(local[None])[0]

    at = np.array(tab._handle.position)
    x, y = pixel(0.3)
    page.mouse.move(x, y)
    page.wait_for_timeout(300)
    page.mouse.down()
    for step in range(1, 11):
        page.mouse.move(x, y - 4 * step)
        page.wait_for_timeout(40)
    page.mouse.up()
    controls = tab.controls
    until(lambda: page.wait_for_timeout(20) is None and controls.weather.flood.level is not None)
    page.wait_for_timeout(300)
    level = controls.weather.flood.level
    assert level == pytest.approx(
        float(tab._handle.position[2]) - app.place.scene.ground_z, abs=2e-3
    )
    assert 0.1 < level < 1.0
    page.context.close()


@pytest.mark.slow
def test_a_newer_fit_is_shown_with_the_weather_of_each_tab(browser, app):
    page, tab = opened(browser, app)
    tab.controls.set("flood.level", 0.4)
    settled(page, tab)
    before = tab.shown.picture
    newer = AnalyticField([HalfSpace(colour=(0.9, 0.1, 0.1))], box=BOX)
    app.use(replace(app.place, field=protocol_of(newer)), None)
    until(lambda: page.wait_for_timeout(20) is None
          and not np.array_equal(tab.shown.picture, before))  # fmt: skip
    settled(page, tab)
    assert tab.shown.wanted.weather.flood.level == 0.4
    page.context.close()


@pytest.mark.slow
def test_the_path_is_rendered_as_a_movie_in_the_weather_that_is_shown(browser, tmp_path):
    from climatenerf.viewer.app import ViewerApp

    folder = random_run(tmp_path / "run", small("cpu"))
    run = load_run(folder)
    app = ViewerApp(folder, Place(run.field, run.scene), 0, digest=run.digest)
    page, tab = opened(browser, app, {"width": 240, "height": 160})
    tab.controls.set("smog.visibility", 50.0)
    with pytest.raises(UserError, match="add key poses"):
        tab.render_path()
    tab.add_key_pose()
    movie = tab.render_path()
    assert movie == folder / "views" / "movie-0001" / "movie.mp4" and movie.stat().st_size > 500
    sidecar = json.loads((movie.parent / "movie.json").read_text())
    assert sidecar["weather"]["smog"]["visibility"] == "50 m"
    settled(page, tab)
    frame = np.asarray(Image.open(movie.parent / "frames" / "0000.png"))
    assert np.abs(frame.astype(int) - tab.shown.picture).max() <= 1, "as the viewer shows it"
    tab.files._closed = True  # as of a tab that has gone
    with pytest.raises(UserError, match="the movie was stopped"):
        tab.render_path()
    assert not (folder / "views" / "movie-0002" / "movie.mp4").exists()
    page.context.close()
    app.close()


@pytest.mark.slow
def test_keyframed_weather_is_moved_through_played_and_kept(browser, tmp_path):
    from climatenerf.viewer.app import ViewerApp

    place = yard_place(tmp_path)
    (tmp_path / "run").mkdir()
    given = tmp_path / "given.toml"
    given.write_text('[flood]\nwind-speed = "0 m/s"\nlevel = { "0 s" = "0 m", "2 s" = "0.6 m" }')
    app = ViewerApp(tmp_path / "run", place, 0, weather=given)
    page, tab = opened(browser, app)
    assert f"--weather {given}" in tab._command.value and "--frames 49" in tab._command.value
    page.locator('[role=slider][aria-valuemax="10"]').last.focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    until(lambda: page.wait_for_timeout(20) is None and tab.film.now == 1.0)
    settled(page, tab)
    assert tab.shown.weather == tab.film.film and tab.shown.wanted.time == 1.0
    assert tab.controls.weather.flood.level == pytest.approx(0.3)
    shown = tab.shown.picture
    tab._clicked(SimpleNamespace(ray_origin=(0.0, 0.0, 1.6), ray_direction=(0.0, 0.3, -1.0)))
    assert "water 0.30" in tab._measured.content, "at the moment that is shown"
    tab.controls.set("flood.level", 0.8)
    assert "--flood.level=0.8" in tab._command.value, "as shown, which no keyframe holds yet"
    tab.film.keep()
    kept = tmp_path / "run" / "views" / "weather-0001.toml"
    assert read_weather(kept).keyframes["flood.level"] == ((0.0, 0.0), (1.0, 0.8), (2.0, 0.6))
    assert f"--weather {kept}" in tab._command.value and "0.8 m" in tab._file.value
    settled(page, tab)
    assert not np.array_equal(tab.shown.picture, shown)
    picture = tab.save_picture()
    sidecar = json.loads(picture.with_suffix(".json").read_text())
    assert sidecar["time_s"] == 1.0 and sidecar["weather"]["flood"]["level"] == "0.8 m"
    pose = read_drawn_path(picture.with_name("view-0001-pose.json"), place.scene)
    assert len(pose.c2w) == 49, "the film from this pose; its frame 24 is the picture"
    moments = set()
    page.get_by_text("play", exact=True).click()

    def played():
        page.wait_for_timeout(20)
        moments.add(tab.shown.wanted.time)
        return len(moments) > 4

    until(played)
    page.get_by_text("play", exact=True).click()
    settled(page, tab)
    assert page.problems == []
    page.context.close()
    app.close()


@pytest.mark.slow
def test_a_tab_that_leaves_while_it_is_built_leaves_no_threads(browser, app):
    def threads():
        return [each for each in threading.enumerate() if each.name.startswith("viewer-")]

    for _ in range(4):
        page = browser.new_context(viewport=SIZE).new_page()
        page.goto(f"http://localhost:{app.port}")
        until(lambda page=page: page.wait_for_timeout(2) is None and threads())
        page.context.close()
        until(lambda: not threads() and not app.tabs, 30.0)
