"""What the user sees while the program works: bars with ETA in a terminal, plain lines elsewhere.

The only module that prints. Everything that belongs to progress goes to standard error; results
(where the files are, the PSNR) go to standard output, so that they can be piped.
"""

import functools
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sized
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

LINE_EVERY = 10.0
"""Seconds between two lines where there is no terminal."""

Item = TypeVar("Item")


class Bar:
    """One piece of work with a known end, in steps or in seconds.

    ``with Bar("fit", total=300.0) as bar: bar.update(elapsed, {"step": "120", "PSNR": "21.3"})``.
    In a terminal this is a bar with percentage, ETA and the given columns; elsewhere
    a line about every ten seconds, and one at the end.
    """

    def __init__(self, title: str, total: float, quiet: bool = False) -> None:
        """Prepares the bar.

        Args:
            title: what is being done, a word or two.
            total: amount of work, any unit (steps, frames, seconds), > 0.
            quiet: show nothing.
        """
        self.title = title
        self.total = max(float(total), 1e-9)  # a bar of nothing is complete, not 0/0
        self.done = 0.0
        self.columns: dict[str, str] = {}
        self._quiet = quiet
        self._start = self._paced = time.monotonic()
        self._given = 0.0
        self._next_line = self._start + LINE_EVERY
        self._progress: Progress | None = None

    def __enter__(self) -> Self:
        """Shows the bar."""
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
        """Leaves the bar as it is and frees the line."""
        if self._progress is not None:
            self._progress.stop()
        elif not self._quiet:
            self._line(last=True)

    def update(self, done: float, columns: Mapping[str, str] | None = None) -> None:
        """Tells how far the work is.

        Args:
            done: amount done so far, [0, total].
            columns: label → text beside the bar, e.g. ``{"rays/s": "21 k"}``; kept until changed.
        """
        self.done = min(float(done), self.total)
        self.columns |= columns or {}
        if self._progress is not None:
            self._progress.update(self._task, completed=self.done, columns=self._text())
        elif not self._quiet and time.monotonic() >= self._next_line:
            self._line(last=False)

    def advance(self, by: float = 1.0, columns: Mapping[str, str] | None = None) -> None:
        """Tells that another piece is done."""
        self.update(self.done + by, columns)

    def prepared(self, done: float = 0.0) -> None:
        """Tells that the work begins now, with so much done: time before says nothing of its pace.

        Args:
            done: amount done before, as of a run that is continued.
        """
        self._paced, self._given = time.monotonic(), float(done)
        if self._progress is not None:
            self._progress.reset(self._task, total=self.total, completed=int(done))

    def eta(self) -> float | None:
        """Seconds until the end at the pace so far, or None before anything is done."""
        own = self.done - self._given
        if own <= 0:
            return None
        return (time.monotonic() - self._paced) / own * (self.total - self.done)

    def _text(self) -> str:
        return "  ".join(f"{label} {text}" for label, text in self.columns.items())

    def _line(self, last: bool) -> None:
        now = time.monotonic()
        self._next_line = now + LINE_EVERY
        left = self.eta()
        end = f"{duration(now - self._start)} in all" if last else f"ETA {duration(left)}"
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

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)  # shows the terminal's cursor again
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
    """Yields the items of a sized collection under a bar that counts them."""
    total = len(items) if isinstance(items, Sized) else 0
    with Bar(title, total, quiet) as bar:
        for number, item in enumerate(items):
            bar.update(number)
            yield item
        bar.update(total)


def say(text: str) -> None:
    """A line about what is going on, on standard error; above the bar if one is shown."""
    _console().print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """A warning, on standard error."""
    say(f"warning: {text}")


def result(text: str) -> None:
    """A line that is the program's result, on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def duration(seconds: float | None) -> str:
    """``m:ss`` or ``h:mm:ss``; ``-:--`` where unknown."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def rate(per_second: float) -> str:
    """A number with three digits and k, M or G, e.g. ``21.4 k``."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if per_second >= size:
            return f"{per_second / size:.3g}{letter}"
    return f"{per_second:.3g}"


@functools.cache
def _console() -> "Console":
    from rich.console import Console

    return Console(stderr=True)


def _rich_progress(console: "Console") -> "Progress":
    from rich import progress
    from rich.table import Column

    narrow = console.width < 110

    def fixed(width: int) -> Column:
        # Without a fixed width a narrow terminal squeezes the ETA out before the long columns.
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
