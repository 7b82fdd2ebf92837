"""A short and a longer part of `tools/torture.py`: hostile files, kills, full disks."""

import json
import os
import random

import numpy as np
import pytest

from tools import torture
from tools.torture_parts import mutations, trials
from tools.torture_parts.zygote import Outcome

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
FIRST_SEED = 1000
"""Seed of the quick trials; that of the longer campaign is twice as large."""
QUICK = ["transforms", "colmap-binary", "weather", "camera-path", "run-scene", "field"]
REGRESSIONS = ("two-fit:0",)  # two fits into one folder, before run folders were locked


def passed(found):
    assert not found["failures"], json.dumps(found["failures"], indent=1)
    return found["counts"]


@pytest.mark.slow
def test_some_mutations_of_quick_kinds(tmp_path):
    """The other kinds begin with fits, so only the slow test covers them."""
    options = {"seconds": 600.0, "trials": len(QUICK), "first_seed": FIRST_SEED}
    counts = passed(torture.campaign(tmp_path, only=QUICK, **options))
    assert {kind: row["trials"] for kind, row in counts.items()} == dict.fromkeys(QUICK, 1)


@pytest.mark.slow
def test_many_mutations_and_full_disks(tmp_path):
    """Kills at random moments are tested next to the code that they interrupt."""
    others = ["disk-export", "disk-fit", "disk-render", "two-fit", "two-render"]
    options = {"seconds": 240, "first_seed": 2 * FIRST_SEED, "only": [*trials.KINDS, *others]}
    counts = passed(torture.campaign(tmp_path, **options))
    assert set(trials.KINDS) <= counts.keys()


@pytest.mark.slow
def test_trials_that_failed_earlier_pass(tmp_path):
    passed(torture.campaign(tmp_path, replay=REGRESSIONS))


def test_a_seed_determines_the_mutation(tmp_path):
    tree = json.dumps({"a": {"b": [1, 2.5, "x"]}, "c": None})
    for seed in range(40):
        results = []
        for name in ("one", "two"):
            (tmp_path / name).mkdir(exist_ok=True)
            path = tmp_path / name / "file.json"
            path.write_text(tree)
            done = mutations.mutate(path, random.Random(seed))
            files = sorted(p for p in (tmp_path / name).iterdir() if p.is_file())
            results.append((done, [p.read_bytes() for p in files]))
            for each in (tmp_path / name).iterdir():
                each.rmdir() if each.is_dir() else each.unlink()
        assert results[0] == results[1]


def ended(status=0, err="", seconds=1.0, peak=100_000_000, hung=False):
    return Outcome(status, seconds, peak, hung, None, "", err)


@pytest.mark.parametrize(
    ("done", "messages"),
    [
        (ended(1, "climatenerf: internal error\n"), ["status 1", "internal error"]),
        (ended(-9, hung=True), ["hangs"]),
        (ended(-11), ["status -11"]),
        (ended(0, "Traceback (most recent call last):"), ["Traceback"]),
        (ended(2, "no sentence"), ["no single sentence"]),
        (ended(2, "climatenerf: a\nclimatenerf: b\n"), ["no single sentence"]),
        (ended(2, "climatenerf: Error(s) in loading state_dict\n"), ["Error(s) in loading"]),
        (ended(peak=10**9), ["1000 MB instead of 100"]),
    ],
)
def test_faults_of_an_outcome_are_found(done, messages):
    faults = "; ".join(trials.outcome_faults(done, ended()))
    assert all(message in faults for message in messages), faults


def test_sound_outcomes_have_no_faults():
    assert trials.outcome_faults(ended(), ended()) == []
    assert trials.outcome_faults(ended(2, "warning: so\nclimatenerf: no photos; take some\n")) == []


def test_nan_in_output_files_is_a_fault(tmp_path):
    (tmp_path / "a.json").write_text('{"x": NaN}')
    np.savez(tmp_path / "b.npz", depth=np.array([1.0, np.nan]))
    np.savez(tmp_path / "c.npz", depth=np.array([1.0, np.inf]))
    assert trials.nan_faults(tmp_path) == ["a.json holds NaN", "b.npz holds NaN"]
