"""The viewer: one session, one set of controls and one live view for each browser tab."""

import contextlib
import html
import io
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.rotations import quaternions, rotation_matrices
from climatenerf.core.storage import read_json
from climatenerf.paths.camera_path import still
from climatenerf.render.session import RenderSession
from climatenerf.studies.shot import Place
from climatenerf.training.run import METRICS
from climatenerf.viewer import guarded_server
from climatenerf.viewer.controls import WeatherControls
from climatenerf.viewer.files import SavedFiles, weather_at
from climatenerf.viewer.film import TimeControls
from climatenerf.viewer.live import LiveView, Shown, Wanted
from climatenerf.viewer.measure import measure
from climatenerf.viewer.overlays import LAYERS, legend
from climatenerf.weather.description import (
    KeyframedWeather,
    read_weather,
    weather_to_toml,
)
from climatenerf.weather.registry import installed_effects
from climatenerf.weather.weather import Weather

if TYPE_CHECKING:
    import viser

MAX_SIDE = 960  # pixels of a full picture
JPEG_QUALITY = {"warped": 70, "coarse": 75, "half": 80, "full": 90}
STATES = {"warped": "moving", "coarse": "coarse", "half": "half", "full": "full"}
HANDLE_DISTANCE = 5.0  # m, of the arrow for the water level from the first camera


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
        self._asking = threading.Lock()
        self.files = SavedFiles(app.run, installed_effects(), app.weather_file)
        client.camera.position = tuple(eye.c2w[0, :3, 3])
        client.camera.wxyz = tuple(quaternions(eye.c2w[0, :3, :3]))
        client.camera.fov = float(2 * np.arctan(0.5 * eye.cameras[0].height / eye.cameras[0].fy))
        self.live = LiveView(self._new_session(), self._show, self._tell_state)
        self._ends = [self.files.close, self.live.close]
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
        self._state = gui.add_markdown("picture: none yet")
        self._message = gui.add_markdown(" ")
        self._measured = gui.add_markdown("Click the picture to measure.")
        low = scene.lowest_ground_z - scene.ground_z - 0.5
        eyes = [scene.c2w_world(view)[2, 3] for view in scene.of_split("train")]
        high = max(min(eyes) - scene.ground_z, low + 1)
        levels = float(np.floor(10 * low) / 10), float(np.floor(10 * high) / 10)
        effects, begun = self.live.session.effects, self.app.weather
        self.controls = WeatherControls(
            gui, effects, begun.at(0.0), levels, lambda _: self._edited(), self._tell
        )
        self.film = TimeControls(
            gui,
            effects,
            begun,
            lambda: self.controls.weather,
            self._put,
            self._keyframes_changed,
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
            back = gui.add_button("remove the last key pose")
            movie = gui.add_button("render the path")
            stop = gui.add_button("stop the movie")
            self._command = gui.add_text("command", "", multiline=True)
            self._file = gui.add_text("weather file", "", multiline=True)
        picture.on_click(lambda _: self._saved(self.save_picture))
        key.on_click(lambda _: self._saved(self.add_key_pose))
        back.on_click(lambda _: self._saved(self.remove_key_pose))
        movie.on_click(lambda _: self._saved(self.render_path))
        stop.on_click(lambda _: self.files.stop())

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

    def _edited(self) -> None:
        """Show the weather of the controls, which is that of no keyframe."""
        self.film.edited = True
        self._ask()

    def _keyframes_changed(self) -> None:
        film = self.film.film
        if film is not None:
            self._saved(lambda: self.files.save_weather(film))
            if self.files.key_poses:
                camera = self.wanted().camera
                self._saved(lambda: self.files.write_path(camera, self.app.place, film))
        self._ask()

    def _put(self, weather: Weather | None) -> None:
        if weather is not None:
            self.controls.put(weather)
        self._ask()

    def _tell(self, sentence: str) -> None:
        self._message.content = f"**{html.escape(sentence)}**" if sentence else " "

    def _tell_state(self, sentence: str) -> None:
        """Say what is prepared, or what is wrong with the weather."""
        state = "none yet" if self.shown is None else STATES[self.shown.state]
        self._state.content = f"**{html.escape(sentence)}**" if sentence else f"picture: {state}"

    def _rendering(self, what: str, fraction: float) -> None:
        self._tell(f"movie, {what}: {100 * fraction:.0f} %")

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
        film = self._shown_film()
        file = weather_to_toml(film or weather_at(wanted), self.live.session.effects)
        if self._file.value != file:
            self._file.value = file
        command = self.files.command(wanted, film)
        if self._command.value != command:
            self._command.value = command

    def _show(self, shown: Shown) -> None:
        finer = self.shown is None or self.shown.state != shown.state
        self.shown = shown
        if finer:
            self._tell_state("")
        self.client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=JPEG_QUALITY[shown.state]
        )

    def _clicked(self, event: Any) -> None:
        ray = np.array(event.ray_origin), np.array(event.ray_direction)
        found = measure(self.live.session, *ray, self.film.now, self.app.depth_error)
        self._measured.content = found.sentence

    # --- files ----------------------------------------------------------------------------------

    def save_picture(self) -> Path:
        """Write the picture that is shown; see `SavedFiles`."""
        path = self.files.save_picture(self.shown, self.app.place)
        self._ask()
        return path

    def add_key_pose(self) -> Path:
        """Add the pose that is shown to the camera path; see `SavedFiles`."""
        path = self.files.add_key_pose(self.wanted(), self.app.place, self._shown_film())
        self._ask()
        return path

    def remove_key_pose(self) -> Path:
        """Take the last pose out of the camera path; see `SavedFiles`."""
        path = self.files.remove_key_pose(self.wanted(), self.app.place, self._shown_film())
        self._ask()
        return path

    def render_path(self) -> Path:
        """Render the camera path in the weather that is shown; see `SavedFiles`."""
        app = self.app
        if not app.rendering.acquire(blocking=False):
            raise UserError("a movie is being rendered; wait until it is finished, or stop it")
        try:
            given = self.wanted(), self._shown_film(), app.place, app.digest
            return self.files.render_path(*given, self._rendering)
        finally:
            app.rendering.release()

    def _shown_film(self) -> KeyframedWeather | None:
        return None if self.film.edited else self.film.film


def _depth_error(run: Path) -> float:
    """Relative error of a run's depth at withheld points; 0 where it is not known."""
    path = run / METRICS
    found = read_json(path).get("points.abs_rel") if path.is_file() else None
    return 0.0 if found is None else float(found)


def tunnel_line(port: int) -> str:
    """Return how to reach the viewer from another machine."""
    return f"ssh -L {port}:127.0.0.1:{port} THIS-MACHINE"
