"""`climatenerf render`: frames, layers, parts, sidecars, and what it refuses."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from PIL import Image
from support.command_line import STREET, error_message, run_cli

from climatenerf import cli
from climatenerf.api import load_run
from climatenerf.core.storage import read_safetensors, write_safetensors
from climatenerf.field.checkpoint import load_field, save_field
from climatenerf.output.job import appearance_index
from climatenerf.output.video import write_png
from climatenerf.scene import load_scene
from climatenerf.scene.images import read_rgb
from climatenerf.weather.registry import layer_table

SMALL = ["--size", "96x54", "--frames", "2"]
OURS = ["frames/0000.png", "movie.mp4", "movie.json", "depth/0000.npz", "preview.png"]


@pytest.mark.slow
def test_a_shorter_render_removes_the_frames_of_an_earlier_longer_one(run_folder, tmp_path):
    args = ["render", run_folder, "-o", tmp_path, "--size", "48x27", "--layers", "depth,seen"]
    assert run_cli(*args, "--frames", "3") == 0
    (tmp_path / "frames" / "mine.png").write_bytes(b"not a frame")
    assert run_cli(*args, "--frames", "1", "--smog.visibility", "50 m") == 0
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["0000.png", "mine.png"]
    assert sorted(p.name for p in (tmp_path / "depth").iterdir()) == ["0000.npz"]
    assert (tmp_path / "seen" / "0000.npz").is_file()
    sidecar = json.loads((tmp_path / "movie.json").read_text())
    assert len(sidecar["frames"]) == 1 and sidecar["weather"]["smog"]["visibility"] == "50 m"


def test_ground_is_completed_unless_a_flag_says_no(run_folder, tmp_path, capsys):
    args = ["render", run_folder, "--size", "48x27", "--frames", "1", "--layers", "seen"]
    assert run_cli(*args, "-o", tmp_path / "with") == 0
    assert (run_folder / "terrain.npz").is_file()
    assert run_cli(*args, "-o", tmp_path / "without", "--no-complete-ground") == 0
    seen, keys = [], []
    for name, complete in (("with", True), ("without", False)):
        sidecar = json.loads((tmp_path / name / "movie.json").read_text())
        assert sidecar["complete_ground"] is complete
        keys.append(sidecar["render"])
        seen.append(np.load(tmp_path / name / "seen" / "0000.npz")["seen"])
    assert keys[0] != keys[1]
    assert seen[0].min() >= 0 and seen[0].max() <= 1 and (seen[1] == 1).all()
    (tmp_path / "with" / "movie.json").unlink()
    own = tmp_path / "run"  # other processes read the shared one
    shutil.copytree(run_folder, own)
    (own / "terrain.npz").write_bytes((own / "terrain.npz").read_bytes()[:100])
    message = error_message(capsys, "render", own, *args[2:], "-o", tmp_path / "damaged")
    assert "terrain.npz" in message and "delete it" in message


def test_flags_of_an_absent_effect_give_a_warning(run_folder, tmp_path, capsys):
    args = ["render", str(run_folder), *map(str, SMALL), "--frames", "1", "-o", str(tmp_path)]
    assert cli.main([*args, "--flood.wind-speed", "4 m/s", "--smog.visibility", "9 m"]) == 0
    err = capsys.readouterr().err
    assert "--flood.wind-speed changes nothing without --flood.level" in err
    assert "--smog" not in err
    lost = ("--sky.ev", "1", "--sky.cover", "0.5", "--flood.level=-500 m")
    assert cli.main([*args[:-1], str(tmp_path / "lost"), *lost]) == 0
    err = capsys.readouterr().err
    assert "--sky.cover changes nothing without --sky.kind clear" in err
    assert "--sky.ev changes nothing without --sky.kind overcast or" in err
    assert "--flood.level -500 m lies below the ground near the cameras" in err
    both = ("--flood.level", "1 cm", "--flood.clarity", "1 m", "--flood.attenuation", "1", "1", "1")
    message = error_message(capsys, *args[:-1], str(tmp_path / "both"), *both)
    assert "--flood.clarity and --flood.attenuation say the same thing" in message
    film = tmp_path / "film.toml"
    film.write_text('[flood]\nlevel = { "0 s" = "1 cm", "1 s" = "2 cm" }\n')
    given = ["--weather", str(film), "--flood.wind-speed", "4 m/s"]
    assert cli.main([*args[:-1], str(tmp_path / "film"), *given]) == 0
    assert "changes nothing" not in capsys.readouterr().err


@pytest.mark.parametrize("name", OURS)
def test_a_render_overwrites_no_foreign_file(run_folder, tmp_path, capsys, name):
    mine = tmp_path / "mine" / name
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b'{"mine": 1}')
    args = ["render", run_folder, "-o", tmp_path / "mine", "--layers", "depth", *SMALL]
    args += ["--preview"]
    assert mine.name in error_message(capsys, *args)
    assert mine.read_bytes() == b'{"mine": 1}'
    assert [p for p in (tmp_path / "mine").rglob("*") if p.is_file()] == [mine]


def test_frames_go_neither_into_the_run_nor_among_photos(run_folder, capsys):
    run = load_run(run_folder)
    for out in (run_folder, run.scene.views[0].path.parent):
        before = sorted(out.iterdir())
        assert "name another" in error_message(capsys, "render", run_folder, "-o", out)
        assert sorted(out.iterdir()) == before


def test_a_preview_changes_no_frame_and_is_removed(run_folder, tmp_path):
    """A preview of a killed render is removed, too."""
    (tmp_path / "early").mkdir()
    left_over = tmp_path / "early" / "preview.png"
    write_png(left_over, np.zeros((2, 2, 3), np.uint8), "killed")
    args = ["render", str(run_folder), *map(str, SMALL)]
    assert cli.main([*args, "-o", str(tmp_path / "early"), "--preview"]) == 0
    assert not left_over.exists()
    assert cli.main([*args, "-o", str(tmp_path / "plain")]) == 0
    for index in range(2):
        frame = f"frames/{index:04d}.png"
        same = [read_rgb(tmp_path / folder / frame) for folder in ("early", "plain")]
        assert np.array_equal(*same)


@pytest.mark.slow
def test_parts_in_any_order_are_joined_to_the_movie_of_one_render(run_folder, tmp_path, capsys):
    args = ["render", run_folder, "--size", "48x27", "--frames", "5", "--layers", "depth"]
    args += ["--flood.level", "0.3 m"]
    assert run_cli(*args, "-o", tmp_path / "whole") == 0
    parts = [*args, "-o", tmp_path / "parts"]
    assert run_cli(*parts, "--part", "2/2") == 0
    out, err = capsys.readouterr()
    assert f"frames: {tmp_path / 'parts' / 'frames'}" in out and "2 of 5 frames are finished" in err
    made = sorted(p.name for p in (tmp_path / "parts" / "frames").iterdir())
    assert made == ["0001.png", "0003.png"]
    message = error_message(capsys, *parts, "--join")
    assert "3 of 5 frames" in message and "0000, 0002, 0004" in message
    assert not (tmp_path / "parts" / "movie.json").exists()
    assert run_cli(*parts, "--part", "1/2") == run_cli(*parts, "--join") == 0
    for path in (tmp_path / "whole").rglob("*"):
        if path.is_file():
            same = tmp_path / "parts" / path.relative_to(tmp_path / "whole")
            assert same.read_bytes() == path.read_bytes(), path


@pytest.mark.slow
def test_processes_render_parts_of_a_run_and_one_is_killed(run_folder, tmp_path):
    flags = ["--size", "48x27", "--frames", "6", "--flood.level", "0.3 m", "--snow.depth", "9 cm"]

    def start(out, *args):
        command = [sys.executable, "-m", "climatenerf", "render", run_folder, "-o", tmp_path / out]
        return subprocess.Popen([*map(str, command), *flags, *args], stderr=subprocess.DEVNULL)

    assert start("whole").wait() == 0
    killed, other = start("parts", "--part", "1/2"), start("parts", "--part", "2/2")
    while killed.poll() is None and not (tmp_path / "parts" / "frames" / "0000.png").exists():
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    assert other.wait() == start("parts", "--part", "1/2").wait() == 0
    joins = [start("parts", "--join") for _ in range(2)]
    assert [each.wait() for each in joins] == [0, 0]
    for path in (p for p in (tmp_path / "whole").rglob("*") if p.is_file()):
        same = tmp_path / "parts" / path.relative_to(tmp_path / "whole")
        assert same.read_bytes() == path.read_bytes(), path


def test_a_part_with_other_flags_leaves_an_unfinished_render_alone(run_folder, tmp_path, capsys):
    args = ["render", run_folder, "-o", tmp_path, "--size", "48x27", "--frames", "2"]
    assert run_cli(*args, "--part", "1/2") == 0
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for flags in (["--part", "2/2"], []):
        message = error_message(capsys, *args, "--smog.visibility", "50 m", *flags)
        assert "unfinished render with other settings" in message
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_path_files_with_huge_frames_or_deep_nesting_are_refused(run_folder, tmp_path, capsys):
    entry = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 45}
    path = {"render_width": 100000, "render_height": 100000, "fps": 5, "camera_path": [entry]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    args = ["render", run_folder, "-o", tmp_path / "out", "--path", tmp_path / "path.json"]
    assert "too large" in error_message(capsys, *args)
    (tmp_path / "path.json").write_text("[" * 100_000)
    assert "deeply" in error_message(capsys, *args)


def test_the_sidecar_is_written_without_a_movie(run_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "absent"))
    message = error_message(capsys, "render", run_folder, "-o", tmp_path / "out", *SMALL)
    assert "ffmpeg" in message
    sidecar = json.loads((tmp_path / "out" / "movie.json").read_text())
    assert len(sidecar["frames"]) == 2 and sidecar["frames_wanted"] == 2
    assert "lowest_ground_z" in sidecar
    assert not (tmp_path / "out" / "movie.mp4").exists()


@pytest.mark.slow
def test_render_with_all_weathers_at_once(run_folder, tmp_path, capsys, monkeypatch):
    args = ["render", run_folder, "-o", tmp_path, *SMALL, "--layers", "all"]
    args += ["--flood.level", "0.4 m", "--smog.visibility", "60 m", "--snow.depth", "15 cm"]
    assert run_cli(*args) == 0
    assert f"movie: {tmp_path / 'movie.mp4'}" in capsys.readouterr().out
    assert (tmp_path / "movie.mp4").stat().st_size > 500
    frames = [np.asarray(Image.open(p)) for p in sorted((tmp_path / "frames").glob("*.png"))]
    assert [f.shape for f in frames] == [(54, 96, 3)] * 2
    assert "simulated" in str(Image.open(tmp_path / "frames" / "0000.png").info)
    sidecar = json.loads((tmp_path / "movie.json").read_text())
    assert sidecar["simulated"] is True and sidecar["seed"] == 0
    assert sidecar["weather"]["flood"]["level"] == "0.4 m"
    assert sidecar["weather"]["smog"]["visibility"] == "60 m"
    assert sidecar["weather"]["snow"]["depth"] == "0.15 m"
    assert sidecar["units"]["length"] == "m" and "scale" in sidecar and "versions" in sidecar
    assert len(sidecar["frames"]) == 2 and sidecar["appearance_of_training_view"] is None
    expected_layers = set(layer_table()) - {
        "label"
    }  # labels of the embedded street contain the sky only
    for frame in sidecar["frames"]:
        assert (frame["camera"]["width"], frame["camera"]["height"]) == (96, 54)
        assert np.array(frame["c2w_world"]).shape == (4, 4)
        assert set(frame["layers"]) == expected_layers
        layers = {}
        for name in expected_layers:
            layers[name] = np.load(tmp_path / frame["layers"][name][0])[name]
            assert not np.isnan(layers[name]).any(), name
            assert layers[name].shape[:2] == (54, 96)
        assert frame["measured"]["water_share"] == pytest.approx(
            float(layers["mask_water"].mean()), abs=1e-6
        )
        for mask in ("mask_water", "mask_snow", "mask_smog", "transmittance"):
            assert layers[mask].min() >= -1e-5 and layers[mask].max() <= 1 + 1e-5
        assert layers["mask_water"].mean() > 0.02 and layers["mask_smog"].mean() > 0.05
        # The transmittance layer is the closed form of the depth layer.
        seen = np.isfinite(layers["depth"])
        expected = np.exp(-2.996 / 60 * layers["depth"][seen])
        assert np.allclose(layers["transmittance"][seen], expected, atol=2e-3)


def test_render_without_weather_along_a_drawn_path(run_folder, tmp_path):
    c2w = json.loads((STREET / "scene.json").read_text())["views"][10]["c2w"]
    opengl = (np.array(c2w) @ np.diag([1, -1, -1, 1])).ravel().tolist()
    path = {
        "camera_type": "perspective",
        "render_width": 64,
        "render_height": 36,
        "fps": 5,
        "camera_path": [{"camera_to_world": opengl, "fov": 45}] * 2,
    }
    (tmp_path / "camera_path.json").write_text(json.dumps(path))
    out = tmp_path / "out"
    args = ["render", run_folder, "-o", out, "--path", tmp_path / "camera_path.json"]
    assert run_cli(*args) == 0
    sidecar = json.loads((out / "movie.json").read_text())
    assert sidecar["fps"] == 5 and len(sidecar["frames"]) == 2
    assert np.allclose(sidecar["frames"][0]["c2w_input"], c2w, atol=1e-5)
    assert Image.open(out / "frames" / "0001.png").size == (64, 36)
    assert sidecar["frames"][0]["measured"]["water_share"] == 0
    assert not (out / "depth").exists(), "layers come on request only"


def test_flags_override_a_weather_file(run_folder, tmp_path, monkeypatch):
    weather = tmp_path / "weather.toml"
    weather.write_text('seed = 7\n[smog]\nvisibility = "80 m"\n[flood]\nlevel = "0.3 m"\n')
    out = tmp_path / "out"
    args = ["render", run_folder, "-o", out, "--weather", weather, "--frames", "1"]
    args += ["--size", "64x36", "--smog.visibility", "20 m"]
    assert run_cli(*args) == 0
    weather = json.loads((out / "movie.json").read_text())["weather"]
    assert weather["seed"] == 7 and weather["flood"]["level"] == "0.3 m"
    assert weather["smog"]["visibility"] == "20 m", "flags win, whoever called main"


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--flood.level", "90 m"], "above the whole scene"),
        (["--size", "wide"], "--size"),
        (["--size", "0x10"], "--size"),
        (["--path", "loop"], "loop"),
        (["--path", "still:nobody.jpg"], "nobody.jpg"),
        (["--path", "absent.json"], "absent.json"),
        (["--frames", "0"], "--frames"),
        (["--fps", "inf"], "frame rate"),
        (["--supersample", "10000"], "--supersample"),
        (["--size", "8192x8192", "--supersample", "4"], "too large"),
        (["--weather", "absent.toml"], "absent.toml"),
        (["--smog.visibility", "1 mm"], "smog.visibility"),
        (["--layers", "label"], "without class labels"),
        (["--appearance", "nobody.jpg"], "no training photo"),
        (["--part", "17/16"], "from 1/N to N/N"),
        (["--part", "0/4"], "from 1/N to N/N"),
        (["--part", "x"], "from 1/N to N/N"),
        (["--part", "1/2", "--join"], "render all parts, then use --join"),
        (["--join"], "2 of 2 frames of this render are missing"),
    ],
)
def test_invalid_options_are_refused_and_write_nothing(
    run_folder, tmp_path, capsys, args, expected
):
    message = error_message(capsys, "render", run_folder, "-o", tmp_path / "out", *SMALL, *args)
    assert expected in message
    assert not (tmp_path / "out").exists(), "nothing is begun"


def test_appearance_indices_count_training_photos(run_folder):
    scene = load_scene(run_folder)
    names = [view.name for view in scene.of_split("train")]
    assert scene.views[0].name not in names, "held out, so that places differ"
    assert [appearance_index(name, scene) for name in names] == list(range(len(names)))
    assert appearance_index("mean", scene) is None


@pytest.mark.slow
def test_frames_have_the_appearance_of_the_given_photo(run_folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    field, train = load_field(run), load_scene(run).of_split("train")
    with torch.no_grad():
        field.embeddings.normal_(generator=torch.Generator().manual_seed(0))
        field.view_net[0].normal_(generator=torch.Generator().manual_seed(1))
    save_field(field, run)
    frames, appearances = [], []
    for name in ("mean", train[2].name, train[3].name):
        out = tmp_path / name
        args = ["--path", "still", "--frames", "1", "--size", "64x36", "--appearance", name]
        assert run_cli("render", run, "-o", out, *args) == 0
        frames.append(np.asarray(Image.open(out / "frames" / "0000.png")).astype(int))
        sidecar = json.loads((out / "movie.json").read_text())
        appearances.append(sidecar["appearance_of_training_view"])
    assert appearances == [None, 2, 3]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(frames[one] - frames[other]).mean() > 1


@pytest.mark.parametrize("value", ["10 kg", "half a metre", "0.5"])
def test_a_level_of_the_wrong_dimension_is_refused(run_folder, tmp_path, capsys, value):
    """The option parser prints the error and exits with status 2."""
    capsys.readouterr()
    assert run_cli("render", run_folder, "-o", tmp_path / "out", "--flood.level", value) == 2
    err = "".join(capsys.readouterr())
    assert "such as" in err and "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_folders_without_a_run_are_refused(tmp_path, capsys):
    message = error_message(capsys, "render", tmp_path, "-o", tmp_path / "out")
    assert "climatenerf fit" in message
    error_message(capsys, "render", tmp_path / "absent", "-o", tmp_path / "out")
    error_message(capsys, "render", STREET, "-o", tmp_path / "out")


def test_a_run_of_a_newer_schema_is_refused(run_folder, tmp_path, capsys):
    shutil.copytree(run_folder, tmp_path / "run")
    path = tmp_path / "run" / "field.safetensors"
    arrays, metadata = read_safetensors(path)
    about = {**json.loads(metadata["climatenerf"]), "schema_version": 99}
    write_safetensors(path, arrays, {"climatenerf": json.dumps(about)})
    message = error_message(capsys, "render", tmp_path / "run", "-o", tmp_path / "out", *SMALL)
    assert "newer" in message and "99" in message
    shutil.copy(run_folder / "field.safetensors", path)
    config = tmp_path / "run" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "schema_version": 98}))
    message = error_message(capsys, "render", tmp_path / "run", "-o", tmp_path / "out", *SMALL)
    assert "newer" in message and "98" in message


def test_a_damaged_run_is_refused(run_folder, tmp_path, capsys):
    shutil.copytree(run_folder, tmp_path / "run")
    path = tmp_path / "run" / "field.safetensors"
    path.write_bytes(path.read_bytes()[:5000])
    assert "damaged" in error_message(capsys, "render", tmp_path / "run", "-o", tmp_path / "out")


def files_in(folder):
    found = [path for path in folder.rglob("*.*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


@pytest.mark.slow
def test_workers_render_the_bytes_of_one_process(run_folder, tmp_path, capsys):
    weather = ["--flood.level", "-0.2 m", "--snow.depth", "5 cm", "--smog.visibility", "80 m"]
    weather += ["--sky.kind", "overcast", "--layers", "all", "--frames", "4", "--size", "48x27"]
    for name, flags in (("one", []), ("two", ["--workers", "2"])):
        assert run_cli("render", run_folder, "-o", tmp_path / name, *weather, *flags) == 0
    one, two = (
        {
            p.relative_to(tmp_path / name): p.read_bytes()
            for p in (tmp_path / name).rglob("*.*")
            if p.is_file()
        }
        for name in ("one", "two")
    )
    log = two.pop(Path("workers.log")).decode()
    assert one == two and len(one) > 40
    assert all(f"frame 000{i} took" in log for i in range(4))
    err = capsys.readouterr().err
    assert "distributed" not in err and "frames: 100 %" in err


@pytest.mark.parametrize("flag", [("--part", "1/2"), ("--join",), ("--preview",)])
def test_workers_render_all_frames_themselves(run_folder, tmp_path, capsys, flag):
    given = "render", run_folder, "-o", tmp_path / "out", "--workers", "2"
    assert "leave --part, --join and --preview out" in error_message(capsys, *given, *flag)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_command(run_folder, tmp_path, number):
    out = tmp_path / "out"
    flags = ["--workers", "2", "--frames", "400", "--size", "96x54", "-o", str(out)]
    command = [sys.executable, "-m", "climatenerf", "render", str(run_folder), *flags]
    with (tmp_path / "err").open("wb") as err:
        child = subprocess.Popen(
            command,
            stderr=err,
            start_new_session=True,
            # A shell lets jobs in the background ignore it, and their children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
    deadline = time.monotonic() + 120
    while not list(out.glob("frames/*.png")) and time.monotonic() < deadline:
        time.sleep(0.1)
    below = psutil.Process(child.pid).children(recursive=True)
    assert len(below) >= 2
    if number == signal.SIGINT:  # a terminal sends it to all
        os.killpg(child.pid, number)
    else:
        child.kill()
    assert child.wait(60) == (130 if number == signal.SIGINT else -number)
    assert not psutil.wait_procs(below, timeout=30)[1]
    finished = len(list(out.glob("frames/*.png")))
    assert 0 < finished < 400
    if number == signal.SIGINT:
        said = (tmp_path / "err").read_text()
        assert said.endswith("climatenerf: interrupted\n") and "Traceback" not in said
        assert len(json.loads((out / "movie.json").read_text())["frames"]) == finished
        assert not list(out.glob(".frames/unfinished-*"))
