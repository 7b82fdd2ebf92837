"""Finished frames of a method: `frames/NNNN.png` and `frames.json` with the seconds of each.

A frame is finished if its picture carries the frame's hash, so that a stopped comparison resumes.
"""

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import climatenerf
from climatenerf.core import parsing
from climatenerf.core.errors import UserError
from climatenerf.core.storage import make_folder, plain, read_json, write_json
from climatenerf.output.frame_source import FrameSource, Preview, RenderedFrame
from climatenerf.output.render_folder import png_text
from climatenerf.output.video import MovieWriter, write_png
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare.material import Material, Method
from climatenerf.studies.compare.pictures import Picture

RECORD, MOVIE = "frames.json", "movie.mp4"


@dataclass(frozen=True)
class FrameStore:
    """The folder of a method's frames.

    Attributes:
        folder: such as `OUT/flood/flat-plane`.
        key: hash of run, weather, cameras, method and version.
        count: number of frames.
    """

    folder: Path
    key: str
    count: int

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self.folder / "frames" / f"{index:04d}.png"

    def picture(self, index: int) -> Picture:
        """Read a finished frame."""
        return read_rgb(self.path(index))

    def missing(self) -> list[int]:
        """Return the frames that are not finished."""
        return [i for i in range(self.count) if png_text(self.path(i), "key") != self._key(i)]

    def save(self, index: int, picture: Picture, seconds: float) -> None:
        """Write a frame, and the seconds that it took.

        Raises:
            UserError: a disk error.
        """
        write_png(self.path(index), picture, f"weather edited into {self.path(index).name}",
                  self._key(index))  # fmt: skip
        self.keep_seconds(index, seconds)

    def keep_seconds(self, index: int, seconds: float) -> None:
        """Record the seconds that a frame took, and that the movie is out of date."""
        times = self._seconds()
        times[index] = seconds
        self._write_record({"seconds": times})

    def timed(self, source: FrameSource) -> FrameSource:
        """Return a source of rendered frames that records the seconds of each."""

        def render(index: int, preview: Preview | None) -> RenderedFrame:
            start = time.monotonic()
            frame = source(index, preview)
            self.keep_seconds(index, time.monotonic() - start)
            return frame

        return render

    def mean_seconds(self) -> float:
        """Return the mean time of the frames, s; NaN if none is known."""
        known = [each for each in self._seconds() if each is not None]
        return float(np.mean(known)) if known else float("nan")

    def remove_surplus(self) -> None:
        """Remove frames of a longer earlier movie."""
        for path in (self.folder / "frames").glob("*.png"):
            if path.stem.isdecimal() and int(path.stem) >= self.count:
                path.unlink(missing_ok=True)

    def write_movie(self, size: tuple[int, int], fps: float) -> None:
        """Write the movie, unless it was written from these frames.

        Raises:
            UserError: ffmpeg fails, or a disk error.
        """
        path, record = self.folder / MOVIE, self._record()
        if path.is_file() and record.get("movie") == [fps, path.stat().st_size]:
            return
        with MovieWriter(path, size, fps) as movie:
            for index in range(self.count):
                movie.add(self.picture(index))
        self._write_record({**record, "movie": [fps, path.stat().st_size]})

    def _key(self, index: int) -> str:
        return hash_of([self.key, index])

    def _seconds(self) -> list[float | None]:
        with contextlib.suppress(UserError):
            times = parsing.items(self._record(), "seconds", RECORD)
            if len(times) == self.count:
                return [None if each is None else _time(each) for each in times]
        return [None] * self.count

    def _record(self) -> dict[str, Any]:
        """Return the record of these frames; empty if it is absent, damaged or of others."""
        with contextlib.suppress(UserError):
            record = read_json(self.folder / RECORD)
            return record if record.get("key") == self.key else {}
        return {}

    def _write_record(self, record: dict[str, Any]) -> None:
        write_json(self.folder / RECORD, {**record, "schema_version": 1, "key": self.key})


def store_of(method: Method, material: Material, folder: Path) -> FrameStore:
    """Return the store of a method's frames of some material."""
    described = {
        "version": climatenerf.__version__,
        "method": method.name,
        "identity": method.identity(material),
        "clean": material.clean.job.key,
        "ours": material.ours.job.key,
        "seed": material.seed,
        "true": [hashlib.sha256(each.tobytes()).hexdigest() for each in material.true],
    }
    return FrameStore(folder, hash_of(described), len(material))


def make_frames(
    method: Method, material: Material, store: FrameStore, progress: Callable[[float], None]
) -> None:
    """Let a method edit the frames that are missing.

    Args:
        method: the method.
        material: what it edits.
        store: where the frames go.
        progress: called with the fraction that is finished.

    Raises:
        UserError: the method fails; finished frames stay.
    """
    missing = store.missing()
    progress(1 - len(missing) / store.count)
    if missing:
        make_folder(store.folder / "frames")
        edited = _timed(method.pictures(material, missing, store.folder), len(missing))
        for done, (index, (picture, seconds)) in enumerate(zip(missing, edited, strict=True)):
            store.save(index, picture, seconds)
            progress(1 - (len(missing) - done - 1) / store.count)
    store.remove_surplus()


def _timed(pictures: Iterator[Picture], count: int) -> Iterator[tuple[Picture, float]]:
    """Yield pictures with the seconds that each took.

    A program in a process of its own makes all pictures before the first one, so the time of the
    first one is shared out among all.
    """
    start = time.monotonic()
    first = next(pictures, None)
    if first is None:
        return
    shared = (time.monotonic() - start) / count
    yield first, shared
    start = time.monotonic()
    for picture in pictures:
        yield picture, shared + time.monotonic() - start
        start = time.monotonic()


def hash_of(value: Any) -> str:
    """Return the hash of plain values."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def _time(value: Any) -> float:
    return parsing.checked_number(value, "a time", 0.0)
