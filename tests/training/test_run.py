"""A run: what a fit writes into its folder, its scores, and input that it refuses."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from PIL import Image
from support.toy_run import contents, fitted, full_disk_for, limit_cost, nothing
from support.toy_scene import TINY, make_scene

from climatenerf.core.classes import BUILDING, SKY, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json
from climatenerf.evaluation.appearance import nearby_appearance
from climatenerf.evaluation.heldout import evaluate
from climatenerf.evaluation.metrics import psnr_cc
from climatenerf.field.checkpoint import load_field
from climatenerf.render.volume import render_view
from climatenerf.scene import load_scene
from climatenerf.scene.scene import with_split
from climatenerf.training import run as run_module
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.run import fit_scene, load_pixels
from climatenerf.training.settings import PAPER, FitSettings, Losses


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def scene(toy):
    """The toy scene with one picture held out, since evaluation takes most of the time."""
    return with_split(toy, {"00.png"})


@pytest.fixture(autouse=True)
def limited_cost(monkeypatch):
    limit_cost(monkeypatch)


def test_a_run_folder_contains_metrics_config_scene_preview_and_field(toy, tmp_path):
    done = []
    metrics = fitted(toy, tmp_path / "run", evaluated=lambda *count: done.append(count))
    assert done == [(i, 4) for i in range(1, 5)]
    on_disk = read_json(tmp_path / "run" / "metrics.json")
    assert on_disk == json.loads(json.dumps(metrics))
    assert {"psnr", "ssim", "psnr_cc", "seconds", "steps", "samples"} <= set(on_disk)
    assert on_disk["steps"] == 6 and on_disk["samples"] > 0 and on_disk["seconds"] > 0
    assert on_disk["interrupted"] is False and on_disk["train_views"] == 20
    assert on_disk["masked_fraction"] == 0, "masks start empty"
    assert sorted(on_disk["views"]) == [f"{i:02d}.png" for i in (0, 6, 12, 18)]
    for key in ("psnr", "ssim", "psnr_cc"):
        rows = [row[key] for row in on_disk["views"].values()]
        assert on_disk[key] == pytest.approx(np.mean(rows)) and np.isfinite(rows).all()
    assert on_disk["psnr_cc"] >= on_disk["psnr"]
    config = read_json(tmp_path / "run" / "config.json")
    assert config["schema_version"] == 1 and config["settings"]["steps"] == 6
    loaded = load_scene(tmp_path / "run")
    assert [v.split for v in loaded.views] == [v.split for v in toy.views]
    preview = Image.open(next((tmp_path / "run" / "previews").glob("*.jpg")))
    assert preview.size == (64, 24)
    field = load_field(tmp_path / "run")
    view = toy.of_split("heldout")[0]
    photos = np.stack([toy.c2w_world(v) for v in toy.of_split("train")])
    appearance = nearby_appearance(field, photos, toy.c2w_world(view))
    picture = render_view(field, toy.cameras[0], toy.c2w_world(view), appearance)
    truth = np.asarray(Image.open(view.path)) / 255
    found = -10 * np.log10(np.mean((picture - truth) ** 2))
    assert found == pytest.approx(on_disk["views"][view.name]["psnr"], abs=1e-3)


def test_masked_pixels_do_not_count_in_the_score(toy, tmp_path):
    metrics = fitted(toy, tmp_path / "run", steps=2)
    field, (view, other, *_) = load_field(tmp_path / "run"), toy.of_split("heldout")
    truth = np.asarray(Image.open(view.path)) / 255
    picture = render_view(field, toy.cameras[0], toy.c2w_world(view))
    mask = np.zeros((36, 48), np.uint8)
    mask[:, :20] = 255
    Image.fromarray(mask).save(tmp_path / "half.png")
    Image.fromarray(0 * mask).save(tmp_path / "none.png")
    masks = {view.name: tmp_path / "half.png", other.name: tmp_path / "none.png"}
    views = [dataclasses.replace(v, mask_path=masks.get(v.name)) for v in toy.views]
    masked = dataclasses.replace(toy, views=tuple(views))
    found = evaluate(field, masked, 1, nothing, nearby=False)["views"]
    expected = -10 * np.log10(np.mean((picture - truth)[:, :20] ** 2))
    assert found[view.name]["psnr"] == pytest.approx(expected, abs=1e-3)
    corrected = psnr_cc(picture[:, :20], truth[:, :20].astype(np.float32))
    assert found[view.name]["psnr_cc"] == pytest.approx(corrected, abs=1e-3)
    assert found[view.name]["ssim"] > metrics["views"][view.name]["ssim"]
    assert other.name not in found and len(found) == 3


def test_held_out_views_are_rendered_in_the_appearance_of_nearby_photos(toy, tmp_path, monkeypatch):
    """Appearance vectors are set to the northward component of each photo's direction."""
    fitted(toy, tmp_path / "run", steps=2)
    field = load_field(tmp_path / "run")
    train = [toy.c2w_world(view) for view in toy.of_split("train")]
    field.embeddings.requires_grad_(False)
    field.embeddings[:] = torch.tensor([[c2w[1, 2]] for c2w in train])
    found = []

    def recorded(field, camera, c2w, appearance):
        vector = field.mean_embedding if appearance is None else appearance
        found.append(float(vector.mean()))
        return render_view(field, camera, c2w, appearance)

    monkeypatch.setattr("climatenerf.evaluation.heldout.render_view", recorded)
    evaluate(field, toy, 1, nothing)
    expected = [toy.c2w_world(view)[1, 2] for view in toy.of_split("heldout")]
    assert np.ptp(expected) > 0.5
    assert np.allclose(found, expected, atol=0.1), (found, expected)
    found.clear()
    evaluate(field, toy, 1, nothing, nearby=False)
    assert np.ptp(found) == 0


def test_quality_is_none_without_held_out_photos(scene, tmp_path):
    metrics = fitted(with_split(scene, set()), tmp_path / "run", steps=2)
    assert metrics["psnr"] is None and metrics["ssim"] is None and metrics["psnr_cc"] is None
    assert metrics["train_views"] == 24 and metrics["steps"] == 2


def test_surface_heads_on_the_appearance_grid_are_learned_and_loaded(scene, tmp_path, monkeypatch):
    """As in the paper's preset: no surface grid, the paper's weights, an opaque sky."""
    view = scene.of_split("train")[0]
    settings = dataclasses.replace(
        PAPER,
        size=dataclasses.replace(TINY, surface_levels=0),
        minutes=None,
        steps=40,
        samples_per_step=2**12,
    )
    pixels = load_pixels(scene, 1)
    pixels.label = torch.full((len(pixels.rgb),), BUILDING, dtype=torch.uint8)
    pixels.label[:400], pixels.label[400:800] = SKY, VEGETATION
    monkeypatch.setattr(run_module, "load_pixels", lambda *_: pixels)
    fit_scene(scene, tmp_path / "run", settings, 1, False, nothing, nothing)
    field = load_field(tmp_path / "run")
    assert field.surface_grid.numel() == 0 and field.learned.tolist() == [True, True]
    with torch.no_grad():
        normal, logits = field.surface_at(torch.rand(50, 3))
    assert torch.allclose(normal.norm(dim=-1), torch.ones(50), atol=1e-5)
    solid = [kind for kind in range(7) if kind != SKY]
    assert (logits.argmax(-1) == solid.index(BUILDING)).float().mean() > 0.9
    assert np.isfinite(render_view(field, scene.cameras[0], scene.c2w_world(view))).all()


def test_masked_fraction_is_none_without_masks(scene, tmp_path):
    metrics = fitted(scene, tmp_path / "run", steps=2, losses=Losses(transient=0.0))
    assert metrics["masked_fraction"] is None


def test_a_folder_that_contains_a_run_is_not_overwritten(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=2)
    before = contents(tmp_path / "run")
    with pytest.raises(UserError, match="--resume"):
        fitted(scene, tmp_path / "run", steps=2)
    assert contents(tmp_path / "run") == before


def test_photos_from_one_position_are_refused(scene, tmp_path):
    views = []
    for view in scene.views:
        pose = view.c2w.copy()
        pose[:3, 3] = scene.views[0].c2w[:3, 3] + 1e-5
        views.append(dataclasses.replace(view, c2w=pose))
    with pytest.raises(UserError, match="from one spot.*walk"):
        fitted(dataclasses.replace(scene, views=tuple(views)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_photos_from_one_position_are_refused_at_any_scale(scene, tmp_path):
    """A tripod: rounding separates the cameras, and the scale was derived from their distances."""
    random, views = np.random.default_rng(0), []
    for view in scene.views:
        pose = view.c2w.copy()
        pose[:3, 3] = scene.views[0].c2w[:3, 3] + 1e-9 * random.standard_normal(3)
        views.append(dataclasses.replace(view, c2w=pose))
    stretch = np.diag([1e9, 1e9, 1e9, 1.0])
    scene = dataclasses.replace(scene, views=tuple(views), world_from_input=stretch)
    with pytest.raises(UserError, match="from one spot.*walk"):
        fitted(scene, tmp_path / "run")


def test_a_damaged_held_out_picture_is_reported_before_the_fit(tmp_path):
    scene = with_split(make_scene(tmp_path / "toy"), {"00.png"})
    path = scene.of_split("heldout")[0].path
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match="00.png"):
        fitted(scene, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_damaged_held_out_mask_is_reported_before_the_fit(scene, tmp_path):
    view = scene.of_split("heldout")[0]
    (tmp_path / "mask.png").write_bytes(b"no picture")
    views = [
        dataclasses.replace(v, mask_path=tmp_path / "mask.png") if v is view else v
        for v in scene.views
    ]
    with pytest.raises(UserError, match="mask.png"):
        fitted(dataclasses.replace(scene, views=tuple(views)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["config.json", "field.safetensors", "optimiser.safetensors"])
def test_a_run_that_was_never_saved_can_be_started_again(scene, tmp_path, monkeypatch, name):
    with monkeypatch.context() as patch:
        full_disk_for(name, patch)
        with pytest.raises(UserError, match="disk is full"):
            fitted(scene, tmp_path / "run", steps=3)
    assert fitted(scene, tmp_path / "run", steps=3)["steps"] == 3


def test_multiview_stereo_runs_only_for_the_sparse_depth_loss(tmp_path, monkeypatch):
    """The fit uses the matches; without the loss or the setting photos are not matched."""
    scene, seeds = make_scene(tmp_path / "toy"), []

    def plane_sweep_depth(pixels, points, typical, seed):
        seeds.append(seed)
        return SparseDepth(
            torch.zeros(9, 3), torch.eye(3).repeat(3, 1), torch.ones(9), torch.zeros(9).long()
        )

    counts = []
    original = run_module.make_trainer

    def begin(*args):
        trainer = original(*args)
        counts.append(len(trainer.evidence.depths))
        return trainer

    monkeypatch.setattr(run_module, "plane_sweep_depth", plane_sweep_depth)
    monkeypatch.setattr(run_module, "make_trainer", begin)
    for index, chosen in enumerate(
        ({}, {"multiview_stereo": False}, {"losses": Losses(sparse_depth=0.0)})
    ):
        settings = FitSettings(size=TINY, minutes=None, steps=1, seed=5, **chosen)
        run = tmp_path / str(index)
        run_module.fit_scene(scene, run, settings, 1, False, lambda _: None, lambda *_: None)
    assert seeds == [5] and counts == [1, 0, 0]


def test_only_the_appearance_grid_has_weight_decay(toy, tmp_path, monkeypatch):
    seen = []

    def recorded(tables, decays):
        seen.append([(table.shape, decay) for table, decay in zip(tables, decays, strict=True)])
        return GridAdam(tables, decays)

    monkeypatch.setattr("climatenerf.training.trainer.GridAdam", recorded)
    fitted(toy, tmp_path / "run", steps=1)
    field = load_field(tmp_path / "run")
    grids = (field.geometry_grid, field.appearance_grid, field.sky_grid, field.surface_grid)
    expected = (0.0, FitSettings().decay, 0.0, 0.0)
    assert seen[0] == [(grid.shape, decay) for grid, decay in zip(grids, expected, strict=True)]
    assert read_json(tmp_path / "run" / "metrics.json")["heldout_appearance"] == "nearby"


@pytest.mark.parametrize("free_space", [True, False])
def test_floaters_are_removed_before_the_field_is_saved(scene, tmp_path, monkeypatch, free_space):
    """A finished fit empties cells, which the saved field then leaves empty."""
    emptied = []

    def empty_everything(field, photos, terrain):
        assert len(photos) == len(scene.of_split("train"))
        emptied.append(int(field.occupancy.occupied.sum()))
        field.occupancy.occupied.zero_()
        return 1

    monkeypatch.setattr(run_module, "remove_floaters", empty_everything)
    fitted(scene, tmp_path / "run", free_space=free_space)
    saved = load_field(tmp_path / "run").occupancy.occupied
    assert bool(saved.any()) != free_space and len(emptied) == free_space


def test_the_datum_that_the_fit_found_is_saved_and_reported(scene, tmp_path, monkeypatch):
    def raised(fitted, terrain):
        return dataclasses.replace(fitted, ground_z=fitted.ground_z + 0.25)

    monkeypatch.setattr(run_module, "with_datum", raised)
    metrics = fitted(scene, tmp_path / "run")
    assert metrics["datum_moved_m"] == pytest.approx(0.25)
    assert load_scene(tmp_path / "run").ground_z == pytest.approx(scene.ground_z + 0.25)
    again = fitted(scene, tmp_path / "run", steps=8, resume=True)
    assert again["datum_moved_m"] == pytest.approx(0.25), "from where it was"
    assert load_scene(tmp_path / "run").ground_z == pytest.approx(scene.ground_z + 0.5)
