"""Paint water into frames through given masks, inside a process of ClimateGAN.

Run as `python climategan_paint.py REQUEST` in a ClimateGAN checkout, with the Python of its
environment. REQUEST is JSON with the folders `weights`, `frames`, `masks` and `made`, and `seed`.
"""

import importlib
import json
import os
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

MULTIPLE = 128  # its painter enlarges by that factor


def main() -> None:
    """Paint every frame with its mask."""
    request = json.loads(sys.argv[1])
    frames, masks, made = (Path(request[name]) for name in ("frames", "masks", "made"))
    made.mkdir()
    sys.path.insert(0, os.getcwd())
    trainer = importlib.import_module("climategan.trainer").Trainer.resume_from_path(
        request["weights"], setup=True, inference=True, new_exp=None
    )
    device = trainer.device
    for path in sorted(frames.glob("*.png")):
        frame = values(path, "RGB") * 2 - 1
        mask = (values(masks / path.name, "L") > 0.5).astype(np.float32)
        x, m = (torch.from_numpy(each)[None].to(device) for each in (frame, mask))
        torch.manual_seed(request["seed"])  # one seed for the whole movie
        with torch.no_grad():
            trainer.G.painter.set_latent_shape(tuple(x.shape), True)
            painted = trainer.G.paint(m, x)
        shown = ((painted[0].cpu().permute(1, 2, 0).numpy() + 1) / 2).clip(0, 1)
        Image.fromarray((255 * shown + 0.5).astype(np.uint8)).save(made / path.name)


def values(path: Path, mode: str) -> np.ndarray:
    """Return a picture as (channels, h, w) in [0, 1], cut to multiples of the painter's factor."""
    array = np.asarray(Image.open(path).convert(mode), np.float32) / 255
    height, width = (n // MULTIPLE * MULTIPLE for n in array.shape[:2])
    return np.ascontiguousarray(np.atleast_3d(array)[:height, :width].transpose(2, 0, 1))


if __name__ == "__main__":
    main()
