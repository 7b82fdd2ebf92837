"""``climatenerf check CAPTURE``: check that the parts of a capture agree."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.scene import read_scene
from climatenerf.scene.alignment.scale import scale_findings
from climatenerf.scene.findings import Finding
from climatenerf.scene.read import check_flags
from climatenerf.scene.scene import Scene


@dataclass(frozen=True)
class Check:
    """Check that a capture's photos, intrinsics, poses, points, depths, masks and labels agree.
    Exit status 0, or 2 if it cannot be used."""

    capture: tyro.conf.Positional[Path]
    """Folder or transforms.json of any capture that `fit` reads, or a run or scene folder."""
    json: bool = False
    """Print the findings as JSON."""
    camera_height: Annotated[str | None, optional("LENGTH")] = None
    """Height of the cameras above the ground, such as "1.6 m", as for `fit`."""
    metric_input: bool = False
    """The poses are already in metres with z up."""
    frames: Annotated[str | None, optional("STR")] = None
    """First and last frame of a KITTI-360 drive, such as 1538:1601."""
    label_space: Annotated[str | None, optional("STR")] = None
    """Meaning of the numbers in label files; see `fit`."""


def run(options: Check) -> int:
    """Print what was found.

    Raises:
        UserError: Something prevents the use of the capture.
    """
    scene, findings = inspected(options)
    errors = [each for each in findings if each.severity == "error"]
    if options.json:
        counts = {} if scene is None else used_counts(scene)
        report = {
            "capture": str(options.capture),
            "used": counts,
            "findings": [each.as_json() for each in findings],
        }
        progress.result(json.dumps(report, indent=1, ensure_ascii=False))
    else:
        progress.result(table(scene, findings))
    if errors:
        raise UserError(str(errors[0]))
    return 0


def inspected(options: Check) -> tuple[Scene | None, Sequence[Finding]]:
    """Return the scene and its findings; no scene if it cannot be read."""
    from climatenerf.weather.units import LENGTH, parse_quantity

    height = None
    if options.camera_height is not None:
        height = parse_quantity(options.camera_height, LENGTH, "--camera-height")
    check_flags(height, options.metric_input, options.frames, options.label_space)
    try:
        scene = read_scene(
            options.capture,
            camera_height=height,
            metric_input=options.metric_input,
            frames=options.frames,
            label_space=options.label_space,
        )
    except UserError as error:
        cause, _, remedy = str(error).removesuffix(".").rpartition("; ")
        message, remedy = (cause, remedy) if cause else (remedy, "")
        finding = Finding("unreadable", message, remedy, "error", str(options.capture))
        return None, [finding]
    odd = (*scene.findings, *scale_findings(scene))
    # The summary states how the scale is known; to lack a measured one, or points, is usual.
    usual = {"scale-assumed"} | ({"ground-missing"} if scene.points is None else set())
    return scene, [each for each in odd if each.code not in usual]


def used_counts(scene: Scene) -> dict[str, int]:
    """Return how many photos, cameras, points and sidecars of a scene are used."""
    points = 0 if scene.points is None else len(scene.points)
    return {
        "photos": len(scene.views),
        "held-out photos": len(scene.of_split("heldout")),
        "cameras": len({view.camera for view in scene.views}),
        "sparse points": points,
        "photos with recorded points": sum(
            bool(v.seen is not None and len(v.seen)) for v in scene.views
        ),
        "labels": sum(view.label_path is not None for view in scene.views),
        "masks": sum(view.mask_path is not None for view in scene.views),
        "depths": sum(view.depth_path is not None for view in scene.views),
    }


def table(scene: Scene | None, findings: Sequence[Finding]) -> str:
    """Return what is used and what was found, as text."""
    lines = []
    if scene is not None:
        lines += [f"{scene.source} capture in {scene.root}", ""]
        lines += [f"{count:>8}  {name}" for name, count in used_counts(scene).items()]
        lines += [
            f"{'':8}  up from {scene.up_report.get('used', 'the scene file')};"
            f" scale from {scene.scale_source} (+-{scene.scale_error:.0%})",
            "",
        ]
    if not findings:
        return "\n".join([*lines, "No problems found."])
    width = max(len(each.code) for each in findings)
    for severity in ("error", "warning", "note"):
        for each in findings:
            if each.severity == severity:
                lines.append(f"{severity:<8}{each.code:<{width}}  {each}")
    return "\n".join(lines)
