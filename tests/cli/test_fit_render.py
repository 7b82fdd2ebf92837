"""The two commands of the main job, through the command line, on the street that comes along."""

import dataclasses
import functools
import json
import shutil
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from climatenerf import cli
from climatenerf.cli.fit import Fit, fit_settings, resuming
from climatenerf.core.storage import read_safetensors, write_safetensors
from climatenerf.field.checkpoint import load_field, save_field
from climatenerf.field.presets import PRESETS
from climatenerf.output.job import appearance_index
from climatenerf.output.video import write_png
from climatenerf.scene import load_scene
from climatenerf.scene.images import read_rgb
from climatenerf.training.settings import PAPER, FitSettings, Losses
from climatenerf.weather.registry import layer_table

STREET = Path(str(files("climatenerf") / "assets" / "street"))
SMALL = ["--size", "96x54", "--frames", "2"]
FEW_ROWS = dataclasses.replace(
    PRESETS["cpu"], geometry_log2_rows=13, appearance_log2_rows=13, cascades=4
)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A short fit in small steps with small grids: a blurred street in some haze."""
    from climatenerf.cli import fit as cli_fit
    from climatenerf.training import run as run_module

    folder = tmp_path_factory.mktemp("street") / "run"
    settings = functools.partial(FitSettings, samples_per_step=2**14, size=FEW_ROWS)
    words = ["fit", str(STREET), "-o", str(folder), "--steps", "300", "--downscale", "6"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_fit, "settings_of", lambda preset, device: settings(preset=preset))
        patch.setattr(run_module, "PREVIEW_WIDTH", 64)
        assert cli.main(words) == 0
    return folder


def status(*words):
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as left:
        return left.code


def complaint(capsys, *words):
    """The one sentence that a command which fails with status 2 leaves on standard error."""
    capsys.readouterr()
    assert status(*words) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("climatenerf: ")]
    assert len(lines) == 1 and err.rstrip().endswith(lines[0]), err
    return lines[0]


# --- fit --------------------------------------------------------------------------------------


def test_steps_alone_have_no_time_limit_and_the_device_chooses_the_preset():
    fit = Fit(Path("scene"), Path("run"))
    assert (fit_settings(fit).minutes, fit_settings(fit).preset) == (5.0, "cpu")
    assert fit_settings(dataclasses.replace(fit, steps=9)).minutes is None
    both = fit_settings(dataclasses.replace(fit, steps=9, minutes=2.0))
    assert (both.minutes, both.steps) == (2.0, 9)
    there = fit_settings(dataclasses.replace(fit, device="cuda"))
    assert there.preset == "gpu" and there.samples_per_step == 2**20
    assert fit_settings(dataclasses.replace(fit, preset="gpu")).samples_per_step == 2**16
    chosen = dataclasses.replace(fit, device="cuda", preset="cpu")
    assert fit_settings(chosen).preset == "cpu"


def test_the_help_names_every_loss(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["fit", "--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert end.value.code == 0
    assert all(f" {each.name}" in told for each in dataclasses.fields(Losses))


def test_fit_leaves_a_run(run_folder):
    metrics = json.loads((run_folder / "metrics.json").read_text())
    assert {"psnr", "ssim", "psnr_cc", "seconds", "steps", "samples"} <= metrics.keys()
    assert metrics["steps"] == 300 and metrics["downscale"] == 6 and metrics["psnr"] > 8
    assert len(metrics["views"]) == 8
    assert {"config.json", "field.safetensors", "optimiser.safetensors", "scene.json"} <= {
        p.name for p in run_folder.iterdir()
    }
    assert list((run_folder / "previews").glob("*.jpg"))


def test_fit_refuses_a_folder_that_holds_a_run(run_folder, capsys):
    said = complaint(capsys, "fit", STREET, "-o", run_folder, "--steps", "1")
    assert "--resume" in said


def kept(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--camera-height", "3 m"], "keeps its scale"),
        (["--metric-input"], "keeps its scale"),
        (["--downscale", "3"], "--downscale 6"),
        (["--downscale", "6", "--holdout", "0"], "other photos"),
    ],
)
def test_a_run_is_resumed_as_it_was_begun_or_not_at_all(
    run_folder, capsys, monkeypatch, words, expected
):
    settings = FitSettings(size=FEW_ROWS)
    monkeypatch.setattr("climatenerf.cli.fit.settings_of", lambda preset, device: settings)
    before = kept(run_folder)
    said = complaint(capsys, "fit", STREET, "-o", run_folder, "--resume", *words)
    assert expected in said
    assert kept(run_folder) == before


def test_a_run_of_another_preset_is_refused_before_labels_are_made(run_folder, capsys, monkeypatch):
    def minutes(*_):
        raise AssertionError("labels may take minutes to make")

    monkeypatch.setattr("climatenerf.cli.fit.with_perception", minutes)
    said = complaint(capsys, "fit", STREET, "-o", run_folder, "--resume", "--preset", "gpu")
    assert "with --preset cpu; resume it with the same" in said


def test_the_command_to_go_on_with_repeats_the_flags():
    from climatenerf.cli.fit import Fit, resuming

    begun = Fit(Path("my photos"), Path("run"), minutes=60, downscale=2, camera_height=3.0, seed=4)
    assert resuming(begun) == (
        "climatenerf fit 'my photos' -o run --resume --minutes 60 --downscale 2 --seed 4"
    )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--loss", "foo=1"], "Names: distortion"),
        (["--loss", "sky"], "--loss wants"),
        (["--loss", "sky=-1"], "--loss wants"),
        (["--loss", "normal_consistency=1", "--loss", "normals=0"], "needs predicted normals"),
    ],
)
def test_losses_that_cannot_be_used(tmp_path, capsys, words, expected):
    assert expected in complaint(capsys, "fit", STREET, "-o", tmp_path / "run", *words)
    assert not (tmp_path / "run").exists()


def test_losses_come_from_flags_on_top_of_the_preset():
    fit = Fit(Path("a"), Path("b"), preset="paper", loss=("sky=0", "planarity=0.5"))
    settings = fit_settings(fit)
    assert settings.losses == dataclasses.replace(PAPER.losses, sky=0.0, planarity=0.5)
    assert settings.preset == "paper" and settings.opaque_sky
    assert fit_settings(dataclasses.replace(fit, mono_depth="none")).losses.monocular_depth == 0
    earlier = dataclasses.replace(fit, loss=("sky=0", "flat=0.5"))
    assert fit_settings(earlier) == settings, "earlier names of losses are taken as well"
    words = resuming(fit)
    assert "--loss sky=0 --loss planarity=0.5" in words and "--preset paper" in words
    assert resuming(Fit(Path("a"), Path("b"), refine_poses=True)).endswith("--refine-poses")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("DOOR", "a name and a length"), ("DOOR=2 kg", "length"), ("DOOR=-1 m", "above 0"),
     ("DOOR=2 m", "mark.html")],
)  # fmt: skip
def test_known_lengths_that_cannot_be_used(tmp_path, capsys, text, expected):
    words = ["fit", STREET, "-o", tmp_path / "run", "--known-length", text]
    assert expected in complaint(capsys, *words)
    assert not (tmp_path / "run").exists()


def test_a_known_length_sets_the_scale(tmp_path):
    """The street's own metres say how long something is; told it is twice that, all doubles."""
    from climatenerf.cli.fit import with_known_lengths
    from climatenerf.scene import read_scene

    scene = read_scene(STREET)
    ends = {"from": np.array([2.0, 6.0, 0.5]), "to": np.array([2.0, 6.0, 2.5])}
    lines = []
    for end, place in ends.items():
        lines.append(f"[POST.{end}]")
        for view in scene.views:
            c2w, camera = scene.c2w_world(view), scene.cameras[view.camera]
            local = (place - c2w[:3, 3]) @ c2w[:3, :3]
            x, y = camera.project(local)
            if local[2] > 0.5 and 0 < x < camera.width and 0 < y < camera.height:
                lines.append(f'"{view.name}" = [{x:.3f}, {y:.3f}]')
    (tmp_path / "marks.toml").write_text("\n".join(lines))
    out = with_known_lengths(scene, ("POST=4 m",), tmp_path / "marks.toml")
    assert out.scale == pytest.approx(2 * scene.scale, rel=1e-3)
    # In photos of 384 pixels two pixels are some centimetres.
    assert out.scale_source == "known-length" and out.scale_error < 0.03


@pytest.mark.parametrize("left", ["optimiser.safetensors", "metrics.json"])
def test_a_finished_run_is_not_overwritten_whatever_was_deleted(run_folder, tmp_path, capsys, left):
    (tmp_path / "run").mkdir()
    shutil.copy(run_folder / left, tmp_path / "run" / left)
    complaint(capsys, "fit", STREET, "-o", tmp_path / "run", "--steps", "1")
    assert [p.name for p in (tmp_path / "run").iterdir()] == [left]


def test_a_capture_is_never_written_into(tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(STREET, scene)
    before = kept(scene)
    assert "capture itself" in complaint(capsys, "fit", scene, "-o", scene, "--steps", "1")
    shutil.copytree(scene, tmp_path / "other")
    said = complaint(capsys, "fit", scene, "-o", tmp_path / "other", "--steps", "1")
    assert "overwritten" in said
    assert kept(scene) == kept(tmp_path / "other") == before


# --- render -----------------------------------------------------------------------------------


def test_a_shorter_render_leaves_nothing_of_the_longer_one_before_it(run_folder, tmp_path):
    words = ["render", run_folder, "-o", tmp_path, "--size", "48x27", "--layers", "depth"]
    assert status(*words, "--frames", "3") == 0
    (tmp_path / "frames" / "mine.png").write_bytes(b"not a frame")
    assert status(*words, "--frames", "1", "--smog.visibility", "50 m") == 0
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["0000.png", "mine.png"]
    assert sorted(p.name for p in (tmp_path / "depth").iterdir()) == ["0000.npz"]
    told = json.loads((tmp_path / "movie.json").read_text())
    assert len(told["frames"]) == 1 and told["weather"]["smog"]["visibility"] == "50 m"


def test_flags_of_a_weather_that_is_not_there_are_told(run_folder, tmp_path, capsys):
    words = ["render", str(run_folder), *map(str, SMALL), "--frames", "1", "-o", str(tmp_path)]
    assert cli.main([*words, "--flood.wind-speed", "4 m/s", "--snow.depth", "1 cm"]) == 0
    told = capsys.readouterr().err
    assert "--flood.wind-speed changes nothing without --flood.level" in told
    assert "--snow" not in told
    film = tmp_path / "film.toml"
    film.write_text('[flood]\nlevel = { "0 s" = "1 cm", "1 s" = "2 cm" }\n')
    given = ["--weather", str(film), "--flood.wind-speed", "4 m/s"]
    assert cli.main([*words[:-1], str(tmp_path / "film"), *given]) == 0
    assert "changes nothing" not in capsys.readouterr().err


OURS = ["frames/0000.png", "movie.mp4", "movie.json", "depth/0000.npz", "preview.png"]


@pytest.mark.parametrize("name", OURS)
def test_a_render_overwrites_nothing_that_it_did_not_make(run_folder, tmp_path, capsys, name):
    mine = tmp_path / "mine" / name
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b'{"mine": 1}')
    words = ["render", run_folder, "-o", tmp_path / "mine", "--layers", "depth", *SMALL]
    words += ["--preview"]
    assert mine.name in complaint(capsys, *words)
    assert mine.read_bytes() == b'{"mine": 1}'
    assert [p for p in (tmp_path / "mine").rglob("*") if p.is_file()] == [mine]


def test_a_preview_changes_no_frame_and_is_removed(run_folder, tmp_path):
    """Also where a killed render left a preview."""
    (tmp_path / "early").mkdir()
    left_over = tmp_path / "early" / "preview.png"
    write_png(left_over, np.zeros((2, 2, 3), np.uint8), "killed")
    words = ["render", str(run_folder), *map(str, SMALL)]
    assert cli.main([*words, "-o", str(tmp_path / "early"), "--preview"]) == 0
    assert not left_over.exists()
    assert cli.main([*words, "-o", str(tmp_path / "plain")]) == 0
    for index in range(2):
        frame = f"frames/{index:04d}.png"
        same = [read_rgb(tmp_path / folder / frame) for folder in ("early", "plain")]
        assert np.array_equal(*same)


def test_parts_in_any_order_are_joined_to_the_movie_of_one_render(run_folder, tmp_path, capsys):
    words = ["render", run_folder, "--size", "48x27", "--frames", "5", "--layers", "depth"]
    words += ["--flood.level", "0.3 m"]
    assert status(*words, "-o", tmp_path / "whole") == 0
    parts = [*words, "-o", tmp_path / "parts"]
    assert status(*parts, "--part", "2/2") == 0
    out, err = capsys.readouterr()
    assert f"frames: {tmp_path / 'parts' / 'frames'}" in out and "2 of 5 frames are finished" in err
    made = sorted(p.name for p in (tmp_path / "parts" / "frames").iterdir())
    assert made == ["0001.png", "0003.png"]
    said = complaint(capsys, *parts, "--join")
    assert "3 of 5 frames" in said and "0000, 0002, 0004" in said
    assert not (tmp_path / "parts" / "movie.json").exists()
    assert status(*parts, "--part", "1/2") == status(*parts, "--join") == 0
    for path in (tmp_path / "whole").rglob("*"):
        if path.is_file():
            same = tmp_path / "parts" / path.relative_to(tmp_path / "whole")
            assert same.read_bytes() == path.read_bytes(), path


@pytest.mark.slow
def test_processes_render_parts_of_a_run_and_one_is_killed(run_folder, tmp_path):
    flags = ["--size", "48x27", "--frames", "6", "--flood.level", "0.3 m", "--snow.depth", "9 cm"]

    def start(out, *words):
        command = [sys.executable, "-m", "climatenerf", "render", run_folder, "-o", tmp_path / out]
        return subprocess.Popen([*map(str, command), *flags, *words], stderr=subprocess.DEVNULL)

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
    words = ["render", run_folder, "-o", tmp_path, "--size", "48x27", "--frames", "2"]
    assert status(*words, "--part", "1/2") == 0
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for flags in (["--part", "2/2"], []):
        said = complaint(capsys, *words, "--smog.visibility", "50 m", *flags)
        assert "unfinished render with other settings" in said
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_path_that_asks_for_huge_frames(run_folder, tmp_path, capsys):
    entry = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 45}
    path = {"render_width": 100000, "render_height": 100000, "fps": 5, "camera_path": [entry]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    words = ["render", run_folder, "-o", tmp_path / "out", "--path", tmp_path / "path.json"]
    assert "too large" in complaint(capsys, *words)
    (tmp_path / "path.json").write_text("[" * 100_000)
    assert "deeply" in complaint(capsys, *words)


def test_frames_keep_their_sidecar_when_there_is_no_movie(
    run_folder, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "absent"))
    said = complaint(capsys, "render", run_folder, "-o", tmp_path / "out", *SMALL)
    assert "ffmpeg" in said
    sidecar = json.loads((tmp_path / "out" / "movie.json").read_text())
    assert len(sidecar["frames"]) == 2 and sidecar["frames_wanted"] == 2
    assert "lowest_ground_z" in sidecar
    assert not (tmp_path / "out" / "movie.mp4").exists()


def test_render_with_all_weathers_at_once(run_folder, tmp_path, capsys, monkeypatch):
    words = ["render", run_folder, "-o", tmp_path, *SMALL, "--layers", "all"]
    words += ["--flood.level", "0.4 m", "--smog.visibility", "60 m", "--snow.depth", "15 cm"]
    assert status(*words) == 0
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
    known = set(layer_table()) - {"label"}  # the embedded street's labels know the sky alone
    for frame in sidecar["frames"]:
        assert (frame["camera"]["width"], frame["camera"]["height"]) == (96, 54)
        assert np.array(frame["c2w_world"]).shape == (4, 4)
        assert set(frame["layers"]) == known
        layers = {}
        for name in known:
            layers[name] = np.load(tmp_path / frame["layers"][name][0])[name]
            assert not np.isnan(layers[name]).any(), name
            assert layers[name].shape[:2] == (54, 96)
        assert frame["measured"]["water_share"] == pytest.approx(
            float(layers["mask_water"].mean()), abs=1e-6
        )
        for mask in ("mask_water", "mask_snow", "mask_smog", "transmittance"):
            assert layers[mask].min() >= -1e-5 and layers[mask].max() <= 1 + 1e-5
        assert layers["mask_water"].mean() > 0.02 and layers["mask_smog"].mean() > 0.05
        # Smog in closed form: the transmittance is that of the depth beside it.
        seen = np.isfinite(layers["depth"])
        expected = np.exp(-2.996 / 60 * layers["depth"][seen])
        assert np.allclose(layers["transmittance"][seen], expected, atol=2e-3)


def test_render_without_weather_from_a_drawn_path(run_folder, tmp_path):
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
    words = ["render", run_folder, "-o", out, "--path", tmp_path / "camera_path.json"]
    assert status(*words) == 0
    sidecar = json.loads((out / "movie.json").read_text())
    assert sidecar["fps"] == 5 and len(sidecar["frames"]) == 2
    assert np.allclose(sidecar["frames"][0]["c2w_input"], c2w, atol=1e-5)
    assert Image.open(out / "frames" / "0001.png").size == (64, 36)
    assert sidecar["frames"][0]["measured"]["water_share"] == 0
    assert not (out / "depth").exists(), "layers come on request only"


def test_a_weather_file_and_a_flag_on_top(run_folder, tmp_path, monkeypatch):
    weather = tmp_path / "weather.toml"
    weather.write_text('seed = 7\n[smog]\nvisibility = "80 m"\n[flood]\nlevel = "0.3 m"\n')
    out = tmp_path / "out"
    words = ["render", run_folder, "-o", out, "--weather", weather, "--frames", "1"]
    words += ["--size", "64x36", "--smog.visibility", "20 m"]
    assert status(*words) == 0
    told = json.loads((out / "movie.json").read_text())["weather"]
    assert told["seed"] == 7 and told["flood"]["level"] == "0.3 m"
    assert told["smog"]["visibility"] == "20 m", "flags win, whoever called main"


# --- mistakes ---------------------------------------------------------------------------------


def capture(folder, count=6, **changes):
    """A small transforms.json whose frames can be spoilt."""
    frames = []
    for i in range(count):
        path = folder / "images" / f"{i}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(i).integers(0, 255, (24, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        turn = 2 * np.pi * i / count
        back = np.array([np.cos(turn), np.sin(turn), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([[-back[1], back[0], 0], [0, 0, 1], back, 4 * back], -1)
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    data = {"w": 32, "h": 24, "fl_x": 30.0, "frames": frames, **changes}
    (folder / "transforms.json").write_text(json.dumps(data))
    return data


def spoil_pose(data):
    data["frames"][2]["transform_matrix"][0][3] = float("nan")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (spoil_pose, "finite"),
        (lambda data: data.update(fl_x=0.0), "focal"),
        (lambda data: data.update(camera_model="PERISCOPE"), "PERISCOPE"),
    ],
)
def test_bad_poses_and_cameras(tmp_path, capsys, spoil, words):
    data = capture(tmp_path / "scene")
    spoil(data)
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(data))
    said = complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1")
    assert words in said
    assert not (tmp_path / "run").exists()


def test_a_missing_folder_and_one_without_pictures(tmp_path, capsys):
    said = complaint(capsys, "fit", tmp_path / "absent", "-o", tmp_path / "run")
    assert "absent" in said and "does not exist" in said
    (tmp_path / "empty").mkdir()
    said = complaint(capsys, "fit", tmp_path / "empty", "-o", tmp_path / "run")
    assert "no pictures" in said


def test_missing_pictures_are_counted_and_too_few_are_an_error(tmp_path, capsys):
    capture(tmp_path / "scene")
    for i in (1, 2, 3, 4):
        (tmp_path / "scene" / "images" / f"{i}.png").unlink()
    said = complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run")
    assert "2 of the 6" in said


@pytest.mark.parametrize("keep", [0.0, 0.5])
def test_a_truncated_picture(tmp_path, capsys, keep):
    capture(tmp_path / "scene")
    path = tmp_path / "scene" / "images" / "3.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    said = complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1")
    assert "3.png" in said
    assert not (tmp_path / "run" / "field.safetensors").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["--minutes", "0"],
        ["--minutes", "nan"],
        ["--minutes", "inf"],
        ["--loss", "sky=nan"],
        ["--loss", "sky=inf"],
        ["--steps", "0"],
        ["--downscale", "0"],
        ["--downscale", "2"],  # 16 x 12: too small to measure
        ["--downscale", "99"],
    ],
)
def test_fit_options_out_of_range(tmp_path, capsys, words):
    capture(tmp_path / "scene")
    complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", *words)


def test_masks_that_leave_nothing(tmp_path, capsys):
    capture(tmp_path / "scene")
    (tmp_path / "scene" / "masks").mkdir()
    for i in range(6):
        path = tmp_path / "scene" / "masks" / f"{i}.png"
        Image.fromarray(np.zeros((24, 32), np.uint8)).save(path)
    said = complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1")
    assert "masks" in said and not (tmp_path / "run").exists()
    mask = np.zeros((24, 32), np.uint8)
    mask[12, 16] = 255  # a pixel of one photo is as good as nothing
    Image.fromarray(mask).save(tmp_path / "scene" / "masks" / "3.png")
    said = complaint(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1")
    assert "masks" in said and not (tmp_path / "run").exists()


def test_unknown_names_to_hold_out(tmp_path, capsys):
    capture(tmp_path / "scene")
    words = ["fit", tmp_path / "scene", "-o", tmp_path / "run", "--holdout", "nobody.png"]
    assert "nobody.png" in complaint(capsys, *words)


@pytest.mark.parametrize(
    ("words", "expected"),
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
def test_render_mistakes(run_folder, tmp_path, capsys, words, expected):
    said = complaint(capsys, "render", run_folder, "-o", tmp_path / "out", *SMALL, *words)
    assert expected in said
    assert not (tmp_path / "out").exists(), "nothing is begun"


def test_appearances_are_counted_among_the_training_photos(run_folder):
    scene = load_scene(run_folder)
    names = [view.name for view in scene.of_split("train")]
    assert scene.views[0].name not in names, "held out, so that places differ"
    assert [appearance_index(name, scene) for name in names] == list(range(len(names)))
    assert appearance_index("mean", scene) is None


def test_frames_are_in_the_appearance_of_the_photo_that_is_named(run_folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    field, train = load_field(run), load_scene(run).of_split("train")
    with torch.no_grad():
        field.embeddings.normal_(generator=torch.Generator().manual_seed(0))
        field.view_net[0].normal_(generator=torch.Generator().manual_seed(1))
    save_field(field, run)
    frames, told = [], []
    for name in ("mean", train[2].name, train[3].name):
        out = tmp_path / name
        words = ["--path", "still", "--frames", "1", "--size", "64x36", "--appearance", name]
        assert status("render", run, "-o", out, *words) == 0
        frames.append(np.asarray(Image.open(out / "frames" / "0000.png")).astype(int))
        sidecar = json.loads((out / "movie.json").read_text())
        told.append(sidecar["appearance_of_training_view"])
    assert told == [None, 2, 3]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(frames[one] - frames[other]).mean() > 1


@pytest.mark.parametrize("value", ["10 kg", "half a metre", "0.5"])
def test_a_level_of_the_wrong_dimension(run_folder, tmp_path, capsys, value):
    """Told by the parser of options, in its own frame, with status 2."""
    capsys.readouterr()
    assert status("render", run_folder, "-o", tmp_path / "out", "--flood.level", value) == 2
    err = "".join(capsys.readouterr())
    assert "such as" in err and "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_folders_that_are_no_run(tmp_path, capsys):
    said = complaint(capsys, "render", tmp_path, "-o", tmp_path / "out")
    assert "climatenerf fit" in said
    complaint(capsys, "render", tmp_path / "absent", "-o", tmp_path / "out")
    complaint(capsys, "render", STREET, "-o", tmp_path / "out")


def test_a_run_from_a_newer_schema(run_folder, tmp_path, capsys):
    shutil.copytree(run_folder, tmp_path / "run")
    path = tmp_path / "run" / "field.safetensors"
    arrays, metadata = read_safetensors(path)
    about = {**json.loads(metadata["climatenerf"]), "schema_version": 99}
    write_safetensors(path, arrays, {"climatenerf": json.dumps(about)})
    said = complaint(capsys, "render", tmp_path / "run", "-o", tmp_path / "out", *SMALL)
    assert "newer" in said and "99" in said
    shutil.copy(run_folder / "field.safetensors", path)
    config = tmp_path / "run" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "schema_version": 98}))
    said = complaint(capsys, "render", tmp_path / "run", "-o", tmp_path / "out", *SMALL)
    assert "newer" in said and "98" in said


def test_a_damaged_run(run_folder, tmp_path, capsys):
    shutil.copytree(run_folder, tmp_path / "run")
    path = tmp_path / "run" / "field.safetensors"
    path.write_bytes(path.read_bytes()[:5000])
    assert "damaged" in complaint(capsys, "render", tmp_path / "run", "-o", tmp_path / "out")


# --- help -------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", ["fit", "render", "demo"])
def test_help_of_a_verb_loads_no_torch(verb):
    code = (
        "import sys; from climatenerf.cli import main\n"
        "try:\n    status = main(sys.argv[1:])\n"
        "except SystemExit as left:\n    status = left.code\n"
        "print('HEAVY', sorted({'torch', 'numba'} & set(sys.modules)), 'STATUS', status)"
    )
    words = [sys.executable, "-c", code, verb, "--help"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.stdout.rstrip().endswith("HEAVY [] STATUS 0"), done.stdout + done.stderr
    assert f"climatenerf {verb}" in done.stdout
