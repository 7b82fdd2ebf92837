"""Which folders a fit may write into. Imports no torch, so that it is known before all else."""

from pathlib import Path

from climatenerf.errors import UserError
from climatenerf.scene.scene import Scene

OPTIMISER = "optimiser.safetensors"


def check_folder(scene: Scene, run: Path, resume: bool) -> None:
    """Refuses a folder in which a fit would destroy something, or could not go on."""
    if run.resolve() == scene.root.resolve():
        raise UserError(f"{run} is the capture itself; give another folder for the run with -o")
    has_config = (run / "config.json").is_file()
    if resume and not has_config:
        raise UserError(f"{run} holds no run to resume; leave --resume out to begin one")
    if resume and not (run / OPTIMISER).is_file():
        raise UserError(
            f"{run} holds no {OPTIMISER}, without which it can be rendered but not resumed; fit"
            " anew into another folder"
        )
    if not resume and (run / "scene.json").exists() and not has_config:
        raise UserError(f"{run} holds a scene, which would be overwritten; choose another -o")
    # Of a checkpoint's files the optimiser's is written last: before it there is nothing to lose.
    if not resume and ((run / OPTIMISER).exists() or (run / "metrics.json").exists()):
        raise UserError(
            f"{run} already holds a run; choose another -o, or continue it with --resume"
        )
