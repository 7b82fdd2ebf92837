"""What a tab saves into the folder `views` of a run: pictures, camera paths, weather, movies."""

import io
import re
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.storage import make_folder, write_bytes, write_json
from climatenerf.field.compositing import RenderCancelled
from climatenerf.paths.key_poses import through
from climatenerf.paths.nerfstudio import DrawnPath, write_drawn_path
from climatenerf.studies.shot import Place
from climatenerf.viewer.controls import FPS, render_command
from climatenerf.viewer.live import Shown, Wanted
from climatenerf.weather.description import (
    KeyframedWeather,
    weather_to_table,
    weather_to_toml,
)
from climatenerf.weather.effect import Effect
from climatenerf.weather.weather import Weather

VIEWS = "views"
"""Folder in the run that files are written into."""


class SavedFiles:
    """Files of one tab; those of other tabs and of earlier sessions stay.

    Attributes:
        key_poses: poses (world m) and vertical fields of view (deg) that the camera path goes
            through.
    """

    def __init__(self, run: Path, effects: Sequence[Effect], weather_file: Path | None):
        """Save nothing yet.

        Args:
            run: the run folder.
            effects: the effects in use.
            weather_file: that the tab began with.
        """
        self._run, self._effects = run, tuple(effects)
        self.key_poses: list[tuple[np.ndarray, float]] = []
        self._path_file: Path | None = None
        self._weather_file = weather_file
        self._saved: tuple[np.ndarray, Path] | None = None
        self._stop = threading.Event()
        self._closed = False
        self._rendering = threading.Lock()

    # --- pictures -------------------------------------------------------------------------------

    def save_picture(self, shown: Shown | None, place: Place) -> Path:
        """Write a picture with a sidecar and its pose, and return its path.

        Args:
            shown: the picture.
            place: field and scene that it shows.

        Raises:
            UserError: it is not full yet, or cannot be written.
        """
        if shown is None or shown.state != "full":
            raise UserError(
                "the picture is not finished yet; save it when it is said to be full, below"
            )
        path = self._numbered("view", ".png")
        picture = io.BytesIO()
        Image.fromarray(shown.picture).save(picture, "PNG", pnginfo=_simulated())
        write_bytes(path, picture.getvalue())
        wanted, weather = shown.wanted, shown.weather
        now = weather.at(wanted.time) if isinstance(weather, KeyframedWeather) else weather
        pose = path.with_name(f"{path.stem}-pose.json")
        frames = _frames(weather, wanted.time)
        self._write(pose, np.repeat(wanted.c2w[None], frames, axis=0), wanted.camera, place)
        self._saved = wanted.c2w, pose
        sidecar = {
            "simulated": True,
            "note": "weather is simulated",
            "weather": weather_to_table(now, self._effects),
            "time_s": wanted.time,
            "layer": wanted.layer or "picture",
            "c2w_world": wanted.c2w.tolist(),
            "vertical_fov_deg": vertical_fov(wanted.camera),
            "scale_error": place.scene.scale_error,
        }
        write_json(path.with_suffix(".json"), sidecar)
        return path

    def command(self, wanted: Wanted, film: KeyframedWeather | None) -> str:
        """Return the line that renders what is shown; the last frame of a film is its end.

        Args:
            wanted: what is shown.
            film: its weather over time, if that is what is shown; None: the weather of `wanted`.
        """
        size, path, seconds = (wanted.camera.width, wanted.camera.height), "still", 0.0
        if self._saved is not None and np.array_equal(self._saved[0], wanted.c2w):
            path = str(self._saved[1])
        elif self._path_file is not None and self.key_poses:
            path = str(self._path_file)
        if path == "still":
            seconds = (_frames(film or wanted.weather, wanted.time) - 1) / FPS
        weather: Weather | Path
        if film is not None and self._weather_file is not None:
            weather = self._weather_file
        else:
            weather = wanted.weather if isinstance(wanted.weather, Weather) else weather_at(wanted)
        return render_command(self._run, weather, self._effects, path, size, seconds)

    # --- weather and paths ----------------------------------------------------------------------

    def save_weather(self, film: KeyframedWeather) -> Path:
        """Write the weather file of the keyframes, one for the tab, and return its path.

        Raises:
            UserError: it cannot be written.
        """
        path = self._weather_file
        if path is None or path.parent != self._run / VIEWS:
            path = self._numbered("weather", ".toml")
        write_bytes(path, weather_to_toml(film, self._effects).encode())
        self._weather_file = path
        return path

    def add_key_pose(self, wanted: Wanted, place: Place, film: KeyframedWeather | None) -> Path:
        """Add a pose to the camera path, write it as nerfstudio's JSON, and return its path.

        Raises:
            UserError: it cannot be written.
        """
        self.key_poses.append((wanted.c2w, vertical_fov(wanted.camera)))
        return self.write_path(wanted.camera, place, film)

    def remove_key_pose(self, wanted: Wanted, place: Place, film: KeyframedWeather | None) -> Path:
        """Take the last pose out of the camera path.

        Raises:
            UserError: there is none, or the file cannot be written.
        """
        if not self.key_poses:
            raise UserError("the path has no key pose")
        self.key_poses.pop()
        return self.write_path(wanted.camera, place, film)

    def write_path(self, camera: Camera, place: Place, film: KeyframedWeather | None) -> Path:
        """Write the camera path, which waits at its end until the film's.

        Raises:
            UserError: it cannot be written.
        """
        path = self._path_file or self._numbered("path", ".json")
        self._path_file = path
        if self.key_poses:
            keys, angles = zip(*self.key_poses, strict=True)
            poses, fovs = through(keys, angles)
            missing = max(_frames(film, 0.0) - len(poses), 0)
            poses = np.concatenate([poses, np.repeat(poses[-1:], missing, axis=0)])
            fovs = np.concatenate([fovs, np.repeat(fovs[-1:], missing)])
            self._write(path, poses, camera, place, fovs)
        return path

    # --- movies ---------------------------------------------------------------------------------

    def render_path(
        self,
        wanted: Wanted,
        film: KeyframedWeather | None,
        place: Place,
        digest: str | None,
        report: Callable[[str, float], None],
    ) -> Path:
        """Render the camera path in the weather that is shown, and return the movie.

        With keyframes of the weather and without key poses it stands still.

        Args:
            wanted: what is shown.
            film: as in `command`.
            place: field and scene.
            digest: identity of the run; None takes that of its files.
            report: called with what is done and the fraction of it.

        Raises:
            UserError: there is no path, or it was stopped.
        """
        from climatenerf.api import Run, render_movie

        if not self.key_poses and film is None:
            raise UserError("add key poses to the path first")

        def reported(what: str, fraction: float) -> None:
            if self._stop.is_set() or self._closed:
                raise RenderCancelled
            report(what, fraction)

        self._stop.clear()
        with self._rendering:
            if self.key_poses:
                path = self.write_path(wanted.camera, place, film)
            else:
                path = self._numbered("path", ".json")
                poses = np.repeat(wanted.c2w[None], _frames(film, 0.0), axis=0)
                self._write(path, poses, wanted.camera, place)
            fitted = Run(self._run, place.field, place.scene, digest, style=place.style)  # pyright: ignore[reportArgumentType]
            try:
                return render_movie(
                    fitted,
                    self._numbered("movie", ""),
                    film or wanted.weather,
                    path=str(path),
                    complete_ground=False,
                    progress=reported,
                )
            except RenderCancelled:
                raise UserError("the movie was stopped") from None

    def stop(self) -> None:
        """Stop the movie that is being rendered, after the frame at work."""
        self._stop.set()

    def close(self) -> None:
        """Stop the movie, and return when it has ended."""
        self._closed = True
        with self._rendering:
            pass

    # --- files ----------------------------------------------------------------------------------

    def _numbered(self, kind: str, ending: str) -> Path:
        """Return a new path of a kind, with the number after the greatest."""
        folder = make_folder(self._run / VIEWS)
        found = (re.match(rf"{kind}-(\d+)", each.name) for each in folder.iterdir())
        number = max((int(each[1]) for each in found if each is not None), default=0) + 1
        return folder / f"{kind}-{number:04d}{ending}"

    def _write(
        self,
        path: Path,
        poses: np.ndarray,
        camera: Camera,
        place: Place,
        fovs: np.ndarray | None = None,
    ) -> None:
        fovs = np.full(len(poses), vertical_fov(camera)) if fovs is None else fovs
        drawn = DrawnPath(poses, fovs, (camera.width, camera.height), FPS, "")
        write_drawn_path(path, place.scene, drawn)


def weather_at(wanted: Wanted) -> Weather:
    """The weather of the moment that is shown."""
    weather = wanted.weather
    return weather.at(wanted.time) if isinstance(weather, KeyframedWeather) else weather


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view, degrees."""
    return float(np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy)))


def _frames(weather: KeyframedWeather | Weather | None, moment: float) -> int:
    """Number of frames of a film, or until a moment (s) of other weather."""
    end = weather.duration if isinstance(weather, KeyframedWeather) else moment
    return round(max(end, moment) * FPS) + 1


def _simulated() -> PngImagePlugin.PngInfo:
    """Text chunk that marks a picture as simulated."""
    info = PngImagePlugin.PngInfo()
    info.add_text("simulated", "weather simulated by climatenerf")
    return info
