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
from tools.torture_parts.trials import Campaign, Trial, judged, unsound
from tools.torture_parts.zygote import ROOT, Runner

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
MAX_SECONDS_AFTER_STOP = 10.0
MOVIE = ["--path", "training", "--frames", "6", "--size", "48x27", "--flood.level", "0.3 m"]
DISKS = {"export": ("20k", "200k"), "fit": ("100k", "2m"), "render": ("8k", "60k")}


def commands(campaign: Campaign, out: Path) -> dict[str, list[str]]:
    """Return the words of the verbs that are stopped."""
    nest = campaign.nest
    found = {
        "fit": ["fit", nest / "scene", "-o", out, "--steps", "60"],
        "render": ["render", nest / "run", "-o", out, *MOVIE],
    }
    try:
        import pycolmap  # noqa: F401

        photos = nest / "scene" / "images"
        found["capture"] = ["capture", photos, "-o", out, "--from-colmap", nest / "colmap"]
    except ImportError:
        pass
    return {verb: [str(word) for word in words] for verb, words in found.items()}


def stopped(campaign: Campaign, verb: str, seed: int) -> Trial:
    """Stop a verb at a random moment, run it again, and compare with an undisturbed result."""
    rng, out = random.Random(f"stop-{verb}:{seed}"), campaign.work / "out"
    words = commands(campaign, out)[verb]
    reference = campaign.nest / f"undisturbed-{verb}"
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
    done = campaign.runner.run(*words, stop=[int(SIGNALS[name]), after])
    faults = _judged_stop(done.status, name, done.after_stop, done.err)
    said = done.err.strip()[-1500:]
    again = list(words)
    # A fit that saved its field says how it goes on.
    if verb == "fit" and (out / "optimiser.safetensors").exists():
        again.append("--resume")
    done = campaign.runner.run(*again)
    faults += [f"again: {fault}" for fault in judged(done)]
    if done.status:
        faults.append(f"the same command fails afterwards with status {done.status}")
    else:
        faults += unsound(out)
        if "--resume" not in again:
            faults += difference(reference, out)
    mutation = f"{name} after {after:.2f} s"
    shown, said = " ".join(words), f"{said} | again: {done.err.strip()[-1500:]}"
    return Trial(f"stop-{verb}", seed, mutation, shown, done.status, tuple(faults), said)


def _judged_stop(status: int, name: str, seconds: float | None, err: str) -> list[str]:
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
    left = [p.name for p in other.rglob("*") if ".tmp" in p.name]
    return faults + [f"{name} is left" for name in left]


def _content(path: Path) -> str:
    """Return a hash of what matters in a file; "" where that may differ."""
    if path.suffix == ".png":
        with Image.open(path) as picture:
            return hashlib.sha256(np.asarray(picture).tobytes()).hexdigest()
    # The optimiser's file holds the seconds of the fit.
    if path.suffix == ".npz" or path.name == "field.safetensors":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return ""


def on_full_disk(campaign: Campaign, verb: str, seed: int) -> Trial | str:
    """Run a verb into a disk that is too small; a text says why that is not possible here."""
    disk = campaign.work / "disk"
    _empty(campaign.work)
    disk.mkdir()
    words = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    size = random.Random(f"disk-{verb}:{seed}").choice(DISKS[verb])
    inner = f'mount -t tmpfs -o size={size} tmpfs "$0" && exec "$@"'
    possible = (
        shutil.which("unshare") is not None
        and not subprocess.run([*words, inner, str(disk), "true"], capture_output=True).returncode
    )
    if not possible:
        return "no permission to mount a disk in a user namespace"
    nest = campaign.nest
    verbs = {
        "export": ["export", nest / "scene", "-o", disk / "out"],
        "fit": ["fit", nest / "scene", "-o", disk / "out", "--steps", "2"],
        "render": ["render", nest / "run", "-o", disk / "out", *STILL, "--layers", "depth"],
    }
    program = [sys.executable, "-m", "tools.torture_parts.single", *map(str, verbs[verb])]
    done = subprocess.run(
        [*words, inner, str(disk), *program], capture_output=True, text=True, cwd=ROOT
    )
    last = done.stderr.replace("\r", "\n").strip().splitlines()[-1:]
    faults = []
    if done.returncode == 2 and not (last and last[0].startswith("climatenerf: ")):
        faults.append("no sentence at the end of stderr")
    if done.returncode not in (0, 2):
        faults.append(f"status {done.returncode}")
    if "Traceback" in done.stderr:
        faults.append("a traceback")
    said = done.stderr.strip()[-1500:]
    return Trial(f"disk-{verb}", seed, size, verb, done.returncode, tuple(faults), said)


def two_at_once(campaign: Campaign, verb: str, seed: int, other: Runner) -> Trial:
    """Run a verb twice into one folder at once; what is there afterwards must be of one of them."""
    _empty(campaign.work)
    _empty(other.work)
    out = campaign.work / "out"
    words = commands(campaign, out)[verb]
    later = [*words, "--seed", "1"] if verb == "fit" else words
    campaign.runner.start(words)
    other.start(later)
    ends = [campaign.runner.result(), other.result()]
    faults = [f"one: {fault}" for done in ends for fault in judged(done)]
    if not any(done.status == 0 for done in ends):
        faults.append("neither ends with status 0")
    faults += unsound(out)
    if verb == "fit":
        check = campaign.work / "check"
        done = campaign.runner.run("render", out, "-o", check, *STILL)
        if done.status:
            faults.append("the run cannot be rendered")
        saved = json.loads((out / "config.json").read_text())["settings"]["seed"]
        if sum(done.status == 0 for done in ends) > 1:
            faults.append(f"both fits claim one folder (its settings have seed {saved})")
    said = " | ".join(done.err.strip()[-300:] for done in ends)
    return Trial(f"two-{verb}", seed, "", " ".join(words), ends[0].status, tuple(faults), said)


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
