import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.toy_scene import TINY, make_scene

from climatenerf.core.errors import UserError
from climatenerf.core.samples import MIN_TAU
from climatenerf.evaluation.baselines import CleanView
from climatenerf.evaluation.evaluated_run import EvaluatedRun
from climatenerf.evaluation.reference import read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.field.presets import PRESETS, FieldSize
from climatenerf.scene import Camera, load_scene, read_scene
from climatenerf.studies import geometry_ablation as ablation
from climatenerf.studies.study_folder import ABLATION, TEXT
from climatenerf.training import run as run_module
from climatenerf.training.settings import PAPER, FitSettings, Losses, settings_of

REFERENCE = Path(__file__).parents[2] / "reference" / "street"


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setattr(ablation, "settings_of", lambda preset: FitSettings(size=TINY))
    monkeypatch.setattr(run_module, "PREVIEW_WIDTH", 32)


def differences(one, other):
    """Return the names of the settings and losses in which two differ."""
    settings = {
        f.name for f in dataclasses.fields(FitSettings) if f.name != "losses"
        and getattr(one, f.name) != getattr(other, f.name)
    }  # fmt: skip
    return settings | {
        f.name
        for f in dataclasses.fields(Losses)
        if getattr(one.losses, f.name) != getattr(other.losses, f.name)
    }


def test_density_normals_are_taken_at_the_surfaces_in_camera_axes():
    """The normals point away from the plane x = 2 on both sides; they are 0 in the sky."""

    class Slanted:
        def to_grid(self, x):
            return x - 2

        def density_normal(self, q):
            return torch.stack([q[:, 0].sign(), torch.zeros(len(q)), torch.zeros(len(q))], dim=-1)

    camera = Camera(2, 1, 1.0, 1.0, 1.0, 0.5)
    c2w = np.eye(4)
    c2w[:3, :3] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]  # its x axis is the world's y
    c2w[:3, 3] = (-1.0, 0.0, 0.0)
    rays = np.array([[[1.0, 0, 0], [1.0, 0, 0]]])
    for depth, along in ((4.0, 1.0), (2.0, -1.0)):
        depths = np.array([[depth, np.inf]])
        dry = CleanView(np.zeros((1, 2, 3)), depths, np.zeros((1, 2, 3)), rays, c2w, camera)
        found = ablation.density_normals(Slanted(), dry)
        assert np.allclose(found, [[[0.0, -along, 0.0], [0.0, 0.0, 0.0]]]), found


def test_each_row_leaves_out_one_part():
    rows = ablation.rows(4.0)
    full = rows["full"]
    assert full == FitSettings(minutes=4.0, size=TINY)
    assert {name: differences(full, row) for name, row in rows.items() if name != "plain NGP"} == {
        "no appearance": {"appearance"},
        "no distortion": {"distortion"},
        "no normals": {"normals"},
        "no planarity": {"planarity"},
        "no occlusion": {"occlusion"},
        "no sky": {"sky_labels"},
        "no monocular depth": {"monocular_depth"},
        "monocular depth alone": {"sparse_depth", "ground_height"},
        "no depth": {"sparse_depth", "ground_height", "monocular_depth"},
        "full": set(),
    }
    plain = rows["plain NGP"]
    assert (
        not any(dataclasses.astuple(plain.losses)) and not plain.appearance and not plain.free_space
    )
    assert not plain.sky_labels and not plain.multiview_stereo and plain.decay == 0 < full.decay
    assert (
        not plain.warm_up
        and not plain.near_camera_gradient_scaling
        and plain.pruning_threshold == MIN_TAU < full.pruning_threshold
    )
    assert {row.samples_per_step for row in rows.values()} == {full.samples_per_step}


def test_rows_are_selected_by_name_in_table_order():
    assert list(ablation.select_rows(4.0, ())) == list(ablation.rows(4.0))
    two = ablation.select_rows(2.0, ("full", "plain NGP"))
    assert list(two) == ["plain NGP", "full"] and two["full"] == ablation.rows(2.0)["full"]
    with pytest.raises(UserError, match="'no sun'; choose from: plain NGP, no appearance"):
        ablation.select_rows(4.0, ("full", "no sun"))


def test_the_paper_preset_has_the_weights_of_the_paper():
    """Where the paper prints 3^{-4}, the authors' first public code has 3e-4."""
    weights = PAPER.losses
    assert (weights.classes, weights.normals, weights.distortion) == (4e-2, 7e-4, 3e-4)
    assert (weights.sky, weights.opacity_entropy, PAPER.decay) == (1e-1, 2e-4, 0.0)
    assert settings_of("paper") is PAPER and settings_of("cpu").losses == Losses()
    assert settings_of("gpu").preset == "gpu"


def test_the_paper_preset_has_surface_heads_on_the_appearance_grid():
    paper = PRESETS["paper"]
    assert paper.surface_levels == 0 and FieldSize().surface_levels > 0
    assert (paper.geometry_levels, paper.geometry_log2_rows) == (16, 19)
    assert (paper.appearance_levels, paper.appearance_log2_rows) == (32, 21)
    assert PAPER.preset == "paper" and PAPER.opaque_sky


def test_finished_rows_are_kept_and_other_settings_refused(tmp_path):
    scene = make_scene(tmp_path / "toy")
    settings = FitSettings(size=TINY, minutes=None, steps=2, samples_per_step=2**12)
    run, steps = tmp_path / "run", []
    ablation.fit_row(scene, run, settings, 1, lambda state: steps.append(state.step))
    assert steps == [1, 2]
    field = (run / "field.safetensors").read_bytes()
    ablation.fit_row(scene, run, settings, 1, lambda state: steps.append(state.step))
    assert steps == [1, 2] and (run / "field.safetensors").read_bytes() == field
    for other, downscale in ((dataclasses.replace(settings, seed=1), 1), (settings, 2)):
        with pytest.raises(UserError, match="other settings"):
            ablation.fit_row(scene, run, other, downscale, lambda state: None)


@pytest.mark.slow
def test_an_interrupted_row_is_resumed(tmp_path):
    scene = make_scene(tmp_path / "toy")
    settings = FitSettings(size=TINY, minutes=None, steps=6, samples_per_step=2**12)
    run, steps = tmp_path / "run", []

    def stop(state):
        steps.append(state.step)
        if state.step == 3 and len(steps) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ablation.fit_row(scene, run, settings, 1, stop)
    ablation.fit_row(scene, run, settings, 1, stop)
    assert steps == [1, 2, 3, 4, 5, 6]


def test_a_capture_without_ground_truth_is_refused_before_any_fit(tmp_path):
    scene = make_scene(tmp_path / "toy")
    with pytest.raises(UserError, match="reference"):
        ablation.ablate(scene, tmp_path / "out", 1.0, 1, 1, print, print, ablation.rows(1.0))
    assert not (tmp_path / "out").exists()


def test_the_table_shows_means_and_half_ranges():
    data = {
        "minutes": 2.0,
        "downscale": 2,
        "capture": "street",
        "rows": [
            {"name": "plain NGP", "seeds": [{"psnr": 20.0}, {"psnr": 21.0}]},
            {"name": "full", "seeds": [{"psnr": 25.0}]},
        ],
    }
    text = ablation.markdown(data)
    assert "| plain NGP | 20.5 ± 0.5 | - |" in text and "| full | 25 | - |" in text


def test_metrics_are_means_over_the_fits_that_have_them():
    seeds = [{"psnr": 20.0, "miou": 0.5}, {"psnr": 22.0}]
    assert ablation.means(seeds) == {"psnr": 21.0, "miou": 0.5}


def test_rows_of_monocular_depth_need_a_capture_that_has_it(tmp_path):
    """Without it they would equal other rows."""
    scene = make_scene(tmp_path / "toy")
    assert not ablation.has_relative_depth(scene)
    rest = ablation.select_rows(4.0, (), relative_depth=False)
    assert set(ablation.rows(4.0)) - set(rest) == {"no monocular depth", "monocular depth alone"}
    with pytest.raises(UserError, match="needs a capture with relative depths"):
        ablation.select_rows(4.0, ("full", "monocular depth alone"), relative_depth=False)
    (scene.root / "depth_relative").mkdir()
    assert ablation.has_relative_depth(scene)
    assert "monocular depth alone" in ablation.select_rows(4.0, ("monocular depth alone",))


def test_depth_and_normal_pictures_have_known_values():
    depth = np.array([[1.0, 4.0, np.inf]])
    assert ablation.depth_picture(depth)[0, :, 0].tolist() == [255, 128, 0]
    normal = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    assert ablation.normal_picture(normal)[0].tolist() == [[128, 128, 255], [0, 0, 0]]


@pytest.mark.slow
def test_two_rows_from_end_to_end(tmp_path, monkeypatch):
    full = FitSettings(size=TINY, minutes=None, steps=250, samples_per_step=2**14)
    bare = ablation.rows(1.0)["no sky"]
    bare = dataclasses.replace(bare, minutes=None, steps=250, samples_per_step=2**14)
    chosen = {"no sky": bare, "full": full}
    monkeypatch.setattr(ablation, "WEATHERS", ("smog-mid",))
    data = ablation.ablate(
        read_scene(REFERENCE), tmp_path, 1.0, 4, 1, lambda *_: None, lambda name: None, chosen
    )
    rows = {row["name"]: row["metrics"] for row in data["rows"]}
    assert rows["full"]["sky_empty_fraction"] > rows["no sky"]["sky_empty_fraction"]
    written = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert [row["name"] for row in written] == list(rows)
    assert [row["picture"] for row in written] == ["no-sky.jpg", "full.jpg"]
    assert all((tmp_path / row["picture"]).stat().st_size > 5_000 for row in written)
    assert (tmp_path / "contact-sheet.jpg").stat().st_size > 10_000
    assert "smog-mid" in (tmp_path / "ablation.md").read_text()


@pytest.mark.slow
def test_a_short_fit_of_the_reference_street_is_good(tmp_path, monkeypatch):
    """The bounds lie between the scores of docs/reference-scene.md and those of broken fits."""
    monkeypatch.undo()  # the real preset
    monkeypatch.setattr(ablation, "WEATHERS", ())
    scene = read_scene(REFERENCE)
    settings = FitSettings(minutes=None, steps=700)
    run_module.fit_scene(scene, tmp_path, settings, 2, False, lambda _: None, lambda *_: None)
    run = EvaluatedRun(load_field(tmp_path), load_scene(tmp_path), read_reference(REFERENCE))
    found, _ = ablation.score_row(run, settings, False)
    assert found["psnr"] > 24 and found["depth_abs_rel"] < 0.06 and found["miou"] > 0.85
    assert found["normal_ground_roof_median_deg"] < 8 and found["floater_mass"] < 0.12
    # Predicted normals are much smoother than those of the density.
    assert found["normal_median_deg"] < 0.6 * found["slope_median_deg"]
    assert found["open_sky"] > 0.95 and found["sky_empty_fraction"] > 0.9
    # Reflections show the sky in all directions above the horizon; none may be black.
    photos = np.concatenate([truth.clean.reshape(-1, 3) for truth in run.reference.truths])
    darkest = 0.25 * np.median(photos.mean(-1))
    azimuth, up = np.meshgrid(np.linspace(0, 2 * np.pi, 64), np.linspace(0.05, 1.0, 20))
    level = np.sqrt(1 - up**2)
    d = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], -1).reshape(-1, 3)
    sky = run.field.sky(torch.from_numpy(d.astype(np.float32)))
    assert sky.mean(-1).min() > darkest


@pytest.mark.parametrize("schema", [1, 2])
def test_a_report_of_fewer_rows_does_not_replace_one_of_more(tmp_path, schema):
    listed = [{"name": "full"}, {"name": "no sky"}]
    rows = {"full": [], "no sky": []} if schema == 1 else listed
    about = {"minutes": 4.0} if schema == 1 else {"study": "geometry", "files": []}
    (tmp_path / ABLATION).write_text(json.dumps({**about, "rows": rows}))
    ablation.check_folder(tmp_path, REFERENCE, ("no sky", "full", "no depth"))
    with pytest.raises(UserError, match="more rows .no sky.; choose another folder"):
        ablation.check_folder(tmp_path, REFERENCE, ("full",))


def test_wrong_input_is_refused_before_the_first_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "fit_scene", lambda *_: pytest.fail("a fit began"))
    scene = read_scene(REFERENCE)

    def refused(match, out, of=scene):
        with pytest.raises(UserError, match=match):
            ablation.ablate(of, out, 1.0, 2, 1, print, print, ablation.rows(1.0))

    refused("lies in the reference set", REFERENCE / "mine")
    trained = [dataclasses.replace(view, split="train") for view in scene.views]
    refused("was fitted to the test view", tmp_path, dataclasses.replace(scene, views=trained))
    fewer = [view for view in scene.views if view.name != "t03.jpg"]
    refused("lacks the test view", tmp_path, dataclasses.replace(scene, views=fewer))
    (tmp_path / TEXT).write_text("mine")
    refused("would be overwritten", tmp_path)
    assert (tmp_path / TEXT).read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
