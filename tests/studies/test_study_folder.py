"""Folders of studies: what they write, and what they never overwrite."""

import json

import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.core.storage import write_json
from climatenerf.studies import study_folder as f

ROWS = [
    f.Row("no waves", np.full((20, 30, 3), 90, np.uint8), {"tilt_deg": 0.5}, "a number", False),
    f.Row(
        "full", np.full((20, 30, 3), 40, np.uint8), {"tilt_deg": 0.25, "psnr_db": 30.0}, "", None
    ),
]


def write(out, rows, kind="flood", earlier=()):
    f.write_ablation(out, kind, {"view": "t01.jpg"}, rows, 2, earlier)


def test_an_ablation_has_rows_of_name_picture_and_metrics(tmp_path):
    write(tmp_path, ROWS)
    data = json.loads((tmp_path / "ablation.json").read_text())
    assert data["schema_version"] == 2 and data["study"] == "flood" and data["view"] == "t01.jpg"
    assert [(row["name"], row["picture"]) for row in data["rows"]] == [
        ("no waves", "no-waves.png"), ("full", "full.png"),
    ]  # fmt: skip
    assert data["rows"][1]["metrics"] == {"tilt_deg": 0.25, "psnr_db": 30.0}
    assert [row["shown"] for row in data["rows"]] == [False, None]
    assert {path.name for path in tmp_path.iterdir()} == set(data["files"])
    with Image.open(tmp_path / "no-waves.png") as picture:
        assert np.array_equal(picture, ROWS[0].picture) and "simulated" in picture.info
    with Image.open(tmp_path / "contact-sheet.jpg") as sheet:
        assert sheet.width > 60 and sheet.height < 40, "two in a row"


def test_the_table_has_a_dash_for_what_is_not_known():
    lines = f.table(ROWS).splitlines()
    assert lines[0] == "| row | tilt deg | psnr db |"
    assert lines[2:] == ["| no waves | 0.5 | - |", "| full | 0.25 | 30 |"]
    assert f.findings(ROWS) == "- no waves: a number: NOT SHOWN"


def test_a_study_replaces_an_earlier_one_of_its_kind_and_no_other_file(tmp_path):
    names = f.ablation_files(["no waves", "full"])
    assert f.check_folder(tmp_path / "new", f.ABLATION, "flood", names) == set()
    assert not (tmp_path / "new").exists(), "the check leaves no folder"
    write(tmp_path, ROWS)
    earlier = f.check_folder(tmp_path, f.ABLATION, "flood", names)
    assert earlier == set(names)
    with pytest.raises(UserError, match="of another study than snow"):
        f.check_folder(tmp_path, f.ABLATION, "snow", f.ablation_files(["full"]))
    (tmp_path / "diffuse.png").write_bytes(b"mine")
    with pytest.raises(UserError, match="diffuse.png would be overwritten"):
        f.check_folder(tmp_path, f.ABLATION, "flood", f.ablation_files(["diffuse"]))
    write(tmp_path, ROWS[1:], earlier=earlier)
    assert not (tmp_path / "no-waves.png").exists() and (tmp_path / "full.png").exists()
    assert (tmp_path / "diffuse.png").read_bytes() == b"mine"


def test_a_damaged_index_names_no_files_elsewhere(tmp_path):
    out = tmp_path / "out"
    victim, folder = tmp_path / "victim.png", out / "runs"
    folder.mkdir(parents=True)
    victim.write_bytes(b"mine")
    for files in (["../victim.png", str(victim), "runs", ".hidden.png", 3], "full.png", None):
        write_json(out / f.ABLATION, {"study": "flood", "files": files})
        earlier = f.check_folder(out, f.ABLATION, "flood", [f.ABLATION])
        assert earlier == {f.ABLATION}
        f.remove_left_over(out, earlier | {"runs"}, [f.ABLATION])
    assert victim.exists() and folder.is_dir()


def test_the_first_ablations_are_those_of_geometry(tmp_path):
    """Schema 1 had a table by name, and neither kind nor list of files."""
    write_json(tmp_path / f.ABLATION, {"schema_version": 1, "minutes": 4.0, "rows": {"full": []}})
    (tmp_path / "ablation.jpg").write_bytes(b"old")
    earlier = f.check_folder(tmp_path, f.ABLATION, "geometry", f.ablation_files(["full"], ".jpg"))
    assert earlier == {"ablation.json", "ablation.md", "ablation.jpg"}
    with pytest.raises(UserError, match="of another study"):
        f.check_folder(tmp_path, f.ABLATION, "flood", f.ablation_files(["full"]))


def test_rows_have_plain_file_names():
    assert f.file_name("no anti-aliasing") == "no-anti-aliasing.png"
    assert f.file_name("styled + snow") == "styled-snow.png" and f.file_name("+ snow") == "snow.png"
