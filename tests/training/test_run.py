import dataclasses
import errno
import json
import os

import numpy as np
import pytest
import torch
from PIL import Image
from support.toy_scene import CAMERA, TINY, make_scene

from climatenerf.core.classes import BUILDING, SKY, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, read_safetensors, write_json, write_safetensors
from climatenerf.evaluation.appearance import nearby_appearance
from climatenerf.evaluation.heldout import evaluate
from climatenerf.evaluation.metrics import psnr_cc
from climatenerf.field.checkpoint import load_field
from climatenerf.field.sampler import Sampler
from climatenerf.render.volume import render_view
from climatenerf.scene import load_scene
from climatenerf.scene.scene import with_split
from climatenerf.training import run as run_module
from climatenerf.training.checkpoint import checkpoint, restore
from climatenerf.training.evidence import free_space as carving_module
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.evidence.visual_hull import VisualHull
from climatenerf.training.folder import check_config
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.run import fit_scene, load_pixels
from climatenerf.training.settings import (
    PAPER,
    RENAMED_LOSSES,
    RENAMED_SETTINGS,
    FitSettings,
    Losses,
)
from climatenerf.training.setup import make_trainer


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def scene(toy):
    """The toy scene with one picture held out, since measuring takes most of the time."""
    return with_split(toy, {"00.png"})


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Small pictures and few rays: a field of a few steps is haze, which is slow to render."""
    monkeypatch.setattr(run_module, "PREVIEW_WIDTH", 32)
    mark_seen = Sampler.mark_seen
    monkeypatch.setattr(Sampler, "mark_seen", lambda self, o, d: mark_seen(self, o[:50], d[:50]))


def nothing(*_):
    pass


def fitted(scene, folder, steps=6, resume=False, report=nothing, evaluated=nothing, **settings):
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**13, **settings}
    settings = FitSettings(steps=steps, **chosen)
    return fit_scene(scene, folder, settings, 1, resume, report, evaluated)


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def full_disk_for(name, monkeypatch):
    """Let renaming onto a file of this name fail as on a full disk."""
    real = os.replace

    def replace(source, target):
        if os.path.basename(target) == name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)


def test_a_run_folder_holds_metrics_config_scene_preview_and_field(toy, tmp_path):
    scene = toy
    done = []
    metrics = fitted(scene, tmp_path / "run", evaluated=lambda *count: done.append(count))
    assert done == [(i, 4) for i in range(1, 5)]
    on_disk = read_json(tmp_path / "run" / "metrics.json")
    assert on_disk == json.loads(json.dumps(metrics))
    assert {"psnr", "ssim", "psnr_cc", "seconds", "steps", "samples"} <= set(on_disk)
    assert on_disk["steps"] == 6 and on_disk["samples"] > 0 and on_disk["seconds"] > 0
    assert on_disk["interrupted"] is False and on_disk["train_views"] == 20
    assert on_disk["masked_fraction"] == 0, "at first nothing is masked"
    assert sorted(on_disk["views"]) == [f"{i:02d}.png" for i in (0, 6, 12, 18)]
    for key in ("psnr", "ssim", "psnr_cc"):
        rows = [row[key] for row in on_disk["views"].values()]
        assert on_disk[key] == pytest.approx(np.mean(rows)) and np.isfinite(rows).all()
    assert on_disk["psnr_cc"] >= on_disk["psnr"]
    config = read_json(tmp_path / "run" / "config.json")
    assert config["schema_version"] == 1 and config["settings"]["steps"] == 6
    loaded = load_scene(tmp_path / "run")
    assert [v.split for v in loaded.views] == [v.split for v in scene.views]
    preview = Image.open(next((tmp_path / "run" / "previews").glob("*.jpg")))
    assert preview.size == (64, 24)
    field = load_field(tmp_path / "run")
    view = scene.of_split("heldout")[0]
    photos = np.stack([scene.c2w_world(v) for v in scene.of_split("train")])
    appearance = nearby_appearance(field, photos, scene.c2w_world(view))
    picture = render_view(field, scene.cameras[0], scene.c2w_world(view), appearance)
    truth = np.asarray(Image.open(view.path)) / 255
    found = -10 * np.log10(np.mean((picture - truth) ** 2))
    assert found == pytest.approx(on_disk["views"][view.name]["psnr"], abs=1e-3)


def test_masked_pixels_do_not_count_in_the_score(toy, tmp_path):
    scene = toy
    metrics = fitted(scene, tmp_path / "run", steps=2)
    field, (view, other, *_) = load_field(tmp_path / "run"), scene.of_split("heldout")
    truth = np.asarray(Image.open(view.path)) / 255
    picture = render_view(field, scene.cameras[0], scene.c2w_world(view))
    mask = np.zeros((36, 48), np.uint8)
    mask[:, :20] = 255
    Image.fromarray(mask).save(tmp_path / "half.png")
    Image.fromarray(0 * mask).save(tmp_path / "none.png")
    masks = {view.name: tmp_path / "half.png", other.name: tmp_path / "none.png"}
    views = [dataclasses.replace(v, mask_path=masks.get(v.name)) for v in scene.views]
    masked = dataclasses.replace(scene, views=tuple(views))
    found = evaluate(field, masked, 1, nothing, nearby=False)["views"]
    wanted = -10 * np.log10(np.mean((picture - truth)[:, :20] ** 2))
    assert found[view.name]["psnr"] == pytest.approx(wanted, abs=1e-3)
    corrected = psnr_cc(picture[:, :20], truth[:, :20].astype(np.float32))
    assert found[view.name]["psnr_cc"] == pytest.approx(corrected, abs=1e-3)
    assert found[view.name]["ssim"] > metrics["views"][view.name]["ssim"]
    assert other.name not in found and len(found) == 3


def test_held_out_views_are_rendered_in_the_appearance_of_nearby_photos(toy, tmp_path, monkeypatch):
    """Appearance vectors are set to the northward component of each photo's direction."""
    scene = toy
    fitted(scene, tmp_path / "run", steps=2)
    field = load_field(tmp_path / "run")
    train = [scene.c2w_world(view) for view in scene.of_split("train")]
    field.embeddings.requires_grad_(False)
    field.embeddings[:] = torch.tensor([[c2w[1, 2]] for c2w in train])
    found = []

    def recorded(field, camera, c2w, appearance):
        vector = field.mean_embedding if appearance is None else appearance
        found.append(float(vector.mean()))
        return render_view(field, camera, c2w, appearance)

    monkeypatch.setattr("climatenerf.evaluation.heldout.render_view", recorded)
    evaluate(field, scene, 1, nothing)
    wanted = [scene.c2w_world(view)[1, 2] for view in scene.of_split("heldout")]
    assert np.ptp(wanted) > 0.5
    assert np.allclose(found, wanted, atol=0.1), (found, wanted)
    found.clear()
    evaluate(field, scene, 1, nothing, nearby=False)
    assert np.ptp(found) == 0


def test_quality_is_none_without_held_out_photos(scene, tmp_path):
    metrics = fitted(with_split(scene, set()), tmp_path / "run", steps=2)
    assert metrics["psnr"] is None and metrics["ssim"] is None and metrics["psnr_cc"] is None
    assert metrics["train_views"] == 24 and metrics["steps"] == 2


def test_surface_heads_on_the_appearance_grid_learn_and_load(scene, tmp_path, monkeypatch):
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


def test_a_folder_that_holds_a_run_is_not_overwritten(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=2)
    before = contents(tmp_path / "run")
    with pytest.raises(UserError, match="--resume"):
        fitted(scene, tmp_path / "run", steps=2)
    assert contents(tmp_path / "run") == before


# --- resuming ---------------------------------------------------------------------------------


def state_of(trainer):
    """All state that a step reads or changes."""
    state = {f"field.{k}": v for k, v in trainer.field.state_dict().items()}
    state |= {f"grid.{k}": v for k, v in trainer.grid_adam.state().items()}
    for index, moments in trainer.net_adam.state_dict()["state"].items():
        state |= {f"net.{index}.{k}": torch.as_tensor(v) for k, v in moments.items()}
    state["generator"] = trainer.generator.get_state()
    counters = (trainer.steps, trainer.samples, trainer.rays)
    floats = (trainer.seconds, trainer.step_scale, trainer.error)
    return {k: v.clone() for k, v in state.items()}, counters, floats


def begin(scene, **settings):
    views = scene.of_split("train")
    poses = np.stack([scene.c2w_world(v) for v in views])
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**13, **settings}
    extent = run_module.find_extent(poses, None)
    pixels, settings = load_pixels(scene, 1), FitSettings(**chosen)
    points = run_module.unmasked_sparse_depth(scene, pixels)
    return make_trainer(pixels, extent, settings, points)


def assert_same(a, b):
    for one, other in zip(state_of(a), state_of(b), strict=True):
        if isinstance(one, dict):
            assert one.keys() == other.keys()
            for key in one:
                assert torch.equal(one[key], other[key]), key
        else:
            assert one == other


def stop_at(step):
    def report(state):
        if state.step == step:
            raise KeyboardInterrupt

    return report


def stop_half_way(trainer, run):
    """Stop a fit of 40 steps after 20, and write its checkpoint."""
    with pytest.raises(KeyboardInterrupt):
        trainer.run(stop_at(20))
    write_json(run / "config.json", run_module._config(trainer.settings, 1, trainer.field))
    checkpoint(trainer, run)


def test_a_restored_fit_continues_bit_for_bit(scene, tmp_path):
    trainer = begin(scene, steps=40)
    trainer.field.pruning_threshold = 0.004
    stop_half_way(trainer, tmp_path)
    again = begin(scene, steps=40)
    restore(again, tmp_path)
    assert again.field.pruning_threshold == trainer.field.pruning_threshold
    assert_same(trainer, again)
    trainer.run(nothing)
    again.run(nothing)
    trainer.seconds = again.seconds  # the one thing that may differ
    assert trainer.steps == 40
    assert_same(trainer, again)


def labelled(trainer):
    """A fit of the same pixels, labelled by brightness: sky, building, vegetation."""
    pixels = trainer.pixels
    grey = pixels.rgb.float().mean(-1)
    others = torch.where(grey > 100, BUILDING, VEGETATION)
    pixels.label = torch.where(grey > 128, SKY, others).to(torch.uint8)
    sizes = (pixels.pixel_start[1:] - pixels.pixel_start[:-1]).tolist()
    maps = [part.view(36, 48).numpy() for part in pixels.label.split(sizes)]
    pixels.sky_hull = VisualHull([CAMERA] * len(maps), pixels.c2w.numpy(), maps, [SKY], 0.1)
    return make_trainer(pixels, trainer.extent, trainer.settings)


def test_a_restored_fit_with_labels_continues_bit_for_bit(scene, tmp_path):
    """The checkpoint holds masks, sums of relative depth, and cells that the sky forces empty."""
    trainer = labelled(begin(scene, steps=40))
    assert trainer.field.occupancy.forced_empty.any()
    stop_half_way(trainer, tmp_path)
    again = labelled(begin(scene, steps=40))
    restore(again, tmp_path)
    assert torch.equal(again.field.occupancy.forced_empty, trainer.field.occupancy.forced_empty)
    assert again.field.knows_classes and again.objective.classes_trusted_at < 0.5
    assert again.objective.classes_trusted_at == trainer.objective.classes_trusted_at
    trainer.run(nothing)
    again.run(nothing)
    trainer.seconds = again.seconds
    assert_same(trainer, again)
    assert all(map(torch.equal, trainer.masks.parameters(), again.masks.parameters()))


def test_new_labels_of_a_resumed_run_are_trusted_later(scene, tmp_path):
    trainer = begin(scene, steps=40)
    stop_half_way(trainer, tmp_path)
    again = labelled(begin(scene, steps=40))
    restore(again, tmp_path)
    assert again.field.knows_classes and not trainer.field.knows_classes
    wanted = 0.5 + trainer.objective.classes_trusted_at
    assert again.objective.classes_trusted_at == pytest.approx(wanted)


def test_refined_poses_are_saved_and_need_the_flag_to_resume(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=20, refine_poses=True)
    moved = load_scene(tmp_path / "run")
    pairs = [(a.c2w, b.c2w) for a, b in zip(scene.views, moved.views, strict=True)]
    train = [view.split == "train" for view in scene.views]
    assert [not np.array_equal(a, b) for a, b in pairs] == train
    assert max(np.abs(a - b).max() for a, b in pairs) < 0.3
    with pytest.raises(UserError, match="--refine-poses"):
        fitted(scene, tmp_path / "run", steps=22, resume=True)
    fitted(scene, tmp_path / "run", steps=22, resume=True, refine_poses=True)


def test_a_run_of_an_earlier_version_is_not_resumed(scene, tmp_path):
    fitted(scene, tmp_path / "run")
    config = read_json(tmp_path / "run" / "config.json")
    del config["settings"]["losses"]
    write_json(tmp_path / "run" / "config.json", config)
    with pytest.raises(UserError, match="earlier version"):
        fitted(scene, tmp_path / "run", steps=8, resume=True)


def test_a_run_with_the_earlier_names_of_settings_is_read_and_resumed(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=4)
    config = read_json(tmp_path / "run" / "config.json")
    now = config["settings"]
    names = {new: old for old, new in (RENAMED_SETTINGS | RENAMED_LOSSES).items()}
    before = {names.get(name, name): value for name, value in now.items()}
    before["losses"] = {names.get(name, name): value for name, value in now["losses"].items()}
    assert {"carve", "match", "crowded", "cautious", "thin"} <= before.keys()
    assert {"flat", "solid", "opacity", "points", "bend"} <= before["losses"].keys()
    write_json(tmp_path / "run" / "config.json", {**config, "settings": before})
    assert check_config(tmp_path / "run")["settings"] == now
    assert fitted(scene, tmp_path / "run", steps=6, resume=True)["steps"] == 6


def test_resuming_continues_the_counters(scene, tmp_path):
    first = fitted(scene, tmp_path / "run", steps=8)
    second = fitted(scene, tmp_path / "run", steps=16, resume=True)
    assert second["steps"] == 16
    assert second["samples"] > first["samples"] and second["seconds"] > first["seconds"]
    third = fitted(scene, tmp_path / "run", steps=16, resume=True)
    assert third["steps"] == 16 and third["samples"] == second["samples"], "it was finished"


def test_progress_does_not_fall_when_a_run_is_resumed_for_longer(scene, tmp_path):
    """What depends on progress, such as the near distance, does not go back."""
    fitted(scene, tmp_path / "run", steps=8)
    again = begin(scene, steps=800)
    assert again.progress == 0 and again.near > again.field.near
    restore(again, tmp_path / "run")
    assert again.elapsed < 0.02 and again.progress == 1 and again.near == again.field.near
    arrays, head = read_safetensors(tmp_path / "run" / "optimiser.safetensors", "state")
    state = {name: torch.from_numpy(np.array(values)) for name, values in arrays.items()}
    state["floats"] = state["floats"][:3]  # as earlier versions wrote it
    write_safetensors(tmp_path / "run" / "optimiser.safetensors", state, {})
    before = begin(scene, steps=800)
    restore(before, tmp_path / "run")
    assert before.steps == 8 and before.progress == before.elapsed


def test_photos_from_one_spot_are_refused(scene, tmp_path):
    views = []
    for view in scene.views:
        pose = view.c2w.copy()
        pose[:3, 3] = scene.views[0].c2w[:3, 3] + 1e-5
        views.append(dataclasses.replace(view, c2w=pose))
    with pytest.raises(UserError, match="from one spot.*walk"):
        fitted(dataclasses.replace(scene, views=tuple(views)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_photos_from_one_spot_are_refused_whatever_the_scale(scene, tmp_path):
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


def test_a_run_resumed_after_refinement_protects_the_cells_of_points(scene, tmp_path):
    points = np.array([[0.0, -0.6, 0.6], [0.6, 0.0, 0.8]])
    views = [dataclasses.replace(view, seen=np.arange(2)) for view in scene.views]
    scene = dataclasses.replace(scene, views=tuple(views), points=points)
    trainer = begin(scene, steps=4)
    trainer.field.occupancy.refine()
    trainer.evidence.free_space.force_empty(everywhere=False)
    protected = trainer.evidence.free_space.protected
    assert protected.shape == trainer.field.occupancy.occupied.shape and protected.any()
    fitted(scene, tmp_path / "run", steps=2)  # its other files
    checkpoint(trainer, tmp_path / "run")
    again = begin(scene, steps=4)
    restore(again, tmp_path / "run")
    assert torch.equal(again.evidence.free_space.protected, protected)
    assert torch.equal(again.field.occupancy.forced_empty, trainer.field.occupancy.forced_empty)


def test_a_resumed_fit_has_the_ground_height_in_the_units_of_the_run(scene, tmp_path, monkeypatch):
    """Although a new extent is estimated, the field keeps the run's."""
    xy = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    points = np.concatenate([xy, np.zeros((200, 1))], axis=1)
    views = [dataclasses.replace(view, seen=np.arange(200)) for view in scene.views]
    scene = dataclasses.replace(scene, views=tuple(views), points=points)
    every = torch.ones(1, dtype=torch.bool)
    monkeypatch.setattr(carving_module, "is_ground", lambda label: every.expand(label.shape))
    first = begin(scene, steps=4)
    fitted(scene, tmp_path / "run", steps=2)
    checkpoint(first, tmp_path / "run")
    find_extent = run_module.find_extent
    monkeypatch.setattr(
        run_module,
        "find_extent",
        lambda *a: dataclasses.replace(find_extent(*a), unit=1.7 * find_extent(*a).unit),
    )
    again = begin(scene, steps=4)
    wanted = first.evidence.free_space.ground.height
    assert not torch.equal(again.evidence.free_space.ground.height, wanted)
    restore(again, tmp_path / "run")
    assert again.field.unit == first.field.unit
    assert torch.allclose(again.evidence.free_space.ground.height, wanted, atol=1e-5)


def test_ctrl_c_leaves_a_run_that_renders_and_resumes(scene, tmp_path):
    metrics = fitted(scene, tmp_path / "run", steps=50, report=stop_at(5))
    assert metrics["interrupted"] is True and metrics["steps"] == 5
    assert metrics["psnr"] > 0
    assert read_json(tmp_path / "run" / "metrics.json")["interrupted"] is True
    load_field(tmp_path / "run")
    again = fitted(scene, tmp_path / "run", steps=9, resume=True)
    assert again["steps"] == 9 and again["interrupted"] is False


def test_a_checkpoint_during_a_fit_marks_observed_cells(scene, tmp_path):
    """Snow and light must work on a run left by a crash, too."""
    trainer = begin(scene, steps=40)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(stop_at(20))
    checkpoint(trainer, tmp_path)
    early = load_field(tmp_path)
    assert early.observed_only().occupancy.occupied.any(), (
        "all is haze: no cell is observed, so all are kept"
    )
    with torch.no_grad():
        trainer.field.geometry_net[-1].add_(8.0)  # surfaces, as a longer fit would find
    checkpoint(trainer, tmp_path)
    field = load_field(tmp_path)
    assert field.occupancy.seen.sum() > 10
    assert 0 < field.observed_only().occupancy.occupied.sum() < field.occupancy.occupied.sum()


def test_a_resumed_run_keeps_its_metric_frame(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=2)
    before = load_scene(tmp_path / "run")
    bigger = np.diag([2.0, 2.0, 2.0, 1.0]) @ scene.world_from_input
    again = dataclasses.replace(scene, world_from_input=bigger, ground_z=7.0)
    fitted(again, tmp_path / "run", steps=4, resume=True)
    after = load_scene(tmp_path / "run")
    assert np.array_equal(after.world_from_input, before.world_from_input)
    assert after.ground_z == before.ground_z


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


def test_resuming_an_empty_folder_is_refused(scene, tmp_path):
    with pytest.raises(UserError, match="no run to resume"):
        fitted(scene, tmp_path / "run", resume=True)


@pytest.mark.parametrize("heldout", [{"01.png", "02.png"}, {"01.png"}])
def test_resuming_with_other_photos_is_refused(scene, tmp_path, heldout):
    """Also with the same number: held-out photos must not become training photos."""
    fitted(scene, tmp_path / "run", steps=2)
    with pytest.raises(UserError, match="other photos"):
        fitted(with_split(scene, heldout), tmp_path / "run", steps=4, resume=True)


def test_resuming_with_another_size_is_refused(scene, tmp_path, monkeypatch):
    fitted(scene, tmp_path / "run", steps=2)
    other = dataclasses.replace(TINY, geometry_levels=5)
    monkeypatch.setattr(run_module, "load_pixels", None)  # photos are not read for nothing
    with pytest.raises(UserError, match="earlier version; it can be rendered but not resumed"):
        fitted(scene, tmp_path / "run", steps=4, resume=True, size=other)
    with pytest.raises(UserError, match="with --preset cpu; resume it with the same"):
        fitted(scene, tmp_path / "run", steps=4, resume=True, preset="gpu", size=other)


def test_a_run_of_a_newer_version_is_not_touched(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=2)
    config = read_json(tmp_path / "run" / "config.json")
    write_json(tmp_path / "run" / "config.json", {**config, "schema_version": 99})
    before = contents(tmp_path / "run")
    with pytest.raises(UserError, match="newer"):
        fitted(scene, tmp_path / "run", steps=4, resume=True)
    assert contents(tmp_path / "run") == before


@pytest.mark.parametrize("name", ["optimiser.safetensors", "config.json"])
@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"{}"])
def test_a_damaged_run_is_a_user_error(scene, tmp_path, name, damage):
    fitted(scene, tmp_path / "run", steps=2)
    path = tmp_path / "run" / name
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError):
        fitted(scene, tmp_path / "run", steps=4, resume=True)


def test_a_missing_or_incomplete_optimiser_state_is_a_user_error(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=2)
    path = tmp_path / "run" / "optimiser.safetensors"
    arrays, about = read_safetensors(path)
    fewer = {k: v for k, v in arrays.items() if k != "generator"}
    write_safetensors(path, fewer, about)
    with pytest.raises(UserError, match="damaged .its checksum"):
        fitted(scene, tmp_path / "run", steps=4, resume=True)
    write_safetensors(path, fewer, {})
    with pytest.raises(UserError, match="damaged.*generator.*rendered but not resumed"):
        fitted(scene, tmp_path / "run", steps=4, resume=True)
    path.unlink()
    with pytest.raises(UserError, match="rendered but not resumed"):
        fitted(scene, tmp_path / "run", steps=4, resume=True)


@pytest.mark.parametrize(
    ("name", "value"), [("grid.0.first", np.nan), ("grid.0.second", -1e38), ("floats", np.inf)]
)
def test_an_optimiser_state_that_would_make_nan_is_refused(scene, tmp_path, name, value):
    fitted(scene, tmp_path / "run", steps=2)
    path = tmp_path / "run" / "optimiser.safetensors"
    arrays, _ = read_safetensors(path)
    arrays[name] = np.full_like(arrays[name], value)
    write_safetensors(path, arrays, {})
    before = (tmp_path / "run" / "field.safetensors").read_bytes()
    with pytest.raises(UserError, match=f"damaged .{name}"):
        fitted(scene, tmp_path / "run", steps=4, resume=True)
    assert (tmp_path / "run" / "field.safetensors").read_bytes() == before


# --- full disk ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["field.safetensors", "optimiser.safetensors", "metrics.json", "scene.json"]
)
def test_a_full_disk_damages_nothing_and_the_run_resumes(scene, tmp_path, monkeypatch, name):
    fitted(scene, tmp_path / "run", steps=3)
    before = contents(tmp_path / "run")
    with monkeypatch.context() as patch:
        full_disk_for(name, patch)
        with pytest.raises(UserError, match="space") as caught:
            fitted(scene, tmp_path / "run", steps=6, resume=True)
        assert name in str(caught.value)
    after = contents(tmp_path / "run")
    assert after[name] == before[name]
    assert after.keys() == before.keys(), "no temporary file stays"
    load_field(tmp_path / "run")
    assert fitted(scene, tmp_path / "run", steps=6, resume=True)["steps"] == 6


@pytest.mark.parametrize("name", ["config.json", "field.safetensors", "optimiser.safetensors"])
def test_a_run_that_was_never_saved_can_begin_again(scene, tmp_path, monkeypatch, name):
    with monkeypatch.context() as patch:
        full_disk_for(name, patch)
        with pytest.raises(UserError, match="disk is full"):
            fitted(scene, tmp_path / "run", steps=3)
    assert fitted(scene, tmp_path / "run", steps=3)["steps"] == 3


def test_multiview_stereo_runs_only_for_the_sparse_depth_loss(tmp_path, monkeypatch):
    """Matches reach the fit; without the loss or the setting photos are not matched."""
    scene, asked = make_scene(tmp_path / "toy"), []

    def plane_sweep_depth(pixels, points, typical, seed):
        asked.append(seed)
        return SparseDepth(
            torch.zeros(9, 3), torch.eye(3).repeat(3, 1), torch.ones(9), torch.zeros(9).long()
        )

    measured = []
    began = run_module.make_trainer

    def begin(*words):
        trainer = began(*words)
        measured.append(len(trainer.evidence.depths))
        return trainer

    monkeypatch.setattr(run_module, "plane_sweep_depth", plane_sweep_depth)
    monkeypatch.setattr(run_module, "make_trainer", begin)
    for index, chosen in enumerate(
        ({}, {"multiview_stereo": False}, {"losses": Losses(sparse_depth=0.0)})
    ):
        settings = FitSettings(size=TINY, minutes=None, steps=1, seed=5, **chosen)
        run = tmp_path / str(index)
        run_module.fit_scene(scene, run, settings, 1, False, lambda _: None, lambda *_: None)
    assert asked == [5] and measured == [1, 0, 0]


def test_only_the_appearance_grid_has_weight_decay(toy, tmp_path, monkeypatch):
    seen = []

    def watched(tables, decays):
        seen.append([(table.shape, decay) for table, decay in zip(tables, decays, strict=True)])
        return GridAdam(tables, decays)

    monkeypatch.setattr("climatenerf.training.trainer.GridAdam", watched)
    fitted(toy, tmp_path / "run", steps=1)
    field = load_field(tmp_path / "run")
    grids = (field.geometry_grid, field.appearance_grid, field.sky_grid, field.surface_grid)
    decays_of = (0.0, FitSettings().decay, 0.0, 0.0)
    assert seen[0] == [(grid.shape, decay) for grid, decay in zip(grids, decays_of, strict=True)]
    assert read_json(tmp_path / "run" / "metrics.json")["heldout_appearance"] == "nearby"
