"""The field on disk: `field.safetensors`, with its sizes in the file's metadata."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from climatenerf.core import parsing
from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.regular_files import check_regular
from climatenerf.core.samples import MIN_TAU
from climatenerf.core.storage import (
    check_finite,
    check_schema,
    digest,
    read_safetensors,
    write_safetensors,
)
from climatenerf.field.hash_field import Field
from climatenerf.field.occupancy import Occupancy
from climatenerf.field.presets import FieldSize

SCHEMA_VERSION = 3
FILE_NAME = "field.safetensors"
MAX_LENGTH = 1e7
"""Lengths and distances from the origin, m; see `scene.scene.MAX_WORLD`."""
MAX_VALUE = 1e30
"""Numbers of a field; squares of larger ones overflow 32 bits."""


def save_field(field: Field, run: Path, checkpoint: str = "") -> None:
    """Write the field into a run folder, atomically.

    Args:
        field: the field.
        run: the folder.
        checkpoint: identity that the files of one checkpoint share; "" for a field alone.

    Raises:
        UserError: the field holds numbers that are not finite, or the folder cannot be written.
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
    try:
        check_finite({k: to_numpy(v) for k, v in tensors.items()}, MAX_VALUE)
    except ValueError as error:
        raise UserError(f"the field is not saved, since {error}; fit anew") from error
    about["digest"] = digest(tensors)
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
    check_regular(path, "the field")
    if not path.is_file():
        raise UserError(
            f"{run} holds no {FILE_NAME}, so it is no finished run; make one with"
            " `climatenerf fit SCENE -o RUN`"
        )
    arrays, metadata = read_safetensors(path, "the field")
    where = "its description"
    try:
        about = parsing.parse_json(metadata.get("climatenerf", "{}"), where)
        version = parsing.integer(about, "schema_version", where, 1, 10**9)
    except UserError as error:
        raise _damaged(path, str(error).partition(";")[0]) from error
    check_schema(version, SCHEMA_VERSION, f"the field in {run}")
    try:
        size = _size(parsing.entries(about, "size", where), where)
        unit = parsing.number(about, "unit", where, 1 / MAX_LENGTH, MAX_LENGTH)
        near = parsing.number(about, "near", where, 0.0, MAX_LENGTH)
        # Version 2 named the threshold "thin"; before that a run kept the initial one.
        key = "pruning_threshold" if "pruning_threshold" in about else "thin"
        threshold = parsing.number(about, key, where, 0.0, 1e3, MIN_TAU)
    except UserError as error:
        raise _damaged(path, str(error).partition(";")[0]) from error
    try:
        if "digest" in about and about["digest"] != digest(arrays):  # absent in earlier versions
            raise ValueError("its checksum is another")
        check_finite(arrays, MAX_VALUE)
        if np.abs(arrays["centre"]).max() > MAX_LENGTH:
            raise ValueError(f"its centre is further than {MAX_LENGTH:g} m from the origin")
        side = arrays["occupancy.density"].shape[1]
        _check_grids(size, arrays, version)  # before memory is taken for what is claimed
        field = _untrained(size, arrays["embeddings"].shape[0], unit, near, side)
        wanted = {
            k: tuple(v.shape)
            for k, v in field.state_dict().items()
            if version > 1 or not k.startswith(("surface_", "learned"))
        }
        for name in sorted(wanted.keys() | arrays.keys()):
            if wanted.get(name) != (arrays[name].shape if name in arrays else None):
                raise ValueError(f"{name} is absent, surplus or of another size")
        field.pruning_threshold = threshold
        tensors = {k: to_device(v, CPU) for k, v in arrays.items()}
        if version == 1:  # without a surface head: keep the untrained one
            fresh = field.state_dict()
            tensors |= {k: fresh[k] for k in fresh if k.startswith(("surface_", "learned"))}
        field.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise _damaged(path, str(error)) from error
    return field.to(device).eval().requires_grad_(False)


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(f"{path} is damaged ({one_line(reason, 200)}); fit the scene again")


def _check_grids(size: FieldSize, arrays: Mapping[str, np.ndarray], version: int) -> None:
    """Check that the hash grids, which take nearly all memory, have the sizes that are claimed.

    Raises:
        ValueError: one has not.
        KeyError: one is absent.
    """
    kinds = ("geometry", "appearance", "surface", "sky") if version > 1 else ("geometry", "sky")
    for kind in kinds:
        levels, rows = getattr(size, f"{kind}_levels"), 2 ** getattr(size, f"{kind}_log2_rows")
        shape = arrays[f"{kind}_grid"].shape
        if levels and (len(shape) != 3 or shape[:2] != (levels, rows)):
            raise ValueError(f"{kind}_grid is of another size")


def _untrained(size: FieldSize, images: int, unit: float, near: float, side: int) -> Field:
    field = Field(size, images, np.zeros(3), unit, near)
    field.occupancy = Occupancy(size.cascades, side)
    return field


def _size(found: dict, where: str) -> FieldSize:
    """Return the sizes of a field's description, each within what can be fitted."""
    names = [item.name for item in dataclasses.fields(FieldSize)]
    unknown = set(found) - set(names)
    if unknown:
        raise UserError(f"{where} has an unknown size {min(unknown)!r}; fit the scene again")
    given = {}
    for name in found:
        if name.endswith("_log2_rows"):
            low, high = 1, 26
        elif name.endswith("_levels") or name == "cascades":
            low, high = 0 if name == "surface_levels" else 1, 64
        else:
            low, high = 1, 2**12 if name.endswith(("_hidden", "embedding", "_side")) else 2**20
        given[name] = parsing.integer(found, name, where, low, high)
    return FieldSize(**given)
