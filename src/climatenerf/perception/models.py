"""Loading networks of `transformers` by name or folder, and the licences of their weights."""

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

# The first part found in the lower-case name counts; a local copy is recognised by its folder.
_LICENCES = (
    ("segformer", "NVIDIA source code licence: non-commercial, research or evaluation only"),
    ("oneformer", "MIT"),
    ("depth-anything-v2-small", "Apache-2.0"),
    ("depth-anything-v2-metric-indoor-small", "Apache-2.0"),
    ("depth-anything-v2-metric-outdoor-small", "Apache-2.0"),
    ("depth-anything-v2", "CC-BY-NC-4.0: non-commercial"),
)


@dataclass(frozen=True)
class Network:
    """A loaded network.

    Attributes:
        name: As the user gave it: a name on the Hugging Face Hub, or a folder.
        revision: Commit on the Hub; None for a folder.
        predict: Maps an 8-bit sRGB picture `h w 3` to the network's output.
    """

    name: str
    revision: str | None
    predict: Callable[[UInt8[np.ndarray, "h w 3"]], Shaped[np.ndarray, "h2 w2"]]


def licence_of(name: str) -> str:
    """Return the licence of a network's weights, in a few words."""
    found = [licence for part, licence in _LICENCES if part in name.lower()]
    return found[0] if found else "unknown; see the source of the model"


def check_name(name: str) -> None:
    """Check that a name can be a network, before anything is loaded.

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
            f"there is no model {name}; give the folder of a model, or its name on the Hugging Face"
            " Hub as OWNER/NAME"
        )


def load_parts(name: str, load: Callable[[str, bool], Parts]) -> Parts:
    """Load a network from a folder, from the local cache, or by download, in this order.

    Args:
        name: Folder, or OWNER/NAME on the Hub.
        load: Called as `load(name, local_files_only)`.

    Returns:
        The result of `load`.

    Raises:
        UserError: `transformers` is missing, or there is no usable network of this name.
    """
    check_name(name)
    from safetensors import SafetensorError

    folder = Path(name).expanduser()
    # The exceptions that the libraries raise for damaged or unsuitable files.
    unusable = (OSError, ValueError, RuntimeError, ImportError, KeyError, SafetensorError)
    if folder.is_dir():
        try:
            return load(str(folder), True)
        except unusable as error:
            raise UserError(
                f"the model in {folder} cannot be loaded ({_first_line(error)}); give a folder"
                " written by save_pretrained, including the image processor"
            ) from error
    try:
        return load(name, True)
    except unusable:
        pass  # not in the cache
    try:
        return load(name, False)
    except unusable as error:
        raise UserError(
            f"the model {name} cannot be downloaded ({_first_line(error)}); check the name and"
            " the internet connection, or give the local path of a copy"
        ) from error


def _first_line(error: Exception) -> str:
    """Return the first line of an exception's message, or the exception's name."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
