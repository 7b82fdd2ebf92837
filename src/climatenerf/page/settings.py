"""What a user can ask of a page. Does not import torch."""

from dataclasses import dataclass

MAX_VIEWS = 24
MAX_STEPS = 20


@dataclass(frozen=True)
class PageSettings:
    """Contents of a page.

    Attributes:
        title: shown above the picture and in it; "" takes the name of the capture.
        source: who took the photos or made the page, shown in the picture; may be empty.
        scenario: what the water levels mean, shown in the picture; may be empty.
        datum: name of the height at which level 0 lies; "" means the ground at the cameras.
        level_error: standard error of the levels besides that of the scale, m.
        language: key of `languages.LANGUAGES`.
        views: names of photos whose poses the views have; empty chooses `view_count` of them.
        view_count: how many views are chosen.
        size: width and height of the pictures, pixels; None takes the photos', 640 to 960 wide.
        levels: water levels that are rendered, m above the ground datum; empty chooses five.
        snow_depths: m; empty leaves snow out.
        visibilities: of smog, m; empty leaves smog out.
        seasons: names of seasons.
        objects: whether a staff gauge and a figure stand in the scene.
    """

    title: str = ""
    source: str = ""
    scenario: str = ""
    datum: str = ""
    level_error: float = 0.0
    language: str = "en"
    views: tuple[str, ...] = ()
    view_count: int = 6
    size: tuple[int, int] | None = None
    levels: tuple[float, ...] = ()
    snow_depths: tuple[float, ...] = (0.05, 0.15, 0.3)
    visibilities: tuple[float, ...] = (200.0, 80.0, 30.0)
    seasons: tuple[str, ...] = ("autumn", "winter", "drought", "wildfire")
    objects: bool = True
