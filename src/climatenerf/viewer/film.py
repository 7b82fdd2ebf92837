"""The time of a viewer: a slider, play, and keyframes of the weather."""

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.weather.description import KeyframedWeather, from_moments
from climatenerf.weather.effect import Effect
from climatenerf.weather.weather import Weather

LENGTH = 10.0  # s, of the slider; keyframes beyond lengthen it
STEP = 0.1  # s, of the slider
PLAYED = 0.1  # s between the moments that are asked for while it plays


class TimeControls:
    """Moment, play and keyframes of one tab.

    Attributes:
        moments: weather at the keyframes, by time in s.
        edited: whether a control was moved since the film was shown, so that it is not.
    """

    def __init__(
        self,
        gui: Any,
        effects: Sequence[Effect],
        film: KeyframedWeather,
        current: Callable[[], Weather],
        put: Callable[[Weather | None], None],
        changed: Callable[[], None],
        tell: Callable[[str], None],
    ):
        """Add the controls.

        Args:
            gui: of the viewer, by viser.
            effects: the effects in use.
            film: to begin with.
            current: returns the weather that the controls show.
            put: lets the controls show the weather of another moment; None: the same as before.
            changed: called after each change of the keyframes.
            tell: takes what is wrong with an input; "" clears it.
        """
        self._effects, self._current, self._put = tuple(effects), current, put
        self._changed, self._tell = changed, tell
        times = sorted({t for frames in film.keyframes.values() for t, _ in frames})
        self.moments = {t: film.at(t) for t in times}
        self._film = film if times else None
        self.edited = False
        self._ended = threading.Event()
        self._player: threading.Thread | None = None
        with gui.add_folder("time", expand_by_default=bool(times)):
            length = max(LENGTH, film.duration)
            self._slider = gui.add_slider("time, s", 0.0, length, STEP, 0.0)
            self._play = gui.add_checkbox("play", False)
            keep = gui.add_button("set a keyframe")
            drop = gui.add_button("remove the nearest keyframe")
            self._list = gui.add_markdown(" ")
        self._slider.on_update(lambda _: self._moved())
        self._play.on_update(lambda _: self._toggled())
        keep.on_click(lambda _: self.keep())
        drop.on_click(lambda _: self.drop())
        self._describe()

    @property
    def now(self) -> float:
        """The moment, s."""
        return float(self._slider.value)

    @property
    def film(self) -> KeyframedWeather | None:
        """The weather over time; None without keyframes."""
        return self._film

    def weather(self) -> KeyframedWeather | Weather:
        """What is to be rendered now: the film, unless a control has been moved since."""
        film = self._film
        return self._current() if film is None or self.edited else film

    def keep(self) -> None:
        """Set a keyframe: the weather that the controls show, at this moment."""
        self._use(self.moments | {round(self.now, 6): self._current()})

    def drop(self) -> None:
        """Remove the keyframe nearest to this moment."""
        if not self.moments:
            self._tell("there is no keyframe")
            return
        nearest = min(self.moments, key=lambda t: abs(t - self.now))
        self._use({t: weather for t, weather in self.moments.items() if t != nearest})

    def close(self) -> None:
        """Stop playing; returns when the thread has ended."""
        self._ended.set()
        player = self._player
        if player is not None and player is not threading.current_thread():
            player.join()

    def _use(self, moments: dict[float, Weather]) -> None:
        """Take other keyframes, or tell why they do not fit each other."""
        try:
            film = from_moments(moments, self._effects) if moments else None
        except UserError as error:
            self._tell(str(error))
            return
        self.moments, self._film, self.edited = moments, film, False
        self._tell("")
        self._describe()
        self._changed()

    def _describe(self) -> None:
        times = ", ".join(f"{t:g}" for t in sorted(self.moments))
        sentence = f"keyframes at {times} s" if times else "no keyframes"
        frozen = [] if self._film is None else self._film.frozen(self._effects)
        if frozen:
            names = ", ".join(frozen).replace("_", "-")
            sentence += f"; {names}: one value for the whole movie, the first"
        self._list.content = sentence

    def _moved(self) -> None:
        film = self._film
        if film is not None and self.edited:
            self._tell("what was changed without a keyframe is gone")
        self.edited = False
        self._put(None if film is None else film.at(self.now))

    def _toggled(self) -> None:
        if self._play.value and (self._player is None or not self._player.is_alive()):
            self._player = threading.Thread(target=self._run, name="viewer-play", daemon=True)
            self._player.start()

    def _run(self) -> None:
        """Move the slider through the time, from here on and again from the beginning."""
        last = time.monotonic()
        with contextlib.suppress(Exception):  # the tab may be gone
            while self._play.value and not self._ended.wait(PLAYED):
                length = LENGTH if self._film is None else max(self._film.duration, STEP)
                now = time.monotonic()
                moment, last = self.now + now - last, now  # of the slider, which a user may move
                self._slider.value = round(moment % length if moment > length else moment, 2)
