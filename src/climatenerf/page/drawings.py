"""Plots of a report: inline SVG, and pictures of measured layers."""

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.classes import CLASS_NAMES, UNKNOWN
from climatenerf.scene.terrain import Terrain

CLASS_COLOURS = np.full((256, 3), 150, np.uint8)
CLASS_COLOURS[:7] = [
    (128, 64, 128),
    (110, 110, 120),
    (70, 125, 45),
    (150, 220, 140),
    (120, 180, 230),
    (220, 60, 80),
    (40, 60, 190),
]
CLASS_COLOURS[UNKNOWN] = (255, 255, 255)
SEEN, COMPLETED, NOTHING = (150, 190, 150), (240, 205, 120), (255, 255, 255)
OPEN = (215, 110, 100)
MAP_SIDE = 640  # pixels at most


def bar_chart(rows: Sequence[tuple[str, float]], mean: float | None, unit: str) -> str:
    """Return horizontal bars as SVG, one a row, with a line at the mean."""
    if not rows:
        return ""
    wide, step, left = 640, 22, 170
    tall = step * len(rows) + 26
    low = min(value for _, value in rows)
    low = np.floor(min(low, mean or low) / 5) * 5 - 5
    high = np.ceil(max(value for _, value in rows) / 5) * 5
    scale = (wide - left - 60) / max(high - low, 1e-6)  # 1e-6: 0/0 for equal values
    parts = [
        f'<svg viewBox="0 0 {wide} {tall}" role="img" class="chart">'
        f"<title>{html.escape(unit)} of each photo</title>"
    ]
    for index, (name, value) in enumerate(rows):
        y = index * step + 4
        length = max((value - low) * scale, 1.0)
        parts.append(
            f'<text x="{left - 6}" y="{y + 13}" text-anchor="end">{html.escape(name)}</text>'
            f'<rect x="{left}" y="{y}" width="{length:.1f}" height="{step - 6}"/>'
            f'<text x="{left + length + 5:.1f}" y="{y + 13}">{value:.1f}</text>'
        )
    if mean is not None:
        x = left + (mean - low) * scale
        parts.append(
            f'<line x1="{x:.1f}" y1="0" x2="{x:.1f}" y2="{tall - 20}" class="mean"/>'
            f'<text x="{x:.1f}" y="{tall - 5}" text-anchor="middle">mean {mean:.1f}'
            f" {html.escape(unit)}</text>"
        )
    parts.append("</svg>")
    return "".join(parts)


def coverage_picture(
    terrain: Terrain, cameras: Float[np.ndarray, "n 2"], radius: float
) -> tuple[UInt8[np.ndarray, "h w 3"], float]:
    """Return a map of the ground around the cameras, +y up, and its metres per pixel.

    Args:
        terrain: of the run.
        cameras: their horizontal positions, world m.
        radius: metres around the cameras that the map shows.
    """
    low = np.maximum(cameras.min(0) - radius, np.array(terrain.origin))
    rows, columns = terrain.height.shape
    far = np.array(terrain.origin) + terrain.cell * np.array([columns - 1, rows - 1])
    high = np.minimum(cameras.max(0) + radius, far)
    metres = max(float((high - low).max()) / MAP_SIDE, terrain.cell / 8)
    width, height = np.maximum(np.ceil((high - low) / metres).astype(int), 1)
    x = low[0] + metres * (np.arange(width) + 0.5)
    y = high[1] - metres * (np.arange(height) + 0.5)
    column = np.clip(np.rint((x - terrain.origin[0]) / terrain.cell).astype(int), 0, columns - 1)
    row = np.clip(np.rint((y - terrain.origin[1]) / terrain.cell).astype(int), 0, rows - 1)
    nodes = np.full((rows, columns, 3), COMPLETED, np.uint8)
    nodes[terrain.seen], nodes[terrain.open] = SEEN, OPEN
    slope = np.gradient(terrain.height.astype(float), terrain.cell)
    shade = np.clip(1 - 0.6 * (slope[0] - slope[1]), 0.6, 1.2)[..., None]
    picture = np.clip(nodes * shade, 0, 255).astype(np.uint8)[np.ix_(row, column)]
    for at in cameras:
        i, j = int((high[1] - at[1]) / metres), int((at[0] - low[0]) / metres)
        picture[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3] = (20, 30, 40)
    return picture, metres


def label_picture(label: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return classes as colours."""
    return CLASS_COLOURS[label]


def class_legend() -> list[tuple[str, str]]:
    """Return name and CSS colour of each class."""
    return [
        (name, "#" + bytes(CLASS_COLOURS[index]).hex()) for index, name in enumerate(CLASS_NAMES)
    ]
