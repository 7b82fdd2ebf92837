"""Pictures of a page: each view dry, under each water level, under snow, in smog, in seasons."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.errors import UserError
from climatenerf.field.protocol import RadianceField
from climatenerf.page.flooding import flooding_levels
from climatenerf.page.settings import PageSettings
from climatenerf.page.views import (
    PageView,
    find_ground,
    page_views,
    placed_objects,
    positions,
    water_levels,
)
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.render.placed_objects import PlacedField, with_objects
from climatenerf.render.session import RenderSession
from climatenerf.studies.shot import Place
from climatenerf.weather.weather import Weather

Picture = UInt8[np.ndarray, "h w 3"]
Progress = Callable[[str, float], None]


@dataclass
class ViewPictures:
    """The pictures of one view.

    Attributes:
        view: the view.
        dry: without weather.
        heights: of what each pixel shows, m above the ground datum; +inf for the sky, -inf where no
            ground is seen below the horizon.
        flooding: water level from which each pixel is under water, likewise.
        water: one picture a level, ascending.
        snow: one a depth.
        smog: one a visibility.
        seasons: one a season.
    """

    view: PageView
    dry: Picture
    heights: Float[np.ndarray, "h w"]
    flooding: Float[np.ndarray, "h w"]
    water: list[Picture] = field(default_factory=list)
    snow: list[Picture] = field(default_factory=list)
    smog: list[Picture] = field(default_factory=list)
    seasons: list[Picture] = field(default_factory=list)


@dataclass(frozen=True)
class PagePictures:
    """All pictures of a page.

    Attributes:
        views: by view.
        levels: of the water, m above the ground datum.
        seasons: names of the seasons that could be rendered.
        notes: sentences about what was left out.
    """

    views: list[ViewPictures]
    levels: list[float]
    seasons: tuple[str, ...]
    notes: tuple[str, ...] = ()


def prepared(
    place: Place, settings: PageSettings, weather: Weather, progress: Progress
) -> tuple[RenderSession, list[PageView], list[float]]:
    """Return a session with gauge and figure in it, its views, and the water levels.

    Args:
        place: the fitted place.
        settings: what the page shows.
        weather: what all pictures have in common, without water.
        progress: called with what is prepared and the fraction that is done.

    Raises:
        UserError: an unknown photo, a level outside the scene, or views without ground.
    """
    scene, datum = place.scene, place.scene.ground_z
    views = page_views(scene, settings.views, settings.view_count, settings.size)
    eyes = np.stack([view.c2w[:3, 3] for view in views])

    def session_of(shown: RadianceField) -> RenderSession:
        given = shown, scene, weather, eyes
        return RenderSession(*given, kept=place.kept, style=place.style)

    bare = session_of(place.field)
    grounds = []
    for count, view in enumerate(views):
        progress("ground", count / len(views))
        grounds.append(find_ground(bare, view))
    progress("ground", 1.0)
    levels = water_levels(settings.levels, grounds, views, datum)
    if not settings.objects:
        return bare, views, levels
    objects = placed_objects(views, grounds, datum, levels[-1])
    light = scene_irradiance(place.field, scene)
    return session_of(with_objects(place.field, objects, light)), views, levels


def page_pictures(
    place: Place, settings: PageSettings, weather: Weather, progress: Progress
) -> PagePictures:
    """Render all pictures of a page; arguments and errors as in `prepared`."""
    session, views, levels = prepared(place, settings, weather, progress)
    seasons, notes = _seasons(session, settings, weather)
    if settings.objects and not isinstance(session.field, PlacedField):
        notes = (*notes, "no staff gauge and figure: the views show no free, level ground nearby")
    steps = [
        ("dry", weather),
        *(("water", under_water(weather, level)) for level in levels),
        *(("snow", weather.with_value("snow.depth", depth)) for depth in settings.snow_depths),
        *(("smog", _smoggy(weather, far)) for far in settings.visibilities),
        *(("seasons", weather.with_value("season.kind", kind)) for kind in seasons),
    ]
    pictures: list[ViewPictures] = []

    def water_at(level: float) -> Weather:
        return under_water(weather, level)

    for count, (kind, here) in enumerate(steps):
        session.change(here)
        for number, view in enumerate(views):
            progress("pictures", (count + number / len(views)) / len(steps))
            frame = session.frame(view.camera, view.c2w)
            if kind == "dry":
                heights = _heights(view, frame.layers["depth"], place.scene.ground_z)
                flooding = flooding_levels(session, view, heights, water_at, levels[-1])
                pictures.append(ViewPictures(view, frame.picture, heights, flooding))
                session.change(here)
            else:
                getattr(pictures[number], kind).append(frame.picture)
    progress("pictures", 1.0)
    return PagePictures(pictures, levels, seasons, notes)


def _heights(
    view: PageView, depth: Float[np.ndarray, "h w"], datum: float
) -> Float[np.ndarray, "h w"]:
    x = positions(view.camera, view.c2w, depth.astype(float))
    down = (view.camera.directions() @ view.c2w[:3, :3].T)[..., 2] < 0
    return np.where(np.isinf(depth) & down, -np.inf, x[..., 2] - datum)


def under_water(weather: Weather, level: float) -> Weather:
    """Return weather with level, windless water; the page knows where it is wet by the level."""
    flood = replace(weather.flood, level=level, wind_speed=0.0, wet_band=0.0)
    return weather.with_value("flood", flood)


def _smoggy(weather: Weather, visibility: float) -> Weather:
    smog = replace(weather.smog, visibility=visibility, sigma=None)
    return weather.with_value("smog", smog)


def _seasons(
    session: RenderSession, settings: PageSettings, weather: Weather
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the seasons that the place can be shown in, and a note where it cannot."""
    for kind in settings.seasons:
        try:
            session.change(weather.with_value("season.kind", kind))
        except UserError as error:
            return (), (f"no seasons: {error}",)
    return settings.seasons, ()
