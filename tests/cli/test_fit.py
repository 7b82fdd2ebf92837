"""`climatenerf fit`: what it writes, what it resumes, and what it refuses."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import FEW_ROWS, STREET, error_message

from climatenerf import cli
from climatenerf.cli.fit import Fit, datum_line, fit_settings, resuming
from climatenerf.training.settings import PAPER, FitSettings, Losses


def test_steps_replace_the_time_limit_and_the_device_selects_the_preset():
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
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert end.value.code == 0
    assert all(f" {each.name}" in text for each in dataclasses.fields(Losses))


def test_fit_writes_a_run_folder(run_folder):
    metrics = json.loads((run_folder / "metrics.json").read_text())
    assert {"psnr", "ssim", "psnr_cc", "seconds", "steps", "samples"} <= metrics.keys()
    assert metrics["steps"] == 300 and metrics["downscale"] == 6 and metrics["psnr"] > 8
    assert len(metrics["views"]) == 8
    assert {"config.json", "field.safetensors", "optimiser.safetensors", "scene.json"} <= {
        p.name for p in run_folder.iterdir()
    }
    assert list((run_folder / "previews").glob("*.jpg"))


def test_fit_refuses_a_folder_that_contains_a_run(run_folder, capsys):
    message = error_message(capsys, "fit", STREET, "-o", run_folder, "--steps", "1")
    assert "--resume" in message


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--camera-height", "3 m"], "keeps its scale"),
        (["--metric-input"], "keeps its scale"),
        (["--downscale", "3"], "--downscale 6"),
        (["--downscale", "6", "--holdout", "0"], "other photos"),
    ],
)
def test_a_resume_with_other_settings_is_refused(
    run_folder, tmp_path, capsys, monkeypatch, args, expected
):
    settings = FitSettings(size=FEW_ROWS)
    monkeypatch.setattr("climatenerf.cli.fit.settings_of", lambda preset, device: settings)
    own = tmp_path / "run"  # renders of other processes keep what they find in the shared one
    shutil.copytree(run_folder, own)
    before = contents(own)
    message = error_message(capsys, "fit", STREET, "-o", own, "--resume", *args)
    assert expected in message
    assert contents(own) == before


def test_a_run_of_another_preset_is_refused_before_labels_are_made(run_folder, capsys, monkeypatch):
    def minutes(*_):
        raise AssertionError("labels may take minutes to make")

    monkeypatch.setattr("climatenerf.cli.fit.with_perception", minutes)
    message = error_message(capsys, "fit", STREET, "-o", run_folder, "--resume", "--preset", "gpu")
    assert "with --preset cpu; resume it with the same" in message


def test_the_command_that_resumes_a_run_repeats_its_flags():
    from climatenerf.cli.fit import Fit, resuming

    begun = Fit(Path("my photos"), Path("run"), minutes=60, downscale=2, camera_height=3.0, seed=4)
    assert resuming(begun) == (
        "climatenerf fit 'my photos' -o run --resume --minutes 60 --downscale 2 --seed 4"
    )


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--loss", "foo=1"], "Names: distortion"),
        (["--loss", "sky"], "--loss needs"),
        (["--loss", "sky=-1"], "--loss needs"),
        (["--loss", "normal_consistency=1", "--loss", "normals=0"], "needs predicted normals"),
    ],
)
def test_invalid_losses_are_refused(tmp_path, capsys, args, expected):
    assert expected in error_message(capsys, "fit", STREET, "-o", tmp_path / "run", *args)
    assert not (tmp_path / "run").exists()


def test_loss_flags_override_the_preset():
    fit = Fit(Path("a"), Path("b"), preset="paper", loss=("sky=0", "planarity=0.5"))
    settings = fit_settings(fit)
    assert settings.losses == dataclasses.replace(PAPER.losses, sky=0.0, planarity=0.5)
    assert settings.preset == "paper" and settings.opaque_sky
    assert fit_settings(dataclasses.replace(fit, mono_depth="none")).losses.monocular_depth == 0
    earlier = dataclasses.replace(fit, loss=("sky=0", "flat=0.5"))
    assert fit_settings(earlier) == settings, "earlier names of losses are accepted"
    command = resuming(fit)
    assert "--loss sky=0 --loss planarity=0.5" in command and "--preset paper" in command
    assert resuming(Fit(Path("a"), Path("b"), refine_poses=True)).endswith("--refine-poses")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("DOOR", "a name and a length"), ("DOOR=2 kg", "length"), ("DOOR=-1 m", "above 0"),
     ("DOOR=2 m", "mark.html")],
)  # fmt: skip
def test_invalid_known_lengths_are_refused(tmp_path, capsys, text, expected):
    args = ["fit", STREET, "-o", tmp_path / "run", "--known-length", text]
    assert expected in error_message(capsys, *args)
    assert not (tmp_path / "run").exists()


def test_a_known_length_sets_the_scale(tmp_path):
    """A length given as twice the true one doubles the scale."""
    from climatenerf.cli.fit import with_known_lengths
    from climatenerf.scene import read_scene

    scene = read_scene(STREET)
    ends = {"from": np.array([2.0, 6.0, 0.5]), "to": np.array([2.0, 6.0, 2.5])}
    lines = []
    for end, point in ends.items():
        lines.append(f"[POST.{end}]")
        for view in scene.views:
            c2w, camera = scene.c2w_world(view), scene.cameras[view.camera]
            local = (point - c2w[:3, 3]) @ c2w[:3, :3]
            x, y = camera.project(local)
            if local[2] > 0.5 and 0 < x < camera.width and 0 < y < camera.height:
                lines.append(f'"{view.name}" = [{x:.3f}, {y:.3f}]')
    (tmp_path / "marks.toml").write_text("\n".join(lines))
    out = with_known_lengths(scene, ("POST=4 m",), tmp_path / "marks.toml")
    assert out.scale == pytest.approx(2 * scene.scale, rel=1e-3)
    # In photos of 384 pixels two pixels are some centimetres.
    assert out.scale_source == "known-length" and out.scale_error < 0.03


@pytest.mark.parametrize("remaining", ["optimiser.safetensors", "metrics.json"])
def test_a_run_with_deleted_files_is_not_overwritten(run_folder, tmp_path, capsys, remaining):
    (tmp_path / "run").mkdir()
    shutil.copy(run_folder / remaining, tmp_path / "run" / remaining)
    error_message(capsys, "fit", STREET, "-o", tmp_path / "run", "--steps", "1")
    assert [p.name for p in (tmp_path / "run").iterdir()] == [remaining]


def test_fit_does_not_write_into_the_capture(tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(STREET, scene)
    before = contents(scene)
    assert "capture itself" in error_message(capsys, "fit", scene, "-o", scene, "--steps", "1")
    shutil.copytree(scene, tmp_path / "other")
    message = error_message(capsys, "fit", scene, "-o", tmp_path / "other", "--steps", "1")
    assert "overwritten" in message
    assert contents(scene) == contents(tmp_path / "other") == before


def capture(folder, count=6, **changes):
    """Write a small capture; `spoil` changes its transforms.json."""
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
    ("spoil", "expected"),
    [
        (spoil_pose, "finite"),
        (lambda data: data.update(fl_x=0.0), "focal"),
        (lambda data: data.update(camera_model="PERISCOPE"), "PERISCOPE"),
    ],
)
def test_invalid_poses_and_cameras_are_refused(tmp_path, capsys, spoil, expected):
    data = capture(tmp_path / "scene")
    spoil(data)
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(data))
    message = error_message(
        capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1"
    )
    assert expected in message
    assert not (tmp_path / "run").exists()


def test_missing_folders_and_folders_without_pictures_are_refused(tmp_path, capsys):
    message = error_message(capsys, "fit", tmp_path / "absent", "-o", tmp_path / "run")
    assert "absent" in message and "does not exist" in message
    (tmp_path / "empty").mkdir()
    message = error_message(capsys, "fit", tmp_path / "empty", "-o", tmp_path / "run")
    assert "neither images nor poses" in message


def test_missing_pictures_are_counted_and_too_few_are_an_error(tmp_path, capsys):
    capture(tmp_path / "scene")
    for i in (1, 2, 3, 4):
        (tmp_path / "scene" / "images" / f"{i}.png").unlink()
    message = error_message(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run")
    assert "2 of the 6" in message


@pytest.mark.parametrize("keep", [0.0, 0.5])
def test_a_truncated_picture_is_refused(tmp_path, capsys, keep):
    capture(tmp_path / "scene")
    path = tmp_path / "scene" / "images" / "3.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    message = error_message(
        capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1"
    )
    assert "3.png" in message
    assert not (tmp_path / "run" / "field.safetensors").exists()


@pytest.mark.parametrize(
    "args",
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
def test_fit_options_out_of_range_are_refused(tmp_path, capsys, args):
    capture(tmp_path / "scene")
    error_message(capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", *args)


def test_masks_that_leave_no_pixels_are_refused(tmp_path, capsys):
    capture(tmp_path / "scene")
    (tmp_path / "scene" / "masks").mkdir()
    for i in range(6):
        path = tmp_path / "scene" / "masks" / f"{i}.png"
        Image.fromarray(np.zeros((24, 32), np.uint8)).save(path)
    message = error_message(
        capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1"
    )
    assert "masks" in message and not (tmp_path / "run").exists()
    mask = np.zeros((24, 32), np.uint8)
    mask[12, 16] = 255  # one pixel of one photo is too few
    Image.fromarray(mask).save(tmp_path / "scene" / "masks" / "3.png")
    message = error_message(
        capsys, "fit", tmp_path / "scene", "-o", tmp_path / "run", "--steps", "1"
    )
    assert "masks" in message and not (tmp_path / "run").exists()


def test_unknown_held_out_photos_are_refused(tmp_path, capsys):
    capture(tmp_path / "scene")
    args = ["fit", tmp_path / "scene", "-o", tmp_path / "run", "--holdout", "nobody.png"]
    assert "nobody.png" in error_message(capsys, *args)


def test_a_moved_datum_is_reported():
    assert datum_line({}) == datum_line({"datum_moved_m": 0.0}) == ""
    line = datum_line({"datum_moved_m": 0.247})
    assert "+0.25 m" in line and "--camera-height" in line
