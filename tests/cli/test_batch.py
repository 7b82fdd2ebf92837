"""Batches: the file, the order of the tasks, what is done before, and the table."""

import csv
import threading
import time
from pathlib import Path

import psutil
import pytest
from support.command_line import STREET, error_message, run_cli

from climatenerf.cli.batch import flag_words, read_batch
from climatenerf.cluster import workers
from climatenerf.cluster.batch import Task, run_batch
from climatenerf.cluster.on_worker import run_verb

WHOLE = """
[defaults.fit]
minutes = 10
loss = ["sky=0", "planarity=0.5"]

[[scene]]
name = "yard"
capture = "captures/yard"
fit.labels = "heuristic"
fit.minutes = 2

[[scene.stylize]]
name = "winter"
season = "winter"

[[scene.render]]
name = "flood in winter"
of = "winter"
size = "480x270"
layers = ["depth", "normal"]
complete_ground = false
flood.level = "0.3 m"
flood.wind-speed = "2 m/s"

[[scene]]
photos = "photos/lane"
"""


def batch_file(folder, text):
    path = folder / "batch.toml"
    path.write_text(text)
    return path


def test_tasks_are_commands_in_the_order_of_their_needs(tmp_path):
    tasks = read_batch(batch_file(tmp_path, WHOLE), tmp_path / "out")
    yard, lane = tmp_path / "out" / "yard", tmp_path / "out" / "lane"
    assert [(task.title, task.needs) for task in tasks] == [
        ("yard: fit", ()),
        ("yard: winter", ("fit",)),
        ("yard: flood in winter", ("winter",)),
        ("lane: capture", ()),
        ("lane: fit", ("capture",)),
    ]
    fit = ["fit", f"{tmp_path}/captures/yard", "-o", f"{yard}/run", "--minutes", "2"]
    fit += ["--loss", "sky=0", "--loss", "planarity=0.5", "--labels", "heuristic"]
    assert list(tasks[0].words) == fit
    flood = ["render", f"{yard}/winter", "-o", f"{yard}/flood in winter", "--size", "480x270"]
    flood += ["--layers", "depth", "normal", "--no-complete-ground", "--flood.level", "0.3 m"]
    assert list(tasks[2].words) == [*flood, "--flood.wind-speed", "2 m/s"]
    assert tasks[3].words == ("capture", f"{tmp_path}/photos/lane", "-o", f"{lane}/capture")
    assert tasks[4].words[1] == f"{lane}/capture"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "should list its captures, each under [[scene]]"),
        ("[[scene]]\n", "either capture = "),
        ('[[scene]]\ncapture = "a"\nphotos = "b"', "either capture = "),
        ('[[scene]]\ncapture = "a"\n[[scene]]\ncapture = "b/a"', "two scenes 'a'"),
        ('[[scene]]\ncapture = "a"\nflood = 1', "unknown key 'flood'"),
        ('[[scene]]\ncapture = "a"\nfit = 3', "fit should be a table of flags; got 3"),
        ('[[scene]]\ncapture = "a"\nfit.minute = 3', "--minutes"),
        ('[[scene]]\ncapture = "a"\nfit.minutes = "soon"', "--minutes must be a number"),
        ('[[scene]]\ncapture = "a"\nfit.loss = [true]', "loss must be a text or a number"),
        ('[[scene]]\nname = "../b"\ncapture = "a"', "cannot be that of a folder"),
        ('[[scene]]\ncapture = "a"\nrender = 1', "under [[scene.render]]"),
        ('[[scene]]\ncapture = "a"\n[[scene.render]]\n[[scene.render]]', "two tasks 'render'"),
        ('[[scene]]\ncapture = "a"\n[[scene.render]]\nname = "run"', "'run', or the name is"),
        ('[[scene]]\ncapture = "a"\n[[scene.render]]\nof = "spring"', "no styled run 'spring'"),
        ('[[scene]]\ncapture = "a"\n[[scene.render]]\nflood.level = "3"', "has no unit"),
        ("[[scene]]\ncapture = 5", "either capture = "),
        ('[[scene]]\ncapture = "a"\nfit.out = "b"', "leave out out, which the batch decides"),
        ('[[scene]]\ncapture = "a"\nfit.help = true', "leave help out"),
        ('[[scene]]\nname = "table.csv"\ncapture = "a"', "or the name is reserved"),
        ('[defaults.flood]\n[[scene]]\ncapture = "a"', "unknown key 'flood'"),
    ],
)
def test_wrong_files_are_one_sentence_and_write_nothing(tmp_path, capsys, text, said):
    path = batch_file(tmp_path, text)
    message = error_message(capsys, "batch", path, "-o", tmp_path / "out")
    assert said in message and str(path) in message
    assert not (tmp_path / "out").exists()


def test_lists_are_repeated_or_listed_as_the_verb_wants():
    assert flag_words("fit", {"known-length": ["A=1 m", "B=2 m"]}, "") == [
        *("--known-length", "A=1 m", "--known-length", "B=2 m")
    ]
    assert flag_words("render", {"layers": ["depth", "label"], "preview": True}, "") == [
        *("--layers", "depth", "label", "--preview")
    ]


def test_a_dry_run_prints_commands_and_writes_nothing(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_cli("batch", batch_file(tmp_path, WHOLE), "-o", out, "--dry-run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5 and lines[1].endswith(f"-o {out}/yard/winter --season winter")
    assert not out.exists()


def check_task(tmp_path, name, capture, needs=()):
    """A task that takes a second: it checks a capture, and makes what stands for its result."""
    out = tmp_path / "out" / "scene" / name
    words = ("check", str(capture))
    log = tmp_path / "out" / "scene" / "logs" / f"{name}.log"
    return Task("scene", name, words, out, tmp_path, log, needs)


@pytest.mark.parametrize("workers", [None, 2])
def test_a_failure_skips_what_needs_it_and_nothing_else(tmp_path, workers):
    good = check_task(tmp_path, "good", STREET)
    bad = check_task(tmp_path, "bad", tmp_path / "absent")
    after_good = check_task(tmp_path, "after good", STREET, ("good",))
    after_bad = check_task(tmp_path, "after bad", STREET, ("bad",))
    last = check_task(tmp_path, "last", STREET, ("after bad",))
    tasks = [good, bad, after_good, after_bad, last]
    for task in tasks:
        task.out.mkdir(parents=True)
    seen = []
    outcomes = run_batch(tasks, tmp_path / "out", workers, lambda task, how: seen.append(task))
    found = [outcomes[task].status for task in tasks]
    assert found == ["done", "failed", "done", "skipped", "skipped"]
    assert set(seen) == set(tasks)
    assert "absent does not exist" in outcomes[bad].message
    assert good.log.read_text().startswith(f"$ climatenerf check {STREET}\n")
    again = run_batch(tasks, tmp_path / "out", None, lambda task, how: None)
    assert [again[task].before for task in tasks] == [True, False, True, False, False]
    good.out.rmdir()  # what it made is gone, so it is made anew, and what needs it stays done
    third = run_batch(tasks[:3], tmp_path / "out", None, lambda task, how: None)
    assert [third[task].before for task in tasks[:3]] == [False, False, True]


def test_the_table_shows_what_failed_and_escapes_it(tmp_path, capsys, monkeypatch):
    text = '[[scene]]\nname = "a & b"\ncapture = "absent"\n[[scene.render]]\n'
    monkeypatch.chdir(tmp_path)  # a relative folder, as people type it
    out = Path("out")
    message = error_message(capsys, "batch", batch_file(tmp_path, text), "-o", out)
    assert message.endswith("runs them again") and "1 of 2 tasks have failed" in message
    with (out / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["failed", "skipped"]
    assert "absent does not exist" in rows[0]["message"]
    page = (out / "table.html").read_text()
    assert "a &amp; b" in page and "a & b" not in page and "1 failed, 1 skipped" in page
    assert 'href="a%20%26%20b/logs/fit.log"' in page
    monkeypatch.setattr(workers, "CONNECT", 1.0)
    address = "tcp://127.0.0.1:9"  # a refused command leaves the table
    said = error_message(capsys, "batch", "batch.toml", "-o", out, "--workers", address)
    assert "no Dask scheduler answers" in said and (out / "table.html").read_text() == page
    said = error_message(capsys, "batch", "batch.toml", "-o", "new", "--workers", address)
    assert "no Dask scheduler answers" in said and not Path("new").exists()


def test_a_verb_that_a_signal_ends_is_said(tmp_path):
    log = tmp_path / "log"

    def kill_it():
        while True:
            for process in psutil.Process().children():
                if process.cmdline()[-2:-1] == ["check"]:
                    process.kill()
                    return
            time.sleep(0.02)

    threading.Thread(target=kill_it, daemon=True).start()
    status, _, message = run_verb(["check", str(STREET)], log, tmp_path, None)
    assert status == -9 and message.startswith("ended by signal 9")


@pytest.mark.slow
def test_a_batch_fits_and_renders_and_goes_on(tmp_path, capsys):
    text = f"""
[[scene]]
name = "street"
capture = "{STREET}"
fit = {{ steps = 20, downscale = 8 }}
[[scene.render]]
name = "flood"
frames = 2
size = "48x27"
flood.level = "0.2 m"
"""
    path, out = batch_file(tmp_path, text), tmp_path / "out"
    assert run_cli("batch", path, "-o", out, "--workers", "1") == 0
    assert (out / "street" / "flood" / "movie.mp4").is_file()
    with (out / "table.csv").open(newline="") as file:
        fit, flood = csv.DictReader(file)
    assert float(fit["psnr"]) > 8 and fit["steps"] == "20"
    assert flood["result"] == "street/flood/movie.mp4"
    capsys.readouterr()
    path.write_text(text.replace("20", "30", 1))  # more steps: the fit goes on, the movie is new
    assert run_cli("batch", path, "-o", out) == 0
    assert "done before" not in capsys.readouterr().err
    log = (out / "street" / "logs" / "fit.log").read_text()
    assert log.count("$ climatenerf fit") == 2 and "--steps 30 --downscale 8 --resume" in log


@pytest.mark.slow
def test_a_killed_worker_takes_its_verb_along_and_another_repeats_it(tmp_path):
    log = tmp_path / "out" / "scene" / "logs" / "verify.log"
    task = Task("scene", "verify", ("verify",), tmp_path / "out" / "scene", tmp_path, log)
    killed = []

    def kill_first_worker():
        for process in psutil.Process().children(recursive=True):
            if process.cmdline()[-1:] == ["verify"]:
                killed.append(process)
                process.parent().kill()
                return

    def watch():
        while not killed:
            time.sleep(0.2)
            kill_first_worker()

    threading.Thread(target=watch, daemon=True).start()
    outcomes = run_batch([task], tmp_path / "out", 1, lambda task, how: None)
    assert outcomes[task].status == "done"
    assert log.read_text().count("$ climatenerf verify") == 2
    psutil.wait_procs(killed, timeout=10)
    assert not killed[0].is_running()
