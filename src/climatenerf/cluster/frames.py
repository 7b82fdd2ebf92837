"""The frames of one movie on several workers.

This process prepares light, waves, ground and snow once and saves them beside the frames; the
workers read that. Which frames are finished is read from the disk, never from the result of a task.
"""

import functools
import hashlib
import pickle
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from climatenerf.cluster import on_worker
from climatenerf.cluster.on_worker import Saved
from climatenerf.cluster.workers import Workers, connected, logger, parse_workers, results
from climatenerf.core.errors import UserError
from climatenerf.core.storage import write_bytes
from climatenerf.output import job as jobs
from climatenerf.output import render_folder

if TYPE_CHECKING:
    from distributed import Client

    from climatenerf.output.frame_source import FrameSource
    from climatenerf.output.job import RenderFrames, RenderJob

ROUNDS = 3
"""How often frames are rendered that are not on the disk although a worker has finished them."""


def renderer(workers: Workers) -> "RenderFrames":
    """Return what renders frames on workers, for `output.job.render_movie`.

    Args:
        workers: how many processes of this machine, or the address of a scheduler.
    """
    return functools.partial(_render_frames, parse_workers(str(workers)))


def _render_frames(
    workers: Workers,
    job: "RenderJob",
    out: Path,
    prepare: Callable[[], "FrameSource"],
    indices: Iterable[int],
    *,
    preview: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> None:
    """Render the frames that are not finished yet; see `output.job.render_frames`.

    Raises:
        UserError: as there, or from `workers.connected`; a worker has failed; or none is left.
    """
    if preview:
        raise UserError(
            "a preview shows one frame at work; leave it out, or render without workers"
        )
    indices = list(indices)
    missing = jobs.frames_to_render(job, out, indices)
    if not missing:
        return
    report = progress or (lambda what, fraction: None)
    with connected(workers, out) as client:
        source = prepare()
        jobs.claim(job, out)
        with render_folder.unfinished_files(out) as scratch:
            data = pickle.dumps((job, source), pickle.HIGHEST_PROTOCOL)
            digest = hashlib.sha256(data).hexdigest()
            prepared = Saved(scratch.resolve() / "prepared", digest, on_worker.versions())
            write_bytes(prepared.path, data)
            del data
            report("frames", (len(indices) - len(missing)) / len(indices))
            for _ in range(ROUNDS):
                for done in _finished(client, out, prepared, missing):
                    report("frames", (len(indices) - len(missing) + done) / len(indices))
                missing = jobs.missing_frames(job, out, indices)
                if not missing:
                    return
    raise UserError(
        f"{len(missing)} frames that workers have finished are not in {out}; check that all"
        " machines share the folder, and run it again"
    )


def _finished(client: "Client", out: Path, prepared: Saved, missing: list[int]) -> Iterator[int]:
    """Render frames, and yield how many are finished whenever one is."""
    titles = {}
    for index in missing:
        given = out.resolve(), prepared, index
        future = client.submit(on_worker.render_frame, *given, pure=False)
        titles[future] = f"frame {index:04d}"
    for count, (future, (seconds, process)) in enumerate(results(client, titles, out), 1):
        logger.info("%s took %.2f s on %s", titles[future], seconds, process)
        yield count
