"""Contact sheets: rows of frames with a label each, or a grid of labelled pictures."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from climatenerf.core.errors import UserError
from climatenerf.core.storage import write_bytes

GAP = 4
"""Pixels between the pictures."""


def contact_sheet(
    rows: Sequence[tuple[str, Sequence[UInt8[np.ndarray, "h w 3"]]]],
    columns: int | None = None,
    cell_width: int = 320,
) -> UInt8[np.ndarray, "H W 3"]:
    """Arrange rows of frames in one labelled picture.

    Args:
        rows: label and frames of each row; all frames of one shape.
        columns: maximum number of frames of each row, evenly spaced; None takes all.
        cell_width: width of each frame in the sheet, pixels; frames are never enlarged.

    Returns:
        The sheet, 8-bit RGB.
    """
    if not rows or any(len(frames) == 0 for _, frames in rows):
        raise ValueError("a contact sheet needs at least one frame in every row")
    count = min(columns or 10**9, max(len(frames) for _, frames in rows))
    cells = []
    for r, (label, frames) in enumerate(rows):
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round())
        for c, index in enumerate(chosen.astype(int)):
            cells.append((r, c, label if c == 0 else "", frames[index]))
    return _composed(cells, cell_width)


def labelled_grid(
    pictures: Sequence[tuple[str, UInt8[np.ndarray, "h w 3"]]],
    columns: int,
    cell_width: int = 320,
) -> UInt8[np.ndarray, "H W 3"]:
    """Arrange pictures row by row in one picture, each with a label of its own.

    Args:
        pictures: label and picture, all of one shape.
        columns: pictures in a row.
        cell_width: as in `contact_sheet`.

    Returns:
        The grid, 8-bit RGB.
    """
    if not pictures:
        raise ValueError("a grid needs at least one picture")
    cells = [(i // columns, i % columns, *each) for i, each in enumerate(pictures)]
    return _composed(cells, cell_width)


def _composed(
    cells: Sequence[tuple[int, int, str, UInt8[np.ndarray, "h w 3"]]], cell_width: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Paste pictures at their row and column on white, with their labels where there are any."""
    height, width = cells[0][3].shape[:2]
    cell = (min(cell_width, width), max(1, round(height * min(cell_width, width) / width)))
    rows, columns = 1 + max(r for r, *_ in cells), 1 + max(c for _, c, *_ in cells)
    size = (columns * (cell[0] + GAP) + GAP, rows * (cell[1] + GAP) + GAP)
    sheet = Image.new("RGB", size, (255, 255, 255))
    font = ImageFont.load_default(size=max(10, cell[1] // 14))
    for r, c, label, pixels in cells:
        picture = Image.fromarray(np.ascontiguousarray(pixels))
        corner = (GAP + c * (cell[0] + GAP), GAP + r * (cell[1] + GAP))
        sheet.paste(picture.resize(cell, Image.Resampling.LANCZOS), corner)
        if label:
            _label(ImageDraw.Draw(sheet), corner, label, font)
    return np.asarray(sheet)


def write_jpeg(
    path: Path | str, picture: UInt8[np.ndarray, "h w 3"], max_bytes: int | None = None
) -> int:
    """Write a JPEG, marked as simulated, with the best quality that the size limit allows.

    Quality is lowered from 90 to 60 first; then the picture is reduced.

    Args:
        path: the file.
        picture: 8-bit RGB.
        max_bytes: maximum size of the file, or None.

    Returns:
        Size of the file, bytes.

    Raises:
        UserError: the limit cannot be met, or the file cannot be written.
    """
    image = Image.fromarray(np.ascontiguousarray(picture))
    while min(image.size) >= 16:
        for quality in (90, 82, 74, 66, 60):
            buffer = io.BytesIO()
            image.save(buffer, "JPEG", quality=quality, optimize=True, comment=b"simulated")
            if max_bytes is None or buffer.tell() <= max_bytes:
                write_bytes(path, buffer.getvalue())
                return buffer.tell()
        image = image.resize(
            (round(image.width * 0.8), round(image.height * 0.8)), Image.Resampling.LANCZOS
        )
    raise UserError(f"{path} does not fit into {max_bytes} bytes; allow a larger file")


def _label(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    text: str,
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
) -> None:
    left, top, right, bottom = draw.textbbox((corner[0] + 6, corner[1] + 4), text, font=font)
    draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill=(0, 0, 0))
    draw.text((corner[0] + 6, corner[1] + 4), text, font=font, fill=(255, 255, 255))
