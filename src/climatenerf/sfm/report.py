"""The capture's report: a picture of cameras and points, and a text of what to re-shoot."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from climatenerf.core.storage import atomic_path, write_bytes
from climatenerf.scene.alignment.scale import scale_summary
from climatenerf.scene.scene import Scene
from climatenerf.sfm.diagnose import Unposed
from climatenerf.sfm.photo_import import PhotoImport
from climatenerf.sfm.reconstruct import Model

PANEL = 640  # pixels
GROUND_REACH = 5.0  # camera heights around the path in which ground is asked for
MIN_VIEWS = 3  # pictures that should show a piece of ground


def write_report(
    folder: Path, scene: Scene, imported: PhotoImport, model: Model, unposed: list[Unposed]
) -> tuple[Path, Path]:
    """Writes `report.md` and `report.png` into the scene folder; returns their paths."""
    text, picture = folder / "report.md", folder / "report.png"
    ground, sky = ground_coverage(scene), sky_coverage(scene)
    write_bytes(text, report_text(scene, imported, model, unposed, ground, sky).encode())
    with atomic_path(picture) as temporary:
        draw_report(scene).save(temporary, format="PNG")
    return text, picture


def report_text(
    scene: Scene,
    imported: PhotoImport,
    model: Model,
    unposed: list[Unposed],
    ground: float,
    sky: float,
) -> str:
    """What a user wants to know before fitting, in Markdown."""
    error = model.reprojection_error
    lines = [
        "# Capture",
        "",
        "![Cameras (red) and points, from above and from the side](report.png)",
        "",
        f"- Pictures with poses: {len(model.registered)} of {len(model.registered) + len(unposed)}",
        f"- Reprojection error: {'not known' if error is None else f'{error:.2f} px'};"
        f" {model.points} points",
        f"- Ground within {GROUND_REACH:g} camera heights of the path that {MIN_VIEWS} pictures"
        f" or more look at: {ground:.0%}",
        f"- Sky (directions more than 10 degrees up) that any picture looks at: {sky:.0%}",
        f"- Up from {scene.up_report.get('used', '?')}; {scale_summary(scene)}; lowest ground"
        f" {scene.lowest_ground_z - scene.ground_z:+.2f} m from the datum",
    ]
    angles = {k: v for k, v in scene.up_report.items() if isinstance(v, int | float)}
    if angles:
        told = ", ".join(f"{name} {angle:.1f}" for name, angle in angles.items())
        lines.append(f"- Degrees between the up that is used and each method's: {told}")
    place = scene.georeference
    if place:
        lines.append(
            f"- GPS of {place['photos']} photos: x east, y north; the origin is at"
            f" {place['latitude']:.6f}, {place['longitude']:.6f} degrees; photos are"
            f" {place['spread_m']:.2f} m from their GPS places"
        )
    for kind in ("label", "mask", "depth"):
        count = sum(getattr(view, f"{kind}_path") is not None for view in scene.views)
        if count:
            lines.append(f"- Pictures with {kind} files: {count}")
    if len(model.groups) > 1:
        lines.append(f"- Groups that do not fit together: {', '.join(map(str, model.groups))}")
    if unposed or imported.unusable:
        source = {picture.name: picture.source for picture in imported.pictures}
        head = ("picture", "probable reason", "what to do", "fits best (matches)")
        lines += ["", "## Without pose", "", _row(*head), _row(*["---"] * 4)]
        for one in unposed:
            near = ", ".join(f"{source.get(n, n)} ({count})" for n, count in one.neighbours)
            lines.append(_row(one.source, one.reason, one.remedy, near or "none"))
        lines += [_row(name, why, "replace it", "") for name, why in imported.unusable.items()]
    if scene.warnings:
        lines += ["", "## Warnings", ""] + [f"- {warning}" for warning in scene.warnings]
    return "\n".join(lines) + "\n"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def ground_coverage(scene: Scene) -> float:
    """Share of the ground around the camera path that `MIN_VIEWS` pictures look at.

    By the pictures' frames alone: what stands in the way is not asked for.
    """
    poses = np.stack([scene.c2w_world(view) for view in scene.views])
    eyes = poses[:, :3, 3]
    height = max(float(np.median(eyes[:, 2])) - scene.ground_z, 1e-3)
    reach = GROUND_REACH * height
    lower, upper = eyes[:, :2].min(0) - reach, eyes[:, :2].max(0) + reach
    axes = [np.linspace(lower[i], upper[i], 40) for i in range(2)]
    flat = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    near = (np.linalg.norm(flat[:, None] - eyes[None, :, :2], axis=-1) < reach).any(1)
    places = np.concatenate([flat[near], np.full((int(near.sum()), 1), scene.ground_z)], axis=1)
    seen = np.zeros(len(places), int)
    for view, pose in zip(scene.views, poses, strict=True):
        seen += _in_frame(scene, view.camera, (places - pose[:3, 3]) @ pose[:3, :3])
    return float((seen >= MIN_VIEWS).mean())


def sky_coverage(scene: Scene) -> float:
    """Share of the directions more than 10 degrees above the horizon that a picture shows."""
    count = 2000
    z = math.sin(math.radians(10)) + (np.arange(count) + 0.5) / count * (
        1 - math.sin(math.radians(10))
    )
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)
    seen = np.zeros(count, bool)
    for view in scene.views:
        seen |= _in_frame(scene, view.camera, directions @ scene.c2w_world(view)[:3, :3])
    return float(seen.mean())


def _in_frame(scene: Scene, camera: int, local: Float[np.ndarray, "n 3"]) -> np.ndarray:
    lens = scene.cameras[camera]
    ahead = local[:, 2] > 0.05 * np.linalg.norm(local, axis=-1)
    pixel = lens.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
    inside = (pixel >= 0).all(-1) & (pixel[:, 0] < lens.width) & (pixel[:, 1] < lens.height)
    return ahead & inside


def draw_report(scene: Scene) -> Image.Image:
    """Cameras and points from above and from the side, one metre grid each."""
    poses = np.stack([scene.c2w_world(view) for view in scene.views])
    points = scene.points_world()
    points = np.empty((0, 3)) if points is None else points
    centre = np.median(poses[:, :3, 3], axis=0)
    spread = np.linalg.norm(poses[:, :3, 3] - centre, axis=-1).max()
    if len(points):  # most of the points, not the stray ones
        spread = max(spread, float(np.quantile(np.linalg.norm(points - centre, axis=-1), 0.7)))
    half = 1.15 * max(spread, 1e-3)
    # From the side means across the path's longer horizontal direction.
    flat = poses[:, :2, 3] - centre[:2]
    along = np.linalg.svd(flat, full_matrices=False)[2][0] if len(flat) > 1 else np.array([1, 0])
    side = np.array([along[0], along[1], 0.0])
    above = "from above, north up" if scene.georeference else "from above"
    panels = [
        _panel(above, np.array([[1.0, 0, 0], [0, 1.0, 0]]), poses, points, centre, half),
        _panel("from the side", np.stack([side, [0, 0, 1.0]]), poses, points, centre, half),
    ]
    sheet = Image.new("RGB", (2 * PANEL, PANEL), "white")
    for i, panel in enumerate(panels):
        sheet.paste(panel, (i * PANEL, 0))
    return sheet


def _panel(
    title: str,
    axes: Float[np.ndarray, "2 3"],
    poses: Float[np.ndarray, "n 4 4"],
    points: Float[np.ndarray, "m 3"],
    centre: Float[np.ndarray, "3"],
    half: float,
) -> Image.Image:
    image = Image.new("RGB", (PANEL, PANEL), "white")
    draw = ImageDraw.Draw(image)

    def place(x: Float[np.ndarray, "*n 3"]) -> np.ndarray:
        flat = (x - centre) @ axes.T / half
        return np.stack([PANEL / 2 * (1 + flat[..., 0]), PANEL / 2 * (1 - flat[..., 1])], axis=-1)

    step = 10.0 ** math.floor(math.log10(half))
    for k in range(-10, 11):
        offset = PANEL / 2 * (1 + k * step / half)
        draw.line([(offset, 0), (offset, PANEL)], fill=(235, 235, 235))
        draw.line([(0, offset), (PANEL, offset)], fill=(235, 235, 235))
    for x, y in place(points):
        if 0 <= x < PANEL and 0 <= y < PANEL:
            draw.point((x, y), fill=(90, 110, 150))
    font = ImageFont.load_default(15)
    for number, pose in enumerate(poses):
        eye, ahead = place(pose[:3, 3]), place(pose[:3, 3] + 0.06 * half * pose[:3, 2])
        draw.line([tuple(eye), tuple(ahead)], fill=(200, 40, 30), width=2)
        draw.ellipse([*(eye - 3), *(eye + 3)], fill=(200, 40, 30))
        if number % max(1, len(poses) // 8) == 0:
            draw.text(tuple(eye + 5), str(number + 1), fill=(120, 20, 10), font=font)
    words = f"{title}; a square is {step:g} m; cameras red, numbered in the order of their names"
    draw.rectangle([0, 0, PANEL, 26], fill="white")
    draw.text((8, 5), words, fill=(0, 0, 0), font=font)
    return image
