"""The HTML document of a page: data, style and script in one file that requests nothing."""

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from climatenerf.output.contact_sheet import labelled_grid
from climatenerf.page.encoding import DIFFERENCE_STEP, STEP, height_text, picture_text
from climatenerf.page.languages import LANGUAGES
from climatenerf.page.pictures import PagePictures, ViewPictures
from climatenerf.page.settings import PageSettings


def page_data(
    pictures: PagePictures, settings: PageSettings, title: str, scale_error: float
) -> dict[str, Any]:
    """Return what the script of a page reads.

    Args:
        pictures: of all views.
        settings: texts and steps.
        title: of the page.
        scale_error: relative standard error of the scene's scale.
    """
    return {
        "title": title,
        "source": settings.source,
        "scenario": settings.scenario,
        "datum": settings.datum,
        "levels": pictures.levels,
        "lowest": _lowest(pictures),
        "scale_error": scale_error,
        "level_error": settings.level_error,
        "step": STEP,
        "difference_step": DIFFERENCE_STEP,
        "snow": list(settings.snow_depths),
        "smog": list(settings.visibilities),
        "seasons": list(pictures.seasons),
        "language": settings.language,
        "words": LANGUAGES[settings.language],
        "views": [_view(each) for each in pictures.views],
    }


def _lowest(pictures: PagePictures) -> float:
    """Level from which the slider begins, m: that of the lowest ground, within a metre."""
    first = pictures.levels[0]
    heights = [each.heights[np.isfinite(each.heights)] for each in pictures.views]
    lowest = float(np.quantile(np.concatenate([*heights, [first]]), 0.002))
    return round(min(max(lowest, first - 1.0), first - 0.05), 2)


def _view(each: ViewPictures) -> dict[str, Any]:
    low, heights = height_text(each.heights, each.flooding)
    return {
        "name": each.view.name,
        "size": [each.view.camera.width, each.view.camera.height],
        "low": low,
        "heights": heights,
        "dry": picture_text(each.dry),
        "water": [picture_text(one) for one in each.water],
        "snow": [picture_text(one) for one in each.snow],
        "smog": [picture_text(one) for one in each.smog],
        "seasons": [picture_text(one) for one in each.seasons],
    }


def document(data: Mapping[str, Any], still: str) -> bytes:
    """Return the page.

    Args:
        data: from `page_data`.
        still: WebP in base64, shown where scripts are not allowed.
    """
    assets = resources.files("climatenerf") / "assets" / "page"
    style, script = ((assets / f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    # Escape "<": a title "</script>" must not end the script.
    listed = json.dumps(data, ensure_ascii=True, separators=(",", ":")).replace("<", "\\u003c")
    policy = (
        f"default-src 'none'; script-src {source_of(script)}; style-src {source_of(style)};"
        " img-src data: blob:"
    )
    words = data["words"]
    texts = {
        "policy": policy,
        "style": style,
        "title": html.escape(data["title"]),
        "language": html.escape(data["language"]),
        "no_script": html.escape(words["no_script"]),
        "still": still,
        "still_text": html.escape(f"{data['title']}: {words['before']}, {words['after']}"),
        "script": script,
        "data": listed,
    }
    text = (assets / "page.html").read_text("utf-8")
    # In one pass: a title may hold what looks like a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], text).encode()


def still_text(pictures: PagePictures, words: Mapping[str, str], title: str) -> str:
    """Return a picture of the first view, dry and under water, for readers without scripts."""
    first = pictures.views[0]
    middle = len(first.water) // 2
    level = words["metres"].replace("{}", f"{pictures.levels[middle]:.2f}")
    label = f"{words['level']}: {level}, {words['simulation']}"
    shown: Sequence[tuple[str, np.ndarray]] = [(title, first.dry), (label, first.water[middle])]
    return picture_text(labelled_grid(shown, 2, 480), 70)


def source_of(text: str) -> str:
    """Return the hash by which a content security policy allows a script or style of a page."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
