"""How soon nerfstudio's nerfacto reaches some PSNR on a CPU, for `engine.py --peer`.

It needs an environment of its own, since nerfstudio pins other versions:

python -m venv peer && peer/bin/pip install torch==2.13.0 torchvision nerfstudio==1.1.5
peer/bin/python benchmarks/peer_nerfacto.py ../shared/data/fox --minutes 10 --rays 1024

The photos with a `transforms.json`, every eighth by name held out, as `climatenerf fit` does; the
method's own settings but for the number of rays and fixed cameras. Printed, as JSON: seconds of
training and PSNR of some thousand pixels drawn from the held-out photos, at each look.
"""

import argparse
import functools
import json
import math
import sys
import time
from pathlib import Path

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from torch.amp import GradScaler

LOOKS = 4096  # held-out pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training")
    parser.add_argument("--rays", type=int, default=4096, help="a step; the method's own: 4096")
    parser.add_argument("--every", type=float, default=30.0, help="seconds between measurements")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    out, sys.stdout = sys.stdout, sys.stderr  # it prints much
    torch.manual_seed(options.seed)
    config = method_configs["nerfacto"]
    model = config.pipeline.model
    model.implementation = "torch"
    model.camera_optimizer = CameraOptimizerConfig(mode="off")
    parsing = NerfstudioDataParserConfig(
        data=options.capture, downscale_factor=1, eval_mode="interval", eval_interval=8
    )
    config.pipeline.datamanager = VanillaDataManagerConfig(
        dataparser=parsing,
        train_num_rays_per_batch=options.rays,
        eval_num_rays_per_batch=LOOKS,
    )
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    pipeline.train()
    groups = pipeline.get_param_groups()
    named = {name: config.optimizers[name] for name in groups if groups[name]}
    optimizers = Optimizers(named, {name: groups[name] for name in named})
    scaler = GradScaler(enabled=False)
    callbacks = pipeline.get_training_callbacks(
        TrainingCallbackAttributes(optimizers=optimizers, grad_scaler=scaler, pipeline=pipeline)
    )
    shown, truth = pipeline.datamanager.next_eval(0)

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
                rgb = pipeline.model(shown)["rgb"].clamp(0, 1)
            pipeline.train()
            error = float((rgb - truth["image"][..., :3]).square().mean())
            curve.append({"seconds": seconds, "steps": step, "psnr": -10 * math.log10(error)})
            print(curve[-1], file=sys.stderr, flush=True)
    answer = {"steps": step, "seconds": seconds, "rays": options.rays, "curve": curve}
    print(json.dumps(answer), file=out)


if __name__ == "__main__":
    main()
