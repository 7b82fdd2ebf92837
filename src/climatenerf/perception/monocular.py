"""Depth of single photos by a network: which of two things is nearer, in no known unit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.perception.models import Network, load_parts

DEFAULT = "depth-anything/Depth-Anything-V2-Small-hf"
"""The smallest of its family, and the one with a free licence."""
LONGEST = 518
"""Pixels on the longer side of what is kept: the network sees no finer."""


def load_depth(name: str) -> Network:
    """A Depth Anything by name or folder.

    Its `predict` gives, for a picture `h w 3`, float32 in the same shape of at most `LONGEST`
    pixels: a z-depth's inverse, up to a factor and a constant that differ between photos; larger
    is nearer.

    Raises:
        UserError: It cannot be had, or is a network of another kind.
    """
    config, processor, model = load_parts(name, _load)

    def predict(picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2"]:
        import torch

        with torch.inference_mode():
            inputs = processor(images=Image.fromarray(picture), return_tensors="pt")
            seen = model(**inputs.to(model.device)).predicted_depth[0].float().cpu().numpy()
        if config.depth_estimation_type == "metric":
            seen = 1 / np.maximum(seen, 1e-3)  # a millimetre: 1/0
        height, width = picture.shape[:2]
        scale = min(1.0, LONGEST / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        # The network's own shape is the photo's only nearly, as it sees patches of 14 pixels.
        return np.asarray(Image.fromarray(seen).resize(size, Image.Resampling.BILINEAR))

    return Network(name, getattr(config, "_commit_hash", None), predict)


def _load(name: str, local: bool):
    """Configuration, processor and model."""
    import torch
    import transformers

    config = transformers.AutoConfig.from_pretrained(name, local_files_only=local)
    if config.model_type != "depth_anything":
        # Others give depth where this gives its inverse, and nothing in them says which.
        raise UserError(
            f"the model {name} is no Depth Anything ({config.model_type}); give {DEFAULT} or a"
            " copy of one of its family"
        )
    processor = transformers.AutoImageProcessor.from_pretrained(name, local_files_only=local)
    model = transformers.AutoModelForDepthEstimation.from_pretrained(
        name, config=config, local_files_only=local
    )
    return config, processor, model.eval().to("cuda" if torch.cuda.is_available() else "cpu")
