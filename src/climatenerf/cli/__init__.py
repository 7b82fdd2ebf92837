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
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import climatenerf
from climatenerf.core.errors import UserError

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
    "check": Verb("climatenerf.cli.check", "Check", "hold a capture against itself"),
    "fit": Verb("climatenerf.cli.fit", "Fit", "fit a radiance field to posed photographs"),
    "render": Verb("climatenerf.cli.render", "Render", "render a fitted place in any weather"),
    "evaluate": Verb("climatenerf.cli.evaluate", "Evaluate", "measure a run against ground truth"),
    "export": Verb("climatenerf.cli.export", "Export", "write poses for other programs"),
    "demo": Verb("climatenerf.cli.demo", "Demo", "fit and render the embedded street"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after the program's name; None takes those of this process.

    Returns:
        Exit status: 0; 2 after an error that the user can correct; 130 after Ctrl-C; 143 after
        `kill`; 129 after the terminal is closed.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _stopped_like_ctrl_c():
            status = _run(words)
        sys.stdout.flush()  # here, so that a closed pipe is handled below
        return status
    except UserError as error:
        return _complain(str(error))
    except KeyboardInterrupt as stop:
        with contextlib.suppress(OSError):  # the terminal may be closed
            sys.stderr.write("\nclimatenerf: interrupted\n")
        return 128 + (stop.args[0] if stop.args else signal.SIGINT)
    except BrokenPipeError:
        # The reader (`| head`) has exited. Redirecting prevents a second error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            where = f" while writing {error.filename}" if error.filename else ""
            return _complain(f"the disk is full{where}; free some space and run it again")
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS) and error.filename:
            return _complain(f"{error.filename} may not be read or written; change its permissions")
        raise


@contextlib.contextmanager
def _stopped_like_ctrl_c() -> Iterator[None]:
    """Let `kill` and a closed terminal end a verb as Ctrl-C does: with clean-up and a message."""
    replaced = []
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):  # Windows lacks the second
            number = getattr(signal, name, None)
            # Ignored signals (nohup) and foreign handlers stay as they are.
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, _stop)
                replaced.append(number)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, signal.SIG_DFL)


def _stop(number: int, frame: object) -> None:
    raise KeyboardInterrupt(number)


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        sys.stdout.write(f"climatenerf {climatenerf.__version__}\n")
        return 0
    name = words[0]
    if name not in VERBS:
        near = difflib.get_close_matches(name, VERBS, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}?" if near else f"use one of {', '.join(VERBS)}."
        raise UserError(f"there is no verb {name!r}; {hint}")
    _check_out(words[1:])
    for variable, value in THREADING.items():
        os.environ.setdefault(variable, value)
    import tyro

    verb = VERBS[name]
    module = importlib.import_module(verb.module)
    kind = getattr(module, verb.options)
    if name == "render":  # its flags depend on the installed weather effects
        kind = module.options_class()
    # tyro prints help and errors itself, and raises SystemExit with status 0 or 2.
    options = tyro.cli(kind, prog=f"climatenerf {name}", args=words[1:])
    if name == "render":  # given flags override a weather file
        return module.run(options, words[1:]) or 0
    return module.run(options) or 0


def _check_out(words: Sequence[str]) -> None:
    """Refuse an empty output folder, such as `-o "$OUT"` without OUT: it would be parsed as "."."""
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


def _complain(message: str) -> int:
    sys.stderr.write(f"climatenerf: {message}\n")
    return 2
