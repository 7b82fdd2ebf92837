"""A page in Chromium: what it shows between the rendered levels, and how people use it."""

import base64
import io
import json
import re

import numpy as np
import pytest
from PIL import Image
from support.browser import chromium, opened_page, wait_until
from support.study_yard import yard_place

from climatenerf.page.encoding import OPEN, SKY, height_text
from climatenerf.page.pictures import prepared, under_water
from climatenerf.page.settings import PageSettings
from climatenerf.page.write import write_page
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.weather import Weather

SETTINGS = PageSettings(
    title="A yard </script>{{data}} & <b>",
    source="somebody",
    scenario="once in 100 years",
    level_error=0.04,
    size=(320, 200),
    view_count=2,
    levels=(0.2, 0.5, 0.8),
    snow_depths=(),
    visibilities=(20.0,),
    seasons=("winter",),
)
BASE = Weather(flood=Flood(clarity=0.5))
UNSENT = (0.13, 0.3, 0.42, 0.61, 0.77)


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return yard_place(tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def page_file(place, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "yard.html"
    written = write_page(place, out, SETTINGS, BASE)
    assert written.views == 2
    assert len(written.notes) == 1 and "seasons" in written.notes[0], "the yard has no classes"
    return out


def opened(browser, file, address="", **options):
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    page = opened_page(context, file.as_uri() + address)
    if options.get("java_script_enabled", True):
        wait_until(page, "shown !== null && composed !== null")
    return page


def set_level(page, level):
    page.evaluate(
        "level => { const slider = find('level'); slider.value = level;"
        " slider.dispatchEvent(new Event('input')); }",
        level,
    )


def composed(page):
    """The picture without its captions."""
    data = page.evaluate("btoa(Array.from(composed.data, c => String.fromCharCode(c)).join(''))")
    width, height = page.evaluate("[composed.width, composed.height]")
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)[..., :3]


def psnr(a, b):
    return -10 * np.log10(np.mean((a / 255.0 - b / 255.0) ** 2))


def test_levels_that_were_not_rendered_are_as_the_renderer_shows_them(browser, place, page_file):
    session, views, levels = prepared(place, SETTINGS, BASE, lambda what, fraction: None)
    page = opened(browser, page_file)
    for number, view in enumerate(views):
        page.evaluate("n => choose(n, 'water')", number)
        wait_until(page, f"state.view === {number}")
        page.evaluate("data.level_error = 0")  # its dashed lines are no part of the comparison
        for level in UNSENT:
            set_level(page, level)
            session.change(under_water(BASE, level))
            true = session.frame(view.camera, view.c2w)
            wet = np.array(
                page.evaluate("Array.from(shown.flooding, from => from < state.level ? 1 : 0)")
            )
            wet = wet.reshape(true.picture.shape[:2]).astype(bool)
            mask = true.layers["mask_water"] > 0.5
            assert (wet & mask).sum() / (wet | mask).sum() > 0.99, level
            ours = composed(page)
            upper = next(each for each in levels if each >= level)
            session.change(under_water(BASE, upper))
            alone = session.frame(view.camera, view.c2w).picture
            assert psnr(ours, true.picture) > max(27.0, psnr(alone, true.picture)), level


def test_clicks_read_the_depth_of_the_water(browser, place, page_file):
    session, views, _ = prepared(place, SETTINGS, BASE, lambda what, fraction: None)
    page = opened(browser, page_file)
    set_level(page, 0.61)
    session.change(under_water(BASE, 0.61))
    layers = session.frame(views[0].camera, views[0].c2w).layers
    rows, columns = np.nonzero((layers["mask_water"] > 0.99) & (layers["water_depth"] > 0))
    box = page.locator("#picture").bounding_box()
    rng = np.random.default_rng(0)
    for i in rng.choice(len(rows), 20, replace=False):
        x = box["x"] + (columns[i] + 0.5) / 320 * box["width"]
        y = box["y"] + (rows[i] + 0.5) / 200 * box["height"]
        page.mouse.click(x, y)
        assert page.evaluate("state.mark") == [columns[i], rows[i]]
        depth = page.evaluate("markedDepth()")
        assert depth == pytest.approx(float(layers["water_depth"][rows[i], columns[i]]), abs=0.01)
        assert f"water {depth:.2f} m" in page.inner_text("#told")
        assert "± 0.04 m" in page.inner_text("#told")


def test_what_is_drawn_dry_reads_dry(browser, page_file):
    page = opened(browser, page_file)
    set_level(page, 0.4)
    wrong = page.evaluate(
        "(() => { let wrong = 0; for (let i = 0; i < shown.flooding.length; i += 7) {"
        " state.mark = [i % canvas.width, Math.floor(i / canvas.width)];"
        " if ((markedDepth() > 0) !== (shown.flooding[i] < state.level)) wrong++; }"
        " return wrong; })()"
    )
    assert wrong == 0


def test_views_chosen_quickly_keep_their_own_pictures(browser, page_file):
    page = opened(browser, page_file)
    page.evaluate("Promise.all([choose(1, 'water'), choose(0, 'water')])")
    assert page.evaluate("[state.view, shown.index]") == [0, 0]
    page.evaluate("Promise.all([choose(0, 'water'), choose(1, 'smog', 1), choose(1, 'water')])")
    assert page.evaluate("[state.view, state.kind, shown.index]") == [1, "water", 1]


def test_a_changed_address_is_followed(browser, page_file):
    page = opened(browser, page_file)
    page.evaluate("location.hash = '#view=2&show=smog&step=1'")
    wait_until(page, "state.kind === 'smog'")
    assert page.evaluate("[state.view, state.step]") == [1, 1]
    page.get_by_role("radio", name="none").check()
    assert "step=0" in page.url


def test_it_requests_itself_alone_and_works_by_keyboard(browser, page_file):
    page = opened(browser, page_file)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.role") == "tab"
    page.keyboard.press("ArrowRight")
    wait_until(page, "state.kind === 'smog'")
    assert page.is_hidden("#level") and "visibility 20 m" in page.inner_text("#steps")
    assert "visibility 20 m" in page.get_attribute("#picture", "aria-label")
    page.keyboard.press("ArrowLeft")
    wait_until(page, "state.kind === 'water'")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "picture"
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    wait_until(page, "state.mark !== null")
    assert "ground at" in page.inner_text("#told")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "level"
    before = page.evaluate("state.level")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("state.level") == pytest.approx(before + 0.01)
    assert page.get_attribute("#level", "aria-valuetext").startswith(f"{before + 0.01:.2f} m")
    names = page.evaluate(
        "[...document.querySelectorAll('input,button')].map(each => each.labels?.length"
        " || each.textContent.length)"
    )
    assert all(names), "each control has a name"
    assert page.problems == [] and page.requests == [page.url.partition("#")[0]]


def test_the_title_is_text(browser, page_file):
    page = opened(browser, page_file)
    assert page.inner_text("h1") == SETTINGS.title and page.title() == SETTINGS.title


def test_captions_are_part_of_the_picture(browser, page_file):
    """What is copied from the canvas has them."""
    page = opened(browser, page_file)
    data = page.evaluate("canvas.toDataURL()").partition(",")[2]
    copied = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
    bare = composed(page)
    changed = (copied != bare).any(-1)
    assert changed[:20].mean() > 0.3 and changed[-12:].mean() > 0.2
    assert not changed[60:150].any(), "the middle is free"


def test_before_and_after_are_split(browser, page_file):
    page = opened(browser, page_file)
    page.evaluate("find('compare').value = 50; find('compare').dispatchEvent(new Event('input'))")
    dry = page.evaluate("Array.from(new Uint8Array(shown.dry.buffer))")
    dry = np.array(dry, np.uint8).reshape(200, 320, 4)[..., :3]
    ours = composed(page)
    assert np.array_equal(ours[:, :160], dry[:, :160])
    assert (ours[:, 160:] != dry[:, 160:]).any(-1).mean() > 0.2


def test_the_address_holds_what_is_shown(browser, page_file):
    page = opened(browser, page_file, "#view=2&show=water&level=0.33")
    assert page.evaluate("[state.view, state.level]") == [1, 0.33]
    wild = opened(browser, page_file, "#view=99&show=rain&level=1e9&step=x")
    assert wild.evaluate("[state.view, state.kind, state.level]") == [1, "water", 0.8]
    assert wild.problems == []


def test_dashed_lines_show_the_error_of_the_level(browser, page_file):
    page = opened(browser, page_file)
    set_level(page, 0.3)
    lines = (composed(page) == (255, 255, 0)).all(-1).sum()  # yellow: lower water
    page.evaluate("data.level_error = 0; draw()")
    assert lines > 20 and (composed(page) == (255, 255, 0)).all(-1).sum() == 0


def test_it_fits_a_phone(browser, page_file):
    page = opened(browser, page_file, viewport={"width": 360, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    level = page.locator("#level").bounding_box()
    assert level["height"] >= 40 and level["y"] + level["height"] < 740, "without scrolling"


def test_without_scripts_it_shows_before_and_after(browser, page_file):
    page = opened(browser, page_file, java_script_enabled=False)
    picture = page.locator("noscript img")
    assert picture.is_visible() and picture.evaluate("each => each.naturalWidth") > 500


def test_heights_survive_the_page(page_file):
    text = re.search(r'id="data">(.*?)</script>', page_file.read_text(), re.DOTALL)[1]
    data = json.loads(text)
    assert data["title"] == SETTINGS.title
    flooding = np.array([[-1.2345, 0.0, 12.5, np.inf], [-np.inf, 64.2, 70.0, 500.0]])
    heights = flooding - np.array([[0.1, -0.03, 0.0, 0.0], [0.0, 0.004, 0.0, 0.0]])
    low, coded = height_text(heights, flooding)
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(coded)))).astype(int)
    counts = pixels[..., 0] * 256 + pixels[..., 1]
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 1)):
        level = low + 0.001 * counts[row, column]
        assert level == pytest.approx(flooding[row, column], abs=0.0006)
        height = level - 0.002 * (pixels[row, column, 2] - 128)
        assert height == pytest.approx(heights[row, column], abs=0.0016)
    assert counts[0, 3] == SKY and counts[1, 0] == OPEN and (counts[1, 2:] == OPEN - 1).all()
    flat, _ = height_text(np.full((2, 2), np.inf), np.full((2, 2), np.inf))
    assert flat == 0.0
