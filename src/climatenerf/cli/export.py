"""``climatenerf export RUN|SCENE -o FOLDER``: poses for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.scene import read_scene
from climatenerf.scene.export import export_colmap, export_transforms


@dataclass(frozen=True)
class Export:
    """Write the poses of a scene, in the input's own frame, for other programs."""

    scene: tyro.conf.Positional[Path]
    """Run folder, scene folder, or any capture that `fit` reads."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to write into."""
    format: tuple[Literal["transforms", "colmap"], ...] = ("transforms", "colmap")
    """transforms.json (nerfstudio, instant-ngp), COLMAP text."""


def run(options: Export) -> int:
    """Write the files, and print where they are.

    Raises:
        UserError: `--format` names none, or the capture cannot be used.
    """
    if not options.format:
        raise UserError("--format names no format; give transforms, colmap or both")
    scene = read_scene(options.scene)
    progress.report_findings(scene.findings)
    writers = {"transforms": export_transforms, "colmap": export_colmap}
    with only_writer(options.out):
        for name in dict.fromkeys(options.format):
            progress.result(f"{name}: {writers[name](scene, options.out)}")
    return 0
