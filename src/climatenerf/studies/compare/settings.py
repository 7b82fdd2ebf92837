"""Settings of the adapters for other programs. Does not import torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

EFFECTS = ("smog", "flood", "snow")
_PATH = tyro.conf.arg(metavar="PATH", help_behavior_hint="")
_FLOAT = tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")


@dataclass(frozen=True)
class DiffusionSettings:
    """Inpainting of the water by pipelines of `diffusers`."""

    models: tuple[str, ...] = ()
    """Folders of pipelines, or NAME=FOLDER. Nothing is downloaded."""
    prompt: str = "flooding"
    """Text that the water is painted from; the default is the paper's."""
    steps: int = 30
    """Number of denoising steps."""
    guidance: Annotated[float | None, _FLOAT] = None
    """Guidance scale. Default: the usual one of the pipeline."""
    side: int = 512
    """Least shorter side at which pictures are painted, pixels."""


@dataclass(frozen=True)
class ClimateGanSettings:
    """ClimateGAN and ClimateGAN++, each as a process of its own in a checkout of yours."""

    checkout: Annotated[Path | None, _PATH] = None
    """Folder of the ClimateGAN repository. Default: it is not run."""
    weights: Annotated[Path | None, _PATH] = None
    """Folder with opts.yaml and checkpoints/."""
    python: Annotated[Path | None, _PATH] = None
    """Python of the environment that it is installed in. Default: the present one."""


@dataclass(frozen=True)
class UvqSettings:
    """Scores of movies by UVQ, as a process of its own in a checkout of yours."""

    checkout: Annotated[Path | None, _PATH] = None
    """Folder of the UVQ repository. Default: it is not run."""
    version: Literal["1.0", "1.5"] = "1.0"
    """Version of the model; the paper used 1.0."""
    python: Annotated[Path | None, _PATH] = None
    """Python of the environment that it is installed in. Default: the present one."""
