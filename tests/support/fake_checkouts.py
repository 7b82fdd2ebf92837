"""Checkouts of other projects that have the interface of the real ones and trivial content."""

from pathlib import Path

APPLY_EVENTS = """
import argparse
from pathlib import Path
import numpy as np
from PIL import Image

parser = argparse.ArgumentParser()
parser.add_argument("-b", "--batch_size", type=int, default=4)
parser.add_argument("-i", "--images_paths", required=True)
parser.add_argument("-o", "--output_path", default=None)
parser.add_argument("-r", "--resume_path", default=None)
parser.add_argument("--keep_ratio_128", action="store_true")
args = parser.parse_args()
assert (Path(args.resume_path) / "opts.yaml").is_file()
out = Path(args.output_path)
if out.exists() and "n" in input("overwrite?"):
    raise SystemExit(1)
out.mkdir(parents=True)
for path in sorted(Path(args.images_paths).glob("*")):
    picture = np.asarray(Image.open(path)).astype(float)
    height, width = picture.shape[:2]
    assert args.keep_ratio_128 and args.batch_size == 1
    new = int(width / 128) * 128
    tall = int(new * (height / width) / 128) * 128
    small = Image.fromarray(picture.astype(np.uint8)).resize((new, tall))
    for event, gain in (("flood", 0.5), ("wildfire", 0.1), ("smog", 0.75)):
        made = (np.asarray(small) * gain).astype(np.uint8)
        Image.fromarray(made).save(out / f"{path.stem}_{event}_{new}_AR.png")
print("sizes", new, tall)
"""

TRAINER = """
from types import SimpleNamespace
import torch


class Painter:
    def set_latent_shape(self, shape, is_input):
        self.shape = shape


class Generator:
    painter = Painter()

    def paint(self, mask, x):
        assert self.painter.shape == tuple(x.shape) and x.shape[-1] % 128 == 0
        assert mask.shape[1] == 1 and x.min() >= -1
        red = torch.zeros_like(x)
        red[:, 0] = 1.0
        red[:, 1:] = -1.0
        red[:, 2] = torch.rand(1)
        return x * (1 - mask) + red * mask


class Trainer:
    @classmethod
    def resume_from_path(cls, path, overrides={}, setup=True, inference=False, new_exp=False):
        assert setup and inference and new_exp is None and "weights" in str(path)
        return SimpleNamespace(G=Generator(), device=torch.device("cpu"))
"""

UVQ = """
import argparse, json
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("input")
parser.add_argument("--model_version", default="1.5", choices=["1.0", "1.5"])
parser.add_argument("--output", default="")
args = parser.parse_args()
assert Path(args.input).stat().st_size > 0
with open("calls.txt", "a") as calls:
    calls.write(args.input + "\\n")
key = {"1.0": "compression_content_distortion", "1.5": "uvq1p5_score"}[args.model_version]
scores = {"content": 1.0, key: 3.25 if args.model_version == "1.0" else 4.5}
Path(args.output).write_text(json.dumps(scores))
print(scores[key])
"""


def make_climategan(folder: Path) -> tuple[Path, Path]:
    """Return a checkout of ClimateGAN and a folder of weights."""
    checkout, weights = folder / "climategan", folder / "weights"
    (checkout / "climategan").mkdir(parents=True)
    (checkout / "apply_events.py").write_text(APPLY_EVENTS)
    (checkout / "climategan" / "__init__.py").write_text("")
    (checkout / "climategan" / "trainer.py").write_text(TRAINER)
    (weights / "checkpoints").mkdir(parents=True)
    (weights / "opts.yaml").write_text("tasks: [m, p]\n")
    (weights / "checkpoints" / "latest_ckpt.pth").write_bytes(b"weights")
    return checkout, weights


def make_uvq(folder: Path) -> Path:
    """Return a checkout of UVQ."""
    checkout = folder / "uvq"
    checkout.mkdir(parents=True)
    (checkout / "uvq_inference.py").write_text(UVQ)
    return checkout
