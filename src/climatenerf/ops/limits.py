"""Bounds that end every loop over a ray, whatever numbers the ray and the field hold.

A step that is too small for 32 bits beside the length travelled leaves the length as it is, and a
NaN compares as the compiler likes. Counting ends such rays.
"""

MAX_STEPS = 2**14
"""Steps of a ray, over cells or empty blocks. A ray across all cascades takes 850 whole steps."""
MAX_METABALL_STEPS = 2**20
"""Steps of a ray through snow; they are at least a hundredth of a cell long."""
