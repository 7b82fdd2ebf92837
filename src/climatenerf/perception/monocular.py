"""Monocular depth: relative inverse depth of single photos by a network."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.perception.models import Network, load_parts

DEFAULT = "depth-anything/Depth-Anything-V2-Small-hf"
"""The smallest model of its family, and the only one with a free licence."""
MAX_SIZE = 518
"""Pixels on the longer side of the stored depth: the resolution of the network."""


def load_depth(name: str) -> Network:
    """Load a Depth Anything network by name or folder.

    Its `predict` maps a picture `h w 3` to float32 of the same aspect ratio, at most `MAX_SIZE`
    pixels on the longer side: inverse z-depth up to a scale and a shift that differ between photos;
    larger is nearer.

    Raises:
        UserError: The network cannot be loaded, or is of another kind.
    """
    config, processor, model = load_parts(name, _load)

    def predict(picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2"]:
        import torch

        with torch.inference_mode():
            inputs = processor(images=Image.fromarray(picture), return_tensors="pt")
            depth = model(**inputs.to(model.device)).predicted_depth[0].float().cpu().numpy()
        if config.depth_estimation_type == "metric":
            depth = 1 / np.maximum(depth, 1e-3)  # at least a millimetre: 1/0
        height, width = picture.shape[:2]
        scale = min(1.0, MAX_SIZE / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        # The network rounds the image to patches of 14 px, so its output is resized.
        return np.asarray(Image.fromarray(depth).resize(size, Image.Resampling.BILINEAR))

    return Network(name, getattr(config, "_commit_hash", None), predict)


def _load(name: str, local: bool):
    """Return configuration, processor and model."""
    import torch
    import transformers

    config = transformers.AutoConfig.from_pretrained(name, local_files_only=local)
    if config.model_type != "depth_anything":
        # Other models return depth instead of inverse depth, and their files do not tell which.
        raise UserError(
            f"the model {name} is not a Depth Anything model ({config.model_type}); give {DEFAULT},"
            " another model of its family, or a local copy"
        )
    processor = transformers.AutoImageProcessor.from_pretrained(name, local_files_only=local)
    model = transformers.AutoModelForDepthEstimation.from_pretrained(
        name, config=config, local_files_only=local
    )
    return config, processor, model.eval().to("cuda" if torch.cuda.is_available() else "cpu")
