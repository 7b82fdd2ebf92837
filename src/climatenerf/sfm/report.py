"""Report of a capture: a plot of cameras and points, and a text with photos to retake."""

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

PANEL = 640  # side of a plot, pixels
GROUND_RADIUS = 5.0  # camera heights around the path within which ground coverage is measured
MIN_VIEWS = 3  # pictures that should show each point of the ground


def write_report(
    folder: Path, scene: Scene, imported: PhotoImport, model: Model, unposed: list[Unposed]
) -> tuple[Path, Path]:
    """Write `report.md` and `report.png` into the scene folder and return their paths."""
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
    """Return the report in Markdown.

    Args:
        scene: the scene.
        imported: all imported pictures.
        model: result of structure from motion.
        unposed: pictures without pose.
        ground: fraction of the ground that is covered, see `ground_coverage`.
        sky: fraction of the sky that is covered, see `sky_coverage`.
    """
    error = model.reprojection_error
    lines = [
        "# Capture",
        "",
        "![Cameras (red) and points, from above and from the side](report.png)",
        "",
        f"- Pictures with poses: {len(model.registered)} of {len(model.registered) + len(unposed)}",
        f"- Reprojection error: {'unknown' if error is None else f'{error:.2f} px'};"
        f" {model.points} points",
        f"- Ground within {GROUND_RADIUS:g} camera heights of the path in view of {MIN_VIEWS} or"
        f" more pictures: {ground:.0%}",
        f"- Sky (more than 10 degrees above the horizon) in view of any picture: {sky:.0%}",
        f"- Up from {scene.up_report.get('used', '?')}; {scale_summary(scene)}; lowest ground"
        f" {scene.lowest_ground_z - scene.ground_z:+.2f} m from the datum",
    ]
    angles = {k: v for k, v in scene.up_report.items() if isinstance(v, int | float)}
    if angles:
        listed = ", ".join(f"{name} {angle:.1f}" for name, angle in angles.items())
        lines.append(f"- Degrees between the up direction used and that of each method: {listed}")
    gps = scene.georeference
    if gps:
        lines.append(
            f"- GPS of {gps['photos']} photos: x east, y north; the origin is at"
            f" {gps['latitude']:.6f}, {gps['longitude']:.6f} degrees; photos are"
            f" {gps['spread_m']:.2f} m from their GPS positions"
        )
    for kind in ("label", "mask", "depth"):
        count = sum(getattr(view, f"{kind}_path") is not None for view in scene.views)
        if count:
            lines.append(f"- Pictures with {kind} files: {count}")
    if len(model.groups) > 1:
        lines.append(f"- Unconnected groups of pictures: {', '.join(map(str, model.groups))}")
    if unposed or imported.unusable:
        source = {picture.name: picture.source for picture in imported.pictures}
        head = ("picture", "probable cause", "what to do", "best neighbours (matches)")
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
    """Return the fraction of the ground around the camera path in view of `MIN_VIEWS` pictures.

    Only the frustums count: occlusion is ignored.
    """
    poses = np.stack([scene.c2w_world(view) for view in scene.views])
    positions = poses[:, :3, 3]
    height = max(float(np.median(positions[:, 2])) - scene.ground_z, 1e-3)
    radius = GROUND_RADIUS * height
    lower, upper = positions[:, :2].min(0) - radius, positions[:, :2].max(0) + radius
    axes = [np.linspace(lower[i], upper[i], 40) for i in range(2)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    near = (np.linalg.norm(grid[:, None] - positions[None, :, :2], axis=-1) < radius).any(1)
    ground = np.concatenate([grid[near], np.full((int(near.sum()), 1), scene.ground_z)], axis=1)
    views = np.zeros(len(ground), int)
    for view, pose in zip(scene.views, poses, strict=True):
        views += _in_frame(scene, view.camera, (ground - pose[:3, 3]) @ pose[:3, :3])
    return float((views >= MIN_VIEWS).mean())


def sky_coverage(scene: Scene) -> float:
    """Return the fraction of the sky above an elevation of 10 degrees in view of any picture."""
    count = 2000
    z = math.sin(math.radians(10)) + (np.arange(count) + 0.5) / count * (
        1 - math.sin(math.radians(10))
    )
    azimuth = np.arange(count) * math.pi * (3 - math.sqrt(5))  # Fibonacci lattice: equal areas
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    visible = np.zeros(count, bool)
    for view in scene.views:
        visible |= _in_frame(scene, view.camera, directions @ scene.c2w_world(view)[:3, :3])
    return float(visible.mean())


def _in_frame(scene: Scene, camera: int, local: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Return True for points or directions in the camera frame that lie in the picture."""
    lens = scene.cameras[camera]
    ahead = local[:, 2] > 0.05 * np.linalg.norm(local, axis=-1)
    pixel = lens.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
    inside = (pixel >= 0).all(-1) & (pixel[:, 0] < lens.width) & (pixel[:, 1] < lens.height)
    return ahead & inside


def draw_report(scene: Scene) -> Image.Image:
    """Plot cameras and points from above and from the side, each with a metric grid."""
    poses = np.stack([scene.c2w_world(view) for view in scene.views])
    points = scene.points_world()
    points = np.empty((0, 3)) if points is None else points
    centre = np.median(poses[:, :3, 3], axis=0)
    spread = np.linalg.norm(poses[:, :3, 3] - centre, axis=-1).max()
    if len(points):  # 70 % of the points: outliers must not set the scale
        spread = max(spread, float(np.quantile(np.linalg.norm(points - centre, axis=-1), 0.7)))
    half = 1.15 * max(spread, 1e-3)
    # The side view looks across the main horizontal direction of the path.
    offsets = poses[:, :2, 3] - centre[:2]
    if len(offsets) > 1:
        along = np.linalg.svd(offsets, full_matrices=False)[2][0]
    else:
        along = np.array([1, 0])
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
    """Plot cameras and points projected on two axes; `half` is half the side of the plot, m."""
    image = Image.new("RGB", (PANEL, PANEL), "white")
    draw = ImageDraw.Draw(image)

    def to_pixels(x: Float[np.ndarray, "*n 3"]) -> np.ndarray:
        uv = (x - centre) @ axes.T / half
        return np.stack([PANEL / 2 * (1 + uv[..., 0]), PANEL / 2 * (1 - uv[..., 1])], axis=-1)

    step = 10.0 ** math.floor(math.log10(half))
    for k in range(-10, 11):
        offset = PANEL / 2 * (1 + k * step / half)
        draw.line([(offset, 0), (offset, PANEL)], fill=(235, 235, 235))
        draw.line([(0, offset), (PANEL, offset)], fill=(235, 235, 235))
    for x, y in to_pixels(points):
        if 0 <= x < PANEL and 0 <= y < PANEL:
            draw.point((x, y), fill=(90, 110, 150))
    font = ImageFont.load_default(15)
    for number, pose in enumerate(poses):
        position = to_pixels(pose[:3, 3])
        ahead = to_pixels(pose[:3, 3] + 0.06 * half * pose[:3, 2])
        draw.line([tuple(position), tuple(ahead)], fill=(200, 40, 30), width=2)
        draw.ellipse([*(position - 3), *(position + 3)], fill=(200, 40, 30))
        if number % max(1, len(poses) // 8) == 0:
            draw.text(tuple(position + 5), str(number + 1), fill=(120, 20, 10), font=font)
    caption = f"{title}; grid {step:g} m; cameras red, numbered by name"
    draw.rectangle([0, 0, PANEL, 26], fill="white")
    draw.text((8, 5), caption, fill=(0, 0, 0), font=font)
    return image
