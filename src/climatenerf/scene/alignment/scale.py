"""The scale of a scene: the evidence that sets it, the other evidence, and disagreements.

`Scene.scale_report` holds, for each piece of evidence that does not set the scale, `times` (scale
according to it, relative to the scale in use) and `error` (relative standard error).
"""

from dataclasses import replace

import numpy as np

from climatenerf.scene.alignment.ground_plane import find_ground
from climatenerf.scene.findings import Finding
from climatenerf.scene.images import load_depth
from climatenerf.scene.scene import Scene

MIN_DEPTHS = 5  # points per view, and views, that a scale from depth files needs
MIN_DEPTH_ERROR = 0.01  # relative, of a scale from depth files
MAX_SPREAD = 0.15  # of log depth over points: metric depth is mostly within a tenth
MIN_HEIGHT_ERROR = 0.05  # relative, of a scale from the camera height
SIGMAS = 2.0  # difference between two pieces of evidence that is worth a warning


def rescaled(scene: Scene, factor: float, source: str, error: float) -> Scene:
    """Return the scene enlarged by `factor` about its ground datum, on new evidence.

    Args:
        scene: Scene aligned to the world frame.
        factor: New metres per present metre, > 0.
        source: Name of the evidence, for `scale_source`.
        error: Relative standard error of the evidence.
    """
    report = {k: {**v, "times": v["times"] / factor} for k, v in scene.scale_report.items()}
    report[scene.scale_source] = {"times": 1 / factor, "error": scene.scale_error}
    report.pop(source, None)
    similarity = np.diag([factor, factor, factor, 1.0])
    similarity[2, 3] = (1 - factor) * scene.ground_z
    return replace(
        scene,
        world_from_input=similarity @ scene.world_from_input,
        scale_source=source,
        scale_error=error,
        scale_report=report,
        lowest_ground_z=scene.ground_z + factor * (scene.lowest_ground_z - scene.ground_z),
        findings=tuple(f for f in scene.findings if f.code != "scale-assumed"),
    )


def with_scale_evidence(scene: Scene, name: str, times: float, error: float) -> Scene:
    """Return the scene with evidence added to its report, without changing its scale.

    Args:
        scene: Scene aligned to the world frame.
        name: Name of the evidence.
        times: Scale according to the evidence, relative to the scale in use.
        error: Relative standard error.
    """
    entry = {"times": times, "error": error}
    return replace(scene, scale_report={**scene.scale_report, name: entry})


def rescale_by_camera_height(scene: Scene, height: float) -> Scene | None:
    """Return the scene scaled so that its cameras are `height` metres above the ground.

    Up, heading and position stay. None if no ground is found below the cameras.
    """
    points = scene.points_world()
    cameras = np.stack([scene.c2w_world(view)[:3, 3] for view in scene.views])
    ground = None if points is None else find_ground(points, cameras)
    if ground is None:
        return None
    error = max(MIN_HEIGHT_ERROR, round(ground.spread, 3))
    return rescaled(scene, height / ground.camera_height, "camera-height", error)


def scale_from_depth_files(scene: Scene) -> tuple[float, float] | None:
    """Return the scale according to the depth files, relative to the scale in use, and its error.

    The scale is the median over views of the median ratio of file depth to sparse-point depth; the
    error is its relative standard error. None if fewer than `MIN_DEPTHS` views have points with
    depth, or if the ratios vary too much within a view, as those of relative depth do.

    Raises:
        UserError: A depth file cannot be read.
    """
    points, ratios, spreads = scene.points_world(), [], []
    for view in scene.views:
        depth = load_depth(view, scene)
        if points is None or depth is None or view.seen is None or not len(view.seen):
            continue
        c2w = scene.c2w_world(view)
        local = (points[view.seen] - c2w[:3, 3]) @ c2w[:3, :3]
        local = local[local[:, 2] > 0]
        x, y = scene.cameras[view.camera].project(local).T.astype(np.int64)
        inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
        ratio = np.log(depth[y[inside], x[inside]] / local[inside, 2])
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) >= MIN_DEPTHS:
            ratios.append(float(np.median(ratio)))
            spreads.append(float(np.median(np.abs(ratio - np.median(ratio)))))
    if len(ratios) < MIN_DEPTHS or np.median(spreads) > MAX_SPREAD:
        return None
    median = float(np.median(ratios))
    # 1.4826: standard deviation of a normal distribution over its median absolute deviation.
    sigma = 1.4826 * float(np.median(np.abs(np.array(ratios) - median)))
    return float(np.exp(median)), max(sigma / np.sqrt(len(ratios)), MIN_DEPTH_ERROR)


def scale_summary(scene: Scene) -> str:
    """Return the source of the scale and the scales of the other evidence, in one clause."""
    clauses = [f"scale from {scene.scale_source} (+-{percent(scene.scale_error)})"]
    clauses += [
        f"{name}: {entry['times']:.2f} times that (+-{percent(entry['error'])})"
        for name, entry in scene.scale_report.items()
    ]
    return "; ".join(clauses)


def scale_findings(scene: Scene) -> list[Finding]:
    """Return a finding for each piece of evidence that differs by more than the errors allow."""
    return [
        Finding(
            "scale-disagrees",
            f"The scale from {name} is {entry['times']:.2f} times the one from"
            f" {scene.scale_source}",
            "check both",
            file=str(scene.root),
        )
        for name, entry in scene.scale_report.items()
        if abs(np.log(entry["times"])) > SIGMAS * (entry["error"] + scene.scale_error)
    ]


def with_capture_flags(scene: Scene) -> Scene:
    """Return the scene with the finding of an assumed scale naming the flags of `capture`."""
    remedy = "give --camera-height or --known-length"
    findings = [
        replace(f, remedy=remedy) if f.code == "scale-assumed" else f for f in scene.findings
    ]
    return replace(scene, findings=tuple(findings))


def percent(fraction: float) -> str:
    """Format a fraction as a percentage: 30%, 0.5%."""
    return f"{fraction:.0%}" if fraction >= 0.0095 else f"{fraction:.1%}"
