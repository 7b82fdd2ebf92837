"""`climatenerf compare`: a comparison from the command line, and what it refuses."""

import json

import numpy as np
import pytest
from PIL import Image
from support.command_line import error_message, run_cli
from support.fake_checkouts import make_climategan, make_uvq
from support.processes import holder

SMALL = ["--size", "48x27", "--frames", "2", "--effects", "flood", "--portion", "0.02"]


@pytest.mark.slow
def test_all_kinds_of_methods_are_compared_and_licences_are_said_once(run_folder, tmp_path, capsys):
    checkout, weights = make_climategan(tmp_path)
    frames = tmp_path / "arf" / "flood"
    frames.mkdir(parents=True)
    for index in range(2):
        Image.new("RGB", (96, 54), (200, 0, 0)).save(frames / f"{index:04d}.png")
    film = tmp_path / "deep.toml"
    film.write_text('[flood]\nlevel = "0.5 m"\nwind-speed = "0 m/s"\n')
    out = tmp_path / "out"
    args = ["compare", run_folder, "-o", out, *SMALL, "--weather", f"flood={film}"]
    args += ["--climategan.checkout", checkout, "--climategan.weights", weights]
    args += ["--folder", f"arf={tmp_path / 'arf'}", "--uvq.checkout", make_uvq(tmp_path)]
    args += ["--licence", "CC BY 4.0"]
    assert run_cli(*args) == 0
    said = capsys.readouterr()
    assert f"report: {out / 'compare.md'}" in said.out and "## flood" in said.out
    for name in ("climategan", "climategan++", "arf", "UVQ"):
        assert said.err.count(f"licence of {name}:") == 1
    data = json.loads((out / "compare.json").read_text())
    kinds = {each["name"]: each["kind"] for each in data["methods"]}
    assert kinds["climatenerf"] == "ours" and kinds["flat-plane"] == "stand-in"
    assert kinds["climategan"] == kinds["climategan++"] == "model" and kinds["arf"] == "folder"
    assert data["licence"] == "CC BY 4.0" and data["size"] == [48, 27]
    assert data["weather"]["flood"]["flood"]["level"] == "0.5 m"
    assert all(row["uvq"] == 3.25 for row in data["scores"])
    red = np.asarray(Image.open(out / "flood" / "arf" / "frames" / "0001.png"))
    assert red.shape == (27, 48, 3) and (red == (200, 0, 0)).all()
    # The command resumes: the same files, and UVQ is not asked again.
    calls = (tmp_path / "uvq" / "calls.txt").read_text()
    assert run_cli(*args) == 0
    assert (tmp_path / "uvq" / "calls.txt").read_text() == calls
    assert json.loads((out / "compare.json").read_text()) == data


def test_wrong_flags_are_refused_before_anything_is_rendered(run_folder, tmp_path, capsys):
    out = tmp_path / "out"
    args = ["compare", run_folder, "-o", out]
    for flags, message in (
        (["--effects", "rain"], "there is no effect 'rain'"),
        (["--weather", "flood"], "--weather must be EFFECT=FILE"),
        (["--portion", "0"], "--portion must be above 0"),
        (["--fps", "0"], "the frame rate"),
        (["--size", "9x9"], "--size must be"),
        (["--seed", "-1"], "--seed must lie"),
        (["--folder", "x"], "--folder must be NAME=PATH"),
        (["--climategan.checkout", tmp_path], "no checkout of ClimateGAN"),
        (["--uvq.checkout", tmp_path], "no checkout of UVQ"),
        (["--diffusion.models", "owner/model"], "nothing is downloaded"),
    ):
        assert message in error_message(capsys, *args, *flags), flags
    assert not out.exists()
    assert "name another" in error_message(capsys, "compare", run_folder, "-o", run_folder)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "a.txt").write_text("mine")
    said = error_message(capsys, "compare", run_folder, "-o", mine, *SMALL)
    assert "no comparison made" in said and len(list(mine.iterdir())) == 1


def test_a_comparison_waits_for_no_other_writer(run_folder, tmp_path, capsys):
    out = tmp_path / "out"
    with holder(out):
        said = error_message(capsys, "compare", run_folder, "-o", out, *SMALL)
        assert f"another process is writing into {out}" in said
        assert not (out / "clean").exists()
