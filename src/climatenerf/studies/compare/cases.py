"""What is compared: the weather of each effect, a short camera path, and truth if there is any."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from climatenerf.core.errors import UserError, excerpt, one_line
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.core.parsing import read_bytes
from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views
from climatenerf.evaluation.reference import FILE_NAME, read_reference
from climatenerf.field.protocol import RadianceField
from climatenerf.paths.camera_path import CameraPath, camera_path
from climatenerf.scene import Scene
from climatenerf.studies.compare.pictures import Picture
from climatenerf.studies.compare.settings import EFFECTS
from climatenerf.weather.description import KeyframedWeather, read_weather
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

DEFAULTS = {
    "smog": Weather(smog=Smog(visibility=80.0)),
    "flood": Weather(flood=Flood(level=0.3)),
    "snow": Weather(snow=Snow(depth=0.1)),
}
TRUE_WEATHERS = {"smog": "smog-mid", "flood": "flood-low", "snow": "snow-deep"}
"""Weather of a reference set that has true pictures of each effect; none of them moves."""
WIDTH = 480  # of the longer side of the frames by default, pixels
LICENCE_FILES = ("LICENSE.md", "LICENSE", "LICENSE.txt", "LICENCE.md", "LICENCE", "LICENCE.txt")
MAX_LICENCE = 200  # characters


@dataclass(frozen=True)
class TrueViews:
    """The test views of a reference set.

    Attributes:
        path: their cameras.
        weathers: the weather of each effect.
        pictures: true pictures by effect.
    """

    path: CameraPath
    weathers: Mapping[str, KeyframedWeather]
    pictures: Mapping[str, tuple[Picture, ...]]


def weathers_of(
    given: Sequence[str], effects: Sequence[str], seed: int
) -> dict[str, KeyframedWeather]:
    """Return the weather of each effect, from flags such as `flood=deep.toml` or by default.

    Args:
        given: EFFECT=FILE each.
        effects: the effects to compare.
        seed: random seed of the default weathers.

    Raises:
        UserError: an unknown effect, a damaged file, or a file whose weather lacks its effect.
    """
    files: dict[str, Path] = {}
    for text in given:
        effect, equals, path = text.partition("=")
        if effect not in effects or not equals or not path:
            raise UserError(
                f"--weather must be EFFECT=FILE with one of {', '.join(effects)}, such as"
                f" {effects[0]}=mine.toml; got {excerpt(text)}"
            )
        files[effect] = Path(path)
    found = {}
    for effect in effects:
        if effect not in files:
            found[effect] = KeyframedWeather(DEFAULTS[effect].with_value("seed", seed), {})
            continue
        weather = found[effect] = read_weather(files[effect])
        moving = any(name.startswith(f"{effect}.") for name in weather.keyframes)
        if not moving and weather.base.sections[effect] == type(weather.base.sections[effect])():
            raise UserError(
                f"the weather file {files[effect]} has no {effect}; give it a section [{effect}]"
            )
    return found


def check_effects(effects: Sequence[str]) -> tuple[str, ...]:
    """Return the effects to compare, in the order of `EFFECTS`.

    Raises:
        UserError: none, or an unknown one.
    """
    for effect in effects:
        if effect not in EFFECTS:
            raise UserError(f"there is no effect {excerpt(effect)}; use {', '.join(EFFECTS)}")
    if not effects:
        raise UserError(f"--effects names no effect; use {', '.join(EFFECTS)}")
    return tuple(effect for effect in EFFECTS if effect in effects)


def short_path(
    spec: str, scene: Scene, frames: int, size: tuple[int, int] | None, portion: float
) -> CameraPath:
    """Return the middle part of a camera path.

    Args:
        spec: the path, as for `camera_path`; a file is taken whole.
        scene: the capture.
        frames: number of frames.
        size: width and height, pixels; None takes the photos' shape with `WIDTH` pixels.
        portion: fraction of the path that the frames cover, above 0 to 1.

    Raises:
        UserError: a value out of range, or no such path.
    """
    if not 0 < portion <= 1 or not 1 <= frames <= MAX_FRAMES:
        raise UserError(f"--portion must be above 0 and at most 1, --frames from 1 to {MAX_FRAMES}")
    size = default_size(scene) if size is None else size
    if spec.endswith(".json"):
        return camera_path(spec, scene, frames, size)
    whole = camera_path(spec, scene, min(MAX_FRAMES, max(frames, round(frames / portion))), size)
    start = (len(whole) - frames) // 2
    part = slice(start, start + frames)
    return CameraPath(whole.c2w[part], whole.cameras[part], whole.name, whole.notes, whole.fps)


def default_size(scene: Scene) -> tuple[int, int]:
    """Return the shape of the first photo with at most `WIDTH` pixels a side."""
    camera = scene.cameras[scene.views[0].camera]
    scale = min(1.0, WIDTH / max(camera.width, camera.height))
    return max(16, round(camera.width * scale)), max(16, round(camera.height * scale))


def true_views(scene: Scene, field: RadianceField, effects: Sequence[str]) -> TrueViews | None:
    """Return the test views of the capture's reference set; None for captures without one.

    Raises:
        UserError: the set is damaged, or the run was not fitted to it as it is.
    """
    if not (scene.root / FILE_NAME).is_file():
        return None
    reference = read_reference(scene.root, weathers=tuple(TRUE_WEATHERS[e] for e in effects))
    check_views(scene, reference)
    run = EvaluatedRun(field, scene, reference)
    cameras = [run.camera(truth) for truth in reference.truths]
    path = CameraPath(
        np.stack([c2w for _, c2w in cameras]), tuple(camera for camera, _ in cameras), "test views"
    )
    cases = {case.name: case for case in reference.weathers}
    own = {effect: cases[TRUE_WEATHERS[effect]] for effect in effects}
    return TrueViews(
        path,
        {effect: case.weather for effect, case in own.items()},
        {e: tuple(case.picture(t.name) for t in reference.truths) for e, case in own.items()},
    )


def licence_of(scene: Scene) -> str | None:
    """Return the line of the capture's licence file that names the licence; None without one."""
    for name in LICENCE_FILES:
        path = scene.root / name
        if path.is_file():
            text = read_bytes(path, "the licence of the capture").decode("utf-8", "replace")
            lines = [line.replace("*", "").strip(" #") for line in text.splitlines()]
            lines = [line for line in lines if line]
            naming = [x for x in lines if "licence" in x.lower() or "license" in x.lower()]
            return one_line((naming or lines or [name])[0], MAX_LICENCE)
    return None
