"""A step of a fit with GPU kernels, in Triton's interpreter, against the CPU kernels."""

import os

import pytest
import torch
from test_static_shapes import frozen_fit, gradients_of

from climatenerf.ops import dispatch, marching

os.environ.setdefault("TRITON_INTERPRET", "1")  # read when a kernel is defined
pytest.importorskip("triton", reason="Triton is for Linux")
if os.environ["TRITON_INTERPRET"] != "1":
    pytest.skip("kernels run on the GPU of this machine", allow_module_level=True)

from climatenerf.ops.triton import compositing as gpu_compositing
from climatenerf.ops.triton import encoding as gpu_encoding
from climatenerf.ops.triton import marching as gpu_marching
from climatenerf.ops.triton import network as gpu_network
from climatenerf.ops.triton import optimiser as gpu_optimiser
from climatenerf.ops.triton import visual_hull as gpu_visual_hull

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


def use_backend(backend, monkeypatch):
    """Let all operations use the kernels of `backend`, "cpu" or "triton"."""

    def kernel_array(tensor):
        tensor = tensor.detach().contiguous()
        return tensor.numpy() if backend == "cpu" else tensor

    monkeypatch.setattr(dispatch, "backend", lambda *tensors: backend)
    monkeypatch.setattr(dispatch, "kernel_array", kernel_array)


def test_a_step_with_the_gpu_kernels_has_the_gradients_of_the_cpu_kernels(scene, monkeypatch):
    """Tiles are large, since the interpreter takes milliseconds per operation of any size."""
    for module in (gpu_encoding, gpu_network, gpu_marching):
        monkeypatch.setattr(module, "SAMPLES", 4096)
    for module, name, size in (
        (gpu_marching, "SLOPE_SAMPLES", 4096),
        (gpu_marching, "RAYS", 64),
        (gpu_marching, "RAY_LISTS", 64),
        (gpu_compositing, "RAY_LISTS", 64),
        (gpu_optimiser, "ENTRIES", 2**16),
        (gpu_visual_hull, "POSITIONS", 4096),
        (marching, "MAX_RAY_SAMPLES", 128),
    ):
        monkeypatch.setattr(module, name, size)
    results = []
    for backend in ("cpu", "triton"):
        use_backend(backend, monkeypatch)
        trainer = frozen_fit(scene, backend == "triton")
        with torch.no_grad():  # varied colours, so that gradients are not zero
            generator = torch.Generator().manual_seed(7)
            for grid in trainer.grid_adam.tables:
                grid.copy_(0.1 * torch.randn(grid.shape, generator=generator))
        for _ in range(2):  # the second one with smaller capacities
            batch = trainer.pixels.draw(60, torch.Generator().manual_seed(2), 10, 0.1)
            trainer.objective.depth_alignment.sums.zero_()
            result, gradients = gradients_of(trainer, batch)
        results.append((result, gradients))
    (exact, expected), (deferred, found) = results
    assert deferred[0] == pytest.approx(exact[0], rel=1e-3)
    assert deferred[1] == pytest.approx(exact[1], abs=9)
    assert expected.keys() == found.keys()
    for name, gradient in expected.items():
        off = (found[name] - gradient).norm()
        assert off <= 1e-3 * gradient.norm() + 1e-9, name
