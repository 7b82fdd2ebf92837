import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.output.contact_sheet import GAP, contact_sheet, labelled_grid, write_jpeg


def frame(grey, width=160, height=90):
    return np.full((height, width, 3), grey, np.uint8)


def test_frames_are_placed_in_rows_and_columns():
    rows = [("clean", [frame(i * 20) for i in range(9)]), ("snow", [frame(200), frame(250)])]
    sheet = contact_sheet(rows, columns=3, cell_width=80)
    assert sheet.shape == (2 * (45 + GAP) + GAP, 3 * (80 + GAP) + GAP, 3)

    def middle(row, column):
        return sheet[GAP + row * (45 + GAP) + 35, GAP + column * (80 + GAP) + 60, 0]

    assert [middle(0, c) for c in range(3)] == [0, 80, 160], "first, middle and last frame"
    assert [middle(1, c) for c in range(3)] == [200, 250, 255], "a short row is not stretched"
    label = sheet[GAP : GAP + 20, GAP : GAP + 40]
    blank = contact_sheet([("", [frame(0)])], cell_width=80)[GAP : GAP + 20, GAP : GAP + 40]
    assert label.max() > 200 and blank.max() == 0, "white on black, and only the label"


def test_small_frames_are_not_enlarged():
    assert contact_sheet([("a", [frame(9, 40, 20)])]).shape == (20 + 2 * GAP, 40 + 2 * GAP, 3)
    with pytest.raises(ValueError, match="every row"):
        contact_sheet([("a", [])])


def test_jpeg_stays_below_its_size_limit(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)
    free = write_jpeg(tmp_path / "a.jpg", noise)
    bound = write_jpeg(tmp_path / "b.jpg", noise, 20_000)
    assert free > 20_000 >= bound == (tmp_path / "b.jpg").stat().st_size
    with Image.open(tmp_path / "b.jpg") as image:
        assert image.info["comment"] == b"simulated"
    with pytest.raises(UserError, match="does not fit"):
        write_jpeg(tmp_path / "c.jpg", noise, 100)
    assert not (tmp_path / "c.jpg").exists()


def test_each_picture_of_a_grid_has_its_own_label():
    grid = labelled_grid([("a", frame(0)), ("", frame(60)), ("c", frame(0))], 2, 80)
    assert grid.shape == (2 * (45 + GAP) + GAP, 2 * (80 + GAP) + GAP, 3)

    def corner(row, column):
        top, left = GAP + row * (45 + GAP), GAP + column * (80 + GAP)
        return grid[top : top + 20, left : left + 40]

    assert corner(0, 0).max() > 200 < corner(1, 0).max(), "white on black"
    assert corner(0, 1).min() == corner(0, 1).max() == 60, "no label"
    assert corner(1, 1).min() == 255, "an empty place is white"
    with pytest.raises(ValueError, match="at least one"):
        labelled_grid([], 2)
