"""Numberings of semantic classes, and their mapping to Cityscapes train ids.

Train ids: 0 road, 1 sidewalk, 2 building, 3 wall, 4 fence, 5 pole, 6 traffic light, 7 traffic sign,
8 vegetation, 9 terrain, 10 sky, 11 person, 12 rider, 13 car, 14 truck, 15 bus, 16 train,
17 motorcycle, 18 bicycle, 255 unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8

from climatenerf.core.errors import UserError

TRAIN_IDS = "cityscapes-train-ids"
CITYSCAPES_IDS = "cityscapes-ids"
SEVEN = "seven"

UNKNOWN = 255
_UNDEFINED = -1
_TRAIN_FROM_TRAIN = {i: i for i in range(19)}
# Cityscapes ids, then the KITTI-360 ids of garage, gate and small pole. Classes that neither data
# set assigns a train id are absent (static, parking, rail track, bridge, caravan, trailer, stop,
# lamp, trash bin, vending machine, box, ...) and become unknown.
_TRAIN_FROM_CITYSCAPES = {
    7: 0, 8: 1, 11: 2, 12: 3, 13: 4, 17: 5, 19: 6, 20: 7, 21: 8, 22: 9, 23: 10, 24: 11, 25: 12,
    26: 13, 27: 14, 28: 15, 31: 16, 32: 17, 33: 18, 34: 2, 35: 4, 37: 5,
}  # fmt: skip
# Road, building, vegetation, terrain, sky, person, vehicle. Each merges several train ids and maps
# to the most frequent one.
_TRAIN_FROM_SEVEN = {0: 0, 1: 2, 2: 8, 3: 9, 4: 10, 5: 11, 6: 13}


def _table(train_ids: Mapping[int, int], count: int) -> Int16[np.ndarray, " 256"]:
    """Return the train id of each 8-bit id; ids from `count` to 254 are undefined."""
    table = np.full(256, _UNDEFINED, dtype=np.int16)
    table[:count] = UNKNOWN
    table[UNKNOWN] = UNKNOWN
    table[list(train_ids)] = list(train_ids.values())
    return table


_TABLES = {
    TRAIN_IDS: _table(_TRAIN_FROM_TRAIN, 19),
    CITYSCAPES_IDS: _table(_TRAIN_FROM_CITYSCAPES, 45),
    SEVEN: _table(_TRAIN_FROM_SEVEN, 7),
}
LABEL_SPACES = tuple(_TABLES)


def checked_label_space(name: str, where: str) -> str:
    """Return the name if it is a known label space.

    Args:
        name: Name from a file or the command line.
        where: Origin of the name, for the message.

    Raises:
        UserError: No label space has this name.
    """
    if name not in _TABLES:
        raise UserError(f'{where} is "{name}"; choose one of {", ".join(LABEL_SPACES)}.')
    return name


def to_train_ids(
    labels: UInt8[np.ndarray, "h w"], space: str, path: Path
) -> UInt8[np.ndarray, "h w"]:
    """Convert labels to Cityscapes train ids, 255 where unknown.

    Args:
        labels: Class ids as stored in the file.
        space: One of `LABEL_SPACES`.
        path: The file, for the message.

    Raises:
        UserError: An id is undefined in the label space.
    """
    train_ids = _TABLES[space][labels]
    undefined = train_ids == _UNDEFINED
    if undefined.any():
        raise UserError(
            f"The labels {path} contain the id {labels[undefined].max()}, which {space} does not"
            f" define; set --label-space to one of {', '.join(LABEL_SPACES)}."
        )
    return train_ids.astype(np.uint8)
