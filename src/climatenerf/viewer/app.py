"""The viewer: one session, one set of controls and one live view for each browser tab."""

import contextlib
import html
import io
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, PngImagePlugin

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.rotations import quaternions, rotation_matrices
from climatenerf.core.storage import make_folder, read_json, write_bytes, write_json
from climatenerf.paths.camera_path import still
from climatenerf.paths.key_poses import through
from climatenerf.paths.nerfstudio import DrawnPath, write_drawn_path
from climatenerf.render.session import RenderSession
from climatenerf.studies.shot import Place
from climatenerf.training.run import METRICS
from climatenerf.viewer import guarded_server
from climatenerf.viewer.controls import FPS, WeatherControls, render_command
from climatenerf.viewer.film import TimeControls
from climatenerf.viewer.live import LiveView, Shown, Wanted
from climatenerf.viewer.measure import measure
from climatenerf.viewer.overlays import LAYERS, legend
from climatenerf.weather.description import (
    KeyframedWeather,
    read_weather,
    weather_to_table,
    weather_to_toml,
)
from climatenerf.weather.registry import installed_effects
from climatenerf.weather.weather import Weather

if TYPE_CHECKING:
    import viser

MAX_SIDE = 960  # pixels of a full picture
JPEG_QUALITY = {"warped": 70, "coarse": 75, "half": 80, "full": 90}
HANDLE_DISTANCE = 5.0  # m, of the arrow for the water level from the first camera
WEATHER_FILE = "weather.toml"
VIEWS = "views"
"""Folder in the run that pictures and paths are written into."""


class ViewerApp:
    """Serves a fitted place to browser tabs of this machine."""

    def __init__(
        self,
        run: Path,
        place: Place,
        port: int,
        allowed_hosts: tuple[str, ...] = (),
        digest: str | None = None,
        weather: Path | None = None,
    ):
        """Start the server.

        Args:
            run: the run folder; files are written into its folder `views` alone.
            place: field and scene.
            port: to listen on; 0 takes a free one.
            allowed_hosts: see `guarded_server.start`.
            digest: identity of the run, for movies; None takes that of its files.
            weather: weather file that each tab begins with; None: no weather.

        Raises:
            UserError: the package is missing, or the port is taken.
        """
        self.run, self.place = run, place
        effects = installed_effects()
        clear = KeyframedWeather(Weather(effects=effects), {})
        self.weather = clear if weather is None else read_weather(weather, effects)
        self.weather_file = weather
        self.depth_error = _depth_error(run)
        self.tabs: dict[int, Tab] = {}
        self.digest = digest
        self.rendering = threading.Lock()
        self._lock = threading.Lock()
        self.server = guarded_server.start(port, allowed_hosts)
        self.port = self.server.get_port()
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    def _connected(self, client: "viser.ClientHandle") -> None:
        tab = Tab(self, client)
        with self._lock:
            here = client.client_id in self.server.get_clients()
            if here:
                self.tabs[client.client_id] = tab
        if not here:  # it has left while the tab was built
            tab.close()

    def _left(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            tab = self.tabs.pop(client.client_id, None)
        if tab is not None:
            tab.close()

    def use(self, place: Place, digest: str | None) -> None:
        """Show a newer fit of the run in all tabs, with the weather that each has."""
        with self._lock:
            self.place, self.digest = place, digest
            tabs = list(self.tabs.values())
        for tab in tabs:
            tab.follow()

    def close(self) -> None:
        """End all tabs' threads and the server."""
        with self._lock:
            tabs, self.tabs = list(self.tabs.values()), {}
        for tab in tabs:
            tab.close()
        with contextlib.redirect_stdout(io.StringIO()):  # viser says that it ends
            self.server.stop()


class Tab:
    """One browser tab."""

    def __init__(self, app: ViewerApp, client: "viser.ClientHandle"):
        """Build the controls, and show the place from its most central photo."""
        self.app, self.client = app, client
        eye = still(app.place.scene, None, 1, None)
        self.shown: Shown | None = None
        self.keyframes: list[tuple[np.ndarray, float]] = []
        self._asking = threading.Lock()
        self._weather_file = app.weather_file
        self._saved_pose: tuple[np.ndarray, Path] | None = None
        client.camera.position = tuple(eye.c2w[0, :3, 3])
        client.camera.wxyz = tuple(quaternions(eye.c2w[0, :3, :3]))
        client.camera.fov = float(2 * np.arctan(0.5 * eye.cameras[0].height / eye.cameras[0].fy))
        self.live = LiveView(self._new_session(), self._show, self._tell)
        self._ends = [self.live.close]
        try:
            self._build(client.gui)
            self._add_level_handle(eye.c2w[0])
            client.camera.on_update(lambda _: self._ask())
            client.scene.on_click()(self._clicked)
            self._ask()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the threads; returns when they have ended."""
        for end in self._ends:
            end()

    def _new_session(self) -> RenderSession:
        place = self.app.place
        return RenderSession(
            place.field,
            place.scene,
            Weather(),
            kept=place.kept,
            style=place.style,
        )

    def follow(self) -> None:
        """Show the newer place of the app."""
        self.live.use(self._new_session())

    # --- controls -------------------------------------------------------------------------------

    def _build(self, gui: Any) -> None:
        scene = self.app.place.scene
        name = html.escape(scene.root.resolve().name)
        gui.add_markdown(f"**{name}**: simulated weather, no forecast")
        self._message = gui.add_markdown(" ")
        self._measured = gui.add_markdown("Click the picture to measure.")
        low = scene.lowest_ground_z - scene.ground_z - 0.5
        eyes = [scene.c2w_world(view)[2, 3] for view in scene.of_split("train")]
        high = max(min(eyes) - scene.ground_z, low + 1)
        levels = float(np.floor(10 * low) / 10), float(np.floor(10 * high) / 10)
        effects, begun = self.live.session.effects, self.app.weather
        self.controls = WeatherControls(
            gui, effects, begun.at(0.0), levels, lambda _: self._ask(), self._tell
        )
        self.film = TimeControls(
            gui,
            effects,
            begun,
            lambda: self.controls.weather,
            self._put,
            lambda: self._saved(self.save_keyframes),
            self._tell,
        )
        self._ends.insert(0, self.film.close)
        with gui.add_folder("show", expand_by_default=True):
            names = ["picture", *(name for name in LAYERS if name)]
            layer = gui.add_dropdown("layer", names, initial_value="picture")
            self._legend = gui.add_markdown(" ")
            self._gui_handle = gui.add_checkbox("water level arrow", False)
            self._before = gui.add_checkbox("before | after", False)
            self._split = gui.add_slider("split, %", 1, 99, 1, 50)
        self._layer = ""
        self._before.on_update(lambda _: self._ask())
        self._split.on_update(lambda _: self._ask() if self._before.value else None)

        @layer.on_update
        def _(_: Any) -> None:
            self._layer = "" if layer.value == "picture" else layer.value
            self._legend.content = legend(self._layer) if self._layer else " "
            self._ask()

        with gui.add_folder("save", expand_by_default=False):
            picture = gui.add_button("save the picture")
            key = gui.add_button("add a key pose to the path")
            movie = gui.add_button("render the path")
            self._command = gui.add_text("command", "", multiline=True)
            self._file = gui.add_text("weather file", "", multiline=True)
        picture.on_click(lambda _: self._saved(self.save_picture))
        key.on_click(lambda _: self._saved(self.add_keyframe))
        movie.on_click(lambda _: self._saved(self.render_path))

    def _add_level_handle(self, c2w: np.ndarray) -> None:
        """Put an arrow into the scene, by which the water level is drawn up and down."""
        datum = self.app.place.scene.ground_z
        at = c2w[:3, 3] + HANDLE_DISTANCE * c2w[:3, 2]
        handle = self.client.scene.add_transform_controls(
            "/water level",
            scale=0.6,
            active_axes=(False, False, True),
            disable_rotations=True,
            disable_sliders=True,
            depth_test=False,
            position=(at[0], at[1], datum),
            visible=False,
        )
        self._handle = handle
        shown = self._gui_handle
        shown.on_update(lambda _: setattr(handle, "visible", shown.value))

        @handle.on_update
        def _(_: Any) -> None:
            level = round(float(handle.position[2]) - datum, 3)
            if level != self.controls.weather.flood.level:
                self.controls.set("flood.level", level)

    def _put(self, weather: Weather | None) -> None:
        if weather is not None:
            self.controls.put(weather)
        self._ask()

    def _tell(self, sentence: str) -> None:
        self._message.content = f"**{html.escape(sentence)}**" if sentence else " "

    def _preparing(self, what: str, fraction: float) -> None:
        self._tell(f"preparing {what}: {100 * fraction:.0f} %")

    def _saved(self, save: Callable[[], Path]) -> None:
        try:
            self._tell(f"saved {save()}")
        except (UserError, OSError) as error:
            self._tell(str(error))

    # --- pictures -------------------------------------------------------------------------------

    def wanted(self) -> Wanted:
        """Return what the tab shows now."""
        camera = self.client.camera
        aspect, fov = float(camera.aspect), float(camera.fov)
        height = min(int(camera.image_height) or MAX_SIDE, MAX_SIDE)
        width = round(height * aspect)
        if width > MAX_SIDE:
            width, height = MAX_SIDE, round(MAX_SIDE / aspect)
        width, height = max(width, 16), max(height, 16)
        focal = 0.5 * height / np.tan(fov / 2)
        c2w = np.eye(4)
        c2w[:3, :3] = rotation_matrices(np.asarray(camera.wxyz, float))
        c2w[:3, 3] = camera.position
        pinhole = Camera(width, height, focal, focal, width / 2, height / 2)
        split = self._split.value / 100 if self._before.value else 0.0
        return Wanted(
            pinhole,
            c2w,
            self.film.weather(),
            self._layer,
            self.film.now,
            split,
            asked=time.monotonic(),
        )

    def _ask(self) -> None:
        with self._asking:  # a callback of an older pose must not overtake a newer one
            wanted = self.wanted()
            self.live.ask(wanted)
        effects, film = self.live.session.effects, self.film.film
        size, path = (wanted.camera.width, wanted.camera.height), self._path_of(wanted)
        file = weather_to_toml(film or self.controls.weather, effects)
        if self._file.value != file:
            self._file.value = file
        if film is None:
            command = render_command(self.app.run, self.controls.weather, effects, path, size)
        else:
            seconds = film.duration if path == "still" else 0.0
            kept = self._weather_file or self.app.run / VIEWS / WEATHER_FILE
            command = render_command(self.app.run, kept, effects, path, size, seconds)
        if self._command.value != command:
            self._command.value = command

    def _path_of(self, wanted: Wanted) -> str:
        """Return the --path that shows a pose: that of a saved picture, or of the key poses."""
        saved = self._saved_pose
        if saved is not None and np.array_equal(saved[0], wanted.c2w):
            return str(saved[1])
        return str(self.app.run / VIEWS / "camera_path.json") if self.keyframes else "still"

    def _show(self, shown: Shown) -> None:
        self.shown = shown
        self.client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=JPEG_QUALITY[shown.state]
        )

    def _clicked(self, event: Any) -> None:
        found = measure(
            self.live.session, np.array(event.ray_origin), np.array(event.ray_direction)
        )
        self._measured.content = found.sentence

    # --- files ----------------------------------------------------------------------------------

    def save_picture(self) -> Path:
        """Write the picture that is shown, with a sidecar, and return its path.

        Raises:
            UserError: it is not full yet, or cannot be written.
        """
        shown = self.shown
        if shown is None or shown.state != "full":
            raise UserError("the picture is not finished yet; wait until it is, and save again")
        folder = make_folder(self.app.run / VIEWS)
        path = folder / f"view-{_next_number(folder, 'view')}.png"
        picture = io.BytesIO()
        Image.fromarray(shown.picture).save(picture, "PNG", pnginfo=_simulated())
        write_bytes(path, picture.getvalue())
        wanted = shown.wanted
        size = wanted.camera.width, wanted.camera.height
        fov = np.array([_vertical_fov(wanted.camera)])
        drawn = DrawnPath(wanted.c2w[None], fov, size, FPS, "")
        pose = path.with_name(f"{path.stem}-pose.json")
        write_drawn_path(pose, self.app.place.scene, drawn)
        self._saved_pose = wanted.c2w, pose
        sidecar = {
            "simulated": True,
            "note": "weather is simulated",
            "weather": weather_to_table(shown.weather, self.live.session.effects),
            "layer": shown.wanted.layer or "picture",
            "c2w_world": shown.wanted.c2w.tolist(),
            "vertical_fov_deg": _vertical_fov(shown.wanted.camera),
            "scale_error": self.app.place.scene.scale_error,
        }
        write_json(path.with_suffix(".json"), sidecar)
        self._ask()
        return path

    def save_keyframes(self) -> Path:
        """Write the weather file of the keyframes, and return its path.

        Raises:
            UserError: it cannot be written.
        """
        path = make_folder(self.app.run / VIEWS) / WEATHER_FILE
        weather = self.film.film or self.controls.weather
        write_bytes(path, weather_to_toml(weather, self.live.session.effects).encode())
        self._weather_file = path
        self._ask()
        return path

    def add_keyframe(self) -> Path:
        """Add the pose to the camera path, and write it as nerfstudio's `camera_path.json`.

        Raises:
            UserError: it cannot be written.
        """
        wanted = self.wanted()
        self.keyframes.append((wanted.c2w, _vertical_fov(wanted.camera)))
        keys, angles = zip(*self.keyframes, strict=True)
        path = self._write_path(*through(keys, angles), wanted.camera)
        self._ask()
        return path

    def _write_path(self, poses: np.ndarray, fovs: np.ndarray, camera: Camera) -> Path:
        drawn = DrawnPath(poses, fovs, (camera.width, camera.height), FPS, "")
        path = make_folder(self.app.run / VIEWS) / "camera_path.json"
        return write_drawn_path(path, self.app.place.scene, drawn)

    def render_path(self) -> Path:
        """Render the camera path in the weather that is shown, and return the movie.

        With keyframes of the weather and without key poses it stands still.

        Raises:
            UserError: there is no path, or one is being rendered.
        """
        from climatenerf.api import Run, render_movie

        film = self.film.film
        if not self.keyframes and film is None:
            raise UserError("add key poses to the path first")
        place, run = self.app.place, self.app.run
        if not self.app.rendering.acquire(blocking=False):
            raise UserError("a movie is being rendered; wait until it is finished")
        try:
            folder = make_folder(run / VIEWS)
            if not self.keyframes and film is not None:
                frames, here = round(film.duration * FPS) + 1, self.wanted()
                fovs = np.full(frames, _vertical_fov(here.camera))
                self._write_path(np.repeat(here.c2w[None], frames, axis=0), fovs, here.camera)
            out = folder / f"movie-{_next_number(folder, 'movie')}"
            fitted = Run(run, place.field, place.scene, self.app.digest, style=place.style)  # pyright: ignore[reportArgumentType]
            return render_movie(
                fitted,
                out,
                film or self.controls.weather,
                path=str(folder / "camera_path.json"),
                complete_ground=False,
                progress=self._preparing,
            )
        finally:
            self.app.rendering.release()


def _depth_error(run: Path) -> float:
    """Relative error of a run's depth at withheld points; 0 where it is not known."""
    path = run / METRICS
    found = read_json(path).get("points.abs_rel") if path.is_file() else None
    return 0.0 if found is None else float(found)


def _vertical_fov(camera: Camera) -> float:
    """Vertical field of view, degrees."""
    return float(np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy)))


def _next_number(folder: Path, kind: str) -> str:
    """Return the number after the greatest of the folder's files of a kind, four digits."""
    numbers = [
        int(found[1])
        for each in folder.iterdir()
        if (found := re.match(rf"{kind}-(\d+)", each.name)) is not None
    ]
    return f"{max(numbers, default=0) + 1:04d}"


def _simulated() -> PngImagePlugin.PngInfo:
    """Text chunk that marks a picture as simulated."""
    info = PngImagePlugin.PngInfo()
    info.add_text("simulated", "weather simulated by climatenerf")
    return info


def tunnel_line(port: int) -> str:
    """Return how to reach the viewer from another machine."""
    return f"ssh -L {port}:127.0.0.1:{port} THIS-MACHINE"
