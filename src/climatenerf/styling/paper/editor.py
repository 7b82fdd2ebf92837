"""The user's own image-to-image network as an editor, through `diffusers`, from a local folder.

Nothing is downloaded and no code of the folder runs. `diffusers` is imported when it is needed.
"""

import importlib.util
import inspect
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from climatenerf.core.device import CPU
from climatenerf.core.errors import UserError, one_line
from climatenerf.styling.paper.shots import Shot
from climatenerf.styling.paper.teachers import Edit, fitting

STRENGTH = 0.5  # of the noise that an image-to-image network begins with, where it has such
SIDES = 16  # sides of pictures are multiples of this many pixels


def diffusion_editor(folder: Path, text: str, seed: int) -> Edit:
    """Return a network of `diffusers` as an editor.

    Args:
        folder: a pipeline as `save_pretrained` writes it, with weights in safetensors.
        text: what the pictures are to show.
        seed: the same for all views; a view's name changes it.

    Raises:
        UserError: `diffusers` is missing, or the folder holds no usable pipeline.
    """
    if not (folder / "model_index.json").is_file():
        raise UserError(
            f"{folder} holds no model_index.json, so it is no network of diffusers; give with"
            " --editor the local folder of an image-to-image network"
        )
    if importlib.util.find_spec("diffusers") is None:
        raise UserError(
            "--editor needs the diffusers package; install it with pip install diffusers"
        )
    from diffusers.pipelines.auto_pipeline import AutoPipelineForImage2Image

    try:
        pipeline = AutoPipelineForImage2Image.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True
        )
        pipeline = pipeline.to("cuda" if torch.cuda.is_available() else "cpu")
    except Exception as error:  # noqa: BLE001, the library raises many kinds for damaged files
        raise UserError(
            f"the network in {folder} cannot be loaded ({one_line(str(error), 120)}); give the"
            " folder of an image-to-image network with weights in safetensors"
        ) from error
    pipeline.set_progress_bar_config(disable=True)
    known = inspect.signature(pipeline.__call__).parameters

    def edit(shot: Shot, picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        size = shot.camera.width, shot.camera.height
        width, height = (-(-side // SIDES) * SIDES for side in size)
        image = Image.fromarray((picture * 255 + 0.5).astype(np.uint8))
        drawn = (seed + zlib.crc32(shot.name.encode("utf-8", "backslashreplace"))) % 2**63
        given = {
            "prompt": text,
            "image": image.resize((width, height), Image.Resampling.LANCZOS),
            "strength": STRENGTH,
            "height": height,
            "width": width,
            "generator": torch.Generator(device=CPU).manual_seed(drawn),
        }
        made = pipeline(**{name: value for name, value in given.items() if name in known})
        out = made.images[0].convert("RGB")
        return fitting(np.asarray(out.resize(size, Image.Resampling.BOX)), shot, "of the network")

    return edit
