"""Store of linear mean pictures, one file each, that grow by passes."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float


def add(path: Path, fresh: Float[np.ndarray, "h w 3"]) -> None:
    """Average a new pass into a picture's mean; the file is replaced atomically."""
    passes, mean = stored(path)
    mean = fresh if mean is None else (passes * mean + fresh) / (passes + 1)
    temporary = path.with_name(path.stem + ".tmp.npz")
    np.savez(temporary, mean=mean.astype(np.float32), passes=passes + 1)
    os.replace(temporary, path)


def stored(path: Path) -> tuple[int, Float[np.ndarray, "h w 3"] | None]:
    """Return the number of passes and their mean; (0, None) without a file."""
    if not path.exists():
        return 0, None
    with np.load(path) as data:
        return int(data["passes"]), data["mean"]
