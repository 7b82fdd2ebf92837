import os
import subprocess
import sys

import pytest
from support.command_line import error_message

from climatenerf.cli import VERBS, main
from climatenerf.cli.flags import names_of

RENDER = ("render", "run", "-o", "out")


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (
            (*RENDER, "--flood.level", "3 kg"),
            '--flood.level must be a length such as "0.5 m"; got "3 kg"; see climatenerf render',
        ),
        ((*RENDER, "--flod.level", "3 m"), "--flod.level, 3 m; did you mean --flood.level?"),
        (("fit",), "missing from climatenerf fit: PATH, -o PATH, --out PATH; see"),
        (("fit", "a", "-o", "b", "--preset", "x"), "invalid choice 'x' for argument '--preset'"),
        (("fit", "a", "-o", "b", "--minutes", "x"), "--minutes must be a number; got 'x'"),
        ((*RENDER, "--layers", "depth", "--layer-format"), "--layer-format names no format"),
        (("export", "a", "-o", "b", "--format"), "--format names no format; give transforms"),
        (("check", ""), "a path is empty; name it"),
        ((*RENDER, "--size"), "missing value for argument '--size'"),
    ],
)  # fmt: skip
def test_a_wrong_flag_is_one_sentence_with_status_2(args, expected, capsys):
    found = error_message(capsys, *args)
    assert expected in found and "None" not in found
    assert "\n" not in found


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_no_words_of_the_parser(verb, capsys):
    with pytest.raises(SystemExit) as end:
        main([verb, "--help"])
    found = capsys.readouterr().out
    assert end.value.code in (0, None) and f"climatenerf {verb}" in found
    for on_by_default in ("complete-ground", "truth", "objects"):
        found = found.replace(f"--no-{on_by_default}", "")
    assert "None" not in found and "--no-" not in found


def test_boxes_of_utf_8_and_of_ascii_give_the_same_sentence():
    args = [sys.executable, "-m", "climatenerf", "fit", "a", "--preset", "x"]
    for encoding in ("utf-8", "ascii"):
        environment = {**os.environ, "PYTHONIOENCODING": encoding}
        done = subprocess.run(args, capture_output=True, text=True, env=environment)
        assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
        assert done.stderr.startswith("climatenerf: invalid choice 'x'")


def test_help_into_a_pipe_that_closes_is_silent():
    command = f"{sys.executable} -m climatenerf render --help | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stdout.startswith("usage:") and done.stderr == ""


def test_names_may_have_commas_or_spaces_between():
    assert names_of("depth,normal", "label", " a , ,b") == ("depth", "normal", "label", "a", "b")
    assert names_of() == ()
