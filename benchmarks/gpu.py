"""What an NVIDIA GPU makes of it: fitting, a capture from nothing, and frames, in one command.

python benchmarks/gpu.py RUN --capture ../shared/data/fox

`step`: million samples a second of one optimiser step on the field of RUN, every sample through
every head, as in `engine.py`, beside eager PyTorch on the same device. `fit`: the capture from
nothing: samples a second in practice, and seconds until the held-out photos reach so many dB
(reading and matching photos are counted, measuring and compiling are not); `waits`: how often a
step waits for the card there, by PyTorch's own count, and at which lines. `frames`: seconds and
frames a second of a view of RUN in each size, clean and with water on about 40 % of it, and of
clean ones the samples a second (those that a march finds before a ray ends). Memory is each part's
peak on the device.
`--device cpu` tries the same without a GPU; its figures are the CPU's.
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
from engine import drawn, our_step, time_to_psnr, twin_step
from frame_time import frames

from climatenerf.cli.render import parse_size
from climatenerf.core.device import on
from climatenerf.core.errors import UserError
from climatenerf.field.checkpoint import load_field
from climatenerf.field.compositing import RENDER_STEP, rays_at_once
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.volume import camera_rays
from climatenerf.scene import load_scene, read_scene
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings, settings_of

GOALS = (20, 22, 24, 25)  # dB
WEATHERS = ("clean", "flood")


def finished(job: Callable[[], None], device: str) -> Callable[[], None]:
    """The job, until the device is done with it."""

    def wait() -> None:
        job()
        if device == "cuda":
            torch.cuda.synchronize()

    return wait


def steps(run: Path, samples: int, repeats: int, device: str, seed: int) -> dict[str, Any]:
    """Samples a second of a step, ours and eager PyTorch's, on the same field and rays."""
    fitting = begin(load_scene(run), FitSettings(seed=seed, multiview_stereo=False), 1)
    fitting.field = load_field(run).requires_grad_()
    at = drawn(fitting, samples)
    size, found = at.samples.t.shape[0], {}
    makers = {"ours": our_step, "eager": lambda field, at: twin_step(field, at, False)}
    for name, make in makers.items():  # made one by one: the twin takes our optimiser's buffers
        job = finished(make(fitting.field, at), device)
        seconds = common.measure(job, repeats, warm_up=3)
        found[name] = {"samples_per_s": size / seconds["median"], "seconds": seconds}
    return {"samples": size, **found}


def shown(run: Path, sizes: list[str], view: str, repeats: int, seed: int) -> dict[str, Any]:
    """Frames a second in each size and weather."""
    rows: dict[str, Any] = {}
    for size in sizes:
        found = frames(run, size, view, repeats, seed, WEATHERS)["frames"]
        rows[size] = {
            name: {**found[name], "frames_per_s": 1 / found[name]["seconds"]["median"]}
            for name in WEATHERS
        }
        of_clean = samples_of_frame(run, size, view)
        rows[size]["clean"]["samples"] = of_clean
        rows[size]["clean"]["samples_per_s"] = of_clean * rows[size]["clean"]["frames_per_s"]
    return rows


def samples_of_frame(run: Path, size: str, view: str) -> int:
    """Samples that a clean frame's rays have until they end."""
    field = load_field(run)
    path = camera_path(view, load_scene(run), 1, parse_size(size))
    rays_o, rays_d = camera_rays(path.cameras[0], path.c2w[0])
    count, some = 0, rays_at_once(rays_o)
    for o, d in zip(rays_o.split(some), rays_d.split(some), strict=True):
        near = torch.full((o.shape[0],), field.near)
        samples = field.march(o, d, near, torch.full_like(near, 1e9), RENDER_STEP)
        count += samples.t.shape[0]
    return count


def waits(capture: Path, settings: FitSettings, downscale: int, steps: int = 300) -> dict[str, Any]:
    """How often a step of a fit waits for the card, in its last third, and where that is."""
    fitting = begin(read_scene(capture), replace(settings, minutes=None, steps=steps), downscale)
    met, ends = [], []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            fitting.run(lambda _: ends.append(len(caught)))
        finally:
            torch.cuda.set_sync_debug_mode("default")
        met = [f"{Path(each.filename).name}:{each.lineno}" for each in caught]
    late = ends[2 * len(ends) // 3]
    places = Counter(met[late:]).most_common(10)
    return {"of_a_step": (ends[-1] - late) / (len(ends) / 3), "places": dict(places)}


def measured(part: Callable[[], Any], device: str) -> dict[str, Any]:
    """What a part finds, and its peak memory on the device; if it fails, the others still run."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    try:
        found = part()
    except UserError:
        raise
    except Exception as error:  # too little memory, or a kernel that this driver does not take
        return {"failed": f"{type(error).__name__}: {error}"[:300]}
    if device == "cuda":
        found["peak_gb"] = torch.cuda.max_memory_allocated() / 1e9
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--capture", type=Path, help="fitted from nothing; default: not asked")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--every", type=float, default=2.0, help="seconds between measurements")
    parser.add_argument("--preset", default="gpu", choices=("gpu", "cpu"), help="of the fit")
    parser.add_argument("--samples", type=int, default=2**20, help="of a step")
    parser.add_argument("--sizes", nargs="+", default=["1280x720", "1920x1080"])
    parser.add_argument("--path", default="still")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    options = parser.parse_args()
    device, seed = options.device, options.seed
    found: dict[str, Any] = {"run": options.run.name, "device": "CPU"}
    parts: dict[str, Callable[[], Any]] = {
        "frames": lambda: shown(options.run, options.sizes, options.path, options.repeats, seed),
        "step": lambda: steps(options.run, options.samples, options.repeats, device, seed),
    }
    if options.capture:
        settings = replace(settings_of(options.preset, device), minutes=options.minutes, seed=seed)
        if device == "cuda":
            parts["waits"] = lambda: waits(options.capture, settings, options.downscale)
        parts["fit"] = lambda: time_to_psnr(
            options.capture, settings, options.downscale, options.every, GOALS
        )
    try:
        with on(device):
            if device == "cuda":
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
