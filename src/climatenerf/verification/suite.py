"""All checks, in order."""

from collections.abc import Callable, Iterator

import torch

from climatenerf.core.device import CPU
from climatenerf.field.hash_field import Field
from climatenerf.scene.scene import Scene
from climatenerf.verification import furnace, invariance, own_run, smog, snow, water
from climatenerf.verification.check import Check
from climatenerf.verification.setting import Viewpoint

TOPICS: dict[str, Callable[[torch.device], Iterator[Check]]] = {
    "smog": smog.checks,
    "water": water.checks,
    "white furnace": furnace.checks,
    "snow": snow.checks,
    "invariance": invariance.checks,
}
"""Checks of the program in scenes of known geometry."""


def verify_program(
    progress: Callable[[str, float], None] | None = None, device: torch.device = CPU
) -> tuple[Check, ...]:
    """Check the physics of the program in scenes of known geometry.

    Args:
        progress: called with the topic and the fraction of all topics that is done.
        device: where to compute.
    """
    report = progress or (lambda topic, fraction: None)
    found: list[Check] = []
    for index, (topic, checks) in enumerate(TOPICS.items()):
        report(topic, index / len(TOPICS))
        found.extend(checks(device))
    return tuple(found)


def verify_run(field: Field, scene: Scene, viewpoint: Viewpoint) -> tuple[Check, ...]:
    """Check the physics in a fitted field; see `own_run`."""
    return tuple(own_run.checks(field, scene, viewpoint))
