import errno
import os
import pty
import signal
import subprocess
import sys
import time
import types
from dataclasses import dataclass

import pytest

import climatenerf
from climatenerf import cli
from climatenerf.core.errors import UserError


@dataclass
class Options:
    """Options of a test verb."""

    scene: str
    minutes: float = 5.0


@pytest.fixture
def verb(monkeypatch):
    """Replace ``fit`` by a verb whose ``run`` each test sets."""
    module = types.ModuleType("a_verb_for_tests")
    module.Options = Options  # type: ignore[attr-defined]
    module.run = lambda options: None  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(cli.VERBS, "fit", cli.Verb(module.__name__, "Options", "test"))
    for name in cli.THREADING:
        monkeypatch.delenv(name, raising=False)
    return module


def program(*args):
    return subprocess.run(
        [sys.executable, "-m", "climatenerf", *args], capture_output=True, text=True, timeout=60
    )


def test_help_lists_every_verb_and_does_not_import_torch():
    done = program("--help")
    assert done.returncode == 0 and done.stderr == ""
    for name, verb in cli.VERBS.items():
        assert f"{name} " in done.stdout and verb.summary in done.stdout
    code = "import sys, climatenerf.cli as c; c.main(['--help']); c.main(['--version']);"
    code += "heavy = {'torch', 'numba', 'numpy', 'tyro', 'rich', 'PIL'} & set(sys.modules);"
    code += "sys.exit(f'imported: {heavy}' if heavy else 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"climatenerf {climatenerf.__version__}\n" in done.stdout


@pytest.mark.parametrize("verb", cli.VERBS)
@pytest.mark.parametrize("args", [("-o", ""), ("--out", " "), ("--out=",), ("-o", "", "--seed")])
def test_an_empty_output_folder_is_refused(tmp_path, monkeypatch, capsys, verb, args):
    monkeypatch.chdir(tmp_path)
    assert cli.main([verb, *(() if verb == "demo" else ("in",)), *args]) == 2
    err = capsys.readouterr().err
    assert err == (
        "climatenerf: -o is empty; name the folder to write into, or give . for the working"
        " folder\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_closed_pipe_is_no_error():
    args = [sys.executable, "-m", "climatenerf", "--help"]
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    pipe = subprocess.PIPE
    process = subprocess.Popen(args, stdout=pipe, stderr=pipe, env=buffered)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=60) == 0


def test_missing_and_unknown_verbs_are_refused(capsys):
    assert cli.main([]) == 2
    assert "usage:" in capsys.readouterr().out
    assert cli.main(["rendr"]) == 2
    error_message = "climatenerf: there is no verb 'rendr'; did you mean render?\n"
    assert capsys.readouterr().err == error_message
    assert cli.main(["xyzzy"]) == 2
    assert (
        "use one of capture, check, fit, stylize, render, view, page, report, evaluate, compare,"
        " verify, study, batch, export, demo" in capsys.readouterr().err
    )


def test_a_verb_receives_its_options_and_the_threading_defaults(verb, monkeypatch):
    seen = []
    verb.run = lambda options: seen.append((options, os.environ["NUMBA_THREADING_LAYER_PRIORITY"]))
    assert cli.main(["fit", "--scene", "a", "--minutes", "2"]) == 0
    assert seen == [(Options("a", 2.0), "omp tbb workqueue")]
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    cli.main(["fit", "--scene", "a"])
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE", "the user's own choice stays"
    for name in cli.THREADING:
        monkeypatch.setenv(name, "")  # so that monkeypatch removes them again


def failing(error):
    def run(options):
        raise error

    return run


@pytest.mark.parametrize(
    "error, status, message",
    [
        (UserError("no photographs in /x; give another folder"), 2, "climatenerf: no photographs"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(errno.ENOSPC, "No space", "/x/a.png"), 2, "disk is full while writing /x/a.png"),
        (OSError(errno.EIO, "broken"), 2, "the system refused a read or write"),
        (OSError(errno.ENAMETOOLONG, "long", "/x/n"), 2, "longer than the disk allows"),
        (PermissionError(errno.EACCES, "no", "/x/n"), 2, "no permission for /x/n"),
        (MemoryError(), 2, "the memory is not enough"),
        (RuntimeError("[enforce fail] can't allocate memory: 9\nx"), 2, "the memory is not enough"),
        (RecursionError("maximum depth"), 1, "internal error"),
        (UnicodeEncodeError("utf-8", "\udce9", 0, 1, "surrogates"), 2, "is not UTF-8"),
        (BrokenPipeError(errno.EPIPE, "pipe"), 2, "ended early"),
        (UserError("a name\n with \x1b[2J in it; rename it"), 2, r"a name with \x1b[2J in it"),
    ],
)
def test_expected_failures_are_one_line(verb, capsys, error, status, message):
    verb.run = failing(error)
    assert cli.main(["fit", "--scene", "a"]) == status
    err = capsys.readouterr().err
    assert message in err and len(err.strip().splitlines()) == 1 and "Traceback" not in err


IN_A_TERMINAL = """
import signal, sys, time, types
from dataclasses import dataclass
from climatenerf import cli
from climatenerf.cli.progress import Bar
@dataclass
class Options:
    pass
def run(options):
    with Bar("work", 1.0) as bar:
        bar.update(0.5)
        time.sleep(0.5)
        print("READY", flush=True)
        time.sleep(60)
# The parent process may ignore these signals.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
module = types.ModuleType("a_verb")
module.Options, module.run = Options, run
sys.modules["a_verb"] = module
cli.VERBS["fit"] = cli.Verb("a_verb", "Options", "test")
sys.exit(cli.main(["fit"]))
"""


def stopped_in_a_terminal(how):
    """Return the terminal output of a verb that a signal ends, and its exit status."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL],
        stdout=theirs, stderr=theirs, env={**os.environ, "TERM": "xterm"},
    )  # fmt: skip
    os.close(theirs)
    output = b""
    while True:
        try:
            more = os.read(ours, 4096)
        except OSError:  # Linux: the other side is closed
            break
        if b"READY" in more and b"READY" not in output:
            process.send_signal(how)
        output += more
        if not more:
            break
    os.close(ours)
    return output.decode(), process.wait(timeout=60)


@pytest.mark.parametrize(
    ("how", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_restores_the_terminal(how, status):
    output, exit_status = stopped_in_a_terminal(how)
    assert exit_status == status and "Traceback" not in output
    assert "climatenerf: interrupted" in output
    assert "\x1b[?25l" in output, "the bar hides the cursor"
    assert output.rfind("\x1b[?25h") > output.rfind("\x1b[?25l"), "and it comes back"


def test_signal_handlers_are_restored_and_ignored_signals_stay_ignored(verb):
    seen = []
    verb.run = lambda options: seen.append([signal.getsignal(n) for n in numbers])
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(signal.SIGTERM, signal.SIG_DFL)]
    before.append(signal.signal(signal.SIGHUP, signal.SIG_IGN))
    try:
        assert cli.main(["fit", "--scene", "a"]) == 0
        assert callable(seen[0][0]) and seen[0][1] is signal.SIG_IGN
        assert [signal.getsignal(n) for n in numbers] == [signal.SIG_DFL, signal.SIG_IGN]
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_unexpected_exceptions_are_one_line_to_report(verb, capsys, monkeypatch):
    verb.run = failing(ZeroDivisionError("so\nit goes"))
    assert cli.main(["fit", "--scene", "a"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("climatenerf: internal error") and "ZeroDivisionError at" in err
    assert "(so it goes)" in err and "please report" in err and err.count("\n") == 1
    monkeypatch.setenv("CLIMATENERF_DEBUG", "1")
    assert cli.main(["fit", "--scene", "a"]) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err and err.splitlines()[-1].startswith("climatenerf: internal error")


def test_an_exception_that_follows_a_signal_is_the_interruption(verb, capsys):
    """Some libraries report a signal by their own exception."""

    def run(options):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        except KeyboardInterrupt:
            raise SystemError("a call returned a result with an exception set") from None

    verb.run = run
    assert cli.main(["fit", "--scene", "a"]) == 143
    err = capsys.readouterr().err
    assert err.startswith("climatenerf: interrupted (SystemError") and err.count("\n") == 1


def test_a_signal_within_a_finaliser_ends_the_verb(verb, capsys):
    """Python drops exceptions that leave finalisers and callbacks, such as those of imports."""

    class Dying:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)
            sum(range(1000))

    def run(options):
        del_me = Dying()
        del del_me
        time.sleep(5)
        return 0

    verb.run = run
    hook, start = sys.unraisablehook, time.monotonic()
    assert cli.main(["fit", "--scene", "a"]) == 143
    assert time.monotonic() - start < 4
    assert capsys.readouterr().err == "\nclimatenerf: interrupted\n"
    assert sys.unraisablehook is hook


def test_wrong_options_exit_with_2(verb, capsys):
    assert cli.main(["fit", "--scene", "a", "--minutse", "2"]) == 2
    assert "did you mean --minutes?" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        cli.main(["fit", "--help"])
    assert caught.value.code == 0
    assert "climatenerf fit" in capsys.readouterr().out


def test_status_of_a_verb_is_passed_on(verb):
    verb.run = lambda options: 1
    assert cli.main(["fit", "--scene", "a"]) == 1


@pytest.mark.parametrize("verb", ["fit", "render", "verify", "demo"])
def test_help_of_a_verb_does_not_load_torch(verb):
    code = (
        "import sys; from climatenerf.cli import main\n"
        "try:\n    status = main(sys.argv[1:])\n"
        "except SystemExit as exit_status:\n    status = exit_status.code\n"
        "print('HEAVY', sorted({'torch', 'numba'} & set(sys.modules)), 'STATUS', status)"
    )
    args = [sys.executable, "-c", code, verb, "--help"]
    done = subprocess.run(args, capture_output=True, text=True, timeout=60)
    assert done.stdout.rstrip().endswith("HEAVY [] STATUS 0"), done.stdout + done.stderr
    assert f"climatenerf {verb}" in done.stdout


def test_a_signal_within_executed_text_keeps_its_status(tmp_path):
    """Imports execute text, that of dataclasses; `python -m` then ends with SIGINT by itself."""
    text = "import os, signal; os.kill(os.getpid(), signal.SIGTERM)"
    code = (
        "import sys\nfrom climatenerf import cli\n"
        f"cli._run = lambda words: exec({text!r})\nsys.exit(cli.main([]))\n"
    )
    (tmp_path / "stopped.py").write_text(code)
    words = [sys.executable, "-m", "stopped"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (143, "\nclimatenerf: interrupted\n")
