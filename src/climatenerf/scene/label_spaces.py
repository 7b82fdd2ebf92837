"""Numberings of semantic classes, and the way from each to Cityscapes train ids.

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
_ABSENT = -1
_TRAIN_OF_TRAIN = {i: i for i in range(19)}
# Cityscapes' own ids, then KITTI-360's garage, gate and small pole. Not listed: what neither
# Cityscapes nor KITTI-360 gives a train id (static, parking, rail track, bridge, caravan, trailer,
# stop, lamp, trash bin, vending machine, box, ...).
_TRAIN_OF_ID = {
    7: 0, 8: 1, 11: 2, 12: 3, 13: 4, 17: 5, 19: 6, 20: 7, 21: 8, 22: 9, 23: 10, 24: 11, 25: 12,
    26: 13, 27: 14, 28: 15, 31: 16, 32: 17, 33: 18, 34: 2, 35: 4, 37: 5,
}  # fmt: skip
# Road, building, vegetation, terrain, sky, person, vehicle: each stands for several classes, and
# its most frequent one stands for it here.
_TRAIN_OF_SEVEN = {0: 0, 1: 2, 2: 8, 3: 9, 4: 10, 5: 11, 6: 13}


def _table(train_of: Mapping[int, int], count: int) -> Int16[np.ndarray, " 256"]:
    """Train id of each of 256 numbers; those from `count` to 254 mean nothing."""
    table = np.full(256, _ABSENT, dtype=np.int16)
    table[:count] = UNKNOWN
    table[UNKNOWN] = UNKNOWN
    table[list(train_of)] = list(train_of.values())
    return table


_TABLES = {
    TRAIN_IDS: _table(_TRAIN_OF_TRAIN, 19),
    CITYSCAPES_IDS: _table(_TRAIN_OF_ID, 45),
    SEVEN: _table(_TRAIN_OF_SEVEN, 7),
}
LABEL_SPACES = tuple(_TABLES)


def checked_label_space(name: str, where: str) -> str:
    """The name itself if there is such a label space.

    Args:
        name: What a file or the user says.
        where: Who says it, for the message.

    Raises:
        UserError: There is none of this name.
    """
    if name not in _TABLES:
        raise UserError(f'{where} is "{name}"; choose one of {", ".join(LABEL_SPACES)}.')
    return name


def to_train_ids(
    labels: UInt8[np.ndarray, "h w"], space: str, path: Path
) -> UInt8[np.ndarray, "h w"]:
    """Labels of one space as Cityscapes train ids, 255 where unknown.

    Args:
        labels: Ids as the file has them.
        space: One of `LABEL_SPACES`.
        path: The file, for the message.

    Raises:
        UserError: An id that the space does not have.
    """
    train = _TABLES[space][labels]
    if (train == _ABSENT).any():
        raise UserError(
            f"The labels {path} hold the id {labels[train == _ABSENT].max()}, which {space} does"
            f" not have; say with --label-space which of {', '.join(LABEL_SPACES)} they are in."
        )
    return train.astype(np.uint8)
