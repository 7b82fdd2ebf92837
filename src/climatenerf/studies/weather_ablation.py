"""The list of weather ablations, and the default weather of each."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.studies import flood_ablation, season_panels, snow_ablation
from climatenerf.studies.shot import Place, Shot, shot_of_photo, shot_of_truth, true_picture
from climatenerf.studies.study_folder import Row
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather


@dataclass(frozen=True)
class Study:
    """An ablation of weather.

    Attributes:
        names: of its rows.
        run: renders them.
        weather: what is rendered where none is given.
        needs: the parameter that a given weather must have.
        true_weather: the weather of a reference set that it is compared with; "" for none.
        columns: pictures in a row of its sheet.
    """

    names: tuple[str, ...]
    run: Callable[[Shot, Callable[[str], None]], list[Row]]
    weather: Weather
    needs: str
    true_weather: str
    columns: int


STUDIES = {
    "flood": Study(
        flood_ablation.ROWS,
        flood_ablation.flood_ablation,
        Weather(flood=Flood(level=0.5, wind_speed=3.0)),
        "flood.level",
        flood_ablation.WEATHER,
        3,
    ),
    "snow": Study(
        snow_ablation.ROWS,
        snow_ablation.snow_ablation,
        Weather(snow=Snow(depth=0.15)),
        "snow.depth",
        snow_ablation.WEATHER,
        2,
    ),
    "seasons": Study(
        season_panels.ROWS,
        season_panels.season_panels,
        Weather(snow=Snow(depth=0.1), season=Season(kind="winter")),
        "snow.depth",
        "",
        2,
    ),
}


def shot_of(
    study: Study,
    place: Place,
    view: str | None,
    size: tuple[int, int] | None,
    weather: Weather | None,
) -> Shot:
    """Return what a study renders.

    On a run of a reference set it is a test view in a weather of the set, and is compared with the
    truth, unless another photo, size or weather is asked for.

    Args:
        study: the ablation.
        place: the fitted field and its capture.
        view: name of a photo; None: the first test view, or the most central photo.
        size: width and height, pixels; None: the photo's own.
        weather: what to put in; None: as above, or the study's own.

    Raises:
        UserError: there is no such photo, the weather lacks the effect, or the reference set is
            damaged.
    """
    if weather is not None and not weather.value(study.needs):
        raise UserError(f"the weather has no {study.needs}; add it to the file of --weather")
    if study.true_weather and size is None and weather is None:
        truth = true_picture(place.scene, view, study.true_weather)
        if truth is not None:
            return shot_of_truth(place, truth, truth.case.weather.at(truth.case.time))
    return shot_of_photo(place, view, size, study.weather if weather is None else weather)


def about_shot(shot: Shot, weather: dict[str, Any] | None) -> dict[str, Any]:
    """Return what an index says of a picture.

    Args:
        shot: the picture.
        weather: tables of its weather; None where each picture has its own.
    """
    truth = None if shot.truth is None else shot.truth.case.name
    return {
        "capture": shot.place.scene.root.name,
        "view": shot.view,
        "size": [shot.camera.width, shot.camera.height],
        "time_s": shot.time,
        "truth": truth,
    } | ({} if weather is None else {"weather": weather})
