"""Inpainting pipelines of `diffusers` from local folders: they paint our water mask.

No pipeline was run with real weights here; the tests load tiny ones of the real classes.
"""

import importlib.util
import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from climatenerf.core.device import resolve_device
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.parsing import read_bytes, read_json
from climatenerf.core.storage import hash_of_files
from climatenerf.studies.compare.folder import check_name
from climatenerf.studies.compare.material import Kind, Material
from climatenerf.studies.compare.pictures import Picture, grey, pasted, resized, working_size
from climatenerf.studies.compare.settings import DiffusionSettings

INDEX = "model_index.json"
MULTIPLE = 16  # divides the sides of what all pipelines paint
GUIDANCE = {"FluxFillPipeline": 30.0, "StableDiffusionInpaintPipeline": 7.5}
LICENCES = {
    "StableDiffusionInpaintPipeline": "CreativeML OpenRAIL-M",
    "StableDiffusionXLInpaintPipeline": "CreativeML OpenRAIL++-M",
    "FluxFillPipeline": "FLUX.1 [dev] Non-Commercial License: non-commercial",
    "Flux2KleinInpaintPipeline": "Apache-2.0 (4B); non-commercial (9B)",
    "QwenImageEditInpaintPipeline": "Apache-2.0",
    "ZImageInpaintPipeline": "Apache-2.0",
}
"""Usual licences of published weights by pipeline, where the folder states none."""
UNKNOWN = "unknown licence; see the source of the weights"


@dataclass(frozen=True)
class Diffusion:
    """An inpainting pipeline; see `material.Method`.

    Attributes:
        name: in all tables.
        folder: of the pipeline, as `save_pretrained` writes it.
        licence: of the weights.
        settings: how it paints.
        device: where it computes.
    """

    name: str
    folder: Path
    licence: str
    settings: DiffusionSettings
    device: Literal["cpu", "cuda"] = "cpu"
    kind: Kind = "model"

    def shows(self, material: Material) -> bool:
        """Return whether the effect is the flood, the only one with a mask to be painted."""
        return material.effect == "flood"

    def identity(self, material: Material) -> object:
        """Return the settings, and a hash of the pipeline's files by their names and sizes."""
        files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        sizes = {path.relative_to(self.folder).as_posix(): path.stat().st_size for path in files}
        used = {"prompt": self.settings.prompt, "steps": self.settings.steps}
        used |= {"guidance": self.settings.guidance, "side": self.settings.side}
        return [hash_of_files([self.folder / INDEX]), sizes, used]

    def pictures(self, material: Material, indices: Sequence[int], work: Path) -> Iterator[Picture]:
        """Return the edited frames, all from one seed; see `material.Method`."""
        pipeline = load_pipeline(self.folder, self.device)

        def paint(index: int) -> Picture:
            clean, mask = material.clean.picture(index), material.mask(index)
            return inpainted(pipeline, clean, mask, self.settings, material.seed)

        return (paint(index) for index in indices)


def diffusion_methods(
    settings: DiffusionSettings, device: Literal["cpu", "cuda"]
) -> tuple[Diffusion, ...]:
    """Return a method for each pipeline that is given as FOLDER or NAME=FOLDER.

    Raises:
        UserError: `diffusers` is missing, or a folder holds no pipeline.
    """
    if settings.models and importlib.util.find_spec("diffusers") is None:
        raise UserError(
            "a diffusion model needs the diffusers package; install it with pip install"
            ' ".[diffusion]"'
        )
    if settings.steps < 1 or not 16 <= settings.side <= 4096:
        raise UserError("--diffusion.steps must be at least 1, --diffusion.side from 16 to 4096")
    return tuple(_method(text, settings, device) for text in settings.models)


def _method(text: str, settings: DiffusionSettings, device: Literal["cpu", "cuda"]) -> Diffusion:
    name, equals, path = text.partition("=")
    folder = Path(path if equals else text).expanduser().resolve()
    if not (folder / INDEX).is_file():
        raise UserError(
            f"{path if equals else text} holds no {INDEX}; give the folder of a diffusers pipeline"
            " on this machine, since nothing is downloaded"
        )
    return Diffusion(
        check_name(name if equals else folder.name), folder, licence_of(folder), settings, device
    )


def licence_of(folder: Path) -> str:
    """Return the licence line of a pipeline: that of its model card, else the usual one.

    Raises:
        UserError: the index is damaged.
    """
    card = folder / "README.md"
    if card.is_file():
        lines = read_bytes(card, "the model card").decode("utf-8", "replace").splitlines()
        # The card begins with YAML between two lines of ---.
        head = (
            lines[1 : lines.index("---", 1)] if lines[:1] == ["---"] and "---" in lines[1:] else []
        )
        stated = [line.partition(":")[2].strip() for line in head if line.startswith("license")]
        stated = [one_line(text, 80) for text in stated if text]
        if stated:
            return f"{', '.join(stated)} (model card)"
    kind = str(read_json(folder / INDEX, "the pipeline").get("_class_name"))
    usual = LICENCES.get(kind)
    return UNKNOWN if usual is None else f"{usual}, usual for {kind}; check your copy"


def load_pipeline(folder: Path, device: Literal["cpu", "cuda"] = "cpu") -> Any:
    """Load a pipeline from a local folder, as an inpainting one.

    Weights are read as safetensors alone, since other formats may execute code.

    Raises:
        UserError: the folder holds no pipeline that can paint a mask, or a damaged one.
    """
    # Public names of the package, which its type information does not export.
    from diffusers import (
        AutoPipelineForInpainting,  # pyright: ignore
        DiffusionPipeline,  # pyright: ignore
    )
    from safetensors import SafetensorError

    # The exceptions that the libraries raise for damaged or unsuitable files.
    unusable = (OSError, ValueError, RuntimeError, ImportError, KeyError, AttributeError)
    try:
        pipeline = DiffusionPipeline.from_pretrained(
            str(folder),
            local_files_only=True,
            use_safetensors=True,
            low_cpu_mem_usage=importlib.util.find_spec("accelerate") is not None,
        )
        if not _paints_masks(pipeline):
            pipeline = AutoPipelineForInpainting.from_pipe(pipeline)
    except (*unusable, TypeError, SafetensorError) as error:
        raise UserError(
            f"the pipeline in {folder} cannot be loaded ({one_line(str(error), 200)}); give a"
            " folder with the safetensors weights of an inpainting pipeline"
        ) from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(resolve_device(device))


def inpainted(
    pipeline: Any,
    picture: Picture,
    mask: Float[np.ndarray, "h w"],
    settings: DiffusionSettings,
    seed: int,
) -> Picture:
    """Return a picture that a pipeline has painted within a mask.

    Args:
        pipeline: from `load_pipeline`.
        picture: the clean frame.
        mask: fraction of each pixel that is to be painted; outside the frame stays as it is.
        settings: how to paint.
        seed: of the noise.
    """
    if not (mask > 0).any():
        return picture
    size = (picture.shape[1], picture.shape[0])
    width, height = inner = working_size(size, settings.side, MULTIPLE)
    kind = type(pipeline).__name__
    guidance = GUIDANCE.get(kind) if settings.guidance is None else settings.guidance
    given = {
        "prompt": settings.prompt,
        "image": Image.fromarray(resized(picture, inner)),
        "mask_image": Image.fromarray(grey(mask, inner)),
        "strength": 1.0,
        "guidance_scale": guidance,
        "num_inference_steps": settings.steps,
        "height": height,
        "width": width,
        "generator": torch.Generator(device="cpu").manual_seed(seed),
    }
    accepted = inspect.signature(pipeline.__call__).parameters
    used = {name: given[name] for name in given if name in accepted and given[name] is not None}
    painted = np.asarray(pipeline(**used).images[0].convert("RGB"))
    return pasted(picture, resized(painted, size), mask)


def _paints_masks(pipeline: Any) -> bool:
    return "mask_image" in inspect.signature(pipeline.__call__).parameters
