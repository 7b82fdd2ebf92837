"""``climatenerf batch FILE.toml -o OUT``: many captures, and what is to be done with each.

[defaults.fit]                  # flags of every fit
minutes = 10

[[scene]]
name = "yard"
capture = "captures/yard"       # photos with poses; or photos = "..." without
fit.labels = "heuristic"        # flags of this fit

[[scene.stylize]]
name = "winter"
season = "winter"

[[scene.render]]
name = "flood in winter"
of = "winter"                   # a styled run; the fit without it
size = "480x270"
flood.level = "0.3 m"
"""

import dataclasses
import importlib
import shlex
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional, parse_flags
from climatenerf.cluster.batch import Outcome, Task, earlier_outcomes, run_batch
from climatenerf.cluster.table import write_table
from climatenerf.cluster.workers import LOG, check_installed, parse_workers
from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.locks import only_writer
from climatenerf.core.parsing import read_toml

OF_A_RUN = ("stylize", "render", "evaluate", "compare")
"""Verbs that read a run; a scene has a list of tables for each."""
TAKEN: tuple[str, ...] = ("capture", "fit", "run", "logs")
"""Names in a scene's folder that tasks of lists cannot have."""
TAKEN_BY_BATCH = ("table.csv", "table.html", LOG, ".lock")
"""Names in the folder of the batch that scenes cannot have."""
SET_BY_BATCH = ("out", "resume", "join", "part", "workers", "help")
"""Flags that a batch gives itself, or that end a verb before its work is done."""
MAX_TASKS = 10_000


@dataclass(frozen=True)
class Batch:
    """Fit, style, render and evaluate many captures, as a file says (docs/guide/cluster.md).
    Re-run the same command to resume a stopped batch."""

    file: tyro.conf.Positional[Path]
    """Batch file (TOML): captures, and what is to be done with each."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the runs, the movies and the table of results."""
    workers: Annotated[str | None, optional("N|ADDRESS")] = None
    """Work on several scenes at a time: N processes of this machine, or those of a Dask scheduler
    such as tcp://10.0.0.1:8786, which must share the folders. Default: one after another."""
    dry_run: bool = False
    """Check the file and print the commands; run none."""


def run(options: Batch) -> int:
    """Run the tasks of a batch file, and print where the table of results is."""
    workers = None if options.workers is None else parse_workers(options.workers)
    if workers is not None:
        check_installed()
    out = options.out.resolve()
    tasks = read_batch(options.file, out)
    if options.dry_run:
        for task in tasks:
            progress.result(shlex.join(["climatenerf", *task.words]))
        return 0
    ended: dict[Task, Outcome] = {}
    with only_writer(out), progress.Bar("batch", len(tasks)) as bar:
        shown = earlier_outcomes(tasks)

        def report(task: Task, outcome: Outcome) -> None:
            ended[task] = shown[task] = outcome
            write_table(out, options.file.stem, tasks, shown)
            progress.say(line(task, outcome))
            bar.update(len(ended))

        run_batch(tasks, out, workers, report)
    progress.result(f"table: {options.out / 'table.html'}")
    failed = sum(outcome.status == "failed" for outcome in ended.values())
    if failed:
        raise UserError(
            f"{failed} of {len(tasks)} tasks have failed; {options.out / 'table.html'} shows why,"
            " and the same command runs them again"
        )
    return 0


def line(task: Task, outcome: Outcome) -> str:
    """Return one line about a task that has ended."""
    if outcome.before:
        return f"{task.title}: done before"
    if outcome.status == "skipped":
        return f"{task.title}: skipped, {outcome.message}"
    took = progress.duration(outcome.seconds)
    if outcome.status == "done":
        return f"{task.title}: done in {took}"
    return f"{task.title}: failed after {took}: {outcome.message} (see {task.log})"


def read_batch(path: Path, out: Path) -> list[Task]:
    """Return the tasks of a batch file, each after those that it needs.

    Args:
        path: the file.
        out: folder of the batch.

    Raises:
        UserError: the file cannot be read, has unknown keys, or a task has flags that its verb
            refuses.
    """
    table = read_toml(path, "batch file")
    where = f"batch file: {path}"
    _check_keys(table, {"scene", "defaults"}, where)
    defaults = _tables(table, "defaults", ("capture", "fit", *OF_A_RUN), where)
    scenes = table.get("scene")
    if not isinstance(scenes, list) or not scenes or not all(isinstance(s, dict) for s in scenes):
        raise UserError(f"{where} should list its captures, each under [[scene]]")
    tasks: list[Task] = []
    names: set[str] = set()
    for number, scene in enumerate(scenes, 1):
        if ("photos" in scene) == ("capture" in scene) or not _source(scene):
            raise UserError(
                f'{where}, scene {number} needs either capture = "FOLDER" (photos with poses) or'
                ' photos = "FOLDER" (without)'
            )
        name = _name(scene.get("name", Path(_source(scene)).name), f"{where}, scene {number}")
        if name in names or name in TAKEN_BY_BATCH:
            raise UserError(
                f"{where} has two scenes {name!r}, or the name is reserved; give each another"
            )
        names.add(name)
        tasks += _tasks(scene, name, defaults, path.resolve().parent, out.resolve(), where)
    if len(tasks) > MAX_TASKS:
        raise UserError(f"{where} has {len(tasks)} tasks; at most {MAX_TASKS} fit into one batch")
    return tasks


def _tasks(
    scene: Mapping[str, Any],
    name: str,
    defaults: Mapping[str, Mapping[str, Any]],
    folder: Path,
    out: Path,
    where: str,
) -> Iterator[Task]:
    """Yield the tasks of a scene."""
    where, home = f"{where}, scene {name!r}", out / name
    _check_keys(scene, {"name", "photos", "capture", "fit", *OF_A_RUN}, where)

    def task(title: str, at: str, words: list[str], flags: Mapping, *needs: str) -> Task:
        flags = {**defaults.get(words[0], {}), **flags}
        words = [*words, "-o", str(home / at), *flag_words(words[0], flags, f"{where}, {title}")]
        _check_flags(words, f"{where}, {title}")
        log = home / "logs" / f"{title}.log"
        return Task(name, title, tuple(words), home / at, folder, log, needs)

    source, needed = str(folder / _source(scene)), ()
    if "photos" in scene:
        yield task("capture", "capture", ["capture", source], {})
        source, needed = str(home / "capture"), ("capture",)
    yield task("fit", "run", ["fit", source], _table(scene, "fit", where), *needed)
    runs = {"fit": home / "run"}
    taken = set(TAKEN)
    for verb in OF_A_RUN:
        for entry in _list(scene, verb, where):
            title = _name(entry.get("name", verb), f"{where}, {verb}")
            if title in taken:
                raise UserError(
                    f"{where} has two tasks {title!r}, or the name is reserved; give each [[scene."
                    f"{verb}]] a name of its own"
                )
            taken.add(title)
            of = str(entry.get("of", "fit"))
            if of not in runs:
                raise UserError(
                    f"{where}, {title}: there is no styled run {excerpt(of)} to work on; of = must"
                    f" be one of {', '.join(runs)}"
                )
            flags = {key: value for key, value in entry.items() if key not in ("name", "of")}
            yield task(title, title, [verb, str(runs[of])], flags, of)
            if verb == "stylize":
                runs[title] = home / title


def flag_words(verb: str, flags: Mapping[str, Any], where: str) -> list[str]:
    """Return flags of the command line for a table of a batch file.

    Args:
        verb: the verb that they belong to.
        flags: values by name; a table in it has the flags of a group, such as flood.level.
        where: begins the messages.

    Raises:
        UserError: a value is neither text, number, truth value nor a list of these.
    """
    repeated = _repeated(verb)
    words: list[str] = []
    for name, value in _flat(flags):
        if name.replace("_", "-") in SET_BY_BATCH:
            raise UserError(f"{where}: leave {name} out, which the batch decides")
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        elif isinstance(value, list) and name.replace("-", "_") in repeated:
            words += [word for each in value for word in (flag, _text(each, name, where))]
        elif isinstance(value, list):
            words += [flag, *(_text(each, name, where) for each in value)]
        else:
            words += [flag, _text(value, name, where)]
    return words


def _flat(flags: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in flags.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _text(value: object, name: str, where: str) -> str:
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        return str(value)
    raise UserError(f"{where}: {name} must be a text or a number; got {excerpt(value)}")


def _options(verb: str) -> Any:
    """Return the dataclass of a verb's flags."""
    from climatenerf.cli import VERBS

    module = importlib.import_module(VERBS[verb].module)
    return module.options_class() if verb == "render" else getattr(module, VERBS[verb].options)


def _repeated(verb: str) -> set[str]:
    """Return the names of the flags that are repeated for several values."""
    kind = _options(verb)
    hints = typing.get_type_hints(kind, include_extras=True)
    append = tyro.conf.UseAppendAction
    names = {field.name for field in dataclasses.fields(kind)}
    marker = typing.get_args(append[int])[1:]
    return {
        name
        for name in names & hints.keys()
        if any(mark in typing.get_args(hints[name])[1:] for mark in (append, *marker))
    }


def _check_flags(words: list[str], where: str) -> None:
    verb, *rest = words
    try:
        parse_flags(_options(verb), f"climatenerf {verb}", rest)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def _check_keys(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise UserError(
            f"{where} has the unknown key {excerpt(unknown[0])}; it may have"
            f" {', '.join(sorted(known))}"
        )


def _tables(
    table: Mapping[str, Any], name: str, verbs: tuple[str, ...], where: str
) -> dict[str, Mapping[str, Any]]:
    found = _table(table, name, where)
    _check_keys(found, set(verbs), f"{where}, [{name}]")
    return {verb: _table(found, verb, f"{where}, [{name}]") for verb in found}


def _table(table: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    found = table.get(name, {})
    if not isinstance(found, dict):
        raise UserError(f"{where}: {name} should be a table of flags; got {excerpt(found)}")
    return found


def _list(table: Mapping[str, Any], name: str, where: str) -> list[Mapping[str, Any]]:
    found = table.get(name, [])
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise UserError(f"{where}: write each {name} under [[scene.{name}]]")
    return found


def _source(scene: Mapping[str, Any]) -> str:
    found = scene.get("capture", scene.get("photos"))
    return found if isinstance(found, str) else ""


def _name(value: object, where: str) -> str:
    """Return a name that can be that of a folder.

    Raises:
        UserError: it cannot.
    """
    bad = not isinstance(value, str) or not value.strip(". ") or len(value) > 80
    if bad or any(c in '/\\:*?"<>|' or not c.isprintable() for c in str(value)):
        raise UserError(
            f"{where}: the name {excerpt(value)} cannot be that of a folder; use letters, digits,"
            " spaces and hyphens"
        )
    return str(value)
