"""Pictures for one viewer: the last picture warped while it moves, then coarse, half and full.

Three threads: one puts new weather in, one renders what was asked for last, and one warps the last
finished picture to the newest pose meanwhile. While weather is prepared, the one before is shown.
What is asked for lies in a mailbox of one place: newer requests replace older ones, and cancel
their finer passes and preparations. No GUI is known here.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.field.compositing import RenderCancelled
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.render.session import Frame, RenderSession
from climatenerf.viewer.controls import FPS
from climatenerf.viewer.overlays import picture_of
from climatenerf.viewer.warp import warped
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

STILL = 0.2  # s without a new pose after which finer passes begin
FRAME = 1 / 30  # s between warped pictures
MOVING_WIDTH = 480  # pixels of warped pictures
COARSE = 4  # pixels along a side that share a ray while moving
FIRST = 8  # of the first picture after a change of the weather
MOMENTS = 1200  # most moments of a film, for which its weather is prepared
PATIENCE = 0.08  # s of computing between two questions whether to stop
State = Literal["warped", "coarse", "half", "full"]


@dataclass(frozen=True)
class Wanted:
    """What a viewer asks for.

    Attributes:
        camera: of the full picture, without distortion.
        c2w: pose, world m.
        weather: what is put in.
        layer: name of a layer shown instead of the picture; "" shows the picture.
        time: moment, s.
        split: fraction of the width, from the left, that shows the place without weather.
        asked: when it was asked for, s of `time.monotonic`.
    """

    camera: Camera
    c2w: Float[np.ndarray, "4 4"]
    weather: KeyframedWeather | Weather
    layer: str = ""
    time: float = 0.0
    split: float = 0.0
    asked: float = 0.0

    def same_place(self, other: "Wanted") -> bool:
        """Whether pose and size are equal."""
        return self.camera == other.camera and np.array_equal(self.c2w, other.c2w)


@dataclass(frozen=True)
class Shown:
    """A picture for a viewer.

    Attributes:
        picture: 8-bit sRGB.
        wanted: what it shows.
        state: how fine it is.
        weather: what is in it: that of `wanted` unless it was refused.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    wanted: Wanted
    state: State
    weather: KeyframedWeather | Weather


@dataclass(frozen=True)
class _Finished:
    """A picture with depth, from which others are warped."""

    picture: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    camera: Camera
    c2w: Float[np.ndarray, "4 4"]
    content: tuple[object, ...]
    """See `_content`."""


@dataclass(frozen=True, eq=False)
class _Ready:
    """Prepared weather.

    Attributes:
        session: with the weather.
        asked: the weather that was asked for; another than the session's if it was refused.
    """

    session: RenderSession
    asked: KeyframedWeather | Weather


@dataclass(frozen=True)
class _Patient:
    """Asks whether to stop, less often than a render does by itself; see `Checkpoints`."""

    asked: Callable[[], bool]
    every: float = PATIENCE

    def __call__(self) -> bool:
        return self.asked()


def _moments(weather: KeyframedWeather | Weather) -> Float[np.ndarray, "f"]:
    """Moments of the frames of a movie, for which keyframed weather is prepared, s."""
    duration = weather.duration if isinstance(weather, KeyframedWeather) else 0.0
    rate = FPS if duration * FPS <= MOMENTS else MOMENTS / duration
    return np.arange(math.floor(duration * rate + 1e-6) + 1) / rate


def _sentence(error: Exception) -> str:
    """Text that tells a user what is wrong."""
    known = isinstance(error, UserError)
    return f"{'' if known else f'internal error: {type(error).__name__}: '}{error}"


def _content(wanted: Wanted) -> tuple[object, ...]:
    """Weather, layer, moment and split of a picture."""
    return wanted.weather, wanted.layer, wanted.time, wanted.split


class LiveView:
    """Renders for one viewer until it is closed.

    Attributes:
        session: with the weather that is shown.
    """

    def __init__(
        self,
        session: RenderSession,
        show: Callable[[Shown], None],
        tell: Callable[[str], None],
    ):
        """Start the threads.

        Args:
            session: field and scene; it stays as it is.
            show: takes pictures; called from two threads.
            tell: takes a sentence about what is prepared or wrong; "" clears it.
        """
        self._show, self._tell = show, tell
        self._next: RenderSession | None = session
        self._ready: _Ready | None = None
        self.session = session
        self._preparing: KeyframedWeather | Weather | None = None
        self._wanted: Wanted | None = None
        self._moved = 0.0
        self._finished: _Finished | None = None
        self._sent: Wanted | None = None
        self._open = True
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for name, work in (
                ("viewer-prepare", self._prepare_all),
                ("viewer-render", self._render_all),
                ("viewer-warp", self._warp_all),
            )
        ]
        for thread in self._threads:
            thread.start()

    def ask(self, wanted: Wanted) -> None:
        """Ask for a picture; what was asked for before is forgotten."""
        with self._changed:
            last = self._wanted
            if last is not None and not last.same_place(wanted):
                self._moved = time.monotonic()
            self._wanted = wanted
            self._changed.notify_all()

    def use(self, session: RenderSession) -> None:
        """Render with another session from the next picture on, such as that of a newer fit."""
        with self._changed:
            self._next = session
            self._changed.notify_all()

    @property
    def wanted(self) -> Wanted | None:
        """What was asked for last."""
        return self._wanted

    def close(self) -> None:
        """End the threads; returns when they have ended."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    # --- preparing ----------------------------------------------------------------------------

    def _prepare_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._open or self._outdated())
                if not self._open:
                    return
                wanted, following = self._wanted, self._next
            assert wanted is not None
            session = following or self.session
            self._preparing = wanted.weather
            problem = ""
            try:
                made = session.changed(wanted.weather, _moments(wanted.weather), self._report)
                made.world(wanted.time)  # prepares what is put off until it is seen
            except RenderCancelled:
                continue
            except Exception as error:  # what was shown before stays
                problem, made = _sentence(error), self.session
            with self._changed:
                if following is not None and self._next is following:
                    self._next = None
                if made is not self.session and following is not None:
                    self._finished = None
                self.session, self._ready = made, _Ready(made, wanted.weather)
                self._changed.notify_all()
            with contextlib.suppress(Exception):  # the tab may be gone
                self._tell(problem)

    def _outdated(self) -> bool:
        """Whether other weather, or another session, is wanted than is ready."""
        wanted, ready = self._wanted, self._ready
        if wanted is None:
            return False
        return self._next is not None or ready is None or ready.asked != wanted.weather

    def _report(self, what: str, fraction: float) -> None:
        """Tell what is prepared.

        Raises:
            RenderCancelled: other weather is wanted by now.
        """
        wanted, preparing = self._wanted, self._preparing
        if not self._open or wanted is None or wanted.weather != preparing:
            raise RenderCancelled
        self._tell(f"preparing {what}: {100 * fraction:.0f} %")

    # --- rendering ----------------------------------------------------------------------------

    def _render_all(self) -> None:
        done: tuple[Wanted, _Ready] | None = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda done=done: not self._open or self._due(done))
                if not self._open:
                    return
                wanted, ready = self._wanted, self._ready
            assert wanted is not None and ready is not None
            try:
                finest = self._render(wanted, ready)
            except RenderCancelled:
                continue
            except Exception as error:  # the viewer goes on with the next request
                with contextlib.suppress(Exception):  # the tab may be gone
                    self._tell(_sentence(error))
                finest = True
            if finest:
                done = wanted, ready

    def _due(self, done: tuple[Wanted, _Ready] | None) -> bool:
        """Whether something can be rendered that has not been."""
        wanted, ready, last = self._wanted, self._ready, self._finished
        if wanted is None or ready is None:
            return False
        if done is not None and done[0] is wanted and done[1] is ready:
            return False
        if ready.asked == wanted.weather or last is None:
            return True
        # Waits for its weather, if that of before is shown in the same way.
        same = _content(wanted)[1:] == last.content[1:]
        return not (same and np.array_equal(last.c2w, wanted.c2w))

    def _render(self, wanted: Wanted, ready: _Ready) -> bool:
        """Render a coarse picture while moving or preparing, else all passes.

        Returns:
            Whether nothing finer is due.
        """
        session, prepared = ready.session, ready.asked == wanted.weather
        shown = wanted if prepared else replace(wanted, weather=ready.asked)
        moving = time.monotonic() - self._moved < STILL
        if moving or not prepared or not self._same_content(shown):
            side = COARSE if moving or not prepared else FIRST
            self._render_coarse(session, shown, side)
            if moving or not prepared:
                return not moving
        passes: list[State] = ["coarse", "half", "full"]

        def preview(picture: UInt8[np.ndarray, "h w 3"]) -> None:
            state = passes.pop(0)
            if state != "full" and not wanted.layer and not wanted.split:
                self._send(Shown(picture, wanted, state, session.weather), wanted)

        cancelled = _Patient(
            lambda: not self._open or self._wanted is not wanted or self._ready is not ready
        )
        frame = session.frame(
            wanted.camera,
            wanted.c2w,
            wanted.time,
            layers=(wanted.layer,),
            preview=preview,
            cancelled=cancelled,
        )
        picture = self._with_before(session, frame, wanted.camera, wanted, cancelled)
        self._keep(picture, frame.layers["depth"], wanted.camera, wanted)
        self._send(Shown(picture, wanted, "full", session.weather), wanted)
        return True

    def _render_coarse(self, session: RenderSession, wanted: Wanted, side: int) -> None:
        """Render a small picture, and keep it for warping; newer requests do not cancel it."""
        camera = wanted.camera
        across = side * max(camera.width / MOVING_WIDTH, 1)
        coarse = camera.resized(
            max(round(camera.width / across), 8), max(round(camera.height / across), 8)
        )
        # While moving, an older picture to warp is better than none.
        open_ = _Patient(lambda: not self._open)
        frame = session.frame(
            coarse, wanted.c2w, wanted.time, layers=(wanted.layer,), cancelled=open_
        )
        if wanted.layer and wanted.layer not in frame.layers:
            self._tell(f"this place has no layer {wanted.layer}")
        picture = self._with_before(session, frame, coarse, wanted, open_)
        self._keep(picture, frame.layers["depth"], coarse, wanted)
        self._send(Shown(picture, wanted, "coarse", session.weather), wanted)

    def _with_before(
        self,
        session: RenderSession,
        frame: Frame,
        camera: Camera,
        wanted: Wanted,
        cancelled: Callable[[], bool],
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of a frame, with the place without weather in its left part."""
        picture = picture_of(wanted.layer, frame)
        columns = round(wanted.split * camera.width)
        if not columns:
            return picture
        dry = World(session.field)
        options = FrameOptions(cancelled=cancelled)
        before, _ = render_frame(dry, camera, wanted.c2w, options)
        return np.concatenate([before[:, :columns], picture[:, columns:]], axis=1)

    def _same_content(self, wanted: Wanted) -> bool:
        """Whether the last finished picture shows the same weather and layer."""
        last = self._finished
        return last is not None and last.content == _content(wanted)

    def _keep(self, picture: np.ndarray, depth: np.ndarray, camera: Camera, at: Wanted) -> None:
        self._finished = _Finished(picture, depth, camera, at.c2w, _content(at))

    def _send(self, shown: Shown, wanted: Wanted) -> None:
        """Show a picture unless its pose is no longer the newest."""
        with self._sending:
            newest = self._wanted
            if self._open and newest is not None and newest.same_place(wanted):
                self._sent = wanted
                self._show(shown)

    # --- warping ------------------------------------------------------------------------------

    def _warp_all(self) -> None:
        while self._open:
            try:
                self._warp_until_closed()
            except Exception as error:  # the viewer goes on with the next pose
                with contextlib.suppress(Exception):
                    self._tell(f"internal error: {type(error).__name__}: {error}")

    def _warp_until_closed(self) -> None:
        last: Wanted | None = None
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda last=last: (
                        not self._open or (self._finished and self._wanted is not last)
                    )
                )
                if not self._open:
                    return
                wanted, finished = self._wanted, self._finished
            assert wanted is not None and finished is not None
            begun = time.monotonic()
            if time.monotonic() - self._moved < STILL:
                width = min(MOVING_WIDTH, wanted.camera.width)
                height = max(round(wanted.camera.height * width / wanted.camera.width), 1)
                to = wanted.camera.resized(width, height)
                given = finished.picture, finished.depth, finished.camera, finished.c2w
                picture = warped(*given, to, wanted.c2w)
                with self._sending:
                    sent = self._sent  # a rendered picture of this pose is better
                    there = sent is not None and sent.same_place(wanted)
                    if self._open and self._wanted is wanted and not there:
                        self._sent = wanted
                        self._show(Shown(picture, wanted, "warped", self.session.weather))
            last = wanted
            time.sleep(max(FRAME - (time.monotonic() - begun), 0.0))
