"""What the studies of weather render: a field from one camera, in one weather."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.core.cameras import Camera
from climatenerf.evaluation.evaluated_run import check_views, find_view
from climatenerf.evaluation.reference import (
    FILE_NAME,
    Reference,
    Truth,
    WeatherTruth,
    read_reference,
)
from climatenerf.evaluation.weather_scores import MIN_SNOW, water_visible
from climatenerf.field.protocol import RadianceField
from climatenerf.paths.camera_path import still
from climatenerf.render.session import RenderSession
from climatenerf.scene import Scene
from climatenerf.weather.style import Style
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Kept


@dataclass(frozen=True)
class Place:
    """A fitted field with its capture.

    Attributes:
        field: the field, with completed ground where there is any.
        scene: its capture.
        kept: where the light that is found in it is kept; None: nowhere.
        style: new colours of the run; None: those of the photos.
    """

    field: RadianceField
    scene: Scene
    kept: Kept | None = None
    style: Style | None = None


@dataclass(frozen=True)
class Shot:
    """One picture of a place.

    Attributes:
        place: what is rendered.
        view: name of the photo whose pose the camera has.
        camera: intrinsics.
        c2w: pose, world m.
        weather: what is put into the place.
        time: moment of the picture, s.
        truth: ground truth of this picture; None where it is not known.
    """

    place: Place
    view: str
    camera: Camera
    c2w: Float[np.ndarray, "4 4"]
    weather: Weather
    time: float = 0.0
    truth: "TruePicture | None" = None

    def session(self, weather: Weather | None = None) -> RenderSession:
        """Prepare a weather for the camera; None: that of the shot."""
        chosen = self.weather if weather is None else weather
        eye, moment = self.c2w[None, :3, 3], np.array([self.time])
        given = self.place.field, self.place.scene, chosen, eye, moment
        return RenderSession(*given, kept=self.place.kept, style=self.place.style)

    def directions(self) -> Float[np.ndarray, "h w 3"]:
        """Unit directions of the pixels, world axes."""
        return self.camera.directions() @ self.c2w[:3, :3].T


@dataclass(frozen=True)
class TruePicture:
    """A test view of a reference set in one of its weathers."""

    reference: Reference
    case: WeatherTruth
    view: Truth

    def picture(self) -> Float[np.ndarray, "h w 3"]:
        """The path-traced picture, display values in [0, 1]."""
        return self.case.picture(self.view.name) / 255.0

    def water(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of water."""
        level = self.case.weather.at(self.case.time).flood.level
        return water_visible(self.view, self.reference.scene.ground_z + level)

    def snow(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of snow."""
        layers = self.case.layers(self.view.name)
        return (layers["thickness"] > MIN_SNOW) & np.isfinite(layers["depth"])


def is_reference(scene: Scene) -> bool:
    """Whether the capture of a scene is a reference set."""
    return (scene.root / FILE_NAME).is_file()


def true_picture(scene: Scene, view: str | None, weather: str) -> TruePicture | None:
    """Return the truth of a view in a weather of the reference set, if there is any.

    Args:
        scene: the fitted scene.
        view: name of a photo, with or without suffix; None: the first test view.
        weather: name of the weather in the reference set.

    Raises:
        UserError: the reference set is damaged, or the run was not fitted to the whole of it.
    """
    if not is_reference(scene):
        return None
    stems = [Path(each.name).stem for each in scene.of_split("heldout")]
    if view is not None and Path(view).stem not in stems:
        return None
    reference = read_reference(scene.root, () if view is None else (Path(view).stem,), (weather,))
    check_views(scene, reference)
    return TruePicture(reference, reference.weathers[0], reference.truths[0])


def shot_of_truth(place: Place, truth: TruePicture, weather: Weather) -> Shot:
    """Return the shot that a true picture is compared with, at its own size."""
    view = find_view(place.scene, truth.view)
    assert view is not None, "`true_picture` checks the views"
    camera, c2w = place.scene.cameras[view.camera], place.scene.c2w_world(view)
    return Shot(place, view.name, camera, c2w, weather, truth.case.time, truth)


def shot_of_photo(
    place: Place, view: str | None, size: tuple[int, int] | None, weather: Weather
) -> Shot:
    """Return a shot from the pose of a photo.

    Args:
        place: what to render.
        view: name of the photo; None: the most central one.
        size: width and height, pixels; None: the photo's own.
        weather: what to put in.

    Raises:
        UserError: there is no such photo.
    """
    path = still(place.scene, view, 1, size)
    return Shot(place, path.name.partition(":")[2], path.cameras[0], path.c2w[0], weather)
