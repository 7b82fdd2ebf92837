"""How live is the viewer: pictures a second while moving, their age, and how soon a change shows?

python benchmarks/viewer.py RUN

Poses arrive 30 times a second for two seconds, as from a drag, in the place as it is, flooded and
under snow. The age of a picture is the time since its pose was asked for. Then the pose rests until
the full picture; then the water level changes. No browser takes part, but for the first picture:
from opening the page in Chromium to the first picture that is sent. With --pictures,
docs/gallery/street-viewer.jpg shows it on a wide screen and on a phone.
"""

import argparse
import io
import shutil
import threading
import time
from pathlib import Path

import common
import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from climatenerf import Flood, Snow, Weather, api
from climatenerf.core.cameras import Camera
from climatenerf.output.contact_sheet import write_jpeg
from climatenerf.paths.camera_path import still
from climatenerf.render.session import RenderSession
from climatenerf.studies.shot import Place
from climatenerf.viewer.app import ViewerApp
from climatenerf.viewer.live import LiveView, Wanted
from climatenerf.weather.world import Kept

GALLERY = Path(__file__).resolve().parents[1] / "docs" / "gallery"
RATE, SECONDS = 30, 2.0
WEATHERS = {
    "clean": Weather(),
    "flood": Weather(flood=Flood(level=0.3)),
    "snow": Weather(snow=Snow(depth=0.1)),
}


def turned(c2w: np.ndarray, angle: float, ahead: float) -> np.ndarray:
    """The pose turned about z (rad) and moved forwards (m)."""
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    moved = c2w.copy()
    moved[:3, :3] = (turn @ c2w)[:3, :3]
    moved[:3, 3] += ahead * c2w[:3, 2]
    return moved


def drag(place: Place, weather: Weather, camera: Camera, c2w: np.ndarray) -> dict[str, object]:
    pictures: list = []
    session = RenderSession(place.field, place.scene, Weather(), kept=place.kept)
    live = LiveView(
        session, lambda shown: pictures.append((time.monotonic(), shown)), lambda told: None
    )

    def full_of(wanted: Wanted) -> float:
        while True:
            for at, shown in reversed(pictures):
                if shown.state == "full" and shown.wanted is wanted:
                    return at
            time.sleep(0.002)

    first = Wanted(camera, c2w, weather, asked=time.monotonic())
    live.ask(first)
    full_of(first)
    full_of(first)
    pictures.clear()
    for i in range(int(RATE * SECONDS)):
        pose = turned(c2w, 0.25 * i / (RATE * SECONDS), 0.5 * i / (RATE * SECONDS))
        wanted = Wanted(camera, pose, weather, asked=time.monotonic())
        live.ask(wanted)
        time.sleep(1 / RATE)
    moving = list(pictures)
    ages = [at - shown.wanted.asked for at, shown in moving]
    rest = full_of(wanted) - wanted.asked
    found: dict[str, object] = {
        "pictures_a_second": len(moving) / SECONDS,
        "age_p95_s": float(np.quantile(ages, 0.95)),
        "rest_to_full_s": rest,
    }
    if weather.flood.level is not None:
        changes = []
        for level in (0.4, 0.5, 0.6):
            pictures.clear()
            changed = weather.with_value("flood.level", level)
            asked = Wanted(camera, wanted.c2w, changed, asked=time.monotonic())
            live.ask(asked)
            while not [at for at, shown in pictures if shown.wanted is asked]:
                time.sleep(0.002)
            changes.append(pictures[0][0] - asked.asked)
            full_of(asked)
        found["level_change_s"] = common.spread(changes)
    live.close()
    return found


def first_picture(run: Path, place: Place) -> dict[str, float]:
    """Time from opening the page to the first picture, s, with compiled kernels."""
    app, times = ViewerApp(run, place, 0), []
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        for _ in range(4):
            page = browser.new_context(viewport={"width": 900, "height": 506}).new_page()
            begun = time.monotonic()
            page.goto(f"http://localhost:{app.port}")
            while not any(tab.shown for tab in app.tabs.values()):
                page.wait_for_timeout(5)
            times.append(time.monotonic() - begun)
            page.context.close()
            while app.tabs:
                time.sleep(0.01)
        browser.close()
    app.close()
    return common.spread(times[1:])


def pictures(run: Path, place: Place) -> None:
    """Write the viewer with a flood, on a wide screen and on a phone, into the gallery."""
    app, shots = ViewerApp(run, place, 0), []
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        for width in (1280, 400):
            page = browser.new_context(viewport={"width": width, "height": 760}).new_page()
            page.goto(f"http://localhost:{app.port}")
            while not app.tabs:
                page.wait_for_timeout(20)
            (tab,) = app.tabs.values()
            page.wait_for_timeout(2000)
            for notice in page.locator(".mantine-Notification-closeButton").all():
                notice.click()  # of rendering without a GPU
            tab.controls.set("flood.level", 0.45)
            tab._before.value = True
            tab._split.value = 30
            while tab.shown is None or tab.shown.state != "full" or not tab.shown.wanted.split:
                page.wait_for_timeout(50)
            page.wait_for_timeout(1000)
            shots.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
            page.context.close()
            while app.tabs:
                time.sleep(0.01)
        browser.close()
    app.close()
    sheet = Image.new("RGB", (sum(s.width for s in shots) + 8, shots[0].height), (90, 90, 90))
    sheet.paste(shots[0], (0, 0))
    sheet.paste(shots[1], (shots[0].width + 8, 0))
    write_jpeg(GALLERY / "street-viewer.jpg", np.asarray(sheet), max_bytes=150_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--pictures", action="store_true", help="draw the gallery's sheet alone")
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    run = api.load_run(options.run)
    place = Place(run.completed(), run.scene, Kept(run.folder, run.digest or ""), run.style)
    if options.pictures:
        pictures(options.run, place)
        return
    path = still(run.scene, None, 1, (width, height))
    found: dict[str, object] = {"size": options.size}
    for name, weather in WEATHERS.items():
        found[name] = drag(place, weather, path.cameras[0], path.c2w[0])
    found["page_to_first_picture_s"] = first_picture(options.run, place)
    found["threads_left"] = threading.active_count()
    common.report("viewer", found)


if __name__ == "__main__":
    main()
