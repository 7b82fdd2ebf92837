"""Networks of `transformers`: finding one by name or folder, and what may be done with it."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Shaped, UInt8

from climatenerf.core.errors import UserError

Parts = TypeVar("Parts")

# Asked in this order, of the name's lower case, so that a local copy is known by its folder too.
_LICENCES = (
    ("segformer", "NVIDIA's own licence: non-commercial, for research or evaluation only"),
    ("oneformer", "MIT"),
    ("depth-anything-v2-small", "Apache-2.0"),
    ("depth-anything-v2-metric-indoor-small", "Apache-2.0"),
    ("depth-anything-v2-metric-outdoor-small", "Apache-2.0"),
    ("depth-anything-v2", "CC-BY-NC-4.0: non-commercial"),
)


@dataclass(frozen=True)
class Network:
    """A network that is ready to look at photos.

    Attributes:
        name: As the user gave it: a name on the Hugging Face Hub, or a folder.
        revision: Commit of the Hub that was loaded; None of a folder.
        predict: From an 8-bit sRGB picture to what the network sees, `h w`.
    """

    name: str
    revision: str | None
    predict: Callable[[UInt8[np.ndarray, "h w 3"]], Shaped[np.ndarray, "h2 w2"]]


def licence_of(name: str) -> str:
    """The licence of a network's weights, in a few words."""
    found = [licence for part, licence in _LICENCES if part in name.lower()]
    return found[0] if found else "not known here; see where the model is from"


def check_name(name: str) -> None:
    """Refuses what cannot be a network, before anything is loaded.

    Raises:
        UserError: `transformers` is missing, or the name is neither a folder nor OWNER/NAME.
    """
    if importlib.util.find_spec("transformers") is None:
        raise UserError(
            f"the model {name} needs the transformers package; install it with"
            ' pip install ".[perception]"'
        )
    if not Path(name).expanduser().is_dir() and not re.fullmatch(r"[\w-][\w.-]*/[\w.-]+", name):
        raise UserError(
            f"there is no model {name}: give the folder of one, or its name on the Hugging Face"
            " Hub as OWNER/NAME"
        )


def load_parts(name: str, load: Callable[[str, bool], Parts]) -> Parts:
    """What `load(name, local_files_only)` gives: from the disk if it is there, else by download.

    Raises:
        UserError: `transformers` is missing, or there is no usable network of this name.
    """
    check_name(name)
    from safetensors import SafetensorError

    folder = Path(name).expanduser()
    # Whatever the files hold, the library says it with one of these.
    unusable = (OSError, ValueError, RuntimeError, ImportError, KeyError, SafetensorError)
    if folder.is_dir():
        try:
            return load(str(folder), True)
        except unusable as error:
            raise UserError(
                f"the model in {folder} cannot be loaded ({_first_line(error)}); give a folder"
                " that save_pretrained wrote, its image processor included"
            ) from error
    try:
        return load(name, True)
    except unusable:
        pass  # not downloaded yet
    try:
        return load(name, False)
    except unusable as error:
        raise UserError(
            f"the model {name} cannot be downloaded ({_first_line(error)}); check the name and the"
            " internet, or give the local path of a copy"
        ) from error


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
