"""The field on disk: `field.safetensors`, with its sizes in the file's metadata."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch

from climatenerf.core.device import CPU, to_device
from climatenerf.core.errors import UserError
from climatenerf.core.samples import MIN_TAU
from climatenerf.core.storage import check_schema, read_safetensors, write_safetensors
from climatenerf.field.hash_field import Field
from climatenerf.field.occupancy import Occupancy
from climatenerf.field.presets import FieldSize

SCHEMA_VERSION = 3
FILE_NAME = "field.safetensors"


def save_field(field: Field, run: Path, checkpoint: str = "") -> None:
    """Write the field into a run folder, atomically.

    Args:
        field: the field.
        run: the folder.
        checkpoint: identity that the files of one checkpoint share; "" for a field alone.
    """
    about = {
        "schema_version": SCHEMA_VERSION,
        "size": dataclasses.asdict(field.size),
        "unit": field.unit,
        "near": field.near,
        "pruning_threshold": field.pruning_threshold,
    }
    if checkpoint:
        about["checkpoint"] = checkpoint
    tensors = {k: v.detach().contiguous() for k, v in field.state_dict().items()}
    write_safetensors(run / FILE_NAME, tensors, {"climatenerf": json.dumps(about)})


def load_field(run: Path, device: torch.device = CPU) -> Field:
    """Read the field of a run folder.

    Args:
        run: the run folder.
        device: where the field computes.

    Raises:
        UserError: there is none, it is damaged, or a newer version of the program wrote it.
    """
    path = run / FILE_NAME
    if not run.exists():
        raise UserError(f"{run} does not exist; give a run folder made by `climatenerf fit`")
    if not path.is_file():
        raise UserError(
            f"{run} holds no {FILE_NAME}, so it is no finished run; make one with"
            " `climatenerf fit SCENE -o RUN`"
        )
    arrays, metadata = read_safetensors(path, "the field")
    try:
        about = json.loads(metadata["climatenerf"])
        check_schema(about["schema_version"], SCHEMA_VERSION, f"the field in {run}")
        size = FieldSize(**about["size"])
        # Version 2 named the threshold "thin"; before that a run kept the initial one.
        threshold = about.get("pruning_threshold", about.get("thin", MIN_TAU))
        numbers = [about["unit"], about["near"], threshold, *arrays["centre"].tolist()]
        if not np.isfinite(np.array(numbers, float)).all() or not numbers[0] > 0 or threshold < 0:
            raise ValueError("a length is not a finite number above 0, or a bound is below it")
        field = Field(
            size, arrays["embeddings"].shape[0], np.zeros(3), about["unit"], about["near"]
        )
        field.pruning_threshold = float(threshold)
        field.occupancy = Occupancy(size.cascades, arrays["occupancy.density"].shape[1])
        tensors = {k: to_device(v, CPU) for k, v in arrays.items()}
        if about["schema_version"] == 1:  # without a surface head: keep the untrained one
            fresh = field.state_dict()
            tensors |= {k: fresh[k] for k in fresh if k.startswith(("surface_", "learned"))}
        field.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}); fit the scene again"
        ) from error
    return field.to(device).eval().requires_grad_(False)
