"""Verbs that are killed, run on a full disk, or run twice at once."""

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from tools.torture_parts.inputs import STILL
from tools.torture_parts.trials import Campaign, Trial, nan_faults, outcome_faults
from tools.torture_parts.zygote import ROOT, Runner

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
MAX_SECONDS_AFTER_STOP = 10.0
MOVIE = ["--path", "training", "--frames", "6", "--size", "48x27", "--flood.level", "0.3 m"]
DISKS = {"export": ("20k", "200k"), "fit": ("100k", "2m"), "render": ("8k", "60k")}


def commands(campaign: Campaign, out: Path) -> dict[str, list[str]]:
    """Return the arguments of the verbs that are stopped."""
    originals = campaign.originals
    found = {
        "fit": ["fit", originals / "scene", "-o", out, "--steps", "60"],
        "render": ["render", originals / "run", "-o", out, *MOVIE],
    }
    try:
        import pycolmap  # noqa: F401

        photos = originals / "scene" / "images"
        found["capture"] = ["capture", photos, "-o", out, "--from-colmap", originals / "colmap"]
    except ImportError:
        pass
    return {verb: [str(arg) for arg in args] for verb, args in found.items()}


def stopped(campaign: Campaign, verb: str, seed: int) -> Trial:
    """Stop a verb at a random moment, run it again, and compare with an undisturbed result."""
    rng, out = random.Random(f"stop-{verb}:{seed}"), campaign.work / "out"
    args = commands(campaign, out)[verb]
    reference = campaign.originals / f"undisturbed-{verb}"
    if not reference.exists():
        undisturbed = commands(campaign, reference)[verb]
        done = campaign.runner.run(*undisturbed)
        if done.status:
            raise RuntimeError(f"{verb} fails: {done.err}")
        campaign.valid["stop-" + verb, 0] = done
    _empty(campaign.work)
    name = rng.choice(sorted(SIGNALS))
    valid = campaign.valid["stop-" + verb, 0]
    after = rng.random() * valid.seconds
    done = campaign.runner.run(*args, stop=[int(SIGNALS[name]), after])
    faults = _stop_faults(done.status, name, done.after_stop, done.err)
    stderr = done.err.strip()[-1500:]
    again = list(args)
    # A fit that saved a checkpoint is continued by `--resume`.
    if verb == "fit" and (out / "optimiser.safetensors").exists():
        again.append("--resume")
    done = campaign.runner.run(*again)
    faults += [f"again: {fault}" for fault in outcome_faults(done)]
    if done.status:
        faults.append(f"the same command fails afterwards with status {done.status}")
    else:
        faults += nan_faults(out)
        if "--resume" not in again:
            faults += difference(reference, out)
    mutation = f"{name} after {after:.2f} s"
    command, stderr = " ".join(args), f"{stderr} | again: {done.err.strip()[-1500:]}"
    return Trial(f"stop-{verb}", seed, mutation, command, done.status, tuple(faults), stderr)


def _stop_faults(status: int, name: str, seconds: float | None, err: str) -> list[str]:
    """Return what is wrong with the end of a verb that got a signal."""
    if seconds is None:  # it ended before
        return []
    number = int(SIGNALS[name])
    faults = []
    if seconds > MAX_SECONDS_AFTER_STOP:
        faults.append(f"ends {seconds:.0f} s after {name}")
    allowed = {0, -number, 128 + number}  # 0: a fit saves its field, or the verb was done
    if status not in allowed:
        faults.append(f"status {status} after {name}")
    if "Traceback" in err:
        faults.append("a traceback")
    return faults


def difference(one: Path, other: Path) -> list[str]:
    """Return which pictures, layers and fields of two outputs differ, and which are left over."""
    faults = []
    for folder, against in ((one, other), (other, one)):
        for path in sorted(folder.rglob("*")):
            relative = path.relative_to(folder)
            if any(part.startswith(".") for part in relative.parts) or path.is_dir():
                continue
            if "previews" in relative.parts or path.suffix in (".log", ".db"):
                continue
            if not (against / relative).exists():
                faults.append(f"{relative} is in one of the results only")
            elif folder is one and _content(path) != _content(against / relative):
                faults.append(f"{relative} differs")
    temporary = [p.name for p in other.rglob("*") if ".tmp" in p.name]
    return faults + [f"{name} is left over" for name in temporary]


def _content(path: Path) -> str:
    """Return a hash of the content that must be reproducible; "" for other files."""
    if path.suffix == ".png":
        with Image.open(path) as picture:
            return hashlib.sha256(np.asarray(picture).tobytes()).hexdigest()
    # The optimiser's file holds the seconds of the fit.
    if path.suffix == ".npz" or path.name == "field.safetensors":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return ""


def on_full_disk(campaign: Campaign, verb: str, seed: int) -> Trial | str:
    """Run a verb with a disk that is too small; return a text if disks cannot be mounted here."""
    disk = campaign.work / "disk"
    _empty(campaign.work)
    disk.mkdir()
    args = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    size = random.Random(f"disk-{verb}:{seed}").choice(DISKS[verb])
    inner = f'mount -t tmpfs -o size={size} tmpfs "$0" && exec "$@"'
    possible = (
        shutil.which("unshare") is not None
        and not subprocess.run([*args, inner, str(disk), "true"], capture_output=True).returncode
    )
    if not possible:
        return "no permission to mount a disk in a user namespace"
    originals = campaign.originals
    verbs = {
        "export": ["export", originals / "scene", "-o", disk / "out"],
        "fit": ["fit", originals / "scene", "-o", disk / "out", "--steps", "2"],
        "render": ["render", originals / "run", "-o", disk / "out", *STILL, "--layers", "depth"],
    }
    program = [sys.executable, "-m", "tools.torture_parts.single", *map(str, verbs[verb])]
    done = subprocess.run(
        [*args, inner, str(disk), *program], capture_output=True, text=True, cwd=ROOT
    )
    last = done.stderr.replace("\r", "\n").strip().splitlines()[-1:]
    faults = []
    if done.returncode == 2 and not (last and last[0].startswith("climatenerf: ")):
        faults.append("no sentence at the end of stderr")
    if done.returncode not in (0, 2):
        faults.append(f"status {done.returncode}")
    if "Traceback" in done.stderr:
        faults.append("a traceback")
    stderr = done.stderr.strip()[-1500:]
    return Trial(f"disk-{verb}", seed, size, verb, done.returncode, tuple(faults), stderr)


def two_at_once(campaign: Campaign, verb: str, seed: int, other: Runner) -> Trial:
    """Run a verb twice into one folder at once; the result must be that of one of them."""
    _empty(campaign.work)
    _empty(other.work)
    out = campaign.work / "out"
    args = commands(campaign, out)[verb]
    later = [*args, "--seed", "1"] if verb == "fit" else args
    campaign.runner.start(args)
    other.start(later)
    ends = [campaign.runner.result(), other.result()]
    faults = [f"one: {fault}" for done in ends for fault in outcome_faults(done)]
    if not any(done.status == 0 for done in ends):
        faults.append("neither ends with status 0")
    faults += nan_faults(out)
    if verb == "fit":
        check = campaign.work / "check"
        done = campaign.runner.run("render", out, "-o", check, *STILL)
        if done.status:
            faults.append("the run cannot be rendered")
        saved = json.loads((out / "config.json").read_text())["settings"]["seed"]
        if sum(done.status == 0 for done in ends) > 1:
            faults.append(f"both fits claim one folder (its settings have seed {saved})")
    stderr = " | ".join(done.err.strip()[-300:] for done in ends)
    return Trial(f"two-{verb}", seed, "", " ".join(args), ends[0].status, tuple(faults), stderr)


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
