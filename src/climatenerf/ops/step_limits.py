"""Limits on the steps along a ray, which end every such loop for any values of ray and field.

A step below the 32-bit resolution of the distance travelled makes no progress, and comparisons with
a NaN depend on the compiler. A step count ends such rays.
"""

MAX_STEPS = 2**14
"""Steps of a ray, over cells or empty blocks. A ray across all cascades takes 850 whole steps."""
MAX_METABALL_STEPS = 2**20
"""Steps of a ray through snow; they are at least a hundredth of a cell long."""
