"""Trials: a mutated copy of a valid input, the verb that reads it, and the faults found."""

import random
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from tools.torture_parts.inputs import STEPS, STILL
from tools.torture_parts.mutations import mutate
from tools.torture_parts.zygote import Outcome, Runner

SLACK_SECONDS = 10.0  # beyond the time of the valid input
MEMORY_FACTOR = 1.5
SLACK_BYTES = 50_000_000
FOREIGN = re.compile(
    r"Traceback|internal error|enforce fail|Error\(s\) in loading|core dumped|Segmentation"
    r"|site-packages|RuntimeWarning|Warning:"
)
ONE_SENTENCE = re.compile(r"^climatenerf: ", re.MULTILINE)


@dataclass(frozen=True)
class Kind:
    """One kind of input.

    Attributes:
        base: its folder or file among the originals, which a trial copies.
        files: pattern of the files of which one is mutated.
        verbs: arguments of the command lines of which one is chosen; {in} is the copy, {out} the
            output, {originals} the folder of originals.
        extra: further originals that are copied.
    """

    base: str
    files: str
    verbs: tuple[tuple[str, ...], ...]
    extra: tuple[str, ...] = ()


EXPORT = ("export", "{in}", "-o", "{out}")
FIT = ("fit", "{in}", "-o", "{out}", "--steps", "2")
RENDER = ("render", "{in}", "-o", "{out}", *STILL, "--layers", "depth", "normal")
RESUME = ("fit", "{originals}/scene", "-o", "{in}", "--resume", "--steps", str(STEPS + 2))
WEATHERED = ("render", "{originals}/run", "-o", "{out}", *STILL, "--weather", "{in}")
DRAWN = ("render", "{originals}/run", "-o", "{out}", "--path", "{in}/camera_path.json")
KINDS = {
    "colmap-binary": Kind("colmap", "sparse/0/*", (EXPORT, EXPORT, EXPORT, FIT)),
    "colmap-text": Kind("colmap-text", "sparse/0/*", (EXPORT, EXPORT, EXPORT, FIT)),
    "transforms": Kind("transforms", "transforms.json", (EXPORT, EXPORT, EXPORT, FIT)),
    "scene": Kind("scene", "scene.json", (EXPORT, EXPORT, EXPORT, FIT)),
    "points": Kind("scene", "points.ply", (EXPORT, EXPORT, FIT)),
    "photos": Kind("scene", "images/*", (FIT,)),
    "labels": Kind("scene", "labels/*", (FIT,)),
    "masks": Kind("scene", "masks/*", (FIT,)),
    "depth": Kind("scene", "depth/*", (FIT,)),
    "weather": Kind("weather.toml", "", (WEATHERED,)),
    "camera-path": Kind("path", "*", (DRAWN,)),
    "run-config": Kind("run", "config.json", (RENDER, RESUME), ("scene",)),
    "run-scene": Kind("run", "scene.json", (RENDER,), ("scene",)),
    "field": Kind("run", "field.safetensors", (RENDER,), ("scene",)),
    "optimiser": Kind("run", "optimiser.safetensors", (RESUME,), ("scene",)),
}


@dataclass
class Campaign:
    """The folders and the runner of trials, and the outcomes of valid inputs.

    Attributes:
        originals: folder of the valid inputs.
        work: folder of the current trial.
        runner: runs the verbs.
        valid: outcomes of valid inputs by kind and verb.
    """

    originals: Path
    work: Path
    runner: Runner
    valid: dict[tuple[str, int], Outcome] = field(default_factory=dict)


@dataclass(frozen=True)
class Trial:
    """The result of one trial; `faults` is empty for a pass."""

    kind: str
    seed: int
    mutation: str
    command: str
    status: int
    faults: tuple[str, ...]
    stderr: str

    @property
    def name(self) -> str:
        """What `--replay` takes."""
        return f"{self.kind}:{self.seed}"


def run_trial(campaign: Campaign, kind_name: str, seed: int) -> Trial:
    """Mutate a copy of an input by a seed, run a verb on it, and return its faults."""
    kind, rng = KINDS[kind_name], random.Random(f"{kind_name}:{seed}")
    verb = rng.randrange(len(kind.verbs))
    if (kind_name, verb) not in campaign.valid:
        copy, args = _prepared(campaign, kind, verb)
        done = campaign.runner.run(*args)
        if done.status:
            raise RuntimeError(f"the valid {kind_name} fails: {done.err}")
        campaign.valid[kind_name, verb] = done
    copy, args = _prepared(campaign, kind, verb)
    files = [copy] if copy.is_file() else sorted(p for p in copy.glob(kind.files) if p.is_file())
    mutation = mutate(rng.choice(files), rng)
    out = campaign.work / "out"
    owned = [out, copy] if kind.verbs[verb] is RESUME else [out]
    before = _listing(campaign.work, owned)
    valid = campaign.valid[kind_name, verb]
    done = campaign.runner.run(*args, limit=valid.seconds + SLACK_SECONDS)
    faults = outcome_faults(done, valid)
    if _listing(campaign.work, owned) != before:
        faults.append("wrote outside its output folder")
    if done.status == 0:
        faults += nan_faults(out)
        faults += nan_faults(copy) if copy in owned else []
    stderr = done.err.strip()[-1500:]
    command = " ".join(str(arg) for arg in args)
    return Trial(kind_name, seed, mutation, command, done.status, tuple(faults), stderr)


def _prepared(campaign: Campaign, kind: Kind, verb: int) -> tuple[Path, list[str]]:
    """Return a fresh copy of an input, and the arguments of a verb that reads it."""
    shutil.rmtree(campaign.work, ignore_errors=True)
    campaign.work.mkdir(parents=True)
    for name in (kind.base, *kind.extra):
        source, target = campaign.originals / name, campaign.work / name
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            shutil.copyfile(source, target)
    paths = {
        "{in}": campaign.work / kind.base,
        "{out}": campaign.work / "out",
        "{originals}": campaign.originals,
    }
    args = []
    for arg in kind.verbs[verb]:
        for key, path in paths.items():
            arg = arg.replace(key, str(path))
        args.append(arg)
    return campaign.work / kind.base, args


def _listing(folder: Path, owned: Sequence[Path]) -> dict[str, tuple[int, int]]:
    """Return size and time of all files but those of the output and of the runner."""
    found = {}
    for path in folder.rglob("*"):
        ours = path.name in ("stdout", "stderr") and path.parent == folder
        if not ours and not any(path.is_relative_to(each) for each in owned):
            state = path.lstat()
            found[str(path)] = (state.st_size, state.st_mtime_ns)
            if path.is_dir():
                found[str(path)] = (0, 0)
    return found


def outcome_faults(done: Outcome, valid: Outcome | None = None) -> list[str]:
    """Return what is wrong with the end of a verb, apart from what it wrote.

    Args:
        done: how it ended.
        valid: how the valid input ended; None skips the comparison of memory.
    """
    faults = []
    if done.hung:
        faults.append(f"hangs: killed after {done.seconds:.0f} s")
    elif done.status not in (0, 2):
        faults.append(f"status {done.status}")
    foreign = FOREIGN.search(done.err)
    if foreign:
        faults.append(f"stderr shows {foreign.group()!r}")
    if done.status == 2:
        lines = done.err.replace("\r", "\n").strip().splitlines()
        if len(ONE_SENTENCE.findall(done.err)) != 1 or not lines[-1].startswith("climatenerf: "):
            faults.append("no single sentence at the end of stderr")
    if valid is not None and done.peak > MEMORY_FACTOR * valid.peak + SLACK_BYTES:
        faults.append(f"{done.peak / 1e6:.0f} MB instead of {valid.peak / 1e6:.0f}")
    return faults


def nan_faults(folder: Path) -> list[str]:
    """Return which files of an output hold NaN."""
    from safetensors.numpy import load_file

    faults = []
    for path in sorted(folder.rglob("*")) if folder.is_dir() else []:
        if path.suffix == ".safetensors":
            arrays = load_file(path)
        elif path.suffix == ".npz":
            with np.load(path) as data:
                arrays = {name: data[name] for name in data.files}
        elif path.suffix == ".json" and re.search(r"\bNaN\b|\bInfinity\b", path.read_text()):
            faults.append(f"{path.name} holds NaN")
            continue
        elif path.suffix == ".png":
            with Image.open(path) as picture:
                arrays = {"picture": np.asarray(picture)}
        else:
            continue
        if any(np.issubdtype(a.dtype, np.floating) and np.isnan(a).any() for a in arrays.values()):
            faults.append(f"{path.name} holds NaN")
    return faults


def summary(trials: Sequence[Trial]) -> dict:
    """Return counts by kind, and all failures with their names for `--replay`."""
    counts: dict[str, dict[str, int]] = {}
    for trial in trials:
        row = counts.setdefault(trial.kind, {"trials": 0, "read": 0, "refused": 0, "failed": 0})
        row["trials"] += 1
        key = "failed" if trial.faults else "read" if trial.status == 0 else "refused"
        row[key] += 1
    failures = [
        {"replay": t.name, "faults": t.faults, "mutation": t.mutation, "stderr": t.stderr}
        for t in trials
        if t.faults
    ]
    return {"counts": counts, "failures": failures}
