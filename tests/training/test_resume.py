"""Resuming a run: restored state, runs of earlier versions, and runs that cannot be resumed."""

import dataclasses

import numpy as np
import pytest
import torch
from support.toy_run import begin, contents, fitted, full_disk_for, limit_cost, nothing, stop_at
from support.toy_scene import CAMERA, TINY, make_scene

from climatenerf.core.classes import BUILDING, SKY, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, read_safetensors, write_json, write_safetensors
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene
from climatenerf.scene.scene import with_split
from climatenerf.training import run as run_module
from climatenerf.training.checkpoint import checkpoint, restore
from climatenerf.training.evidence import free_space
from climatenerf.training.evidence.visual_hull import VisualHull
from climatenerf.training.folder import check_config
from climatenerf.training.settings import RENAMED_LOSSES, RENAMED_SETTINGS
from climatenerf.training.setup import make_trainer


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The toy scene with one picture held out, since evaluation takes most of the time."""
    return with_split(make_scene(tmp_path_factory.mktemp("toy")), {"00.png"})


@pytest.fixture(autouse=True)
def limited_cost(monkeypatch):
    limit_cost(monkeypatch)


def state_of(trainer):
    """Return all state that a step reads or changes."""
    state = {f"field.{k}": v for k, v in trainer.field.state_dict().items()}
    state |= {f"grid.{k}": v for k, v in trainer.grid_adam.state().items()}
    for index, moments in trainer.net_adam.state_dict()["state"].items():
        state |= {f"net.{index}.{k}": torch.as_tensor(v) for k, v in moments.items()}
    state["generator"] = trainer.generator.get_state()
    counters = (trainer.steps, trainer.samples, trainer.rays)
    floats = (trainer.seconds, trainer.step_scale, trainer.error)
    return {k: v.clone() for k, v in state.items()}, counters, floats


def assert_same(a, b):
    for one, other in zip(state_of(a), state_of(b), strict=True):
        if isinstance(one, dict):
            assert one.keys() == other.keys()
            for key in one:
                assert torch.equal(one[key], other[key]), key
        else:
            assert one == other


def stop_halfway(trainer, run):
    """Stop a fit of 40 steps after 20, and write its checkpoint."""
    with pytest.raises(KeyboardInterrupt):
        trainer.run(stop_at(20))
    write_json(run / "config.json", run_module._config(trainer.settings, 1, trainer.field))
    checkpoint(trainer, run)


@pytest.mark.slow
def test_a_restored_fit_is_bit_identical(scene, tmp_path):
    trainer = begin(scene, steps=40)
    trainer.field.pruning_threshold = 0.004
    stop_halfway(trainer, tmp_path)
    again = begin(scene, steps=40)
    restore(again, tmp_path)
    assert again.field.pruning_threshold == trainer.field.pruning_threshold
    assert_same(trainer, again)
    trainer.run(nothing)
    again.run(nothing)
    trainer.seconds = again.seconds  # only the time may differ
    assert trainer.steps == 40
    assert_same(trainer, again)


def labelled(trainer):
    """Return a fit of the same pixels with labels by brightness: sky, building, vegetation."""
    pixels = trainer.pixels
    grey = pixels.rgb.float().mean(-1)
    ground = torch.where(grey > 100, BUILDING, VEGETATION)
    pixels.label = torch.where(grey > 128, SKY, ground).to(torch.uint8)
    sizes = (pixels.pixel_start[1:] - pixels.pixel_start[:-1]).tolist()
    maps = [part.view(36, 48).numpy() for part in pixels.label.split(sizes)]
    pixels.sky_hull = VisualHull([CAMERA] * len(maps), pixels.c2w.numpy(), maps, [SKY], 0.1)
    return make_trainer(pixels, trainer.extent, trainer.settings)


@pytest.mark.slow
def test_a_restored_fit_with_labels_is_bit_identical(scene, tmp_path):
    """The checkpoint contains masks, sums of relative depth, and cells forced empty by the sky."""
    trainer = labelled(begin(scene, steps=40))
    assert trainer.field.occupancy.forced_empty.any()
    stop_halfway(trainer, tmp_path)
    again = labelled(begin(scene, steps=40))
    restore(again, tmp_path)
    assert torch.equal(again.field.occupancy.forced_empty, trainer.field.occupancy.forced_empty)
    assert again.field.knows_classes and again.objective.classes_used_from < 0.5
    assert again.objective.classes_used_from == trainer.objective.classes_used_from
    trainer.run(nothing)
    again.run(nothing)
    trainer.seconds = again.seconds
    assert_same(trainer, again)
    assert all(map(torch.equal, trainer.masks.parameters(), again.masks.parameters()))


def test_new_labels_of_a_resumed_run_are_used_later(scene, tmp_path):
    trainer = begin(scene, steps=40)
    stop_halfway(trainer, tmp_path)
    again = labelled(begin(scene, steps=40))
    restore(again, tmp_path)
    assert again.field.knows_classes and not trainer.field.knows_classes
    expected = 0.5 + trainer.objective.classes_used_from
    assert again.objective.classes_used_from == pytest.approx(expected)


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


@pytest.mark.slow
def test_resuming_continues_the_counters(scene, tmp_path):
    first = fitted(scene, tmp_path / "run", steps=8)
    second = fitted(scene, tmp_path / "run", steps=16, resume=True)
    assert second["steps"] == 16
    assert second["samples"] > first["samples"] and second["seconds"] > first["seconds"]
    third = fitted(scene, tmp_path / "run", steps=16, resume=True)
    assert third["steps"] == 16 and third["samples"] == second["samples"], "the run was complete"


def test_progress_does_not_decrease_when_a_run_is_resumed_for_more_steps(scene, tmp_path):
    """Values that depend on progress, such as the near distance, do not decrease."""
    fitted(scene, tmp_path / "run", steps=8)
    again = begin(scene, steps=800)
    assert again.progress == 0 and again.near > again.field.near
    restore(again, tmp_path / "run")
    assert again.elapsed < 0.02 and again.progress == 1 and again.near == again.field.near
    arrays, head = read_safetensors(tmp_path / "run" / "optimiser.safetensors", "state")
    state = {name: torch.from_numpy(np.array(values)) for name, values in arrays.items()}
    state["floats"] = state["floats"][:3]  # the format of earlier versions
    write_safetensors(tmp_path / "run" / "optimiser.safetensors", state, {})
    before = begin(scene, steps=800)
    restore(before, tmp_path / "run")
    assert before.steps == 8 and before.progress == before.elapsed


def test_pose_corrections_of_earlier_versions_are_restored(scene, tmp_path):
    fitted(scene, tmp_path / "run", steps=4, refine_poses=True)
    path = tmp_path / "run" / "optimiser.safetensors"
    arrays, _ = read_safetensors(path, "state")
    state = {name: torch.from_numpy(np.array(values)) for name, values in arrays.items()}
    saved = {name: state.pop(f"poses.{name}") for name in ("rotation", "translation")}
    assert all((values != 0).any() for values in saved.values())
    state |= {"poses.turn": saved["rotation"], "poses.shift": saved["translation"]}
    write_safetensors(path, state, {})
    again = begin(scene, steps=8, refine_poses=True)
    restore(again, tmp_path / "run")
    for name, values in again.poses.state_dict().items():
        assert torch.equal(values, saved[name]), name


def test_a_run_resumed_after_refinement_protects_the_cells_of_points(scene, tmp_path):
    points = np.array([[0.0, -0.6, 0.6], [0.6, 0.0, 0.8]])
    views = [dataclasses.replace(view, seen=np.arange(2)) for view in scene.views]
    scene = dataclasses.replace(scene, views=tuple(views), points=points)
    trainer = begin(scene, steps=4)
    trainer.field.occupancy.refine()
    trainer.evidence.free_space.force_empty(everywhere=False)
    protected = trainer.evidence.free_space.protected
    assert protected.shape == trainer.field.occupancy.occupied.shape and protected.any()
    fitted(scene, tmp_path / "run", steps=2)  # the other files of a run
    checkpoint(trainer, tmp_path / "run")
    again = begin(scene, steps=4)
    restore(again, tmp_path / "run")
    assert torch.equal(again.evidence.free_space.protected, protected)
    assert torch.equal(again.field.occupancy.forced_empty, trainer.field.occupancy.forced_empty)


@pytest.mark.slow
def test_ground_height_of_a_resumed_run_is_in_its_units(scene, tmp_path, monkeypatch):
    """The extent is estimated again, but the field keeps that of the run."""
    xy = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    points = np.concatenate([xy, np.zeros((200, 1))], axis=1)
    views = [dataclasses.replace(view, seen=np.arange(200)) for view in scene.views]
    scene = dataclasses.replace(scene, views=tuple(views), points=points)
    every = torch.ones(1, dtype=torch.bool)
    monkeypatch.setattr(free_space, "is_ground", lambda label: every.expand(label.shape))
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
    expected = first.evidence.free_space.ground.height
    assert not torch.equal(again.evidence.free_space.ground.height, expected)
    restore(again, tmp_path / "run")
    assert again.field.unit == first.field.unit
    assert torch.allclose(again.evidence.free_space.ground.height, expected, atol=1e-5)


def test_ctrl_c_leaves_a_run_that_renders_and_resumes(scene, tmp_path):
    metrics = fitted(scene, tmp_path / "run", steps=50, report=stop_at(5))
    assert metrics["interrupted"] is True and metrics["steps"] == 5
    assert metrics["psnr"] > 0
    assert read_json(tmp_path / "run" / "metrics.json")["interrupted"] is True
    load_field(tmp_path / "run")
    again = fitted(scene, tmp_path / "run", steps=9, resume=True)
    assert again["steps"] == 9 and again["interrupted"] is False


def test_a_checkpoint_during_a_fit_marks_observed_cells(scene, tmp_path):
    """Snow and light require observed cells, also in a run that crashed."""
    trainer = begin(scene, steps=40)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(stop_at(20))
    checkpoint(trainer, tmp_path)
    early = load_field(tmp_path)
    assert early.observed_only().occupancy.occupied.any(), (
        "a field of haze has no observed cells, so all cells are kept"
    )
    with torch.no_grad():
        trainer.field.geometry_net[-1].add_(8.0)  # surfaces, like those of a longer fit
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


def test_resuming_an_empty_folder_is_refused(scene, tmp_path):
    with pytest.raises(UserError, match="no run to resume"):
        fitted(scene, tmp_path / "run", resume=True)


@pytest.mark.parametrize("heldout", [{"01.png", "02.png"}, {"01.png"}])
def test_resuming_with_other_photos_is_refused(scene, tmp_path, heldout):
    """Also with the same number of photos: held-out photos must not become training photos."""
    fitted(scene, tmp_path / "run", steps=2)
    with pytest.raises(UserError, match="other photos"):
        fitted(with_split(scene, heldout), tmp_path / "run", steps=4, resume=True)


def test_resuming_with_another_size_is_refused(scene, tmp_path, monkeypatch):
    fitted(scene, tmp_path / "run", steps=2)
    other = dataclasses.replace(TINY, geometry_levels=5)
    monkeypatch.setattr(run_module, "load_pixels", None)  # refused before photos are read
    with pytest.raises(UserError, match="earlier version; it can be rendered but not resumed"):
        fitted(scene, tmp_path / "run", steps=4, resume=True, size=other)
    with pytest.raises(UserError, match="with --preset cpu; resume it with the same"):
        fitted(scene, tmp_path / "run", steps=4, resume=True, preset="gpu", size=other)


def test_a_run_of_a_newer_version_is_not_changed(scene, tmp_path):
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
    ("name", "value"),
    [("grid.0.first", np.nan), ("grid.0.second", -1e38), ("net.0.step", -1.0), ("floats", np.inf)],
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["field.safetensors", "optimiser.safetensors", "metrics.json", "scene.json"]
)
def test_a_run_can_be_resumed_after_a_full_disk(scene, tmp_path, monkeypatch, name):
    fitted(scene, tmp_path / "run", steps=3)
    before = contents(tmp_path / "run")
    with monkeypatch.context() as patch:
        full_disk_for(name, patch)
        with pytest.raises(UserError, match="space") as caught:
            fitted(scene, tmp_path / "run", steps=6, resume=True)
        assert name in str(caught.value)
    after = contents(tmp_path / "run")
    if name == "metrics.json":  # the checkpoint is new, and those were of the earlier one
        assert before.keys() - after.keys() == {name}
    else:
        assert after == before, "nothing has changed, and no temporary file remains"
    load_field(tmp_path / "run")
    assert fitted(scene, tmp_path / "run", steps=6, resume=True)["steps"] == 6
