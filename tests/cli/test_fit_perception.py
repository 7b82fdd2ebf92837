"""Sources of labels and relative depths for `fit`."""

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import names_of, ring, write_colmap

from climatenerf import cli
from climatenerf.cli import fit
from climatenerf.scene.images import load_labels


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    for seed, name in enumerate(names_of(9)):
        values = np.random.default_rng(seed).integers(20, 120, (24, 32, 3), dtype=np.uint8)
        values[:10] = 245
        Image.fromarray(values).save(folder / "images" / name)
    write_colmap(folder / "sparse" / "0", ring(9), names_of(9))
    return folder


@pytest.fixture
def fitted(monkeypatch):
    """Record the scenes that would be fitted."""
    scenes = []

    def record(scene, options):
        scenes.append(scene)
        return {"interrupted": True, "psnr": None, "steps": 1, "seconds": 1.0}

    monkeypatch.setattr(fit, "fit_with_bars", record)
    return scenes


def fit_of(capture, *args):
    return cli.main(["fit", str(capture), "-o", str(capture.parent / "run"), *map(str, args)])


def test_sky_is_labelled_without_given_labels(capture, fitted, capsys):
    assert fit_of(capture) == 0
    err = capsys.readouterr().err
    assert "--labels MODEL" in err and "labels: 100 %" in err
    assert (load_labels(fitted[0].views[0], fitted[0])[:5] == 10).all()
    assert not (capture / "labels").exists()
    assert len(list(fitted[0].views[0].label_path.parent.glob("*.png"))) == 9


def test_none_ignores_labels_and_is_part_of_the_resuming_command(capture, fitted, capsys):
    (capture / "labels").mkdir()
    Image.new("L", (32, 24), 0).save(capture / "labels" / "000.png")
    assert fit_of(capture) == fit_of(capture, "--labels", "none", "--mono-depth", "none") == 0
    assert fitted[0].views[0].label_path and not fitted[1].views[0].label_path
    message = capsys.readouterr().err.splitlines()[-1]
    assert "--labels none" in message
    args = [word for word in message.split(" -o ")[1].split()[1:] if word != "--resume"]
    assert fit_of(capture, *args) == 0, "the printed command is valid"
    assert not fitted[2].views[0].label_path


def test_unknown_models_are_refused_before_the_fit(capture, fitted, capsys):
    assert fit_of(capture, "--labels", "simpel") == 2
    assert "there is no model simpel" in capsys.readouterr().err
    assert fit_of(capture, "--mono-depth", capture / "absent") == 2
    assert "there is no model" in capsys.readouterr().err
    capsys.readouterr()
    assert fit_of(capture, "--labels", "heuristic", "--mono-depth", "absent") == 2
    err = capsys.readouterr().err
    assert "there is no model absent" in err and "labels:" not in err, "labels may take minutes"
    assert not fitted


def test_networks_of_the_user_make_labels_and_depth(capture, fitted, tmp_path, capsys):
    pytest.importorskip("transformers", reason="pip install .[perception]")
    from support import networks

    labels = networks.save_segformer(tmp_path / "segformer")
    depth = networks.save_depth_anything(tmp_path / "depth")
    assert fit_of(capture, "--labels", labels, "--mono-depth", depth) == 0
    assert all(view.label_path for view in fitted[0].views)
    assert len(list((capture / "depth_relative").glob("*.npz"))) == 9
    assert capsys.readouterr().err.count("Licence of") == 2
