"""Hostile files and flags end with one sentence and status 2, without time or memory."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import STREET, error_message, run_cli
from support.scene_builders import names_of, ring, write_images, write_transforms

from climatenerf.scene import load_scene
from climatenerf.scene.scene import MAX_VIEWS

FAULTS = Path(__file__).resolve().parents[3] / "shared" / "faults" / "files"
PINHOLE = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 31.0, "cx": 16.0, "cy": 12.0}


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    write_images(folder / "images", names_of(9))
    names = [f"images/{name}" for name in names_of(9)]
    write_transforms(folder / "transforms.json", ring(9), names, **PINHOLE)
    return folder


@pytest.fixture
def street(tmp_path):
    folder = tmp_path / "street"
    shutil.copytree(STREET, folder)
    return folder


def edited(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def weather(tmp_path, text):
    path = tmp_path / "weather.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda d: d.update(scale_report=[]), "scale_report in .* should be a table"),
        (lambda d: d.update(scale_report={"gps": 3}), "gps in scale_report"),
        (lambda d: d.update(georeference=None), "georeference in .* should be a table"),
        (lambda d: d.update(georeference={"lat": "x"}), "georeference.lat in"),
        (lambda d: d.update(up_report={"used": 5}), "used in up_report"),
        (lambda d: d.update(up_report={"lines": None}), "lines in up_report"),
        (lambda d: d.update(views=5), "views in .* should be a list"),
        (lambda d: d.update(views=[5]), "should be a table"),
        (lambda d: d.update(cameras=[None]), "camera"),
        (lambda d: d["cameras"][0].update(width=10**30), "width in camera 0"),
        (lambda d: d["cameras"][0].update(fx="wide"), "fx in camera 0"),
        (lambda d: d.update(root=3), "root in .* should be a text"),
        (lambda d: d.update(warnings=[None]), "warnings in"),
        (lambda d: d["views"][0].update(camera=1.5), "camera in view 0"),
        (lambda d: d["views"][0]["c2w"][0].__setitem__(3, 1e200), "c2w in view 0"),
        (lambda d: d["world_from_input"][0].__setitem__(3, 1e200), "world_from_input"),
        (lambda d: d["world_from_input"][0].__setitem__(3, 1e12), "32 bits resolve no detail"),
        (lambda d: d.update(world_from_input=np.diag([1.0, 1, -1, 1]).tolist()), "mirrored"),
        (lambda d: d.update(world_from_input=np.diag([1.0, 2, 1, 1]).tolist()), "sheared"),
        (lambda d: d.update(world_from_input=np.diag([0.0, 0, 0, 1]).tolist()), "a scale of 0"),
        (lambda d: d.update(ground_z=1e300), "ground_z in"),
    ],
)
def test_scene_files_of_other_types_and_sizes(street, tmp_path, capsys, change, expected):
    edited(street / "scene.json", change)
    message = error_message(capsys, "export", street, "-o", tmp_path / "out")
    import re

    assert re.search(expected, message), message


def test_names_that_no_disk_can_hold(capture, tmp_path, capsys):
    def lengthen(data):
        for number, frame in enumerate(data["frames"][:3]):
            frame["file_path"] = f"images/{number}{'n' * 300}.png"
        data["frames"][3]["file_path"] = "images/a\0b.png"
        data["frames"][4]["file_path"] = "images/\udce9.png"

    edited(capture / "transforms.json", lengthen)
    assert run_cli("export", capture, "-o", tmp_path / "out") == 0
    exported = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(exported["frames"]) == 4, "images that are not on disk are left out"
    message = error_message(capsys, "export", capture, "-o", tmp_path / ("n" * 300))
    assert "longer than the disk allows" in message
    message = error_message(capsys, "export", tmp_path / ("n" * 300), "-o", tmp_path / "other")
    assert "longer than the disk allows" in message


def test_photo_names_that_are_not_utf8_are_exported(capture, tmp_path):
    name = os.fsdecode(b"caf\xe9.png")
    try:
        (capture / "images" / "003.png").rename(capture / "images" / name)
    except OSError:
        pytest.skip("the disk takes names in UTF-8 only")
    edited(
        capture / "transforms.json",
        lambda d: d["frames"][3].update(file_path=f"images/{name}"),
    )
    out = tmp_path / "out"
    assert run_cli("export", capture, "-o", out) == 0
    assert b"caf\xe9.png" in (out / "sparse" / "0" / "images.txt").read_bytes()
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    paths = [Path(frame["file_path"]) for frame in frames]
    assert len(paths) == 9 and all(path.is_file() for path in paths)


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 20_000, "seed = " + "9" * 400, "seed = " + "9" * 5000, "[flood]\nlevel = 5",
     "flood = 5", "[flood]\nlevel = {}", "[flood]\ncolour = [1, 2, 1e400]",
     '[flood]\nlevel = "' + "9" * 100_000 + '"',
     "[flood]\nlevel = {" + ",".join(f'"{t} s" = "1 m"' for t in range(10_001)) + "}"],
)  # fmt: skip
def test_weather_files(tmp_path, capsys, text):
    path = weather(tmp_path, text)
    message = error_message(capsys, "render", tmp_path, "-o", tmp_path / "out", "--weather", path)
    assert "weather.toml" in message and len(message) < 600


@pytest.mark.parametrize("text", ["9" * 400, "nan, 1", '"x", 1', "true, 1"])
def test_marks(tmp_path, capsys, text):
    path = tmp_path / "marks.toml"
    path.write_text(f'[DOOR.from]\n"0001.jpg" = [{text}, 2]\n"0011.jpg" = [3, 4]\n[DOOR.to]\n')
    length = ["--known-length", "DOOR=2 m", "--marks", path]
    assert "marks.toml" in error_message(capsys, "fit", STREET, "-o", tmp_path / "out", *length)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--camera-height", "1e300 m"], "at most 100000 m"),
        (["--camera-height", "1e-320 m"], "scale|32 bits|above 0"),
        (["--known-length", "DOOR=1e300 m"], "above 0 and at most"),
        (["--seed", str(2**200)], "--seed must lie between"),
        (["--seed", "-1"], "--seed must lie between"),
        (["--steps", "1" * 400], "--minutes and --steps|steps"),
        (["--downscale", str(10**30)], "downscaled|downscale"),
    ],
)
def test_flags_of_fit(tmp_path, capsys, flags, expected):
    import re

    message = error_message(capsys, "fit", STREET, "-o", tmp_path / "out", *flags)
    assert re.search(expected, message), message


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--frames", str(10**21)], "--frames"),
        (["--frames", str(10**9)], "--frames"),
        (["--seed", str(2**200)], "--seed must lie between"),
        (["--seed", str(10**400)], "--seed must lie between"),
        (["--part", "1/" + "9" * 5000], "--part"),
        (["--size", "9" * 5000 + "x9"], "--size"),
        (["--fps", "nan"], "frame rate"),
        (["--path", "still:" + "9" * 5000], "no view"),
        (["--path", "n" * 300 + ".json"], "longer than the disk allows"),
    ],
)
def test_flags_of_render(run_folder, tmp_path, capsys, flags, expected):
    message = error_message(capsys, "render", run_folder, "-o", tmp_path / "out", *flags)
    assert expected in message and len(message) < 1500 and not (tmp_path / "out").exists()


PATH = {
    "camera_type": "perspective",
    "render_width": 32,
    "render_height": 18,
    "camera_path": [{"camera_to_world": list(np.eye(4).reshape(-1)), "fov": 50}],
}


@pytest.mark.parametrize(
    "change",
    [
        {"camera_path": 10**399},
        {"camera_path": 5},
        {"camera_path": [5]},
        {"camera_path": [{"camera_to_world": [1e300] * 16, "fov": 50}]},
        {"camera_path": [{"camera_to_world": [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
                          "fov": 50}]},
        {"camera_path": [{"camera_to_world": "x" * 16, "fov": 50}]},
        {"camera_path": [{"camera_to_world": list(np.eye(4).reshape(-1)), "fov": 10**39}]},
        {"camera_type": ["x"] * 1000},
    ],
)  # fmt: skip
def test_camera_paths(run_folder, tmp_path, capsys, change):
    path = tmp_path / "camera_path.json"
    text = json.dumps({**PATH, **change}) if change.get("camera_path") != 10**399 else ""
    path.write_text(text or f'{{"camera_path": {"9" * 400}}}')
    out = tmp_path / "out"
    message = error_message(capsys, "render", run_folder, "-o", out, "--path", path)
    assert "camera path" in message and len(message) < 500 and not out.exists()


@pytest.mark.parametrize("scale", ["NaN", "1e-320", "0", "-1", "1e300", "null", '"1"', "[]"])
def test_scales_of_nerfstudio(run_folder, tmp_path, capsys, scale):
    (tmp_path / "camera_path.json").write_text(json.dumps(PATH))
    transform = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]"
    text = f'{{"transform": {transform}, "scale": {scale}}}'
    (tmp_path / "dataparser_transforms.json").write_text(text)
    args = ["render", run_folder, "-o", tmp_path / "out", "--path", tmp_path / "camera_path.json"]
    assert "scale in" in error_message(capsys, *args)


@pytest.mark.parametrize("verb", ["render", "fit"])
def test_settings_of_another_type(run_folder, tmp_path, capsys, verb):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    edited(run / "config.json", lambda d: d.update(settings=5))
    args = {
        "render": ["render", run, "-o", tmp_path / "out"],
        "fit": ["fit", STREET, "-o", run, "--resume", "--downscale", "6"],
    }
    assert "settings in" in error_message(capsys, *args[verb])


def test_arrays_that_claim_terabytes(capture, tmp_path, capsys):
    depth = capture / "depth" / "001.npy"  # of a photo that is not held out
    depth.parent.mkdir()
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    packed = header.ljust(117) + b"\n"
    depth.write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + packed + bytes(12))
    message = error_message(capsys, "fit", capture, "-o", tmp_path / "run", "--steps", "1")
    assert "001.npy cannot be read (its header claims" in message


def test_pictures_that_take_too_much_memory(capture, tmp_path, capsys):
    big = capture / "images" / "000.png"
    Image.new("1", (24_000, 20_000)).save(big)
    message = error_message(capsys, "export", capture, "-o", tmp_path / "out")
    assert "000.png has 24000x20000 pixels, above the limit of 400 megapixels" in message


def test_more_frames_than_can_be_read(capture, tmp_path, capsys):
    path = capture / "transforms.json"
    few = json.loads(path.read_text())
    path.write_text(json.dumps({**few, "frames": [few["frames"][0]] * (MAX_VIEWS + 1)}))
    assert "frames, more than" in error_message(capsys, "export", capture, "-o", tmp_path / "out")


def test_poses_that_32_bits_cannot_hold(capture, tmp_path, capsys):
    edited(
        capture / "transforms.json",
        lambda d: d["frames"][0]["transform_matrix"][0].__setitem__(3, 1e10),
    )
    message = error_message(capsys, "export", capture, "-o", tmp_path / "out")
    assert "units from the origin" in message and "32 bits" in message


def program(*args, cwd=None, environment=(), **streams):
    """Run the command line in a new process."""
    return subprocess.run(
        [sys.executable, "-m", "climatenerf", *map(str, args)],
        cwd=cwd, env={**os.environ, **dict(environment)}, text=True, timeout=120, **streams,
    )  # fmt: skip


def shell(command, *args):
    """Run `command`, in which "$@" is the command line, in a shell."""
    args = [sys.executable, "-m", "climatenerf", *map(str, args)]
    return subprocess.run(
        ["sh", "-c", command, "sh", *args], capture_output=True, text=True, timeout=120
    )


def test_a_closed_standard_output_is_only_a_warning(capture, tmp_path):
    done = shell('"$@" >&-', "export", capture, "-o", tmp_path / "out")
    assert done.returncode == 0 and (tmp_path / "out" / "transforms.json").exists()
    assert "standard output is closed" in done.stderr and "Error" not in done.stderr
    if Path("/dev/full").exists():
        done = shell('"$@" >/dev/full', "export", capture, "-o", tmp_path / "full")
        assert done.returncode == 0 and "standard output cannot be written" in done.stderr
        assert "Traceback" not in done.stderr and "Exception" not in done.stderr
        assert (tmp_path / "full" / "sparse").exists(), "both formats are written"


def test_a_closed_standard_error_keeps_the_status(capture, tmp_path):
    for close in ('"$@" 2>&-', '"$@" 2>/dev/full', '"$@" 2>&- >&- <&-'):
        done = shell(close, "export", tmp_path / "absent", "-o", tmp_path / "out")
        assert done.returncode == 2, close


def test_ascii_output_with_another_path(capture, tmp_path):
    out = tmp_path / "Straße 雪"
    done = program(
        "export", capture, "-o", out, capture_output=True,
        environment={"PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert r"Stra\xdfe \u96ea" in done.stdout and out.is_dir()


def test_a_removed_working_folder_is_a_user_error(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    command = f'cd "{gone}" && rmdir "{gone}" && "$@"'
    done = shell(command, "export", "x", "-o", "y")
    assert done.returncode == 2 and "no longer exists" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the hostile files are no part of the project")
@pytest.mark.parametrize(
    ("name", "flag"),
    [("deep.toml", "--weather"), ("keyframes.toml", "--weather"), ("int.json", "--path"),
     ("pose_1e300/camera_path.json", "--path"), ("dp_scale_nan/camera_path.json", "--path")],
)  # fmt: skip
def test_hostile_files_of_renders(run_folder, tmp_path, capsys, name, flag):
    out = tmp_path / "out"
    error_message(capsys, "render", run_folder, "-o", out, flag, FAULTS / name)
    assert not out.exists()


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the hostile files are no part of the project")
@pytest.mark.parametrize("name", ["scale_report_list", "georef_null"])
def test_hostile_scenes(tmp_path, capsys, name):
    assert "scene.json" in error_message(capsys, "export", FAULTS / name, "-o", tmp_path / "out")


def test_the_street_itself_is_read():
    assert len(load_scene(STREET).views) == 64
