"""``climatenerf verify [RUN]``: check the physics of the installed program, and of a run."""

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.verification.check import Check

if TYPE_CHECKING:
    from climatenerf.api import Run

WIDTH = 48  # pixels of the pictures of a run
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Verify:
    """Check the physics of the installed program against closed forms: a table of figures and
    thresholds. The exit status is 1 if a check fails."""

    run: Annotated[Path | None, tyro.conf.Positional, optional("[PATH]")] = None
    """Run folder made by `climatenerf fit`, to be checked as well."""
    json: bool = False
    """Print JSON instead of a table."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute."""


def run(options: Verify) -> int:
    """Check, print the table, and return 0 if every check passes, else 1."""
    from climatenerf.api import load_run
    from climatenerf.core.device import resolve_device
    from climatenerf.verification.suite import TOPICS, verify_program

    device = resolve_device(options.device)
    fitted = None if options.run is None else load_run(options.run, device=options.device)
    parts = len(TOPICS) + (fitted is not None)
    with progress.Bar("verify", float(parts), quiet=options.json) as bar:

        def report(topic: str, fraction: float) -> None:
            bar.update(fraction * len(TOPICS), {"now": topic})

        checks = verify_program(report, device)
        if fitted is not None:
            report(fitted.folder.name, 1.0)
            checks += _checks_of(fitted)
        bar.update(float(parts))
    about = provenance(options.device)
    passed = all(check.passed for check in checks)
    if options.json:
        entries = [check.entry() for check in checks]
        data = {
            "schema_version": SCHEMA_VERSION,
            "passed": passed,
            "run": None if options.run is None else str(options.run),
            "provenance": about,
            "checks": entries,
        }
        progress.result(json.dumps(data, indent=1))
    else:
        progress.result(table(checks))
        progress.result("\n" + ", ".join(f"{key} {value}" for key, value in about.items()))
    return 0 if passed else 1


def _checks_of(fitted: "Run") -> tuple[Check, ...]:
    """Check a run from its most central camera, in small pictures."""
    from climatenerf.verification.setting import Viewpoint
    from climatenerf.verification.suite import verify_run

    camera, c2w = fitted.camera()
    small = camera.resized(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
    return verify_run(fitted.field, fitted.scene, Viewpoint(small, c2w))


def provenance(device: str) -> dict[str, Any]:
    """What the checks ran on: versions of the packages, platform and device."""
    import torch

    from climatenerf.output.sidecar import versions

    name = torch.cuda.get_device_name() if device == "cuda" else f"cpu ({torch.get_num_threads()})"
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    return {**versions(), "Python": platform.python_version(), "on": system, "device": name}


def table(checks: Sequence[Check]) -> str:
    """Return the checks as aligned lines, and the number of those that failed."""
    rows = [("check", "figure", "at most", "", "what is compared")]
    for check in checks:
        unit = "" if check.unit == "1" else f" {check.unit}"
        limit = "-" if check.threshold is None else f"{check.threshold:g}{unit}"
        figure = f"{check.figure:.2g}{unit}"
        rows.append((check.name, figure, limit, check.verdict, check.compares))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    padded = ([cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows)
    lines = ["  ".join(cells).rstrip() for cells in padded]
    judged = [check for check in checks if check.threshold is not None]
    failed = sum(not check.passed for check in judged)
    total = f"{len(judged) - failed} of {len(judged)} checks passed"
    return "\n".join([*lines, "", total])
