"""The report of a run: one HTML file with what a user should know of a fit."""

import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from climatenerf.core.storage import write_bytes
from climatenerf.field.capabilities import CLASSES
from climatenerf.page.document import source_of
from climatenerf.page.drawings import (
    COMPLETED,
    OPEN,
    SEEN,
    bar_chart,
    class_legend,
    coverage_picture,
    label_picture,
)
from climatenerf.page.encoding import picture_text
from climatenerf.page.weak_points import Evidence, WeakPoint, percent, weak_points
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.session import RenderSession
from climatenerf.scene import Scene, View
from climatenerf.scene.images import load_image
from climatenerf.scene.terrain import Terrain
from climatenerf.studies.geometry_ablation import depth_picture, normal_picture
from climatenerf.studies.shot import Place
from climatenerf.weather.light.captured import CapturedLight
from climatenerf.weather.light.file import light_of_photos_in
from climatenerf.weather.weather import Weather

NEAR = 10.0  # m around the cameras, of the ground that is judged
SHOWN = 5  # held-out photos with pictures
WIDTH = 360  # pixels, of each picture

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Row:
    """Pictures of one photo: the photo, and the field from the same camera."""

    name: str
    split: str
    psnr: float | None
    pictures: list[tuple[str, UInt8[np.ndarray, "h w 3"]]]


def write_report(
    place: Place,
    terrain: Terrain | None,
    metrics: Mapping[str, Any],
    out: Path,
    title: str,
    progress: Progress | None = None,
) -> list[WeakPoint]:
    """Write the report of a fitted place, and return its weak points.

    Args:
        place: field, scene, and where its light is kept.
        terrain: its ground; None if the photos show too little of it.
        metrics: of the fit, from `metrics.json`.
        out: HTML file.
        title: of the report.
        progress: called with what is computed and the fraction that is done.

    Raises:
        UserError: a photo cannot be read, or the file cannot be written.
    """
    report = progress or (lambda what, fraction: None)
    photos = trace_photos(place.field, place.scene, lambda done: report("photos", done))
    light = light_of_photos_in(place.kept, place.scene, place.field, lambda: photos)
    evidence = Evidence(
        metrics,
        len(place.scene.of_split("train")),
        place.scene.scale_source,
        place.scene.scale_error,
        _ground_seen(terrain, _cameras(place.scene)),
        float(np.mean([np.isinf(photo.t).mean() for photo in photos])),
        isinstance(light, CapturedLight),
        CLASSES in place.field.capabilities,
    )
    points = weak_points(evidence)
    classes = np.bincount(
        np.concatenate([photo.label[np.isfinite(photo.t)] for photo in photos]), minlength=256
    )
    rows = _rows(place, metrics, report)
    sections = [
        _summary(place.scene, metrics, evidence),
        _weak(points),
        _pictures(rows, metrics),
        _ground(place.scene, terrain, evidence),
        _scale(place.scene),
        _geometry(metrics),
        _light(light),
        _classes(classes, evidence),
        _findings(place.scene),
    ]
    write_bytes(out, _document(title, sections))
    return points


# --- what is computed ---------------------------------------------------------------------------


def _cameras(scene: Scene) -> Float[np.ndarray, "n 2"]:
    return np.stack([scene.c2w_world(view)[:2, 3] for view in scene.of_split("train")])


def _ground_seen(terrain: Terrain | None, cameras: Float[np.ndarray, "n 2"]) -> float | None:
    """Fraction of the ground near the cameras that photos show; None where there is none."""
    if terrain is None:
        return None
    near = _near(terrain, cameras) & ~terrain.open
    return float(terrain.seen[near].mean()) if near.any() else None


def _open_ground(terrain: Terrain, cameras: Float[np.ndarray, "n 2"]) -> float:
    """Fraction of the ground near the cameras that is neither held nor completed."""
    return float(terrain.open[_near(terrain, cameras)].mean())


def _near(terrain: Terrain, cameras: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "rows columns"]:
    """Nodes within `NEAR` of a camera."""
    xy = terrain.nodes()[..., :2]
    near = np.zeros(xy.shape[:2], bool)
    for camera in cameras:
        near |= np.linalg.norm(xy - camera, axis=-1) < NEAR
    return near


def _chosen(scene: Scene, metrics: Mapping[str, Any]) -> list[View]:
    """Held-out photos from the worst to the best, evenly; training photos without any."""
    views = scene.of_split("heldout")
    scores = metrics.get("views") or {}
    if views:
        views = sorted(views, key=lambda view: scores.get(view.name, {"psnr": 0.0})["psnr"])
    else:
        views = scene.of_split("train")
    index = np.unique(np.linspace(0, len(views) - 1, SHOWN).round().astype(int))
    return [views[i] for i in index]


def _rows(place: Place, metrics: Mapping[str, Any], report: Progress) -> list[Row]:
    scene, scores = place.scene, metrics.get("views") or {}
    chosen = _chosen(scene, metrics)
    session = RenderSession(place.field, scene, Weather(), style=place.style)
    rows = []
    for count, view in enumerate(chosen):
        report("pictures", count / len(chosen))
        camera = scene.cameras[view.camera]
        size = WIDTH, max(1, round(WIDTH * camera.height / camera.width))
        frame = session.frame(
            camera.resized(*size), scene.c2w_world(view), layers=("normal", "label")
        )
        photo = Image.fromarray(load_image(view, scene)).resize(size, Image.Resampling.LANCZOS)
        pictures = [
            ("photo", np.asarray(photo)),
            ("field", frame.picture),
            ("nearness", _brighter(depth_picture(frame.layers["depth"]))),
            ("normals", normal_picture(frame.layers["normal"])),
        ]
        if "label" in frame.layers:
            pictures.append(("classes", label_picture(frame.layers["label"].astype(np.uint8))))
        psnr = scores.get(view.name, {}).get("psnr")
        rows.append(Row(view.name, view.split, psnr, pictures))
    report("pictures", 1.0)
    return rows


def _brighter(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Square root of a picture: inverse depth of far things is dark."""
    return (255 * np.sqrt(picture / 255.0)).astype(np.uint8)


# --- what is written ----------------------------------------------------------------------------


def _table(rows: list[tuple[str, str]]) -> str:
    cells = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th><td>{html.escape(value)}</td></tr>'
        for name, value in rows
    )
    return f"<table>{cells}</table>"


def _image(picture: UInt8[np.ndarray, "h w 3"], text: str) -> str:
    height, width = picture.shape[:2]
    return (
        f'<img width="{width}" height="{height}" alt="{html.escape(text)}"'
        f' src="data:image/webp;base64,{picture_text(picture)}">'
    )


def _known(value: float | None, text: str) -> str:
    return "not measured" if value is None else text.format(value)


def _summary(scene: Scene, metrics: Mapping[str, Any], given: Evidence) -> str:
    seconds = metrics.get("seconds")
    return "<h2>Summary</h2>" + _table(
        [
            ("photos", f"{given.photos} fitted, {len(scene.of_split('heldout'))} held out"),
            ("read from", scene.source),
            ("fit", f"{metrics.get('steps', '?')} steps, {_known(seconds, '{:.0f} s')}"),
            ("held-out PSNR", _known(metrics.get("psnr"), "{:.1f} dB")),
            ("held-out SSIM", _known(metrics.get("ssim"), "{:.3f}")),
            ("sky in the photos", percent(given.sky)),
        ]
    )


def _weak(points: list[WeakPoint]) -> str:
    if not points:
        text = "<p>Nothing that these measurements find. Look at the pictures all the same.</p>"
    else:
        text = "".join(
            f"<li><b>{html.escape(each.title)}</b>: {html.escape(each.evidence)}."
            f" In weather: {html.escape(each.consequence)}."
            f' <span class="quiet">What helps: {html.escape(each.remedy)}.</span></li>'
            for each in points
        )
        text = f"<ul>{text}</ul>"
    return f"<h2>What weather will look wrong here, and why</h2>{text}"


def _pictures(rows: list[Row], metrics: Mapping[str, Any]) -> str:
    scores = metrics.get("views") or {}
    bars = bar_chart(
        [(name, row["psnr"]) for name, row in sorted(scores.items())], metrics.get("psnr"), "dB"
    )
    parts = ["<h2>Pictures</h2>"]
    if bars:
        parts.append(f"<h3>PSNR of each held-out photo</h3>{bars}")
    for row in rows:
        kind = "held out" if row.split == "heldout" else "fitted"
        score = "" if row.psnr is None else f", {row.psnr:.1f} dB"
        figures = "".join(
            f"<figure>{_image(picture, f'{name} of {row.name}')}<figcaption>{name}</figcaption>"
            "</figure>"
            for name, picture in row.pictures
        )
        title = html.escape(f"{row.name} ({kind}{score})")
        parts.append(f'<h3>{title}</h3><div class="row">{figures}</div>')
    return "".join(parts)


def _ground(scene: Scene, terrain: Terrain | None, given: Evidence) -> str:
    if terrain is None:
        return "<h2>Ground</h2><p>The photos show too little ground for a terrain.</p>"
    cameras = _cameras(scene)
    picture, metres = coverage_picture(terrain, cameras, NEAR)
    legend = "".join(
        f'<li><svg viewBox="0 0 10 10" class="key"><rect width="10" height="10"'
        f' fill="#{bytes(colour).hex()}"/></svg>{text}</li>'
        for colour, text in (
            (SEEN, "seen by photos"),
            (COMPLETED, "completed by the terrain"),
            (OPEN, "no ground found: things stand there, or the photos contradict each other"),
            ((20, 30, 40), "cameras"),
        )
    )
    wide = picture.shape[1] * metres
    seen = "not measured" if given.ground_seen is None else percent(given.ground_seen)
    rows = [
        ("ground within 10 m of the cameras that photos show", seen),
        (
            "of all ground there, neither held nor completed",
            percent(_open_ground(terrain, cameras)),
        ),
        ("median error of its height", f"{100 * float(np.median(terrain.error)):.0f} cm"),
        ("height of the datum", f"{scene.ground_z:.2f} m in the world frame"),
        ("lowest ground near the path", f"{scene.lowest_ground_z - scene.ground_z:.2f} m"),
    ]
    return (
        f"<h2>Ground</h2>{_image(picture, 'map of the ground')}"
        f'<ul class="legend">{legend}</ul><p class="quiet">+y is up; {wide:.0f} m across.</p>'
        + _table(rows)
    )


def _scale(scene: Scene) -> str:
    rows = [
        ("scale from", scene.scale_source.replace("-", " ")),
        ("standard error", percent(scene.scale_error)),
        ("a level of 1 m is right to", f"{100 * scene.scale_error:.0f} cm, by the scale alone"),
    ]
    for name, entry in scene.scale_report.items():
        values = ", ".join(f"{key.replace('_', ' ')} {value:.3g}" for key, value in entry.items())
        rows.append((f"by {name.replace('-', ' ')}", values))
    return "<h2>Scale</h2>" + _table(rows)


def _geometry(metrics: Mapping[str, Any]) -> str:
    reasons = metrics.get("score_reasons") or {}
    names = {
        "neighbours.psnr": ("photos reprojected into their neighbours by depth", "{:.1f} dB"),
        "points.abs_rel": ("depth at sparse points that were not used, relative", "{:.3f}"),
        "ground.present": ("labelled ground that the field holds", "{:.2f}"),
        "ground.roughness_cm": ("roughness of near ground", "{:.1f} cm"),
        "sky.empty": ("sky that is empty", "{:.3f}"),
        "floating.components": ("floating components", "{:.0f}"),
    }
    rows = []
    for name, (title, text) in names.items():
        value = metrics.get(name)
        shown = reasons.get(name, "not measured") if value is None else text.format(value)
        rows.append((title, shown))
    return "<h2>Geometry, without ground truth</h2>" + _table(rows)


def _light(light: object) -> str:
    if not isinstance(light, CapturedLight):
        reason = getattr(light, "reason", "the photos show too little of it")
        return f"<h2>Light</h2><p>Not found: {html.escape(str(reason))}.</p>"
    from climatenerf.weather.light.captured import elevation_azimuth

    if light.sun is None:
        rows = [("sun", "none found: an even sky")]
    else:
        elevation, azimuth = np.degrees(elevation_azimuth(light.sun))
        error = np.degrees(light.sun_error)
        kind = "casts shadows" if light.hard else "behind cloud, or too soft for shadows"
        where = f"{elevation:.0f} deg high at azimuth {azimuth:.0f} deg (± {error:.0f} deg)"
        rows = [("sun", where), ("kind", kind)]
    return "<h2>Light</h2>" + _table(rows)


def _classes(counts: np.ndarray, given: Evidence) -> str:
    if not given.classes:
        return "<h2>Classes</h2><p>The run knows none.</p>"
    total = max(int(counts[: len(class_legend())].sum()), 1)
    rows = "".join(
        f'<li><svg viewBox="0 0 10 10" class="key"><rect width="10" height="10" fill="{colour}"/>'
        f"</svg>{name} {percent(counts[index] / total)}</li>"
        for index, (name, colour) in enumerate(class_legend())
        if counts[index]
    )
    return f'<h2>Classes</h2><p>Of what the photos show:</p><ul class="legend">{rows}</ul>'


def _findings(scene: Scene) -> str:
    if not scene.findings:
        return "<h2>Capture</h2><p>Nothing odd was found when it was read.</p>"
    items = "".join(f"<li>{html.escape(str(each))}</li>" for each in scene.findings)
    return f"<h2>Capture</h2><ul>{items}</ul>"


def _document(title: str, sections: list[str]) -> bytes:
    style = (resources.files("climatenerf") / "assets" / "page" / "report.css").read_text("utf-8")
    policy = f"default-src 'none'; style-src {source_of(style)}; img-src data:"
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{html.escape(title)}</title>
<style>{style}</style>
</head>
<body>
<main>
<h1>{html.escape(title)}</h1>
{"".join(f"<section>{each}</section>" for each in sections)}
</main>
</body>
</html>
""".encode()
