"""`climatenerf stylize`: runs in other colours, and season files."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import FEW_ROWS, run_cli

from climatenerf import api
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import settings_of
from climatenerf.weather.season.palettes import palettes_of
from climatenerf.weather.style import style_in

REFERENCE = Path(__file__).parents[2] / "reference" / "street"


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A short fit of a few photos."""
    if not REFERENCE.is_dir():
        pytest.skip("the reference street is not in this checkout")
    folder = tmp_path_factory.mktemp("street") / "run"
    settings = dataclasses.replace(
        settings_of("cpu"),
        steps=250,
        samples_per_step=2**14,
        size=FEW_ROWS,
        multiview_stereo=False,
    )
    scene = api.open_scene(REFERENCE)
    scene = dataclasses.replace(scene, views=scene.of_split("train")[::8])
    fit_scene(scene, folder, settings, 6, False, lambda state: None, lambda done, total: None)
    return folder


@pytest.fixture(scope="module")
def winter(run_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("styled") / "winter"
    assert run_cli("stylize", run_folder, "-o", out, "--season", "winter") == 0
    return out


def render(run, out, *flags):
    size = ("--size", "32x18", "--frames", 2, "--path", "still")
    assert run_cli("render", run, "-o", out, *size, "--layers", "all", *flags) == 0
    picture = np.asarray(Image.open(out / "frames" / "0000.png")).astype(int)
    return picture, {p.name: p.read_bytes() for p in sorted(out.rglob("*.npz"))}


def test_the_field_and_all_layers_stay_and_colours_change(run_folder, winter, tmp_path):
    name = "field.safetensors"
    assert (winter / name).read_bytes() == (run_folder / name).read_bytes()
    clean, layers = render(run_folder, tmp_path / "clean")
    styled, same = render(winter, tmp_path / "styled")
    assert same == layers and len(layers) == 2
    assert abs(styled - clean).max() > 20
    on_the_fly, _ = render(run_folder, tmp_path / "fly", "--season.kind", "winter")
    assert abs(styled - on_the_fly).max() <= 1
    described = json.loads((tmp_path / "styled" / "movie.json").read_text())
    assert described["style"]["name"] == "winter"
    clean_again, _ = render(winter, tmp_path / "none", "--season.strength", 0)
    np.testing.assert_array_equal(clean_again, clean)


def test_strength_patch_and_seed_are_kept(run_folder, winter, tmp_path):
    out = tmp_path / "run"
    flags = ("--season", "winter", "--strength", 0.5, "--patch", "2 m", "--seed", 3)
    assert run_cli("stylize", run_folder, "-o", out, *flags) == 0
    style, whole = style_in(out), style_in(winter)
    assert (style.patch, style.seed, whole.patch, whole.seed) == (2.0, 3, 4.0, 0)
    assert style.classes[0].strength == pytest.approx(0.5 * whole.classes[0].strength)
    assert api.load_run(out).style.name == "winter"


def photos(folder):
    rng = np.random.default_rng(0)
    picture = rng.integers(60, 255, (60, 80, 3)) * [0.9, 0.5, 0.3]
    folder.mkdir(parents=True)
    Image.fromarray(picture.astype(np.uint8)).save(folder / "a.png")
    return folder


def test_style_photos_give_maps_and_their_licence(run_folder, tmp_path, capsys):
    folder = photos(tmp_path / "photos")
    (folder / "LICENSE").write_text("CC BY 4.0, by somebody")
    out = tmp_path / "run"
    assert run_cli("stylize", run_folder, "-o", out, "--style", folder) == 0
    told = capsys.readouterr().err
    assert "CC BY 4.0, by somebody" in told and "no labels" in told
    style = style_in(out)
    assert style.sources[0].file == "a.png" and style.sources[0].licence
    assert not style.classes[0].palette.any() and style.classes[0].matrix.any()


def test_a_text_tells_what_it_did_not_understand(run_folder, tmp_path, capsys):
    out = tmp_path / "run"
    assert run_cli("stylize", run_folder, "-o", out, "--text", "late autumn, cherry trees") == 0
    told = capsys.readouterr().err
    assert 'no rule for "cherry"' in told and "changes vegetation" in told
    style = style_in(out)
    expected = 0.85 * np.array(palettes_of("autumn").vegetation.palette) * 1.1
    np.testing.assert_allclose(style.classes[0].palette, expected, rtol=1e-6)


def test_a_measured_season_file_styles_a_run(run_folder, tmp_path):
    season, folder = tmp_path / "mine.toml", photos(tmp_path / "photos")
    assert run_cli("stylize", "--measure", folder, "-o", season) == 0
    before = season.read_bytes()
    assert run_cli("stylize", "--measure", folder, "-o", season) == 2
    assert season.read_bytes() == before
    assert run_cli("stylize", run_folder, "-o", tmp_path / "run", "--season", season) == 0
    assert style_in(tmp_path / "run").name == "mine"


def test_an_unfinished_copy_is_made_anew_and_foreign_files_stay(run_folder, tmp_path, capsys):
    out = tmp_path / "run"
    (out / ".next").mkdir(parents=True)
    (out / ".next" / "field.safetensors").write_bytes(b"half")
    (out / "style.json").write_text("{}")
    assert run_cli("stylize", run_folder, "-o", out, "--season", "winter") == 0
    assert api.load_run(out).style.name == "winter"
    before = (out / "style.json").read_bytes()
    assert run_cli("stylize", run_folder, "-o", out, "--season", "autumn") == 2
    assert "already holds a run" in capsys.readouterr().err
    assert (out / "style.json").read_bytes() == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "letter.txt").write_text("mine")
    assert run_cli("stylize", run_folder, "-o", other, "--season", "autumn") == 2
    assert sorted(p.name for p in other.iterdir()) == ["letter.txt"]


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ((), "got none"),
        (("--season", "winter", "--text", "autumn"), "--season and --text"),
        (("--season", "spring"), "there is no season"),
        (("--season", "none.toml"), "none.toml"),
        (("--season", "winter", "--strength", "2"), "from 0 to 1"),
        (("--season", "winter", "--strength", "nan"), "from 0 to 1"),
        (("--season", "winter", "--labels", "x"), "belong to --style"),
        (("--style", "nothing.jpg"), "no style photo"),
        (("--text", "cherry"), "no rule for"),
        (("--season", "winter", "--seed", "99999999999999999999"), "--seed must"),
        (("--season", "winter", "--seed", "-1"), "--seed must"),
        (("--season", "winter", "--steps", "9"), "belongs to --method paper"),
        (("--method", "paper"), "--pictures; got none"),
    ],
)
def test_wrong_input_is_one_sentence_and_writes_nothing(run_folder, tmp_path, capsys, flags, named):
    out = tmp_path / "run"
    assert run_cli("stylize", run_folder, "-o", out, *flags) == 2
    told = capsys.readouterr().err
    assert named in told and told.strip().count("\n") == 0
    assert not out.exists()


def test_the_run_itself_and_missing_paths_are_refused(run_folder, tmp_path, capsys):
    assert run_cli("stylize", run_folder, "-o", run_folder, "--season", "winter") == 2
    assert run_cli("stylize", run_folder, "-o", run_folder / "a", "--season", "winter") == 2
    assert not (run_folder / "a").exists() and not (run_folder / "style.json").exists()
    assert run_cli("stylize", "-o", tmp_path / "a", "--season", "winter") == 2
    assert run_cli("stylize", run_folder, "--season", "winter") == 2
    assert run_cli("stylize", tmp_path / "none", "-o", tmp_path / "a", "--season", "winter") == 2
    assert not (tmp_path / "a").exists()
    assert "name with -o" in capsys.readouterr().err


def test_a_style_that_shares_no_class_with_the_scene_is_refused(run_folder, tmp_path, capsys):
    folder, out = photos(tmp_path / "photos"), tmp_path / "run"
    flags = ("--style", folder, "--style-region", "person=0,0,1,1")
    assert run_cli("stylize", run_folder, "-o", out, *flags) == 2
    assert "nothing would change" in capsys.readouterr().err and not out.exists()


@pytest.mark.slow
def test_sweeps_and_comparisons_show_the_style(run_folder, winter, tmp_path, capsys):
    seen = []
    for run in (run_folder, winter):
        out = tmp_path / f"sweep-{run.name}"
        flags = ("--sweep", "smog.visibility=1 km,2 km", "--size", "32x18")
        assert run_cli("evaluate", run, "-o", out, *flags) == 0
        strip = sorted(out.glob("smog.visibility-*.png"))[0]
        seen.append(np.asarray(Image.open(strip)).astype(int))
        out = tmp_path / f"compare-{run.name}"
        flags = ("--effects", "smog", "--frames", 10, "--size", "32x18", "--no-truth")
        assert run_cli("compare", run, "-o", out, *flags) == 0
        frame = sorted((out / "clean" / "frames").glob("*.png"))[0]
        seen.append(np.asarray(Image.open(frame)).astype(int))
    assert abs(seen[2] - seen[0]).max() > 20 and abs(seen[3] - seen[1]).max() > 20
    assert run_cli("evaluate", winter, "--reference", "-o", tmp_path / "report") == 2
    assert "other colours than the truth" in capsys.readouterr().err
