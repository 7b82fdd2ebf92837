"""ClimateGAN and UVQ as processes in fake checkouts, and folders of frames."""

import ast
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.compared_frames import make_material
from support.fake_checkouts import make_climategan, make_uvq

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.studies.compare.climategan import climategan_methods
from climatenerf.studies.compare.folder import frame_folders
from climatenerf.studies.compare.pictures import grey, pasted, resized, working_size
from climatenerf.studies.compare.program import run_program
from climatenerf.studies.compare.settings import ClimateGanSettings, UvqSettings
from climatenerf.studies.compare.uvq import uvq

ROOT = Path(climatenerf.__file__).parent


@pytest.fixture(scope="module")
def materials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    return {effect: make_material(folder / effect, effect) for effect in ("smog", "flood", "snow")}


@pytest.fixture
def gans(tmp_path):
    checkout, weights = make_climategan(tmp_path)
    return climategan_methods(ClimateGanSettings(checkout, weights))


def test_climategan_runs_in_its_checkout_and_its_events_are_read(gans, materials, tmp_path):
    plain, _ = gans
    assert plain.name == "climategan" and "GPL-3.0" in plain.licence and plain.kind == "model"
    shown = [effect for effect, material in materials.items() if plain.shows(material)]
    assert shown == ["smog", "flood"]
    for effect, gain in (("smog", 0.75), ("flood", 0.5)):
        pictures = list(plain.pictures(materials[effect], [0, 2], tmp_path))
        for index, picture in zip((0, 2), pictures, strict=True):
            clean = materials[effect].clean.picture(index)
            assert picture.shape == clean.shape
            assert np.abs(picture - gain * clean.astype(float)).mean() < 3
    # The smaller side is 640 and both are multiples of 128, which its own rule of sizes keeps.
    assert "sizes 896 640" in (tmp_path / "log.txt").read_text()


def test_climategan_plus_paints_our_mask_with_one_seed(gans, materials, tmp_path):
    _, plus = gans
    assert plus.name == "climategan++"
    shown = [effect for effect, material in materials.items() if plus.shows(material)]
    assert shown == ["flood"]
    flood = materials["flood"]
    pictures = list(plus.pictures(flood, [0, 1, 2], tmp_path))
    blues = set()
    for index, picture in enumerate(pictures):
        clean, mask = flood.clean.picture(index), flood.mask(index)
        np.testing.assert_array_equal(picture[mask == 0], clean[mask == 0])
        inner = np.zeros_like(mask, bool)
        inner[2:-2, 2:-2] = True
        rows = np.flatnonzero(mask.any(1) & inner.any(1))[3:-4]
        water = picture[rows, 20:40]
        assert (water[..., 0] > 250).all() and (water[..., 1] < 5).all()
        blues.update(np.unique(water[..., 2]).tolist())
    assert max(blues) - min(blues) <= 1  # the painter's noise is that of one seed


def test_a_program_that_fails_is_named_with_its_log(gans, materials, tmp_path):
    plain, plus = gans
    (plain.checkout / "apply_events.py").write_text("raise SystemError('no card found')")
    with pytest.raises(UserError, match=r"climategan failed \(SystemError: no card found\); see"):
        list(plain.pictures(materials["flood"], [0], tmp_path))
    assert "no card found" in (tmp_path / "log.txt").read_text()
    (plain.checkout / "apply_events.py").write_text("print('done')")
    with pytest.raises(UserError, match="ended without a picture of frame 0001"):
        list(plain.pictures(materials["flood"], [1], tmp_path))
    (plain.checkout / "climategan" / "trainer.py").write_text("import absent_package_x")
    with pytest.raises(UserError, match="absent_package_x"):
        list(plus.pictures(materials["flood"], [0], tmp_path))


def test_a_program_that_asks_ends_and_an_absent_python_is_named(tmp_path):
    with pytest.raises(UserError, match="EOFError"):
        run_program([sys.executable, "-c", "input()"], tmp_path, tmp_path / "log.txt", "it")
    with pytest.raises(UserError, match="it does not start"):
        run_program([tmp_path / "python"], tmp_path, tmp_path / "log.txt", "it")
    with pytest.raises(UserError, match="exit status 3"):
        command = [sys.executable, "-c", "raise SystemExit(3)"]
        run_program(command, tmp_path, tmp_path / "log.txt", "it")


def test_a_program_ends_with_an_interruption(tmp_path, monkeypatch):
    import subprocess

    wait = subprocess.Popen.wait
    calls = []

    def interrupted(self, timeout=None):
        calls.append(self)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return wait(self, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        command = [sys.executable, "-c", "import time; time.sleep(60)"]
        run_program(command, tmp_path, tmp_path / "log.txt", "it")
    assert calls[0].returncode == -9 and time.monotonic() - start < 50


def test_wrong_checkouts_and_weights_are_refused(tmp_path):
    checkout, weights = make_climategan(tmp_path)
    assert climategan_methods(ClimateGanSettings()) == ()
    with pytest.raises(UserError, match="no checkout of ClimateGAN"):
        climategan_methods(ClimateGanSettings(tmp_path, weights))
    with pytest.raises(UserError, match=r"--climategan\.weights"):
        climategan_methods(ClimateGanSettings(checkout))
    (weights / "opts.yaml").unlink()
    with pytest.raises(UserError, match=r"no opts\.yaml"):
        climategan_methods(ClimateGanSettings(checkout, weights))
    with pytest.raises(UserError, match="no checkout of UVQ"):
        uvq(UvqSettings(checkout))


def test_other_weights_are_another_identity(gans, materials):
    plain, plus = gans
    before = plain.identity(materials["flood"])
    assert plus.identity(materials["flood"]) == before
    (plain.weights / "checkpoints" / "latest_ckpt.pth").write_bytes(b"other")
    assert plain.identity(materials["flood"]) != before


@pytest.mark.parametrize(("version", "score"), [("1.0", 3.25), ("1.5", 4.5)])
def test_uvq_scores_a_movie_once(tmp_path, version, score):
    judge = uvq(UvqSettings(make_uvq(tmp_path), version))
    movie, work = tmp_path / "movie.mp4", tmp_path / "work"
    movie.write_bytes(b"a movie")
    for _ in range(2):
        assert judge.score(movie, work) == score
    calls = judge.checkout / "calls.txt"
    assert calls.read_text().splitlines() == [str(movie)]
    movie.write_bytes(b"another movie")
    assert judge.score(movie, work) == score and len(calls.read_text().splitlines()) == 2


def test_uvq_without_a_score_is_an_error(tmp_path):
    judge = uvq(UvqSettings(make_uvq(tmp_path)))
    movie = tmp_path / "movie.mp4"
    movie.write_bytes(b"a movie")
    (judge.checkout / "uvq_inference.py").write_text("print('no duration, skipping')")
    with pytest.raises(UserError, match="needs ffmpeg and ffprobe"):
        judge.score(movie, tmp_path)
    script = "import sys; open(sys.argv[-1], 'w').write('{\"content\": 1}')"
    (judge.checkout / "uvq_inference.py").write_text(script)
    with pytest.raises(UserError, match="compression_content_distortion"):
        judge.score(movie, tmp_path)


def write_frames(folder, count, size, suffix=".png"):
    folder.mkdir(parents=True)
    for index in range(count):
        colour = (40 * index, 100, 200)
        Image.new("RGB", size, colour).save(folder / f"{index:04d}{suffix}")


def test_frames_of_another_program_are_read_in_our_size(tmp_path, materials):
    write_frames(tmp_path / "arf" / "flood", 3, (128, 96))
    (method,) = frame_folders([f"arf={tmp_path / 'arf'}"])
    assert method.kind == "folder" and method.shows(materials["flood"])
    assert not method.shows(materials["snow"])
    pictures = list(method.pictures(materials["flood"], [0, 2], tmp_path))
    assert [p[0, 0].tolist() for p in pictures] == [[0, 100, 200], [80, 100, 200]]
    assert pictures[0].shape == (48, 64, 3)
    before = method.identity(materials["flood"])
    Image.new("RGB", (128, 96)).save(tmp_path / "arf" / "flood" / "0001.png")
    assert method.identity(materials["flood"]) != before


def test_wrong_folders_of_frames_are_refused(tmp_path, materials):
    with pytest.raises(UserError, match="must be NAME=PATH"):
        frame_folders(["arf"])
    with pytest.raises(UserError, match="has no folder smog, flood or snow"):
        frame_folders([f"arf={tmp_path}"])
    with pytest.raises(UserError, match="cannot be named"):
        frame_folders([f"../up={tmp_path}"])
    write_frames(tmp_path / "few" / "flood", 2, (64, 48), ".jpg")
    (few,) = frame_folders([f"few={tmp_path / 'few'}"])
    with pytest.raises(UserError, match=r"0002\.png is missing: few needs 3 frames"):
        list(few.pictures(materials["flood"], [0], tmp_path))
    write_frames(tmp_path / "cut" / "flood", 3, (64, 64))
    (cut,) = frame_folders([f"cut={tmp_path / 'cut'}"])
    with pytest.raises(UserError, match="another shape than our frames of 64x48"):
        list(cut.pictures(materials["flood"], [0], tmp_path))


def test_sizes_masks_and_pasting():
    assert working_size((480, 270), 640, 128) == (1152, 640)
    assert working_size((64, 48), 512, 16) == (688, 512)
    assert working_size((2000, 1000), 512, 16) == (2000, 992)
    assert working_size((20, 2000), 16, 128) == (128, 2048)
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 4, 5, 3), dtype=np.uint8)
    mask = np.zeros((4, 5))
    mask[1], mask[2] = 1, 0.25
    mixed = pasted(a, b, mask)
    np.testing.assert_array_equal(mixed[[0, 3]], a[[0, 3]])
    np.testing.assert_array_equal(mixed[1], b[1])
    expected = 0.75 * a[2].astype(float) + 0.25 * b[2]
    assert np.abs(mixed[2] - expected).max() <= 0.5
    assert grey(mask, (5, 4)).tolist()[2] == [64] * 5
    assert resized(a, (5, 4)) is a and resized(a, (10, 8)).shape == (8, 10, 3)


def test_no_module_imports_another_project_when_it_is_loaded():
    """GPL code is never imported; diffusers only inside the function that loads a pipeline."""
    for path in sorted(ROOT.rglob("*.py")):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not any(name.split(".")[0] == "climategan" for name in names), path
        top = [n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)]
        assert not any("diffusers" in ast.unparse(node) for node in top), path
    assert "climategan" not in sys.modules
