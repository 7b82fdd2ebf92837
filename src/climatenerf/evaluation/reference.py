"""The reference set: a place whose geometry and whose pictures in weather are known exactly.

What lies where in its folder is told in docs/reference-scene.md.
"""

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from climatenerf.core.errors import UserError
from climatenerf.core.storage import check_schema, read_json
from climatenerf.scene import Camera, Scene, load_scene
from climatenerf.scene.images import load_labels, read_rgb
from climatenerf.weather.description import KeyframedWeather, read_weather

FILE_NAME = "reference.json"
SCHEMA_VERSION = 1
SKY = 10  # Cityscapes train id


@dataclass(frozen=True)
class Truth:
    """What is known of one test view.

    Attributes:
        name: of the view.
        depth: ray length, m; +inf in the sky.
        normal: unit, towards the camera, in the camera's axes (OpenCV); 0 in the sky.
        label: Cityscapes train ids.
        sun: share of the sun's disc that lights the place, 0 to 1.
        clean: linear radiance.
        rays_d: unit directions in the true world (z up).
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
        """Where nothing is."""
        return np.isinf(self.depth)

    @property
    def points(self) -> Float[np.ndarray, "h w 3"]:
        """Places seen, in the true world, m; the eye in the sky."""
        return self.c2w[:3, 3] + np.where(self.sky, 0.0, self.depth)[..., None] * self.rays_d


@dataclass(frozen=True)
class WeatherTruth:
    """One weather of the reference set.

    Attributes:
        name: such as "flood-low".
        weather: what the program is asked for.
        time: moment of the picture, s.
        folder: of its true pictures and layers.
    """

    name: str
    weather: KeyframedWeather
    time: float
    folder: Path

    def picture(self, view: str) -> UInt8[np.ndarray, "h w 3"]:
        """The path-traced display picture."""
        return read_rgb((self.folder / view).with_suffix(".png"))

    def layers(self, view: str) -> dict[str, np.ndarray]:
        """True layers, where this weather has some.

        Smog: `transmittance`. Snow: `depth` along the ray and vertical `thickness`, m.
        """
        return _arrays((self.folder / view).with_suffix(".npz"))


@dataclass(frozen=True)
class Reference:
    """The reference set of a capture.

    Attributes:
        folder: where the truth lies.
        scene: the true scene; its world is the true one.
        truths: one for each view that is measured.
        weathers: by name.
        mirror_level: height of the mirror in the pictures of `mirror/`, m above the ground datum.
    """

    folder: Path
    scene: Scene
    truths: tuple[Truth, ...]
    weathers: tuple[WeatherTruth, ...]
    mirror_level: float

    def mirrored(self, view: str) -> UInt8[np.ndarray, "h w 3"]:
        """The true picture with a perfect mirror at `mirror_level`."""
        return read_rgb((self.folder / "mirror" / view).with_suffix(".png"))


def read_reference(
    capture: Path, views: tuple[str, ...] = (), weathers: tuple[str, ...] = ()
) -> Reference:
    """The reference set that a capture belongs to.

    Args:
        capture: folder with a `reference.json`.
        views: names, without suffix, of those to read; default all.
        weathers: names of those to read; default all.

    Raises:
        UserError: the capture is no reference set, its files are damaged, or a name is unknown.
    """
    path = capture / FILE_NAME
    if not path.is_file():
        raise UserError(
            f"{capture} is no reference set: it has no {FILE_NAME}; fit one (climatenerf fit"
            " reference/street -o RUN) and evaluate that run"
        )
    data = read_json(path, "the reference set's list")
    check_schema(data.get("schema_version"), SCHEMA_VERSION, f"the reference set {capture}")
    try:
        folder = (capture / data["truth"]).resolve()
        listed, kinds = [str(v) for v in data["views"]], dict(data["weather"])
        times = {kind: float(entry["time_s"]) for kind, entry in kinds.items()}
        level = float(data["mirror_level_m"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}); make the set anew"
        ) from error
    scene = load_scene(folder)
    wanted = [v for v in listed if not views or Path(v).stem in views]
    _all_known(views, [Path(v).stem for v in listed], "view")
    _all_known(weathers, list(times), "weather")
    return Reference(
        folder,
        scene,
        tuple(_truth(folder, scene, name) for name in wanted),
        tuple(
            WeatherTruth(
                kind,
                read_weather(folder / "weather" / f"{kind}.toml"),
                times[kind],
                folder / "weather" / kind,
            )
            for kind in times
            if not weathers or kind in weathers
        ),
        level,
    )


def _all_known(names: tuple[str, ...], known: list[str], what: str) -> None:
    for name in names:
        if name not in known:
            raise UserError(f'the reference set has no {what} "{name}"; it has {", ".join(known)}')


def _truth(folder: Path, scene: Scene, name: str) -> Truth:
    view = next((v for v in scene.views if v.name == name), None)
    if view is None:
        raise UserError(f"{folder} lists the view {name} but has no pose of it; make the set anew")
    arrays = _arrays((folder / "truth" / name).with_suffix(".npz"))
    label = load_labels(view, scene)
    camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
    shape = (camera.height, camera.width)
    wanted: Mapping[str, tuple[int, ...]] = {
        "depth": shape, "normal": (*shape, 3), "sun": shape, "clean": (*shape, 3)
    }  # fmt: skip
    for key, size in wanted.items():
        if key not in arrays or arrays[key].shape != size:
            raise UserError(f"the truth of {name} in {folder} lacks {key}; make the set anew")
    if label is None:
        raise UserError(f"{folder} has no labels of {name}; make the set anew")
    return Truth(
        name,
        arrays["depth"].astype(np.float32),
        arrays["normal"].astype(np.float64) @ c2w[:3, :3],
        label,
        arrays["sun"].astype(np.float64),
        arrays["clean"].astype(np.float64),
        world_rays(camera, c2w),
        c2w,
    )


def world_rays(camera: Camera, c2w: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w 3"]:
    """Unit directions of a camera's pixels in the world."""
    return camera.directions() @ c2w[:3, :3].T


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with np.load(path) as data:
            return {key: data[key] for key in data.files}
    except FileNotFoundError:
        raise UserError(f"{path} is missing; the reference set is not whole") from None
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged; make the set anew") from error
