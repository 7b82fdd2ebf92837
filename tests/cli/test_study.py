"""`climatenerf study`: what it prints and writes, and what it refuses."""

import csv
import json

import pytest
from support.command_line import error_message, run_cli
from support.compare_folders import METHODS, write_compare_folder
from support.processes import holder

from climatenerf.cli.study import aligned, p_text
from climatenerf.studies.user_study.votes import COLUMNS


@pytest.fixture
def compared(tmp_path):
    return write_compare_folder(tmp_path / "ditch", effects=("flood",), views=2)


@pytest.fixture
def study(compared, tmp_path):
    assert run_cli("study", "make", compared, "-o", tmp_path / "study") == 0
    return tmp_path / "study"


def write_votes(study, path, participants, prefers_ours):
    """Write votes on all pairs; `prefers_ours` decides by participant and pair."""
    key = json.loads((study / "key.json").read_text())
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for participant in participants:
            for order, pair in enumerate(key["pairs"], start=1):
                sides = [pair["first"], pair["second"]][:: 1 if participant % 2 else -1]
                ours = pair["catch"] or prefers_ours(participant, pair)
                choice = ("left", "right")[sides.index(pair["first" if ours else "second"])]
                about = [pair["kind"], pair["effect"], pair["scene"]]
                writer.writerow([key["study"], participant, order, pair["id"], *about, *sides,
                                 choice, 1200, 0, int(pair["catch"])])  # fmt: skip
    return path


def test_make_prints_what_the_size_can_show(compared, tmp_path, capsys):
    assert run_cli("study", "make", compared, "-o", tmp_path / "out") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"page for participants: {tmp_path / 'out' / 'index.html'}"
    assert lines[1] == f"key, for you alone: {tmp_path / 'out' / 'key.json'}"
    assert "8 pairs in 4 comparisons" in "\n".join(lines)
    table = {line.split()[0]: line.split()[1:3] for line in lines if "%  " in line}
    assert table == {  # two votes of each participant for each comparison
        "55%": ["807", "404"], "60%": ["210", "105"], "65%": ["92", "46"], "70%": ["54", "27"],
        "75%": ["35", "18"],
    }  # fmt: skip
    assert lines[-1] == "37 participants, as in the paper, can show a share of 67% or more."


def test_make_warns_of_what_is_left_out(compared, tmp_path, capsys):
    table = json.loads((compared / "compare.json").read_text())
    table["items"].pop()
    (compared / "compare.json").write_text(json.dumps(table))
    assert run_cli("study", "make", compared, "-o", tmp_path / "out") == 0
    # Ours is still paired with the other three, so nothing stands alone.
    assert "counterpart" not in capsys.readouterr().err
    table["items"] = [
        each for each in table["items"] if each["view"] == "0" or each["method"] != METHODS[0]
    ]
    (compared / "compare.json").write_text(json.dumps(table))
    assert run_cli("study", "make", compared, "-o", tmp_path / "out2") == 0
    assert "3 pictures or movies have no counterpart" in capsys.readouterr().err


def test_score_prints_and_writes(study, tmp_path, capsys):
    one = write_votes(study, tmp_path / "one.csv", range(1, 6), lambda p, pair: True)
    two = write_votes(
        study, tmp_path / "two.csv", range(6, 11), lambda p, pair: pair["other"] != METHODS[1]
    )
    out = tmp_path / "report"
    capsys.readouterr()
    assert run_cli("study", "score", one, two, "--key", study / "key.json", "-o", out) == 0
    printed = capsys.readouterr().out
    row = next(line for line in printed.splitlines() if line.startswith("flood   picture  ARF-9"))
    assert " ".join(row.split()[3:]) == "20 100% 83% to 100% 100% to 100% <.0001 <.0001"
    assert "10 participants, 0 of them excluded" in printed and "left side: 42 of 80" in printed
    scores = json.loads((out / "scores.json").read_text())
    assert scores["schema_version"] == 1 and scores["participants"] == 10
    by_other = {each["other"]: each for each in scores["comparisons"]}
    assert by_other[METHODS[1]]["ours"]["share"] == 0.5 and by_other[METHODS[1]]["p"] == 1
    low, high = by_other[METHODS[1]]["interval_of_participants"]
    assert low < 0.25 and high > 0.75, "wider than the exact one: participants differ"
    exact = by_other[METHODS[1]]["ours"]["interval"]
    assert exact == pytest.approx([0.2720, 0.7280], abs=1e-4)
    assert {each["method"] for each in scores["strengths"]} == set(METHODS)
    assert sum(each["log_strength"] for each in scores["strengths"]) == pytest.approx(0, abs=1e-6)
    assert run_cli("study", "score", one, "--key", study / "key.json", "-o", out) == 0
    assert json.loads((out / "scores.json").read_text())["participants"] == 5, "scored again"


def test_the_key_beside_the_votes_is_found(study, tmp_path, capsys):
    votes = write_votes(study, study / "votes.csv", [1], lambda p, pair: True)
    assert run_cli("study", "score", votes) == 0
    away = tmp_path / "votes.csv"
    votes.rename(away)
    assert "give the study's key with --key" in error_message(capsys, "study", "score", away)


def test_wrong_requests_are_one_sentence(study, compared, tmp_path, capsys):
    out = tmp_path / "out"
    assert "expected one of {make, score}" in error_message(capsys, "study")
    assert "missing from climatenerf study make: -o" in error_message(capsys, "study", "make", "x")
    assert "no comparison is given" in error_message(capsys, "study", "make", "-o", out)
    assert "is no folder" in error_message(capsys, "study", "make", tmp_path / "x", "-o", out)
    assert "no votes are given" in error_message(capsys, "study", "score")
    votes = ["study", "make", compared, "-o", out, "--votes"]
    assert "--votes must lie between 1 and 1000" in error_message(capsys, *votes, "0")
    assert "--seed must lie" in error_message(capsys, *votes, "5", "--seed", "-1")
    assert not out.exists()
    key = ["--key", study / "key.json"]
    message = error_message(capsys, "study", "score", study / "index.html", *key)
    assert "does not begin with the columns" in message
    assert "does not exist" in error_message(capsys, "study", "score", tmp_path / "x.csv", *key)


def test_scores_overwrite_nothing_else(study, tmp_path, capsys):
    votes = write_votes(study, tmp_path / "votes.csv", [1], lambda p, pair: True)
    mine = tmp_path / "scores.json"
    mine.write_text('{"mine": 1}')
    call = ["study", "score", votes, "--key", study / "key.json", "-o", tmp_path]
    assert "holds no scores of a study" in error_message(capsys, *call)
    assert mine.read_text() == '{"mine": 1}'


def test_a_study_waits_for_no_other_writer(compared, tmp_path, capsys):
    out = tmp_path / "out"
    with holder(out):
        message = error_message(capsys, "study", "make", compared, "-o", out)
        assert "another process is writing" in message and not (out / "index.html").exists()
    assert run_cli("study", "make", compared, "-o", out) == 0


def test_texts_of_tables():
    assert aligned([("a", "bcd"), ("ef", "g")]) == ["a   bcd", "ef  g"]
    assert [p_text(p) for p in (1.0, 0.0312, 0.00002)] == ["1", "0.031", "<.0001"]
