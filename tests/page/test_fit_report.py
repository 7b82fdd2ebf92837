"""The report of a run: its weak points, plots and the file."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from support.browser import chromium
from support.command_line import error_message, run_cli
from support.holed_ground import terrain_of
from support.random_run import random_run, small

from climatenerf.page.drawings import COMPLETED, SEEN, bar_chart, class_legend, coverage_picture
from climatenerf.page.weak_points import Evidence, percent, weak_points

GOOD = Evidence({"psnr": 28.0, "views": {"a.jpg": {"psnr": 27.0}}}, 60, "gps", 0.02, 0.95, 0.2,
                True, True)  # fmt: skip


def titles(**changes):
    return [each.title for each in weak_points(replace(GOOD, **changes))]


def test_a_good_fit_has_no_weak_points():
    assert titles() == []


@pytest.mark.parametrize(
    ("changes", "title"),
    [
        ({"ground_seen": 0.5}, "Ground that no photo shows"),
        ({"ground_seen": None}, "No terrain"),
        ({"scale_error": 0.3}, "Uncertain scale"),
        ({"photos": 12}, "Few photos"),
        ({"sky": 0.01}, "Little sky"),
        ({"sky": 0.6}, "Mostly sky"),
        ({"light": False}, "Unknown light"),
        ({"classes": False}, "No classes"),
        ({"metrics": {"psnr": 20.0, "views": {}}}, "Blurred pictures"),
        ({"metrics": {"floating.share": 0.01}}, "Floating matter"),
        ({"metrics": {"sky.empty": 0.9}}, "Sky that is not empty"),
        ({"metrics": {"points.abs_rel": 0.2}}, "Inexact depth"),
        ({"metrics": {"ground.roughness_cm": 9.0}}, "Rough ground"),
    ],
)
def test_each_weak_point_is_found_alone_and_complete(changes, title):
    (found,) = weak_points(replace(GOOD, **changes))
    assert found.title == title
    assert all(len(text) > 5 for text in (found.evidence, found.consequence, found.remedy))


def test_photos_far_below_the_mean_are_named_from_the_worst():
    views = {f"{i}.jpg": {"psnr": value} for i, value in enumerate((29.0, 21.0, 23.5, 29.0))}
    (found,) = weak_points(replace(GOOD, metrics={"psnr": 28.0, "views": views}))
    assert found.evidence == "1.jpg (21.0 dB), 2.jpg (23.5 dB); the mean is 28.0 dB"


def test_percentages_have_two_digits():
    assert [percent(x) for x in (0.0, 0.012, 0.1, 0.456, 1.0)] == [
        "0.0 %", "1.2 %", "10 %", "46 %", "100 %",
    ]  # fmt: skip


def test_bars_are_as_long_as_their_values():
    text = bar_chart([("<a>", 20.0), ("b", 30.0)], 25.0, "dB")
    root = ET.fromstring(text)
    first, second = (float(each.get("width")) for each in root.iter("rect"))
    line = next(root.iter("line"))
    left = float(next(root.iter("rect")).get("x"))
    mean = float(line.get("x1")) - left
    assert mean - first == pytest.approx(second - mean, abs=0.2), "25 lies amid 20 and 30"
    assert root.findtext("text") == "<a>" and bar_chart([], None, "dB") == ""


def test_the_map_shows_seen_and_completed_ground_with_y_up():
    """A hole from -1 to 1 m, completed; a camera at (3, 2) m."""
    terrain = terrain_of(half=1.0)
    picture, metres = coverage_picture(terrain, np.array([[3.0, 2.0]]), 4.0)
    low, high = np.array([-1.0, -2.0]), np.array([7.0, 6.0])

    def at(x, y):
        return picture[int((high[1] - y) / metres), int((x - low[0]) / metres)]

    assert tuple(at(0.0, 0.0)) == COMPLETED and tuple(at(5.0, 4.0)) == SEEN
    assert tuple(at(3.0, 2.0)) not in (COMPLETED, SEEN)
    assert tuple(at(0.0, -1.8)) == SEEN
    assert len(class_legend()) == 7


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = random_run(tmp_path_factory.mktemp("report") / "run", small("cpu"))
    views = json.loads((folder / "scene.json").read_text())["views"]
    scores = {view["name"]: {"psnr": 20.0, "ssim": 0.5, "psnr_cc": 20.0} for view in views[:1]}
    metrics = {"psnr": 20.0, "ssim": 0.5, "psnr_cc": 20.0, "steps": 3, "seconds": 1.0}
    (folder / "metrics.json").write_text(
        json.dumps({**metrics, "interrupted": False, "views": scores})
    )
    return folder


def test_a_report_is_one_file_that_requests_nothing(run, tmp_path, capsys):
    out = tmp_path / "report.html"
    assert run_cli("report", run, "-o", out) == 0
    told = capsys.readouterr()
    assert f"report: {out}" in told.out and "Blurred pictures: 20.0 dB" in told.err
    text = out.read_text()
    for heading in ("Summary", "What weather will look wrong", "Pictures", "Ground", "Scale",
                    "Geometry", "Light", "Classes", "Capture"):  # fmt: skip
        assert re.search(f"<h2>{heading}", text), heading
    assert all(each.strip() for each in re.findall(r'<img[^>]* alt="([^"]*)"', text))
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 360, "height": 740})
        problems, requests = [], []
        page.on("console", lambda said: problems.append(said.text))
        page.on("request", lambda request: requests.append(request.url.partition(":")[0]))
        page.goto(out.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        assert page.evaluate("[...document.images].every(each => each.naturalWidth > 0)")
        assert problems == [] and set(requests) <= {"file", "data"}


def test_reports_of_unfinished_runs_are_refused(run, tmp_path, capsys):
    assert "must name an HTML file" in error_message(capsys, "report", run, "-o", tmp_path / "a")
    assert "give a run folder" in error_message(capsys, "report", tmp_path / "none")
    kept = (run / "metrics.json").read_bytes()
    (run / "metrics.json").unlink()
    assert "resume the fit first" in error_message(capsys, "report", run)
    (run / "metrics.json").write_bytes(kept)
