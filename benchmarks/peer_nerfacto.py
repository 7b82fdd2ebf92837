"""Measure the PSNR of nerfstudio's nerfacto over time on a CPU, for `engine.py --peer`.

nerfstudio pins other versions, so the script needs an environment of its own:

python -m venv peer && peer/bin/pip install torch==2.13.0 torchvision nerfstudio==1.1.5
peer/bin/python benchmarks/peer_nerfacto.py ../shared/data/fox --minutes 10 --rays 1024

The capture has a `transforms.json`; every eighth photo by name is held out, as in `climatenerf
fit`. The settings are the method's own except for the number of rays and fixed cameras. Prints
JSON: seconds of training and PSNR of some thousand pixels of the held-out photos, at each
measurement.
"""

import argparse
import functools
import json
import math
import sys
import tempfile
import time
from pathlib import Path

import torch

try:
    import torchvision  # noqa: F401
except RuntimeError:
    # A CUDA build of torchvision lacks its operators beside a CPU build of PyTorch. They are not
    # called here, but its import requires that these two are registered.
    OPERATORS = torch.library.Library("torchvision", "DEF")
    OPERATORS.define("nms(Tensor boxes, Tensor scores, float threshold) -> Tensor")
    OPERATORS.define("qnms(Tensor boxes, Tensor scores, float threshold) -> Tensor")

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig  # noqa: E402
from nerfstudio.configs.method_configs import method_configs  # noqa: E402
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig  # noqa: E402
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: E402
from nerfstudio.engine.callbacks import (  # noqa: E402
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.engine.optimizers import Optimizers  # noqa: E402
from torch.amp import GradScaler  # noqa: E402
from torchmetrics.image import lpip  # noqa: E402

HELDOUT_PIXELS = 4096


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training")
    parser.add_argument("--rays", type=int, default=4096, help="per step; nerfacto has 4096")
    parser.add_argument("--every", type=float, default=30.0, help="seconds between measurements")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    out, sys.stdout = sys.stdout, sys.stderr  # nerfstudio prints to standard output
    with tempfile.TemporaryDirectory() as folder:
        answer = fitted(existing_poses(options.capture, Path(folder)), options)
    print(json.dumps(answer), file=out)


def existing_poses(capture: Path, folder: Path) -> Path:
    """Write the capture's poses without those of missing pictures; return the file."""
    poses = json.loads((capture / "transforms.json").read_text())
    for frame in poses["frames"]:
        name = Path(frame["file_path"])
        found = [name, *(name.with_name(name.name + end) for end in (".jpg", ".png"))]
        existing = [path for each in found if (path := capture.resolve() / each).is_file()]
        frame["file_path"] = str(existing[0]) if existing else ""
        for key in [key for key in frame if key.endswith("_path") and key != "file_path"]:
            del frame[key]  # paths relative to the capture
    poses["frames"] = [frame for frame in poses["frames"] if frame["file_path"]]
    (folder / "transforms.json").write_text(json.dumps(poses))
    return folder / "transforms.json"


def fitted(poses: Path, options: argparse.Namespace) -> dict:
    """Return steps, seconds and the curve of PSNR of a fit."""
    torch.manual_seed(options.seed)
    # LPIPS is not measured here, and its construction downloads network weights.
    lpip.LearnedPerceptualImagePatchSimilarity = lambda **_: torch.nn.Identity()
    config = method_configs["nerfacto"]
    model = config.pipeline.model
    model.implementation = "torch"
    model.camera_optimizer = CameraOptimizerConfig(mode="off")
    parsing = NerfstudioDataParserConfig(
        data=poses, downscale_factor=1, eval_mode="interval", eval_interval=8
    )
    config.pipeline.datamanager = VanillaDataManagerConfig(
        dataparser=parsing,
        train_num_rays_per_batch=options.rays,
        eval_num_rays_per_batch=HELDOUT_PIXELS,
    )
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    pipeline.train()
    groups = pipeline.get_param_groups()
    named = {name: config.optimizers[name] for name in groups if groups[name]}
    optimizers = Optimizers(named, {name: groups[name] for name in named})
    scaler = GradScaler(enabled=False)
    callbacks = pipeline.get_training_callbacks(
        TrainingCallbackAttributes(
            optimizers=optimizers, grad_scaler=scaler, pipeline=pipeline, trainer=None
        )
    )
    rays, truth = pipeline.datamanager.next_eval(0)

    seconds, step, curve = 0.0, 0, []
    while seconds < 60 * options.minutes:
        start = time.perf_counter()
        for callback in callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        optimizers.zero_grad_all()
        _, loss, _ = pipeline.get_train_loss_dict(step)
        functools.reduce(torch.add, loss.values()).backward()
        optimizers.optimizer_step_all()
        optimizers.scheduler_step_all(step)
        for callback in callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        seconds += time.perf_counter() - start
        step += 1
        if seconds >= options.every * (len(curve) + 1):
            pipeline.eval()
            with torch.no_grad():
                rgb = pipeline.model(rays)["rgb"].clamp(0, 1)
            pipeline.train()
            error = float((rgb - truth["image"][..., :3]).square().mean())
            curve.append({"seconds": seconds, "steps": step, "psnr": -10 * math.log10(error)})
            print(curve[-1], file=sys.stderr, flush=True)
    return {"steps": step, "seconds": seconds, "rays": options.rays, "curve": curve}


if __name__ == "__main__":
    main()
