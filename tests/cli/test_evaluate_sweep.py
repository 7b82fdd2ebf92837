"""`climatenerf evaluate --sweep` on a fitted run, from the command line to the files."""

import json

from support.command_line import error_message, run_cli


def test_a_sweep_of_a_run_writes_its_strip_and_says_its_responses(run_folder, tmp_path, capsys):
    """The paper's smog needs no light of the photos, which takes a while to find."""
    weather, out = tmp_path / "smog.toml", tmp_path / "out"
    weather.write_text('[smog]\nvisibility = "50 m"\nlight = "paper"\n')
    values = "smog.visibility=80 m,20 m,80 m"
    args = ["--weather", weather, "--size", "32x18", "-o", out]
    # The value of --sweep is one word, so that the run may follow it.
    assert run_cli("evaluate", "--sweep", values, run_folder, *args) == 0
    said = capsys.readouterr().out
    assert "smog.visibility: mean_transmittance" in said and "NOT MONOTONE" in said
    assert str(out / "smog.visibility.jpg") in said and (out / "smog.visibility.jpg").exists()
    data = json.loads((out / "sweep.json").read_text())
    assert data["run"] == run_folder.name and data["size"] == [32, 18] and data["truth"] is None
    (sweep,) = data["sweeps"]
    assert sweep["weather"]["smog"]["light"] == "paper" and not sweep["monotone"]
    pictures = [(out / value["picture"]).read_bytes() for value in sweep["values"]]
    assert pictures[0] == pictures[2] != pictures[1]
    refused = error_message(capsys, "evaluate", run_folder, "--sweep", values, "-o", run_folder)
    assert "is the folder of a run" in refused
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "field.safetensors").touch()
    other = tmp_path / "other"
    refused = error_message(capsys, "evaluate", run_folder, "--sweep", values, "-o", other)
    assert "is the folder of a run" in refused


def test_the_rows_of_the_paper_have_weathers_of_their_own(tmp_path, capsys):
    weather = tmp_path / "smog.toml"
    weather.write_text('[smog]\nvisibility = "50 m"\n')
    args = ["evaluate", tmp_path, "--sweep", "paper", "--weather", weather, "-o", tmp_path / "out"]
    assert "leave out --weather" in error_message(capsys, *args)
    assert not (tmp_path / "out").exists()
