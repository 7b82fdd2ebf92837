import json
import re
import shutil
from pathlib import Path
from unicodedata import normalize

import pytest
from PIL import Image
from support.scene_builders import OPENGL
from support.textured_scene import CAMERA, textured_scene

from climatenerf.cli import main
from climatenerf.scene.findings import CODES
from climatenerf.scene.readers.ply import write_points

ROOT = Path(__file__).resolve().parents[2]
FAULTS = ROOT.parent / "shared" / "faults"


@pytest.fixture
def capture(tmp_path):
    """A folder with transforms.json, and a function that rewrites it with changes."""
    scene = textured_scene(tmp_path / "images", 12, seen=False)
    write_points(tmp_path / "points.ply", scene.points)

    def write(change=lambda pose: pose, **top):
        frames = [
            {
                "file_path": f"images/{view.name}",
                "transform_matrix": change(view.c2w @ OPENGL).tolist(),
            }
            for view in scene.views
        ]
        data = {"fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "w": CAMERA.width, "h": CAMERA.height}
        data |= {"ply_file_path": "points.ply", "frames": frames} | top
        (tmp_path / "transforms.json").write_text(json.dumps(data))
        return tmp_path

    write()
    return write


def checked(folder, capsys):
    status = main(["check", str(folder), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_consistent_capture_has_no_findings(capture, capsys):
    status, report = checked(capture(), capsys)
    assert status == 0 and report["findings"] == []
    assert report["used"]["photos"] == 12 and report["used"]["sparse points"] > 1000
    assert main(["check", str(capture())]) == 0
    assert "No problems found." in capsys.readouterr().out


def test_findings_have_code_severity_file_message_and_remedy(capture, capsys):
    status, report = checked(capture(lambda pose: pose @ OPENGL), capsys)
    (finding,) = report["findings"]
    assert status == 0 and finding["code"] == "pose-axes"
    assert set(finding) == {"code", "severity", "file", "message", "remedy"}
    assert finding["severity"] == "warning" and finding["message"].endswith(".")


def test_every_finding_names_a_file(capture, capsys):
    twice = {"w": 2 * CAMERA.width, "h": 2 * CAMERA.height, "fl_x": 2 * CAMERA.fx}
    folder = capture(fl_y=-2 * CAMERA.fy, **twice)
    _, report = checked(folder, capsys)
    found = {each["code"]: each for each in report["findings"]}
    assert set(found) == {"photo-resized", "focal-negative"}
    assert found["photo-resized"]["file"] == str(folder / "images" / "000.png")
    assert found["photo-resized"]["severity"] == "note", "nothing needs doing"
    assert found["focal-negative"]["file"] == str(folder)


def test_named_data_that_is_absent_or_not_read_is_reported(capture, capsys):
    folder = capture(ply_file_path="other.ply", semantics_path="images/000.png", k5=0.2)
    _, report = checked(folder, capsys)
    messages = {each["code"]: each["message"] for each in report["findings"]}
    assert set(messages) == {"file-missing", "file-unread"}
    assert "other.ply" in messages["file-missing"]
    assert "semantics_path" in messages["file-unread"] and "k5" in messages["file-unread"]


def test_files_of_unknown_keys_of_frames_are_told(capture, capsys):
    folder = capture()
    data = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        frame |= {"semantic_path": f"semantics/{i:03}.png", "normal": f"normals\\{i:03}.npy"}
        frame |= {"source_path": "images/", "url_path": "https://a.org/b.png", "note": "a.b/c d"}
        frame |= {"features_path": f"features/{i:03}"}
    (folder / "features").mkdir()
    (folder / "features" / "003").write_bytes(b"")
    (folder / "semantics").mkdir()
    for i in range(10):
        (folder / "semantics" / f"{i:03}.png").write_bytes(b"")
    (folder / "transforms.json").write_text(json.dumps(data))
    _, report = checked(folder, capsys)
    messages = {each["code"]: each["message"] for each in report["findings"]}
    assert set(messages) == {"file-missing", "file-unread"}
    assert messages["file-missing"].startswith("25 files named in"), "2 + 12 + 11"
    assert "semantic_path (10 times), features_path" in messages["file-unread"]


@pytest.mark.parametrize("suffix", [".png", ""])
def test_an_ambiguous_name_is_told_once(capture, capsys, suffix):
    folder = capture()
    photo = folder / "images" / "003.png"
    shutil.copy(photo, folder / "images" / "Photo.png")
    photo.rename(folder / "images" / "PHOTO.png")
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("003.png", f"photo{suffix}"))
    _, report = checked(folder, capsys)
    assert [each["code"] for each in report["findings"]] == ["name-ambiguous"]


def test_sidecars_are_matched_as_photos_are(capture, capsys):
    folder = capture()
    (folder / "labels").mkdir()
    for photo in sorted((folder / "images").iterdir()):
        label = Image.new("L", (CAMERA.width, CAMERA.height))
        label.save(folder / "labels" / photo.name)
    name = "Gebäude é.png"
    (folder / "images" / "003.png").rename(folder / "images" / normalize("NFC", name))
    (folder / "labels" / "003.png").rename(folder / "labels" / normalize("NFD", name))
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("003.png", normalize("NFC", name)))
    _, report = checked(folder, capsys)
    assert report["used"]["labels"] == 12
    (finding,) = report["findings"]
    assert finding["code"] == "name-normalised" and finding["file"] == str(folder / "labels")


def test_a_sidecar_stays_with_the_photo_of_its_exact_name(capture, capsys):
    folder = capture()
    (folder / "labels").mkdir()
    for number, name in ((3, "a.png"), (4, "A.png")):
        (folder / "images" / f"{number:03}.png").rename(folder / "images" / name)
        path = folder / "transforms.json"
        path.write_text(path.read_text().replace(f"{number:03}.png", name))
    Image.new("L", (CAMERA.width, CAMERA.height)).save(folder / "labels" / "a.png")
    _, report = checked(folder, capsys)
    assert report["used"]["labels"] == 1
    assert [each["code"] for each in report["findings"]] == ["sidecar-partial"]


def test_an_unusable_capture_has_status_2_and_one_sentence(tmp_path, capsys):
    assert main(["check", str(tmp_path / "absent")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    status, report = checked(tmp_path / "absent", capsys)
    assert status == 2 and [each["code"] for each in report["findings"]] == ["unreadable"]


def test_export_warns_and_its_output_has_no_findings(capture, tmp_path, capsys):
    folder = capture(lambda pose: pose @ OPENGL)
    assert main(["export", str(folder), "-o", str(tmp_path / "out")]) == 0
    assert "OpenGL's camera axes" in capsys.readouterr().err
    again = json.loads((tmp_path / "out" / "transforms.json").read_text())
    (tmp_path / "out" / "images").mkdir()
    for path in (folder / "images").iterdir():
        shutil.copy(path, tmp_path / "out" / "images")
    assert len(again["frames"]) == 12
    assert main(["check", str(tmp_path / "out")]) == 0
    assert "No problems found." in capsys.readouterr().out


def test_the_guide_lists_every_code():
    listed = re.findall(r"^\| `([\w-]+)` \|", (ROOT / "docs/guide/check.md").read_text(), re.M)
    assert listed == list(CODES)


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder of faulty inputs is absent")
@pytest.mark.parametrize(
    ("folder", "codes"),
    [
        ("01-bom-crlf/scene", []),
        ("01-bom-crlf/scene_json", []),
        ("02-parent-folder/project/nerf", []),
        ("03-no-second-lines/scene", ["model-lines"]),
        ("03-no-second-lines/scene_blank", []),
        ("04-narrow-space/scene", []),
        ("06-nfd-names/scene", ["name-normalised"]),
        ("07-no-size/scene", ["intrinsics-resolution"]),
        ("10-outlier/scene", ["pose-outlier"]),
        ("11-nerfcapture/scene", []),
        ("13-sky-65535/scene", ["depth-disagrees", "depth-saturated"]),
    ],
)
def test_captures_from_public_reports_have_the_expected_findings(folder, codes, capsys):
    status, report = checked(FAULTS / folder, capsys)
    found = sorted(each["code"] for each in report["findings"])
    assert status == 0 and found == codes
    photos = 11 if "outlier" in folder else 12
    assert report["used"]["photos"] == photos
    assert report["used"]["depths"] == (12 if "11-" in folder or "13-" in folder else 0)
