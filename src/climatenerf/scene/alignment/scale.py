"""Metres: which evidence sets them, what the other evidence says, and where they disagree.

`Scene.scale_report` holds, for each piece of evidence that does not set the scale, `times` (how
many times as large as it is the scene would be by it) and `error` (relative standard error).
"""

from dataclasses import replace

import numpy as np

from climatenerf.scene.alignment.ground_plane import find_ground
from climatenerf.scene.images import load_depth
from climatenerf.scene.scene import Scene

MIN_DEPTHS = 5  # points in a view, and views, that depth files must reach
MIN_ERROR = 0.01  # of the scale by depth files
MAX_SPREAD = 0.15  # of log depth over points: metric depth is within a tenth nearly everywhere
ASSUMED_WARNING = "The scale is assumed"  # how the warning begins
SIGMAS = 2.0  # between two pieces of evidence, from which the user is warned


def rescaled(scene: Scene, factor: float, source: str, error: float) -> Scene:
    """The scene `factor` times as large about its ground datum, by better evidence.

    Args:
        scene: levelled.
        factor: new metres in one of the present ones, > 0.
        source: the evidence's name, for `scale_source`.
        error: its relative standard error.
    """
    report = {k: {**v, "times": v["times"] / factor} for k, v in scene.scale_report.items()}
    report[scene.scale_source] = {"times": 1 / factor, "error": scene.scale_error}
    report.pop(source, None)
    turn = np.diag([factor, factor, factor, 1.0])
    turn[2, 3] = (1 - factor) * scene.ground_z
    return replace(
        scene,
        world_from_input=turn @ scene.world_from_input,
        scale_source=source,
        scale_error=error,
        scale_report=report,
        lowest_ground_z=scene.ground_z + factor * (scene.lowest_ground_z - scene.ground_z),
        warnings=tuple(w for w in scene.warnings if not w.startswith(ASSUMED_WARNING)),
    )


def with_scale_evidence(scene: Scene, name: str, times: float, error: float) -> Scene:
    """The scene with one more piece of evidence that does not set its scale."""
    witness = {"times": times, "error": error}
    return replace(scene, scale_report={**scene.scale_report, name: witness})


def rescale_by_camera_height(scene: Scene, height: float) -> Scene | None:
    """The scene in the metres in which its cameras are `height` above the ground below them.

    Up, heading and place stay. None where no ground is seen.
    """
    points = scene.points_world()
    eyes = np.stack([scene.c2w_world(view)[:3, 3] for view in scene.views])
    ground = None if points is None else find_ground(points, eyes)
    if ground is None:
        return None
    error = max(0.05, round(ground.spread, 3))
    return rescaled(scene, height / ground.camera_height, "camera-height", error)


def scale_summary(scene: Scene) -> str:
    """What sets the scale and what the others say, in one clause."""
    words = [f"scale from {scene.scale_source} (+-{percent(scene.scale_error)})"]
    for name, said in scene.scale_report.items():
        words.append(f"{name} says {said['times']:.2f} times that (+-{percent(said['error'])})")
    return "; ".join(words)


def with_capture_flags(scene: Scene) -> Scene:
    """The scene with the flags named that `capture` knows too where its scale is assumed."""
    remedy = "; give --camera-height or --known-length."
    told = [
        w.partition("; give ")[0] + remedy if w.startswith(ASSUMED_WARNING) else w
        for w in scene.warnings
    ]
    return replace(scene, warnings=tuple(told))


def percent(share: float) -> str:
    """A share as text: 30%, 0.5%."""
    return f"{share:.0%}" if share >= 0.0095 else f"{share:.1%}"


def scale_warnings(scene: Scene) -> list[str]:
    """Where two pieces of evidence are further apart than their errors allow."""
    out = []
    for name, said in scene.scale_report.items():
        apart, allowed = abs(np.log(said["times"])), SIGMAS * (said["error"] + scene.scale_error)
        if apart > allowed:
            out.append(
                f"{name} makes the scene {said['times']:.2f} times as large as"
                f" {scene.scale_source} does; check both."
            )
    return out


def scale_from_depth_files(scene: Scene) -> tuple[float, float] | None:
    """How many times as large the scene is by its views' depth files, and the relative error.

    The median over views of the median ratio of file to sparse points. None where the files do not
    measure: relative depths have no one ratio.
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
    middle = float(np.median(ratios))
    apart = 1.4826 * float(np.median(np.abs(np.array(ratios) - middle)))
    return float(np.exp(middle)), max(apart / np.sqrt(len(ratios)), MIN_ERROR)
