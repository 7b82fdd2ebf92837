"""Time an optimiser step, a frame, and a whole fit.

python benchmarks/engine.py RUN
python benchmarks/engine.py RUN --capture ../shared/data/fox --minutes 5
python benchmarks/engine.py RUN --capture ../shared/data/fox --peer peer/bin/python

`step`: samples per second of one optimiser step on the field of RUN with rays of its photos, for
our kernels, for the same step in eager PyTorch, and under `torch.compile`. In all three every
sample passes every head (density, colour, classes, normals and the normals' target); marching is
excluded. `frame`: seconds per picture, as in `frame_time.py`. `time_to_psnr`: seconds from the
start of a fit until the held-out photos of a capture reach some PSNR in the mean appearance of all
photos. Reading photos and multi-view stereo are included, evaluation and compilation are not. The
peer's times come from `peer_nerfacto.py` in an environment of its own, and exclude reading photos.
null: not reached within the time limit.
"""

import argparse
import json
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import common
import torch
from frame_time import frames
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import SOLID
from climatenerf.core.device import CPU, uniform
from climatenerf.core.samples import Samples
from climatenerf.core.vectors import unit
from climatenerf.evaluation.heldout import evaluate
from climatenerf.field import activations
from climatenerf.field import spherical_harmonics as directions
from climatenerf.field.checkpoint import load_field
from climatenerf.field.hash_field import Field
from climatenerf.ops import compositing, encoding, marching, network, reference
from climatenerf.scene import load_scene, read_scene
from climatenerf.training import losses
from climatenerf.training.dataset import Batch
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings
from climatenerf.training.setup import compile_kernels
from climatenerf.training.trainer import Report, Trainer

GOALS = (20, 22, 24)  # dB
STEPS = 5  # steps of our kernels per step of a twin


# --- the same operations in plain PyTorch, without a loop over rays ------------------------------


def ray_of(offsets: Int[Tensor, "rays+1"]) -> Int[Tensor, "s"]:
    return torch.repeat_interleave(
        torch.arange(len(offsets) - 1, device=offsets.device), offsets.diff()
    )


def before_each(values: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]) -> Float[Tensor, "s"]:
    """Return the sum of the preceding values on each sample's ray."""
    passed = values.double().cumsum(0) - values
    first = offsets[:-1].clamp_max(values.shape[0] - 1)
    return (passed - passed[first][ray_of(offsets)]).to(values.dtype)


def eager_weights(tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]):
    weights = (-before_each(tau, offsets)).exp() * -torch.expm1(-tau)
    total = torch.index_add(tau.new_zeros(offsets.shape[0] - 1), 0, ray_of(offsets), tau)
    return weights, (-total).exp()


def eager_accumulate(weights: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    out = values.new_zeros(offsets.shape[0] - 1, values.shape[1])
    return torch.index_add(out, 0, ray_of(offsets), weights[:, None] * values)


def eager_distortion(weights: Tensor, s: Tensor, ds: Tensor, offsets: Tensor) -> Tensor:
    pairs = weights * (s * before_each(weights, offsets) - before_each(weights * s, offsets))
    each = 2 * pairs + weights * weights * ds / 3
    return torch.index_add(each.new_zeros(offsets.shape[0] - 1), 0, ray_of(offsets), each)


def eager_surface(weights: Tensor, raw: Tensor, target: Tensor, offsets: Tensor):
    logits = eager_accumulate(weights, raw[:, 3:], offsets)
    off = (unit(raw[:, :3], 1e-6) - target).square().sum(-1, keepdim=True)
    return logits, eager_accumulate(weights, off, offsets)[:, 0]


def eager_positions(rays, offsets: Tensor, t: Float[Tensor, "s"]) -> Float[Tensor, "s 3"]:
    o, d = (each[ray_of(offsets)] for each in rays)
    return reference.contract(o + t[:, None] * d)


def eager_encoded(u, table, resolutions, layers, shared=None, row=None) -> Tensor:
    """Encode and evaluate separately; on a GPU `network.encoded_mlp` is one kernel."""
    return reference.mlp(reference.hash_encode(u, table, resolutions), layers, shared, row)


def eager_slopes(q: Float[Tensor, "n 3"], net: marching.Net) -> Float[Tensor, "n 3"]:
    table, resolutions, w1, b1, w2, b2 = (each.detach() for each in net)
    return reference.density_slopes(q, table, resolutions, [(w1, b1), (w2, b2)])


@contextmanager
def plain_pytorch() -> Iterator[None]:
    """Replace all kernels by PyTorch operations within the context."""
    encodings = mock.patch.object(encoding, "hash_encode", reference.hash_encode)
    networks = mock.patch.multiple(network, mlp=reference.mlp, encoded_mlp=eager_encoded)
    marches = mock.patch.multiple(marching, density_slopes=eager_slopes, positions=eager_positions)
    sums = mock.patch.multiple(
        compositing,
        render_weights=eager_weights,
        accumulate=eager_accumulate,
        distortion=eager_distortion,
        surface=eager_surface,
    )
    outputs = mock.patch.multiple(
        activations,
        radiance=activations.plain_radiance,
        density_from_raw=activations.plain_density_from_raw,
    )
    harmonics = mock.patch.object(directions, "harmonics", directions.spherical_harmonics)
    with encodings, networks, marches, sums, outputs, harmonics:
        yield


# --- one step ------------------------------------------------------------------------------------


@dataclass
class RayBatch:
    """A batch of rays with their samples."""

    batch: Batch
    samples: Samples
    ray: Int[Tensor, "s"]
    q: Float[Tensor, "s 3"]
    """Grid units."""


def draw_batch(trainer: Trainer, samples: int) -> RayBatch:
    """Draw rays that have about `samples` samples in total."""
    field, rays = trainer.field, 512
    for _ in range(50):  # the number of samples varies per ray, so the target may be missed
        batch = trainer.pixels.draw(rays, trainer.generator)
        near = torch.full_like(batch.rays_o[:, 0], field.near)
        far = torch.full_like(near, 1e9)
        jitter = uniform(trainer.generator, len(near), device=near.device)
        found = field.march(batch.rays_o, batch.rays_d, near, far, 1.0, jitter, stop=1e-4)
        if 0.9 * samples < found.t.shape[0] < 1.1 * samples or rays > 2**16:
            break
        rays = max(16, int(rays * samples / max(found.t.shape[0], 1)))
    ray = found.ray_index()
    x = batch.rays_o[ray] + found.t[:, None] * batch.rays_d[ray]
    return RayBatch(batch, found, ray, field.to_grid(x))


def loss_of(field: Field, at: RayBatch) -> Float[Tensor, ""]:
    """Compute all losses: colour, distortion, opacity, classes and normals of all samples."""
    batch, samples = at.batch, at.samples
    n = batch.rays_o.shape[0]
    u = field.sample_positions(batch.rays_o, batch.rays_d, samples)
    dt, t = samples.dt / field.unit, samples.t / field.unit
    weights, transmittance = compositing.render_weights(
        field.density_with_gradient(u) * dt, samples.offsets
    )
    embedding = field.embeddings.index_select(0, batch.image)
    colour = field.colour_at(u, at.ray, batch.rays_d, embedding)
    radiance = compositing.accumulate(weights, colour, samples.offsets)
    radiance = radiance + transmittance[:, None] * field.sky_colour(batch.rays_d, embedding)
    loss = losses.colour_error(radiance, batch.rgb).mean()
    loss = loss + 1e-2 * losses.distortion_loss(weights, t, dt, samples.offsets)
    loss = loss + 2e-4 * losses.opacity_entropy_loss(transmittance)
    density_normal = field.density_normal(at.q)
    logits, distance = compositing.surface(
        weights.detach(), field.surface_raw(u), density_normal, samples.offsets
    )
    # Any classes: the cost does not depend on them.
    target = torch.arange(n, device=u.device) % len(SOLID)
    loss = loss + 4e-2 * losses.class_loss(logits, target, target >= 0)
    return loss + 4e-2 * distance.sum() / n


def our_step(field: Field, at: RayBatch) -> Callable[[], None]:
    tables = [p for n, p in field.named_parameters() if n.endswith("_grid")]
    weights = [p for n, p in field.named_parameters() if not n.endswith("_grid")]
    grids, nets = GridAdam(tables), torch.optim.Adam(weights, lr=1e-6, fused=True)
    buffers = [table.grad_buffer for table in tables]

    def step() -> None:
        for table, buffer in zip(tables, buffers, strict=True):
            table.grad_buffer = buffer
        try:
            nets.zero_grad()
            loss_of(field, at).backward()
            nets.step()
            grids.step(1e-6)
        finally:
            for table in tables:  # the twins use autograd's gradients
                del table.grad_buffer

    return step


def twin_step(field: Field, at: RayBatch, compiled: bool) -> Callable[[], None]:
    adam = torch.optim.Adam(field.parameters(), lr=1e-6, fused=True)
    loss = torch.compile(loss_of) if compiled else loss_of

    def step() -> None:
        with plain_pytorch():
            adam.zero_grad()
            loss(field, at).backward()
            adam.step()
            adam.zero_grad()

    return step


def steps(trainer: Trainer, samples: int, twin_samples: int, repeats: int) -> dict[str, object]:
    """Measure samples per second of our kernels and the twins on the same field and rays.

    Measurements alternate, so that a change of the machine's load affects all of them.
    """
    large = draw_batch(trainer, samples)
    small = large if twin_samples == samples else draw_batch(trainer, twin_samples)
    jobs = {
        "ours": our_step(trainer.field, large),
        "eager": twin_step(trainer.field, small, False),
        "compile": twin_step(trainer.field, small, True),
    }
    counts = {name: (large if name == "ours" else small).samples.t.shape[0] for name in jobs}
    measured: dict[str, list[float]] = {name: [] for name in jobs}
    failed: dict[str, str] = {}
    for repeat in range(repeats + 1):
        for name in [each for each in jobs if each not in failed]:
            try:
                jobs[name]()  # fill the caches, which contain the tables of the previous job
                for _ in range(STEPS if name == "ours" else 1):
                    seconds = common.measure(jobs[name], 1, warm_up=0)["median"]
                    if repeat:  # the first one compiles
                        measured[name].append(seconds)
            except Exception as error:  # no C compiler, or an unsupported operation
                failed[name] = f"{type(error).__name__}: {error}"[:300]
    seconds = {
        name: common.spread(values) for name, values in measured.items() if name not in failed
    }
    rates = {name: counts[name] / each["median"] for name, each in seconds.items()}
    times = {
        f"times_{name}": rates["ours"] / rates[name]
        for name in ("eager", "compile")
        if name in rates and "ours" in rates
    }
    return {**rates, **times, "samples": counts, "seconds": seconds, "failed": failed}


# --- a whole fit ---------------------------------------------------------------------------------


def time_to_psnr(
    capture: Path,
    settings: FitSettings,
    downscale: int,
    every: float,
    goals: tuple[int, ...] = GOALS,
    device: torch.device = CPU,
) -> dict[str, object]:
    """Fit a capture; return the seconds to reach each PSNR of `goals` (dB), and the curve."""
    scene = read_scene(capture)
    start = time.perf_counter()
    trainer = begin(scene, settings, downscale, device)
    prepared = time.perf_counter() - start
    curve: list[dict[str, float]] = []

    def record(report: Report) -> None:
        if report.seconds >= every * (len(curve) + 1) or report.progress >= 1:
            found = evaluate(trainer.field, scene, downscale, lambda done, total: None, False)
            curve.append(
                {
                    "seconds": prepared + report.seconds,
                    "samples": report.samples,
                    "psnr": found["psnr"],
                    "psnr_cc": found["psnr_cc"],
                }
            )

    compile_kernels(trainer)
    trainer.run(record)
    last = curve[-1]
    found = {"prepared_s": prepared, "samples_per_s": last["samples"] / trainer.seconds}
    return {**reached(curve, goals), **found, "curve": curve}


def reached(
    curve: list[dict[str, float]], goals: tuple[int, ...] = GOALS
) -> dict[str, float | None]:
    """Return the seconds to reach each goal; None if it was not reached."""
    return {
        str(goal): next((at["seconds"] for at in curve if at["psnr"] >= goal), None)
        for goal in goals
    }


def peer_time_to_psnr(python: str, capture: Path, minutes: float, rays: int, seed: int) -> dict:
    """Run `peer_nerfacto.py` with another interpreter; return its times and curve."""
    script = Path(__file__).with_name("peer_nerfacto.py")
    args = [capture, "--minutes", minutes, "--rays", rays, "--seed", seed]
    done = subprocess.run(
        [python, str(script), *map(str, args)], stdout=subprocess.PIPE, text=True, check=True
    )
    found = json.loads(done.stdout.splitlines()[-1])
    return {**reached(found["curve"]), **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--samples", type=int, default=2**16)
    parser.add_argument("--twin-samples", type=int, default=2**16)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--path", default="still")
    parser.add_argument(
        "--capture", type=Path, help="capture to fit for `time_to_psnr`; default: none"
    )
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--every", type=float, default=5.0, help="seconds between measurements")
    parser.add_argument("--peer", help="Python interpreter of an environment with nerfstudio")
    parser.add_argument("--peer-minutes", type=float, default=10.0)
    parser.add_argument("--peer-rays", type=int, default=1024, help="rays per step")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    scene = load_scene(options.run)
    trainer = begin(scene, FitSettings(seed=options.seed, multiview_stereo=False), 1)
    trainer.field = load_field(options.run).requires_grad_()
    found: dict[str, object] = {"run": options.run.name, "capture": scene.root.name}
    found["step"] = steps(trainer, options.samples, options.twin_samples, options.repeats)
    measured = frames(options.run, options.size, options.path, options.repeats, options.seed)
    found["frame"] = {
        f"{name}_s": row["seconds"]["median"] for name, row in measured["frames"].items()
    }
    found["frames"] = measured
    if options.capture:
        settings = FitSettings(minutes=options.minutes, seed=options.seed)
        ours = time_to_psnr(options.capture, settings, options.downscale, options.every)
        found["time_to_psnr"] = {"capture": options.capture.name, "ours": ours}
        if options.peer:
            found["time_to_psnr"]["peer"] = peer_time_to_psnr(
                options.peer, options.capture, options.peer_minutes, options.peer_rays, options.seed
            )
    common.report("speed of a step, of a frame and of a fit", found, options.seed)


if __name__ == "__main__":
    main()
