"""Measure steps, a whole fit and frames on an NVIDIA GPU in one command.

python benchmarks/gpu.py RUN --capture ../shared/data/fox

`step`: million samples per second of one optimiser step on the field of RUN, with every head of
every sample as in `engine.py`, and the same in eager PyTorch on the same device. `fit`: samples per
second of a whole fit, and seconds until the held-out photos reach some PSNR; reading photos and
multi-view stereo are included, evaluation and compilation are not. `waits`: how often a step of
that fit synchronises with the device, counted by PyTorch, and in which lines. `frames`: seconds per
frame and frames per second of a view of RUN in each size, clean and with water on about 40 % of it,
and samples per second of clean frames (samples that marching finds before a ray ends). `peak_gb` is
each part's peak memory on the device. `--device cpu` measures the same on the CPU.
"""

import argparse
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import torch
from engine import draw_batch, our_step, time_to_psnr, twin_step
from frame_time import frames

from climatenerf.cli.render import parse_size
from climatenerf.core.device import resolve_device
from climatenerf.core.errors import UserError
from climatenerf.field.checkpoint import load_field
from climatenerf.field.compositing import RENDER_STEP, rays_at_once
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.volume import camera_rays
from climatenerf.scene import load_scene, read_scene
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings, settings_of
from climatenerf.training.setup import compile_kernels

GOALS = (20, 22, 24, 25)  # dB
WEATHERS = ("clean", "flood")


def synchronised(job: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Return the job followed by a synchronisation with the device."""

    def run() -> None:
        job()
        if device.type == "cuda":
            torch.cuda.synchronize()

    return run


def steps(run: Path, samples: int, repeats: int, device: torch.device, seed: int) -> dict[str, Any]:
    """Measure samples per second of a step, ours and eager PyTorch's, on the same rays."""
    trainer = begin(load_scene(run), FitSettings(seed=seed, multiview_stereo=False), 1, device)
    trainer.field = load_field(run, device).requires_grad_()
    at = draw_batch(trainer, samples)
    size, found = at.samples.t.shape[0], {}
    makers = {"ours": our_step, "eager": lambda field, at: twin_step(field, at, False)}
    for name, make in makers.items():  # ours first: the twin removes its optimiser's buffers
        job = synchronised(make(trainer.field, at), device)
        seconds = common.measure(job, repeats, warm_up=3)
        found[name] = {"samples_per_s": size / seconds["median"], "seconds": seconds}
    return {"samples": size, **found}


def frames_per_s(
    run: Path, sizes: list[str], view: str, repeats: int, seed: int, device: torch.device
) -> dict[str, Any]:
    """Measure frames per second in each size and weather."""
    rows: dict[str, Any] = {}
    for size in sizes:
        found = frames(run, size, view, repeats, seed, WEATHERS, device)["frames"]
        rows[size] = {
            name: {**found[name], "frames_per_s": 1 / found[name]["seconds"]["median"]}
            for name in WEATHERS
        }
        count, clean = samples_of_frame(run, size, view, device), rows[size]["clean"]
        clean["samples"] = count
        clean["samples_per_s"] = count * clean["frames_per_s"]
    return rows


def samples_of_frame(run: Path, size: str, view: str, device: torch.device) -> int:
    """Count the samples of all rays of a clean frame."""
    field = load_field(run, device)
    path = camera_path(view, load_scene(run), 1, parse_size(size))
    rays_o, rays_d = camera_rays(path.cameras[0], path.c2w[0], device)
    count, chunk = 0, rays_at_once(rays_o)
    for o, d in zip(rays_o.split(chunk), rays_d.split(chunk), strict=True):
        near = torch.full_like(o[:, 0], field.near)
        samples = field.march(o, d, near, torch.full_like(near, 1e9), RENDER_STEP)
        count += samples.t.shape[0]
    return count


def count_syncs(
    capture: Path, settings: FitSettings, downscale: int, device: torch.device, steps: int = 300
) -> dict[str, Any]:
    """Count synchronisations with the device per step in the last third of a fit, by line."""
    settings = replace(settings, minutes=None, steps=steps)
    trainer = begin(read_scene(capture), settings, downscale, device)
    ends = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            compile_kernels(trainer)
            trainer.run(lambda _: ends.append(len(caught)))
        finally:
            torch.cuda.set_sync_debug_mode("default")
        lines = [f"{Path(each.filename).name}:{each.lineno}" for each in caught]
    last_third = ends[2 * len(ends) // 3]
    common_lines = Counter(lines[last_third:]).most_common(10)
    return {"per_step": (ends[-1] - last_third) / (len(ends) / 3), "lines": dict(common_lines)}


def measured(part: Callable[[], Any], device: torch.device) -> dict[str, Any]:
    """Run a part; return its results and peak device memory, or its failure."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    try:
        found = part()
    except UserError:
        raise
    except Exception as error:  # too little memory, or a kernel that the driver rejects
        return {"failed": f"{type(error).__name__}: {error}"[:300]}
    if device.type == "cuda":
        found["peak_gb"] = torch.cuda.max_memory_allocated() / 1e9
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--capture", type=Path, help="capture to fit; default: none")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--every", type=float, default=2.0, help="seconds between measurements")
    parser.add_argument("--preset", default="gpu", choices=("gpu", "cpu"), help="preset of the fit")
    parser.add_argument("--samples", type=int, default=2**20, help="samples per step")
    parser.add_argument("--sizes", nargs="+", default=["1280x720", "1920x1080"])
    parser.add_argument("--path", default="still")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    options = parser.parse_args()
    seed = options.seed
    try:
        device = resolve_device(options.device)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    found: dict[str, Any] = {"run": options.run.name, "device": "CPU"}
    parts: dict[str, Callable[[], Any]] = {
        "frames": lambda: frames_per_s(
            options.run, options.sizes, options.path, options.repeats, seed, device
        ),
        "step": lambda: steps(options.run, options.samples, options.repeats, device, seed),
    }
    if options.capture:
        settings = replace(
            settings_of(options.preset, options.device), minutes=options.minutes, seed=seed
        )
        if device.type == "cuda":
            parts["waits"] = lambda: count_syncs(
                options.capture, settings, options.downscale, device
            )
        parts["fit"] = lambda: time_to_psnr(
            options.capture, settings, options.downscale, options.every, GOALS, device
        )
    try:
        if device.type == "cuda":
            found["device"] = torch.cuda.get_device_name()
            found["cuda"] = torch.version.cuda
        for name, part in parts.items():
            found[name] = measured(part, device)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    common.report("speed on a GPU", found, seed)


if __name__ == "__main__":
    main()
