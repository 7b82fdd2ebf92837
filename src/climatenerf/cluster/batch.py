"""Tasks of a batch: verbs of the command line, run where their inputs are finished.

    OUT/SCENE/NAME            what a task makes; NAME is "run" for a fit
    OUT/SCENE/logs/NAME.log   all that its verb printed
    OUT/SCENE/logs/NAME.json  how it ended; a task that is done is not run again
    OUT/table.csv, table.html results so far

A verb resumes what an interrupted one has left, so a task can end at any time and be run again.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import climatenerf
from climatenerf.cluster import on_worker
from climatenerf.cluster.workers import Workers, connected, results
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, write_json

if TYPE_CHECKING:
    from distributed import Future

Status = Literal["done", "failed", "skipped"]


@dataclass(frozen=True)
class Task:
    """One verb for one scene.

    Attributes:
        scene: Name of the scene.
        name: Name of the task, unique in its scene.
        words: Verb and flags, as typed.
        out: Folder that it makes.
        folder: Working folder of the verb, to which relative paths in its flags refer.
        log: File that receives what it prints.
        needs: Names of the tasks of its scene whose results it reads.
    """

    scene: str
    name: str
    words: tuple[str, ...]
    out: Path
    folder: Path
    log: Path
    needs: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """What a person calls the task."""
        return f"{self.scene}: {self.name}"


@dataclass(frozen=True)
class Outcome:
    """How a task ended.

    Attributes:
        status: "skipped" if a task that it needs has failed.
        seconds: Duration of its last run.
        message: Last line that it printed.
        key: Hash of the task and of what it needs.
        before: Whether an earlier batch did it.
    """

    status: Status
    seconds: float
    message: str
    key: str
    before: bool = False


Report = Callable[[Task, Outcome], None]
"""Called with each task that has ended."""


def run_batch(
    tasks: Sequence[Task], out: Path, workers: Workers | None, report: Report
) -> dict[Task, Outcome]:
    """Run tasks, each after those that it needs; one that fails stops none but those that need it.

    Args:
        tasks: in an order in which each comes after those that it needs.
        out: folder of the batch.
        workers: how many processes, or the address of a scheduler; None runs one after another.
        report: called with each task that has ended.

    Raises:
        UserError: see `workers.connected`.
    """
    outcomes: dict[Task, Outcome] = {}
    for task, outcome in _one_by_one(tasks) if workers is None else _by(workers, tasks, out):
        outcomes[task] = outcome
        report(task, outcome)
    return {task: outcomes[task] for task in tasks}


def _one_by_one(tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
    done: dict[tuple[str, str], Outcome] = {}
    for task in tasks:
        outcome = run_task(task, [done[task.scene, name] for name in task.needs])
        done[task.scene, task.name] = outcome
        yield task, outcome


def _by(workers: Workers, tasks: Sequence[Task], out: Path) -> Iterator[tuple[Task, Outcome]]:
    with connected(workers, out) as client:
        futures: dict[tuple[str, str], Future] = {}
        of: dict[Future, Task] = {}
        for number, task in enumerate(tasks):
            needed = [futures[task.scene, name] for name in task.needs]
            # Earlier scenes first, so that the table fills scene by scene.
            future = client.submit(run_on_worker, task, *needed, pure=False, priority=-number)
            futures[task.scene, task.name] = future
            of[future] = task
        titles = {future: task.title for future, task in of.items()}
        for future, outcome in results(client, titles, out):
            yield of[future], outcome


def run_on_worker(task: Task, *needed: Outcome) -> Outcome:
    """Run a task with the threads that a worker has; see `run_task`."""
    return run_task(task, needed, on_worker.own_threads())


def run_task(task: Task, needed: Sequence[Outcome], threads: int | None = None) -> Outcome:
    """Run a task unless it is done, and record how it ended.

    Args:
        task: the task.
        needed: outcomes of the tasks that it needs, in their order.
        threads: of its kernels; None: as many as there are cores.

    Raises:
        UserError: a log or a record cannot be written.
    """
    key = _key(task, needed)
    if any(outcome.status != "done" for outcome in needed):
        return Outcome("skipped", 0.0, "what it needs has failed", key)
    earlier = recorded(task, key)
    if earlier is not None and earlier.status == "done" and task.out.exists():
        return earlier
    words = [*task.words]
    if words[0] == "fit" and (task.out / "config.json").is_file():
        words.append("--resume")
    status, seconds, message = on_worker.run_verb(words, task.log, task.folder, threads)
    outcome = Outcome("done" if status == 0 else "failed", seconds, message, key)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    about = {"command": words, "exit_status": status, "ended": now, "schema_version": 1}
    write_json(task.log.with_suffix(".json"), {**asdict(outcome), **about})
    return outcome


def earlier_outcomes(tasks: Sequence[Task]) -> dict[Task, Outcome]:
    """Return how tasks ended in an earlier batch, as far as neither they nor what they need differ.

    Args:
        tasks: in an order in which each comes after those that it needs.
    """
    found: dict[Task, Outcome] = {}
    by_name: dict[tuple[str, str], Outcome] = {}
    for task in tasks:
        needed = [by_name.get((task.scene, name)) for name in task.needs]
        known = [outcome for outcome in needed if outcome is not None]
        outcome = recorded(task, _key(task, known)) if len(known) == len(needed) else None
        if outcome is not None:
            found[task] = by_name[task.scene, task.name] = outcome
    return found


def recorded(task: Task, key: str) -> Outcome | None:
    """Return how an earlier run of a task ended; None if it had another key, or has no record."""
    with contextlib.suppress(UserError, OSError, KeyError, TypeError, ValueError):
        found = read_json(task.log.with_suffix(".json"))
        status, message = found["status"], str(found["message"])
        if status in ("done", "failed") and found["key"] == key:
            return Outcome(status, float(found["seconds"]), message, key, True)
    return None


def _key(task: Task, needed: Sequence[Outcome]) -> str:
    described = [climatenerf.__version__, task.words, [outcome.key for outcome in needed]]
    return hashlib.sha256(json.dumps(described).encode()).hexdigest()
