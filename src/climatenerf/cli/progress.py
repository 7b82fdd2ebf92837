"""Output for the user: progress bars with ETA in a terminal, plain lines elsewhere.

Verbs print through this module. Progress goes to standard error; results (paths of files, the
PSNR) go to standard output, so that they can be piped.
"""

import contextlib
import functools
import time
from collections.abc import Iterable, Iterator, Mapping, Sized
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

from climatenerf.cli import streams

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from climatenerf.scene.findings import Finding

LINE_EVERY = 10.0
"""Seconds between two lines if standard error is no terminal."""

SHOW_CURSOR = "\x1b[?25h"

Item = TypeVar("Item")


class Bar:
    """Progress of one task with a known amount of work.

    ``with Bar("fit", total=300.0) as bar: bar.update(elapsed, {"step": "120", "PSNR": "21.3"})``.
    In a terminal this is a bar with percentage, ETA and the given columns. Elsewhere it is a line
    about every ten seconds, and one at the end.
    """

    def __init__(self, title: str, total: float, quiet: bool = False) -> None:
        """Prepare the bar.

        Args:
            title: name of the task, a word or two.
            total: amount of work, any unit (steps, frames, seconds), > 0.
            quiet: print nothing.
        """
        self.title = title
        self.total = max(float(total), 1e-9)  # prevents 0/0 for an empty task, which is complete
        self.done = 0.0
        self.columns: dict[str, str] = {}
        self._quiet = quiet
        self._start = self._paced = time.monotonic()
        self._given = 0.0
        self._next_line = self._start + LINE_EVERY
        self._progress: Progress | None = None

    def __enter__(self) -> Self:
        """Show the bar."""
        self._start = self._paced = time.monotonic()
        self._next_line = self._start + LINE_EVERY
        if not self._quiet and _console().is_terminal:
            self._progress = _rich_progress(_console())
            self._progress.start()
            self._task = self._progress.add_task(self.title, total=self.total, columns="")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the bar as it is, and end its line."""
        if self._progress is not None:
            try:
                self._progress.stop()
            finally:
                _show_cursor(self._progress.console)
                if error is not None:
                    _console.cache_clear()  # what is printed next would stay in its open buffer
        elif not self._quiet:
            self._line(last=True)

    def update(self, done: float, columns: Mapping[str, str] | None = None) -> None:
        """Report the amount of work done.

        Args:
            done: amount done so far, [0, total].
            columns: text beside the bar by label, e.g. ``{"rays/s": "21 k"}``; shown until changed.
        """
        self.done = min(float(done), self.total)
        self.columns |= columns or {}
        if self._progress is not None:
            self._progress.update(self._task, completed=self.done, columns=self._text())
        elif not self._quiet and time.monotonic() >= self._next_line:
            self._line(last=False)

    def advance(self, by: float = 1.0, columns: Mapping[str, str] | None = None) -> None:
        """Report that a further amount of work is done."""
        self.update(self.done + by, columns)

    def prepared(self, done: float = 0.0) -> None:
        """Report that the work begins now; the time before does not count in the ETA.

        Args:
            done: amount done before, such as the steps of a resumed run.
        """
        self._paced, self._given = time.monotonic(), float(done)
        if self._progress is not None:
            self._progress.reset(self._task, total=self.total, completed=int(done))

    def eta(self) -> float | None:
        """Return the seconds until the end at the mean pace, or None before any work is done."""
        done_here = self.done - self._given
        if done_here <= 0:
            return None
        return (time.monotonic() - self._paced) / done_here * (self.total - self.done)

    def _text(self) -> str:
        return "  ".join(f"{label} {text}" for label, text in self.columns.items())

    def _line(self, last: bool) -> None:
        now = time.monotonic()
        self._next_line = now + LINE_EVERY
        eta = self.eta()
        end = f"{duration(now - self._start)} in all" if last else f"ETA {duration(eta)}"
        parts = [f"{self.title}: {100 * self.done / self.total:.0f} %", end, self._text()]
        say("  ".join(part for part in parts if part))


class StageBars:
    """A progress bar for each stage of a task, as a progress callback reports them.

    ``with StageBars() as bars: bars("snowfall", 0.3)``. A stage that first reports a fraction above
    0 was begun earlier; that fraction does not count in its pace.
    """

    def __init__(self, prefix: str = "") -> None:
        """Prepare the bars.

        Args:
            prefix: text before the name of each stage.
        """
        self.prefix = prefix
        self._bar: Bar | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        trace: TracebackType | None = None,
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)  # shows the terminal's cursor again
            self._bar = None

    def __call__(self, stage: str, fraction: float) -> None:
        """Report that a fraction of a stage is done."""
        title = self.prefix + stage
        if self._bar is None or self._bar.title != title:
            if self._bar is not None:  # the stages follow one another
                self._bar.update(1.0)
            self.__exit__()
            self._bar = Bar(title, 1.0)
            self._bar.__enter__()
            if fraction > 0:
                self._bar.prepared(fraction)
        self._bar.update(fraction)
        if fraction >= 1:
            self.__exit__()


def track(title: str, items: Iterable[Item], quiet: bool = False) -> Iterator[Item]:
    """Yield the items of a sized collection, with a progress bar that counts them."""
    total = len(items) if isinstance(items, Sized) else 0
    with Bar(title, total, quiet) as bar:
        for number, item in enumerate(items):
            bar.update(number)
            yield item
        bar.update(total)


def say(text: str) -> None:
    """Print a line on standard error, above the progress bar if one is shown."""
    with contextlib.suppress(OSError, ValueError):  # a closed standard error ends no work
        _console().print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    say(f"warning: {text}")


def report_findings(findings: "Iterable[Finding]") -> None:
    """Print each finding about a capture once, on standard error: warnings, then notes."""
    unique = dict.fromkeys(findings)
    for severity in ("error", "warning", "note"):
        for finding in unique:
            if finding.severity == severity:
                say(f"{severity}: {finding}")


def result(text: str) -> None:
    """Print a result on standard output."""
    streams.write_output(text + "\n")


def duration(seconds: float | None) -> str:
    """Format seconds as ``m:ss`` or ``h:mm:ss``; None as ``-:--``."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def rate(per_second: float) -> str:
    """Format a number with three digits and k, M or G, e.g. ``21.4 k``."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if per_second >= size:
            return f"{per_second / size:.3g}{letter}"
    return f"{per_second:.3g}"


def _show_cursor(console: "Console") -> None:
    """Show the cursor of a terminal, past the console's buffer.

    An interruption within rich's `Console.print` leaves that buffer open, and what is printed
    afterwards, such as the sign that shows the cursor, stays in it.
    """
    if not (console.legacy_windows or console.is_dumb_terminal):  # these take no such signs
        with contextlib.suppress(OSError, ValueError):
            console.file.write(SHOW_CURSOR)
            console.file.flush()


@functools.cache
def _console() -> "Console":
    from rich.console import Console

    return Console(stderr=True)


def _rich_progress(console: "Console") -> "Progress":
    from rich import progress
    from rich.table import Column

    narrow = console.width < 110

    def fixed(width: int) -> Column:
        # Without a fixed width, rich drops the ETA before the long columns in a narrow terminal.
        return Column(min_width=width, no_wrap=True)

    return progress.Progress(
        progress.TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        progress.BarColumn(bar_width=8 if narrow else 24),
        progress.TaskProgressColumn(table_column=fixed(4)),
        progress.TextColumn("ETA", table_column=fixed(3)),
        progress.TimeRemainingColumn(compact=True, table_column=fixed(5)),
        progress.TextColumn("{task.fields[columns]}", markup=False),
        console=console,
        refresh_per_second=4,
    )
