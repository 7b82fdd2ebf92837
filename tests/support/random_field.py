"""A small field with random parameters and random occupied cells."""

import numpy as np
import torch

from climatenerf.field.hash_field import Field
from climatenerf.field.presets import FieldSize

SMALL = FieldSize(
    geometry_levels=4,
    geometry_log2_rows=9,
    geometry_finest=40,
    geometry_hidden=8,
    appearance_levels=4,
    appearance_log2_rows=9,
    appearance_finest=40,
    colour_hidden=16,
    coarsest=4,
    embedding=3,
    sky_levels=2,
    sky_log2_rows=9,
    sky_finest=16,
    sky_hidden=8,
    surface_levels=3,
    surface_log2_rows=9,
    surface_finest=20,
    surface_hidden=8,
    occupancy_side=16,
    cascades=3,
)


def random_field(seed: int = 0, images: int = 5, full: bool = False) -> Field:
    """A field with a core of radius 2.5 m at (1, -2, 0.5); a third of its cells are occupied."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    field = Field(SMALL, images, np.array([1.0, -2.0, 0.5]), unit=2.5, near=0.1)
    with torch.no_grad():
        for grid in (field.geometry_grid, field.appearance_grid, field.sky_grid):
            grid.copy_(torch.randn(grid.shape, generator=generator) * 0.5)
        field.embeddings.copy_(torch.randn(field.embeddings.shape, generator=generator))
    shape = field.occupancy.occupied.shape
    if not full:
        field.occupancy.occupied = (torch.rand(shape, generator=generator) < 0.3).to(torch.uint8)
    return field.requires_grad_(False)


def directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=-1)


def points(field: Field, n: int, spread: float = 1.5, seed: int = 0) -> torch.Tensor:
    """World positions around the core, partly outside."""
    generator = torch.Generator().manual_seed(seed)
    return field.centre + field.unit * spread * torch.randn(n, 3, generator=generator)
