"""Read a reference set: a scene with exact geometry and path-traced pictures in known weather.

docs/reference-scene.md describes the files of its folder.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from climatenerf.core import arrays
from climatenerf.core.errors import UserError
from climatenerf.core.storage import check_schema, read_json
from climatenerf.scene import Camera, Scene, load_scene
from climatenerf.scene.images import load_labels, read_rgb
from climatenerf.weather.description import KeyframedWeather, read_weather

FILE_NAME = "reference.json"
SCHEMA_VERSION = 3  # 2: `clean`, and no mirror; 3: light, `relight`, mirror in linear radiance
SKY = 10  # Cityscapes train id


@dataclass(frozen=True)
class Truth:
    """The ground truth of one test view.

    Attributes:
        name: file name of the view.
        depth: ray length, m; +inf in the sky.
        normal: unit, towards the camera, camera axes (OpenCV); 0 in the sky.
        label: Cityscapes train ids.
        sun: visible fraction of the sun's disc at the surface point, [0, 1].
        clean: linear radiance without weather.
        rays_d: unit ray directions, true world (z up).
        c2w: true pose of the camera, world m.
    """

    name: str
    depth: Float32[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    label: UInt8[np.ndarray, "h w"]
    sun: Float[np.ndarray, "h w"]
    clean: Float[np.ndarray, "h w 3"]
    rays_d: Float[np.ndarray, "h w 3"]
    c2w: Float[np.ndarray, "4 4"]

    @property
    def sky(self) -> Bool[np.ndarray, "h w"]:
        """Pixels without a surface."""
        return np.isinf(self.depth)

    @property
    def points(self) -> Float[np.ndarray, "h w 3"]:
        """Surface points, true world, m; the camera centre in the sky."""
        return self.c2w[:3, 3] + np.where(self.sky, 0.0, self.depth)[..., None] * self.rays_d


@dataclass(frozen=True)
class WeatherTruth:
    """One weather of the reference set.

    Attributes:
        name: such as "flood-low".
        weather: the weather to render.
        time: time of the picture, s.
        folder: folder of its true pictures.
        layer_folder: folder of its true layers.
    """

    name: str
    weather: KeyframedWeather
    time: float
    folder: Path
    layer_folder: Path

    def picture(self, view: str) -> UInt8[np.ndarray, "h w 3"]:
        """Read the path-traced display picture of a view."""
        return read_rgb((self.folder / view).with_suffix(".png"))

    def layers(self, view: str) -> dict[str, np.ndarray]:
        """Read the true layers of a view.

        Returns:
            For smog that absorbs `transmittance`; for snow `depth` along the ray and vertical
            `thickness`, m.

        Raises:
            UserError: the file is missing (floods have no layers) or damaged.
        """
        return _arrays((self.layer_folder / view).with_suffix(".npz"))


@dataclass(frozen=True)
class TrueLight:
    """The light of a capture.

    Attributes:
        sheet: radiance of a white sheet on open level ground.
        sun: elevation and azimuth of a hard sun, rad; None under a sky without one.
    """

    sheet: Float[np.ndarray, "3"]
    sun: tuple[float, float] | None


@dataclass(frozen=True)
class Relight:
    """The same place under another sky.

    Attributes:
        name: of the sky, such as "overcast".
        weather: what turns the capture's light into it.
        truths: the test views under it.
    """

    name: str
    weather: KeyframedWeather
    truths: tuple[Truth, ...]


@dataclass(frozen=True)
class Reference:
    """The reference set of a capture.

    Attributes:
        folder: folder of the ground truth.
        scene: the true scene, in the true world.
        truths: one per test view.
        weathers: all weathers to measure.
        mirror_level: height of the mirror in the pictures of `mirror/`, m above the ground datum;
            None without such pictures.
        light: the light of the photos; None where the set does not tell.
        relight: the test views under another sky; None without them.
    """

    folder: Path
    scene: Scene
    truths: tuple[Truth, ...]
    weathers: tuple[WeatherTruth, ...]
    mirror_level: float | None
    light: TrueLight | None = None
    relight: Relight | None = None

    def mirrored(self, view: str) -> Float[np.ndarray, "h w 3"]:
        """Read the linear radiance of a view with a perfect mirror at `mirror_level`."""
        return _arrays((self.folder / "mirror" / view).with_suffix(".npz"))["linear"].astype(float)


def read_reference(
    capture: Path, views: tuple[str, ...] = (), weathers: tuple[str, ...] = ()
) -> Reference:
    """Read the reference set of a capture.

    Args:
        capture: folder with a `reference.json`.
        views: names, without suffix, of the test views to read; default all.
        weathers: names of the weathers to read; default all.

    Raises:
        UserError: the capture is no reference set, its files are damaged, or a name is unknown.
    """
    path = capture / FILE_NAME
    if not path.is_file():
        raise UserError(
            f"{capture} is no reference set: it has no {FILE_NAME}; fit one (climatenerf fit"
            " reference/street -o RUN) and evaluate that run"
        )
    data = read_json(path, "the reference set's index")
    check_schema(data.get("schema_version"), SCHEMA_VERSION, f"the reference set {capture}")
    try:
        folder = (capture / data["truth"]).resolve()
        listed, entries = [str(v) for v in data["views"]], dict(data["weather"])
        times = {name: float(entry["time_s"]) for name, entry in entries.items()}
        # Pictures and requests lie with the truth unless a folder is named.
        places = {
            name: (capture / entry["folder"]).resolve() if "folder" in entry else folder
            for name, entry in entries.items()
        }
        layers = {name: str(entry.get("layers", name)) for name, entry in entries.items()}
        light = _true_light(data.get("light"))
        others = {str(k): (capture / v).resolve() for k, v in data.get("relight", {}).items()}
        mirror = data["mirror_level_m"]
        level = None if mirror is None else float(mirror)
        # The folder of clean pictures in a light or with materials of their own.
        own = None if data.get("clean") is None else (capture / data["clean"]).resolve()
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}); generate the set again"
        ) from error
    scene = load_scene(folder)
    selected = [v for v in listed if not views or Path(v).stem in views]
    _check_names(views, [Path(v).stem for v in listed], "view")
    _check_names(weathers, list(times), "weather")
    truths = tuple(_read_truth(folder, scene, name, own) for name in selected)
    relight = None
    for name, place in others.items():
        weather = read_weather(capture / "relight" / f"{name}.toml")
        clean = (_arrays((place / "truth" / t.name).with_suffix(".npz"))["clean"] for t in truths)
        pairs = zip(truths, clean, strict=True)
        relight = Relight(name, weather, tuple(replace(t, clean=c.astype(float)) for t, c in pairs))
    return Reference(
        folder,
        scene,
        truths,
        tuple(
            WeatherTruth(
                name,
                read_weather(places[name] / "weather" / f"{name}.toml"),
                time,
                places[name] / "weather" / name,
                folder / "weather" / layers[name],
            )
            for name, time in times.items()
            if not weathers or name in weathers
        ),
        level,
        light,
        relight,
    )


def _true_light(data: Mapping[str, Any] | None) -> TrueLight | None:
    if data is None:
        return None
    sun = data["sun_deg"]
    angles = None if sun is None else (np.radians(float(sun[0])), np.radians(float(sun[1])))
    return TrueLight(np.array(data["sheet"], float), angles)


def _check_names(names: tuple[str, ...], existing: list[str], what: str) -> None:
    for name in names:
        if name not in existing:
            raise UserError(
                f'the reference set has no {what} "{name}"; choose from {", ".join(existing)}'
            )


def _read_truth(folder: Path, scene: Scene, name: str, own: Path | None) -> Truth:
    """Read the truth of a view; its `clean` comes from the folder `own`, if there is one."""
    view = next((v for v in scene.views if v.name == name), None)
    if view is None:
        raise UserError(f"{folder} has no pose of its view {name}; generate the set again")
    truth = _arrays((folder / "truth" / name).with_suffix(".npz"))
    if own is not None:
        truth |= _arrays((own / "truth" / name).with_suffix(".npz"))
    label = load_labels(view, scene)
    camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
    shape = (camera.height, camera.width)
    shapes: Mapping[str, tuple[int, ...]] = {
        "depth": shape, "normal": (*shape, 3), "sun": shape, "clean": (*shape, 3)
    }  # fmt: skip
    for key, expected in shapes.items():
        if key not in truth or truth[key].shape != expected:
            raise UserError(f"the truth of {name} in {folder} lacks {key}; generate the set again")
    if label is None:
        raise UserError(f"{folder} has no labels of {name}; generate the set again")
    return Truth(
        name,
        truth["depth"].astype(np.float32),
        truth["normal"].astype(np.float64) @ c2w[:3, :3],
        label,
        truth["sun"].astype(np.float64),
        truth["clean"].astype(np.float64),
        world_rays(camera, c2w),
        c2w,
    )


def world_rays(camera: Camera, c2w: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w 3"]:
    """Return the unit directions of a camera's pixels in the world."""
    return camera.directions() @ c2w[:3, :3].T


def _arrays(path: Path) -> dict[str, Any]:
    try:
        return arrays.read_npz(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing; generate the reference set again") from None
    except arrays.ERRORS as error:
        raise UserError(f"{path} is damaged; generate the set again") from error
