"""Fits that are killed, and fits into a folder that another process uses."""

import time

import numpy as np
import pytest
from support.processes import holder, start
from support.toy_scene import TINY, make_scene

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.storage import is_temporary, read_json
from climatenerf.field.sampler import Sampler
from climatenerf.scene.scene import with_split
from climatenerf.training import run as run_module
from climatenerf.training.checkpoint import restore
from climatenerf.training.run import begin, fit_scene
from climatenerf.training.settings import FitSettings
from climatenerf.training.snapshot import (
    CONFIG,
    FIELD,
    METRICS,
    OPTIMISER,
    SCENE,
    STAGING,
    identity_of,
    writing_run,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return with_split(make_scene(tmp_path_factory.mktemp("toy")), {"00.png"})


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Small pictures and few rays, as in `test_run`; a checkpoint after each step."""
    monkeypatch.setattr(run_module, "PREVIEW_WIDTH", 32)
    monkeypatch.setattr(run_module, "CHECKPOINT_INTERVAL", -1.0)
    mark_seen = Sampler.mark_seen
    monkeypatch.setattr(Sampler, "mark_seen", lambda self, o, d: mark_seen(self, o[:50], d[:50]))


class Killed(BaseException):
    """Ends a fit at once, as a kill does."""


def nothing(*_):
    pass


def fitted(scene, run, steps, resume=False, report=nothing, **settings):
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**12, **settings}
    return fit_scene(scene, run, FitSettings(steps=steps, **chosen), 1, resume, report, nothing)


def kill_at(step):
    def report(state):
        if state.step == step:
            raise Killed

    return report


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def identities(run):
    return {identity_of(run / name) for name in (FIELD, OPTIMISER, SCENE, CONFIG)}


def test_a_second_fit_into_a_folder_is_refused_in_one_sentence(scene, tmp_path):
    run = tmp_path / "run"
    with holder(run):
        before = contents(run)
        with pytest.raises(UserError, match=f"another process is writing into {run}; wait until"):
            fitted(scene, run, 2)
        assert contents(run) == before
    assert fitted(scene, run, 2)["steps"] == 2, "the lock of a dead process does not count"
    assert not [name for name in contents(run) if is_temporary(name)]
    with holder(run):
        before = contents(run)
        with pytest.raises(UserError, match="another process is writing"):
            fitted(scene, run, 4, resume=True)
        climatenerf.load_run(run)  # readers take no lock
        assert contents(run) == before


def test_every_file_of_a_checkpoint_states_its_identity(scene, tmp_path):
    fitted(scene, tmp_path, 2)
    first = identities(tmp_path)
    assert len(first) == 1 and len(first & {"", None}) == 0
    fitted(scene, tmp_path, 3, resume=True)
    assert len(identities(tmp_path)) == 1 and identities(tmp_path) != first
    scene_file = read_json(tmp_path / SCENE)
    assert (tmp_path / scene_file["root"]).resolve() == scene.root.resolve()
    assert not (tmp_path / STAGING).exists()


def test_metrics_of_an_earlier_end_do_not_stay_beside_a_killed_resume(scene, tmp_path):
    fitted(scene, tmp_path, 2)
    with pytest.raises(Killed):
        fitted(scene, tmp_path, 9, resume=True, report=kill_at(3))
    assert read_json(tmp_path / METRICS)["steps"] == 2, "nothing has been saved since"
    with pytest.raises(Killed):
        fitted(scene, tmp_path, 9, resume=True, report=kill_at(5))
    assert not (tmp_path / METRICS).exists()
    assert len(identities(tmp_path)) == 1
    climatenerf.load_run(tmp_path)
    assert fitted(scene, tmp_path, 6, resume=True)["steps"] == 6
    assert read_json(tmp_path / METRICS)["steps"] == 6


def test_config_and_scene_follow_the_field(scene, tmp_path):
    """A resume with other settings changes the files together, at its first checkpoint."""
    fitted(scene, tmp_path, 2, seed=1)
    before = contents(tmp_path)
    with pytest.raises(Killed):
        fitted(scene, tmp_path, 9, resume=True, report=kill_at(3), seed=2)
    assert contents(tmp_path) == before
    with pytest.raises(Killed):
        fitted(scene, tmp_path, 9, resume=True, report=kill_at(4), seed=2)
    assert read_json(tmp_path / CONFIG)["settings"]["seed"] == 2
    assert len(identities(tmp_path)) == 1


def test_field_and_optimiser_of_different_checkpoints_are_not_resumed(scene, tmp_path):
    fitted(scene, tmp_path, 2)
    earlier = (tmp_path / OPTIMISER).read_bytes()
    fitted(scene, tmp_path, 4, resume=True)
    (tmp_path / OPTIMISER).write_bytes(earlier)
    with pytest.raises(UserError, match="different checkpoints; the run can be rendered but not"):
        fitted(scene, tmp_path, 6, resume=True)


@pytest.mark.slow
def test_a_run_is_hashed_as_it_was_read(scene, tmp_path):
    """Frames of a field that a fit has replaced meanwhile do not count as those of the new one."""
    fitted(scene, tmp_path / "run", 2)
    run = climatenerf.load_run(tmp_path / "run")
    fitted(scene, tmp_path / "run", 3, resume=True)
    options = {"path": "still", "frames": 1, "size": (32, 18)}
    for name, each in (("old", run), ("new", tmp_path / "run")):
        climatenerf.render_movie(each, tmp_path / name, **options)
    hashes = [read_json(tmp_path / name / "movie.json")["render"] for name in ("old", "new")]
    assert hashes[0] != hashes[1]


@pytest.mark.slow
def test_a_folder_whose_first_checkpoint_was_cut_off_can_be_resumed(scene, tmp_path):
    fitted(scene, tmp_path, 2)
    (tmp_path / STAGING).mkdir()
    for name in (CONFIG, OPTIMISER, SCENE):
        (tmp_path / name).rename(tmp_path / STAGING / name)
    (tmp_path / METRICS).unlink()
    assert climatenerf.load_run(tmp_path).scene.root == scene.root
    assert fitted(scene, tmp_path, 3, resume=True)["steps"] == 3


def fit_in_process(photos, run, steps, resume):
    """Entry point of a process that fits and saves a checkpoint after each step."""
    run_module.PREVIEW_WIDTH, run_module.CHECKPOINT_INTERVAL = 32, -1.0
    fitted(with_split(make_scene(photos), {"00.png"}), run, steps, resume)


@pytest.mark.slow
def test_fits_that_are_killed_at_random_leave_a_run_that_renders_and_resumes(tmp_path):
    rng, run, scene = np.random.default_rng(3), tmp_path / "run", make_scene(tmp_path / "photos")
    scene = with_split(scene, {"00.png"})
    for _ in range(8):
        resume = (run / FIELD).exists()
        process = start(fit_in_process, tmp_path / "photos", run, 10**6, resume)
        while process.is_alive() and not (run / FIELD).exists():
            time.sleep(0.05)
        end = time.monotonic() + rng.uniform(0, 12)
        while process.is_alive() and time.monotonic() < end:
            climatenerf.load_run(run)
            time.sleep(0.05)
        process.kill()
        process.join()
        assert not (run / METRICS).exists()
        climatenerf.load_run(run)
        with writing_run(run):
            assert len(identities(run)) == 1
            settings = FitSettings(size=TINY, minutes=None, steps=5, samples_per_step=2**12)
            restore(begin(scene, settings, 1), run)
