import io
import re
import sys

import pytest

from climatenerf.cli import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def test_plain_lines_every_ten_seconds_with_eta(clock, capsys):
    with progress.Bar("fit", total=100) as bar:
        for step in range(1, 51):
            clock.now += 0.5
            bar.update(step, {"rays/s": "21 k", "PSNR": f"{step}.0"})
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines == [
        "fit: 20 %  ETA 0:40  rays/s 21 k  PSNR 20.0",
        "fit: 40 %  ETA 0:30  rays/s 21 k  PSNR 40.0",
        "fit: 50 %  0:25 in all  rays/s 21 k  PSNR 50.0",
    ]


def test_preparation_does_not_count_in_the_eta(clock, capsys):
    with progress.Bar("fit", total=100) as bar:
        clock.now += 30  # compiling
        bar.prepared(70)  # continued
        bar.update(70)
        assert bar.eta() is None
        clock.now += 1
        bar.update(72)
        assert bar.eta() == pytest.approx(14)
    assert capsys.readouterr().err.splitlines()[-1] == "fit: 72 %  0:31 in all"


def test_quiet_prints_nothing(clock, capsys):
    with progress.Bar("fit", total=2, quiet=True) as bar:
        clock.now += 60
        bar.advance()
    assert list(progress.track("a", [1, 2], quiet=True)) == [1, 2]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("width", ["80", "140"])
def test_terminal_shows_a_bar_with_its_columns(monkeypatch, width):
    for name in ("NO_COLOR", "TERM", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", width)
    progress._console.cache_clear()
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.Bar("fit", total=10) as bar:
        bar.update(4, {"step": "[12]", "rays/s": "21.4 k", "samples/ray": "12.3", "PSNR": "24.3"})
        progress.say("preview saved [here]")
    progress._console.cache_clear()
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stream.getvalue())
    assert "40%" in text and "step [12]" in text
    assert re.search(r"ETA +(--|\d\d?):", text), "not squeezed out by the columns"
    assert "preview saved [here]" in text


@pytest.mark.parametrize("bars", [lambda: progress.Bar("fit", 1.0), progress.StageBars])
def test_an_interruption_within_a_print_shows_the_cursor_again(monkeypatch, bars):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    progress._console.cache_clear()
    try:
        with pytest.raises(KeyboardInterrupt), bars() as bar:
            if isinstance(bar, progress.StageBars):
                bar("bake", 0.5)
            progress._console().__enter__()  # as `print` begins
            raise KeyboardInterrupt
    finally:
        progress._console.cache_clear()
    shown = terminal.getvalue()
    assert "\x1b[?25l" in shown, "the bar hides the cursor"
    assert shown.rfind("\x1b[?25h") > shown.rfind("\x1b[?25l")
    assert sys.stderr is terminal


def test_after_an_interruption_within_a_print_lines_appear(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    progress._console.cache_clear()
    try:
        with pytest.raises(KeyboardInterrupt), progress.Bar("fit", 1.0):
            progress._console().__enter__()
            raise KeyboardInterrupt
        progress.say("Stopped early")
    finally:
        progress._console.cache_clear()
    assert "Stopped early" in terminal.getvalue()


@pytest.mark.parametrize("term", ["xterm", "dumb"])
def test_a_bar_that_ends_shows_the_cursor_where_it_was_hidden(monkeypatch, term):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", term)
    progress._console.cache_clear()
    try:
        with progress.Bar("fit", 1.0) as bar:
            bar.update(0.5)
    finally:
        progress._console.cache_clear()
    assert ("\x1b[?25h" in terminal.getvalue()) == (term == "xterm")


def test_each_stage_has_a_bar_that_ends_before_the_next(clock, capsys):
    with progress.StageBars("flood: ") as bars:
        bars("light", 0.0)
        bars("frames", 0.5)  # half of the frames exist
        clock.now += 20
        bars("frames", 0.75)
        bars("frames", 1.0)
    assert capsys.readouterr().err.splitlines() == [
        "flood: light: 100 %  0:00 in all",
        "flood: frames: 75 %  ETA 0:20",
        "flood: frames: 100 %  0:20 in all",
    ]


def test_an_interrupted_stage_shows_its_progress(clock, capsys):
    with pytest.raises(KeyboardInterrupt), progress.StageBars() as bars:
        bars("frames", 0.0)
        bars("frames", 0.25)
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "frames: 25 %  0:00 in all\n"


def test_track_counts(capsys):
    assert list(progress.track("frames", [3, 4])) == [3, 4]
    assert "frames: 100 %" in capsys.readouterr().err
    assert list(progress.track("nothing", [])) == []


def test_results_go_to_standard_output(capsys):
    progress.result("PSNR 25.1 dB")
    progress.warn("17 pictures are missing")
    assert capsys.readouterr() == ("PSNR 25.1 dB\n", "warning: 17 pictures are missing\n")


def test_numbers():
    assert progress.duration(None) == "-:--" and progress.duration(59.6) == "1:00"
    assert progress.duration(3725) == "1:02:05"
    assert progress.rate(21440) == "21.4 k" and progress.rate(7) == "7"
    assert progress.rate(2.5e6) == "2.5 M"
