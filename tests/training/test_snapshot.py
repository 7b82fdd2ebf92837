"""Checkpoints are read and replaced atomically, also if the writer is stopped."""

import contextlib
import os
import random
import time

import numpy as np
import pytest
from support.processes import start, write_checkpoint, write_checkpoints

from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, read_safetensors, write_json
from climatenerf.training import snapshot
from climatenerf.training.snapshot import (
    CONFIG,
    FIELD,
    METRICS,
    OPTIMISER,
    SCENE,
    STAGING,
    finish_checkpoint,
    identity_of,
    new_checkpoint,
    read_together,
    writing_run,
)


class Crash(BaseException):
    """Ends a writer at one point, as a kill does."""


def numbers(run):
    """The number that each file of a checkpoint states, read as a viewer reads them."""

    def read(paths):
        field, _ = read_safetensors(paths[FIELD])
        assert len(np.unique(field["field"])) == 1
        texts = [read_json(paths[name])["text"] for name in (SCENE, CONFIG)]
        return [int(field["field"][0]), *(int(text[: len(text) // 5000]) for text in texts)]

    return read_together(run, read)


def crash_at(patch, step):
    """Raise before the `step`-th file that a writer moves or finishes."""
    real, count = os.replace, [0]

    def replace(*args):
        count[0] += 1
        if count[0] == step:
            raise Crash
        real(*args)

    patch.setattr(os, "replace", replace)
    return count


@pytest.mark.parametrize("earlier", [False, True])
def test_a_writer_that_dies_at_any_point_leaves_one_checkpoint(tmp_path, earlier):
    for step in range(1, 30):
        run = tmp_path / str(step)
        if earlier:
            write_checkpoint(run, 1)
            write_json(run / METRICS, {"of": 1})
        with pytest.MonkeyPatch.context() as patch:
            count = crash_at(patch, step)
            # As a kill: the clean-up of the block does not run either.
            patch.setattr(snapshot.shutil, "rmtree", lambda *args, **options: None)
            with contextlib.suppress(Crash):
                write_checkpoint(run, 2)
        swapped = identity_of(run / FIELD) == "2"
        if swapped or earlier:
            assert numbers(run) == [2 if swapped else 1] * 3, step
        assert not (run / METRICS).exists() or (earlier and not swapped), "of this checkpoint"
        with writing_run(run):
            pass
        assert not (run / STAGING).exists()
        if swapped or earlier:
            wanted = "2" if swapped else "1"
            files = [run / name for name in (FIELD, OPTIMISER, SCENE, CONFIG)]
            assert [identity_of(path) for path in files] == [wanted] * 4
        if count[0] < step:
            break
    assert swapped and step > 8


def test_a_checkpoint_that_fails_changes_nothing(tmp_path):
    write_checkpoint(tmp_path, 1)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UserError), new_checkpoint(tmp_path) as staging:
        (staging / FIELD).write_bytes(b"half")
        raise UserError("the disk is full")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def follow_and_kill(run, kills):
    """Read what a process writes, and kill it at random times."""
    rng = random.Random(2)
    write_checkpoint(run, 1)
    for kill in range(kills):
        writer, seen = start(write_checkpoints, run, 10_000 * (kill + 1)), set()
        end = time.monotonic() + rng.uniform(0.05, 0.5)
        while time.monotonic() < end or len(seen) < 4:
            found = numbers(run)
            assert len(set(found)) == 1
            seen.add(found[0])
        writer.kill()
        writer.join()
        assert len(set(numbers(run))) == 1
    finish_checkpoint(run)
    assert len(set(numbers(run))) == 1


def test_a_reader_that_follows_a_writer_sees_no_mixture(tmp_path):
    follow_and_kill(tmp_path, 4)


@pytest.mark.slow
def test_readers_see_no_mixture_of_many_killed_writers(tmp_path):
    follow_and_kill(tmp_path, 60)


def test_files_of_different_checkpoints_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "PAUSE", 0.0)
    write_checkpoint(tmp_path / "a", 1)
    write_checkpoint(tmp_path / "b", 2)
    os.replace(tmp_path / "b" / SCENE, tmp_path / "a" / SCENE)
    with pytest.raises(UserError, match=r"of different checkpoints; copy the whole run"):
        numbers(tmp_path / "a")


def test_files_without_identity_are_read_as_they_are(tmp_path):
    """Runs of earlier versions, and files that a user has written."""
    write_checkpoint(tmp_path, 3)
    write_json(tmp_path / SCENE, {"text": "7" * 5000})
    assert numbers(tmp_path) == [3, 7, 3]
    (tmp_path / FIELD).write_bytes(b"damaged")
    assert identity_of(tmp_path / FIELD) is None
    with pytest.raises(UserError, match="damaged"):
        numbers(tmp_path)
