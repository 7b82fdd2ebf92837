"""Scenes of the analytic field that several tests use."""

import torch

from climatenerf.field.analytic import AnalyticField, Box, HalfSpace, Solid

__all__ = ["AnalyticField", "Box", "HalfSpace", "Solid", "ground", "table"]


def ground(tilt: float = 0.0, heading: float = 0.0, height: float = 0.0) -> HalfSpace:
    """Ground through (0, 0, height), tilted by `tilt` rad and rising towards `heading` rad."""
    angle, turn = torch.tensor(tilt), torch.tensor(heading)
    normal = torch.stack([-angle.sin() * turn.cos(), -angle.sin() * turn.sin(), angle.cos()])
    return HalfSpace(tuple(normal.tolist()), height * float(angle.cos()))


def table(height: float = 0.75, half: float = 0.6, thickness: float = 0.05) -> list[Box]:
    """A table around the z axis: a top whose upper face is at `height`, on four posts."""
    under = height - thickness
    top = Box((-half, -half, under), (half, half, height))
    posts = [
        Box((x - 0.04, y - 0.04, -0.5), (x + 0.04, y + 0.04, under))
        for x in (-half + 0.1, half - 0.1)
        for y in (-half + 0.1, half - 0.1)
    ]
    return [top, *posts]
