"""The command line: ``climatenerf VERB ...``.

Each verb is a module of this package with a torch-free options dataclass and a function ``run``.
Only the module of the verb that was asked for is imported, so that help is quick.
"""

import contextlib
import difflib
import errno
import importlib
import itertools
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import climatenerf
from climatenerf.cli import streams
from climatenerf.cli.interruption import stopped_like_ctrl_c
from climatenerf.core.errors import UserError, explain, one_line

# Set before torch and Numba are imported, unless the user has set them. Both load an OpenMP run
# time. Threads of one that spin long after a parallel region take cores from the other; threads
# that sleep at once wake late. Spinning for some tens of microseconds is fastest (docs/adr/0001).
# Numba's OpenMP layer is thread-safe; its last fallback is not.
THREADING = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "10000",
    "KMP_BLOCKTIME": "0",
    "NUMBA_THREADING_LAYER_PRIORITY": "omp tbb workqueue",
}


@dataclass(frozen=True)
class Verb:
    """A verb of the command line.

    Attributes:
        module: Module that has the options dataclass and ``run``.
        options: Name of the dataclass.
        summary: One line for the help.
    """

    module: str
    options: str
    summary: str


VERBS = {
    "capture": Verb("climatenerf.cli.capture", "Capture", "find the poses of photos or a video"),
    "check": Verb("climatenerf.cli.check", "Check", "check that the parts of a capture agree"),
    "fit": Verb("climatenerf.cli.fit", "Fit", "fit a radiance field to posed photographs"),
    "stylize": Verb("climatenerf.cli.stylize", "Stylize", "give a run the colours of a season"),
    "render": Verb("climatenerf.cli.render", "Render", "render a fitted place in any weather"),
    "view": Verb("climatenerf.cli.view", "View", "look at a place in weather, live in a browser"),
    "page": Verb("climatenerf.cli.page", "Page", "write a web page with a water level slider"),
    "report": Verb("climatenerf.cli.report", "Report", "write what to know of a fit, as HTML"),
    "evaluate": Verb("climatenerf.cli.evaluate", "Evaluate", "measure a run against ground truth"),
    "compare": Verb("climatenerf.cli.compare", "Compare", "compare weather with other methods"),
    "verify": Verb("climatenerf.cli.verify", "Verify", "check the physics of this installation"),
    "study": Verb("climatenerf.cli.study", "Study", "compare methods by a user study"),
    "batch": Verb("climatenerf.cli.batch", "Batch", "do all this for many captures"),
    "export": Verb("climatenerf.cli.export", "Export", "write poses for other programs"),
    "demo": Verb("climatenerf.cli.demo", "Demo", "fit and render the embedded street"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Whatever goes wrong, standard error ends with one sentence. `CLIMATENERF_DEBUG=1` shows the
    traceback before it.

    Args:
        arguments: words after the program's name; None takes those of this process.

    Returns:
        Exit status: 0; 1 after an error of the program itself; 2 after an error that the user can
        correct; 130 after Ctrl-C; 143 after `kill`; 129 after the terminal is closed.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    streams.open_all()
    received: list[int] = []
    try:
        try:
            with stopped_like_ctrl_c(received), _without_warnings():
                return _run(words)
        finally:
            streams.flush_output()
    except (KeyboardInterrupt, Exception) as error:
        try:
            if os.environ.get("CLIMATENERF_DEBUG"):
                streams.complain("".join(traceback.format_exception(error)))
            status, sentence = outcome(error, received)
            streams.complain(sentence)
        except KeyboardInterrupt as again:  # a second signal
            status = outcome(again)[0]
        _forget_interruption()
        return status


def _forget_interruption() -> None:
    """Let Python end with the status of `main` after an interruption within `exec`.

    CPython notes that a KeyboardInterrupt left code that was executed from text, such as that of
    every dataclass of an import, and at its end kills itself with SIGINT. Executing another text
    clears the note.
    """
    exec("")


def outcome(error: BaseException, received: Sequence[int] = ()) -> tuple[int, str]:
    """Return the exit status and the line on standard error for what ended a verb.

    Args:
        error: what ended it.
        received: numbers of the signals that stopped it before.
    """
    if isinstance(error, KeyboardInterrupt):
        number = error.args[0] if error.args else signal.SIGINT
        return 128 + number, "\nclimatenerf: interrupted\n"
    if isinstance(error, UserError):
        return _sentence(str(error))
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):  # NumPy; torch
        return _sentence(
            "the memory is not enough for this; use --downscale for a fit, a smaller --size for"
            " a render, or a machine with more memory"
        )
    if isinstance(error, BrokenPipeError):
        return _sentence("a program that takes or gives data has ended early; run it again")
    if isinstance(error, OSError):
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            where = f" while writing {error.filename}" if error.filename else ""
            return _sentence(f"the disk is full{where}; free some space and run it again")
        if error.errno is not None and error.filename is not None:
            return _sentence(str(explain(error, Path(os.fsdecode(error.filename)))))
        if error.errno is not None:
            return _sentence(f"the system refused a read or write ({error}); check the disk")
    if isinstance(error, UnicodeError):
        return _sentence(
            f"a name or a text is not UTF-8 ({error}); rename the file, or convert the text"
        )
    if received:  # code that is not Python's may raise another exception for the interruption
        return 128 + received[-1], one_line(f"climatenerf: interrupted ({_place(error)})") + "\n"
    return 1, one_line(
        f"climatenerf: internal error in version {climatenerf.__version__}: {_place(error)};"
        " please report it with this line, and with what CLIMATENERF_DEBUG=1 shows"
    ) + "\n"


def _sentence(message: str) -> tuple[int, str]:
    return 2, one_line(f"climatenerf: {message}") + "\n"


def _place(error: BaseException) -> str:
    """Return type and message of an error, and the innermost line of this program it came from."""
    frames = traceback.extract_tb(error.__traceback__)
    root = str(Path(climatenerf.__file__).parent)
    own = [frame for frame in frames if frame.filename.startswith(root)] or frames
    where = f" at {Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
    return f"{type(error).__name__}{where} ({one_line(str(error), 300)})"


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Hide warnings of libraries, which name lines of code; `python -W` and debugging show them."""
    with warnings.catch_warnings():
        if not sys.warnoptions and not os.environ.get("CLIMATENERF_DEBUG"):
            warnings.simplefilter("ignore")
        yield


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        streams.write_output(usage())
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        streams.write_output(f"climatenerf {climatenerf.__version__}\n")
        return 0
    name = words[0]
    if name not in VERBS:
        near = difflib.get_close_matches(name, VERBS, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}?" if near else f"use one of {', '.join(VERBS)}."
        raise UserError(f"there is no verb {name!r}; {hint}")
    _check_out(words[1:])
    try:
        os.getcwd()
    except OSError as error:
        raise UserError(
            "the folder in which this runs no longer exists; change to another one (cd) and run it"
            " again"
        ) from error
    for variable, value in THREADING.items():
        os.environ.setdefault(variable, value)
    from climatenerf.cli.flags import parse_flags

    verb = VERBS[name]
    module = importlib.import_module(verb.module)
    kind = getattr(module, verb.options)
    if name == "render":  # its flags depend on the installed weather effects
        kind = module.options_class()
    options = parse_flags(kind, f"climatenerf {name}", words[1:])
    if name == "render":  # given flags override a weather file
        return module.run(options, words[1:]) or 0
    return module.run(options) or 0


def _check_out(words: Sequence[str]) -> None:
    """Refuse an empty path, such as `-o "$OUT"` without OUT: it would be parsed as "."."""
    for before, word in itertools.pairwise(["", *words]):
        if not word.strip() and not before.startswith("-"):
            raise UserError("a path is empty; name it, or give . for the working folder")
    for flag, value in itertools.pairwise([*words, "-"]):
        empty = flag in ("-o", "--out") and not value.strip()
        if empty or flag.strip() in ("-o=", "--out="):
            raise UserError(
                "-o is empty; name the folder to write into, or give . for the working folder"
            )


def usage() -> str:
    """Return the help text that lists the verbs."""
    lines = [f"  {name:<8} {verb.summary}" for name, verb in VERBS.items()]
    return "\n".join(
        [
            "usage: climatenerf VERB [options]",
            "",
            "Render a real place from photos in physically based smog, flood and snow.",
            "",
            *lines,
            "",
            "  climatenerf VERB --help   options of a verb",
            "  climatenerf --version     version",
            "",
        ]
    )
