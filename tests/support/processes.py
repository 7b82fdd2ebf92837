"""Entry points of processes that hold locks or write checkpoints, until they are killed."""

import contextlib
import json
import multiprocessing
import time
from pathlib import Path

import numpy as np

from climatenerf.core import storage
from climatenerf.core.locks import only_writer
from climatenerf.core.storage import write_json, write_safetensors
from climatenerf.training.snapshot import CONFIG, FIELD, OPTIMISER, SCENE, new_checkpoint

MODULES = ["support.processes"]


def start(target, *args) -> multiprocessing.Process:
    """Start a process quickly: its server has imported this module already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(MODULES)
    process = context.Process(target=target, args=args, daemon=True)
    process.start()
    return process


@contextlib.contextmanager
def holder(folder: Path):
    """A process that writes into a folder: it holds the lock, and has half of a file."""
    signal = folder.parent / f"{folder.name}-is-held"
    process = start(hold, folder, signal)
    while process.is_alive() and not signal.exists():
        time.sleep(0.002)
    signal.unlink()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def hold(folder: Path, signal: Path) -> None:
    """Hold a folder's lock until the process is killed."""
    with only_writer(folder), storage.atomic_path(folder / "half.bin") as temporary:
        temporary.write_bytes(b"half")
        signal.touch()
        time.sleep(1000)


def write_checkpoint(run: Path, number: int) -> None:
    """Write a checkpoint whose files state their number."""
    about = {"checkpoint": str(number)}
    with new_checkpoint(run) as staging:
        field = {"field": np.full(20_000, number, np.float32)}
        write_safetensors(staging / FIELD, field, {"climatenerf": json.dumps(about)})
        write_safetensors(staging / OPTIMISER, {"state": np.full(9, number)}, about)
        for name in (CONFIG, SCENE):
            write_json(staging / name, {**about, "text": str(number) * 5000})


def write_checkpoints(run: Path, first: int) -> None:
    """Write checkpoints until the process is killed."""
    for number in range(first, first + 10**6):
        write_checkpoint(run, number)
