"""Sizes of the field, as plain values. Does not import torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FieldSize:
    """Sizes of the hash grids and of their networks."""

    geometry_levels: int = 8
    geometry_log2_rows: int = 17
    geometry_finest: int = 2048
    """Cells across the contracted cube (4 grid units) at the finest level."""
    geometry_hidden: int = 32
    appearance_levels: int = 12
    appearance_log2_rows: int = 19
    """With fewer rows foliage stays blurred (docs/adr/0011)."""
    appearance_finest: int = 4096
    colour_hidden: int = 64
    surface_levels: int = 8
    """Levels of the grid of normals and classes; 0: their network reads the appearance grid."""
    surface_log2_rows: int = 15
    surface_finest: int = 512
    surface_hidden: int = 32
    coarsest: int = 16
    embedding: int = 8
    """Length of the appearance vector of each training image."""
    sky_levels: int = 4
    sky_log2_rows: int = 15
    sky_finest: int = 128
    """Cells across the sphere of directions at the finest level, 1 degree each."""
    sky_hidden: int = 32
    occupancy_side: int = 128
    """Cells along an edge of each occupancy cascade."""
    cascades: int = 7
    """Cascade k covers the cube of half side 2^k grid units."""


PRESETS = {
    "cpu": FieldSize(),
    # Table sizes that suit a GPU's memory and bandwidth; not evaluated on benchmarks yet.
    "gpu": FieldSize(
        geometry_levels=12,
        geometry_log2_rows=19,
        geometry_hidden=64,
        appearance_levels=16,
        surface_log2_rows=17,
    ),
    # Supplement, "Training Details": 16 levels of 2^19 for density, 32 of 2^21 for the rest.
    "paper": FieldSize(
        geometry_levels=16,
        geometry_log2_rows=19,
        geometry_hidden=128,
        appearance_levels=32,
        appearance_log2_rows=21,
        colour_hidden=128,
        surface_levels=0,
    ),
}
