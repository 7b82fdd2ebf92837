"""How exact and quick is a page of a run between its rendered levels?

python benchmarks/page.py RUN [--pictures]

Writes a page, opens it in Chromium, and at levels that were not rendered compares its wet pixels
with `mask_water`, its colours with a render, and depths at random clicks with `water_depth`.
Cross-fading the pictures of the two levels around, as a page without heights would, stands beside
it. With --pictures, docs/gallery/street-page.jpg shows the page on a wide screen and on a phone.
"""

import argparse
import base64
import io
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from climatenerf import api
from climatenerf.output.contact_sheet import write_jpeg
from climatenerf.page.pictures import prepared, under_water
from climatenerf.page.settings import PageSettings
from climatenerf.page.write import write_page
from climatenerf.studies.shot import Place
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Kept

GALLERY = Path(__file__).resolve().parents[1] / "docs" / "gallery"
LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)
UNSENT = (0.1, 0.3, 0.5, 0.72, 0.93)
CLICKS = 20
STEPS = 60


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a / 255.0 - b / 255.0) ** 2)))


def composed(page) -> np.ndarray:
    """The page's picture without its captions."""
    text = page.evaluate(
        "(() => { let s = ''; const d = composed.data;"
        " for (let i = 0; i < d.length; i += 8192)"
        " s += String.fromCharCode.apply(null, d.subarray(i, i + 8192)); return btoa(s); })()"
    )
    width, height = page.evaluate("[composed.width, composed.height]")
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)[..., :3]


def compared(page, place: Place, settings: PageSettings) -> dict[str, object]:
    """Scores over all views and levels that were not rendered."""
    session, views, levels = prepared(place, settings, Weather(), lambda what, fraction: None)
    rng = np.random.default_rng(0)
    iou, ours, faded, upper_alone, clicks = [], [], [], [], []
    for number, view in enumerate(views):
        page.evaluate("n => choose(n, 'water')", number)

        def rendered(level: float, view=view):
            session.change(under_water(Weather(), level))
            frame = session.frame(view.camera, view.c2w)
            return frame.picture, frame.layers

        sent = {level: rendered(level)[0] for level in levels}
        session.change(Weather())
        dry = session.frame(view.camera, view.c2w).picture
        for level in UNSENT:
            true, layers = rendered(level)
            page.evaluate("level => { state.level = level; draw(); }", level)
            wet = np.array(page.evaluate("Array.from(shown.flooding, z => +(z < state.level))"))
            wet = wet.reshape(true.shape[:2]) > 0
            mask = layers["mask_water"] > 0.5
            iou.append(float((wet & mask).sum() / max((wet | mask).sum(), 1)))
            ours.append(psnr(composed(page), true))
            above = next(each for each in levels if each >= level)
            below = max((each for each in levels if each < level), default=None)
            share = level / above if below is None else (level - below) / (above - below)
            low = dry if below is None else sent[below]
            faded.append(psnr((1 - share) * low + share * sent[above], true))
            upper_alone.append(psnr(sent[above], true))
            rows, columns = np.nonzero((layers["mask_water"] > 0.99) & (layers["water_depth"] > 0))
            for i in rng.choice(len(rows), CLICKS // len(UNSENT), replace=False):
                page.evaluate("([x, y]) => mark(x, y)", [int(columns[i]), int(rows[i])])
                found = page.evaluate("markedDepth()")
                clicks.append(abs(found - float(layers["water_depth"][rows[i], columns[i]])))
    return {
        "wet_iou": {"lowest": min(iou), "median": float(np.median(iou))},
        "psnr_db": common.spread(ours),
        "cross_fade_psnr_db": common.spread(faded),
        "upper_level_psnr_db": common.spread(upper_alone),
        "click_error_m": {"greatest": max(clicks), "median": float(np.median(clicks))},
    }


def steps(page) -> dict[str, float]:
    """Time of a slider step, ms."""
    page.evaluate("choose(0, 'water')")
    found = []
    for level in np.linspace(0.0, 1.0, STEPS):
        found.append(page.evaluate("level => { state.level = level; return draw(); }", level))
    return common.spread(found)


def pictures(browser, file: Path) -> None:
    """Write the page on two screens into the gallery, side by side."""
    shots = []
    for width in (1120, 400):
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.goto(file.as_uri() + "#view=1&level=0.45")
        page.wait_for_timeout(1500)
        shots.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        page.close()
    sheet = Image.new("RGB", (sum(s.width for s in shots) + 8, shots[0].height), (90, 90, 90))
    sheet.paste(shots[0], (0, 0))
    sheet.paste(shots[1], (shots[0].width + 8, 0))
    write_jpeg(GALLERY / "street-page.jpg", np.asarray(sheet), max_bytes=150_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--pictures", action="store_true")
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    settings = PageSettings(
        title="The street",
        source="embedded scene of climatenerf",
        scenario="cloudburst, once in 100 years: 0.45 m" if options.pictures else "",
        level_error=0.05 if options.pictures else 0.0,
        size=(width, height),
        view_count=options.views,
        levels=LEVELS,
        seasons=(),
    )
    run = api.load_run(options.run)
    place = Place(run.completed(), run.scene, Kept(run.folder, run.digest or ""), run.style)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        file = Path(folder) / "page.html"
        written = write_page(place, file, settings, Weather())
        plain = replace(settings, snow_depths=(), visibilities=())
        small = Path(folder) / "water.html"
        write_page(place, small, plain, Weather())
        browser = started.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        if options.pictures:
            pictures(browser, file)
            return
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(file.as_uri())
        page.wait_for_timeout(2000)
        found = {
            "size": options.size,
            "views": written.views,
            "levels": LEVELS,
            "unsent_levels": UNSENT,
            "megabytes_a_view": file.stat().st_size / 1e6 / written.views,
            "megabytes_a_view_water_alone": small.stat().st_size / 1e6 / written.views,
            **compared(page, place, settings),
            "slider_step_ms": steps(page),
            "browser": browser.version,
        }
        browser.close()
    common.report("page", found)


if __name__ == "__main__":
    main()
