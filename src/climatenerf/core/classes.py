"""The paper's seven classes, and how Cityscapes train ids fall into them."""

import numpy as np

ROAD, BUILDING, VEGETATION, TERRAIN, SKY, PERSON, VEHICLE = range(7)
CLASS_NAMES = ("road", "building", "vegetation", "terrain", "sky", "person", "vehicle")
UNKNOWN = 255
GROUND = (ROAD, TERRAIN)
"""Classes that lie on the ground."""
STANDING = (BUILDING, VEGETATION, PERSON, VEHICLE)
"""Classes that stand on it."""

MERGED = np.full(256, UNKNOWN, np.uint8)
"""Class of each Cityscapes train id: road and pavement, what is built, ..., what moves."""
MERGED[[0, 1]] = ROAD
MERGED[2:8] = BUILDING
MERGED[8], MERGED[9], MERGED[10] = VEGETATION, TERRAIN, SKY
MERGED[[11, 12]] = PERSON
MERGED[13:19] = VEHICLE

SOLID = np.array([ROAD, BUILDING, VEGETATION, TERRAIN, PERSON, VEHICLE])
"""Classes that matter can have, in the order of the field's class head: all but the sky."""
SOLID_OF = np.full(256, UNKNOWN, np.uint8)
"""Place of a class in `SOLID`, `UNKNOWN` for sky and unknown."""
SOLID_OF[SOLID] = np.arange(len(SOLID))
