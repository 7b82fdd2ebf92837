"""`stylize --method paper`: shapes and labels stay to the bit, colours learn, and runs resume."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from support.command_line import error_message, run_cli
from support.random_run import VIEWS, opaque_field, random_run, small
from support.wct_weights import save_wct

from climatenerf import load_run
from climatenerf.core.storage import read_safetensors
from climatenerf.field.presets import PRESETS
from climatenerf.field.protocol import observed
from climatenerf.output.job import hash_of_run
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.session import RenderSession
from climatenerf.render.volume import render_view
from climatenerf.styling.paper import fine_tune
from climatenerf.styling.paper.shots import choose_shots, march, matter
from climatenerf.styling.paper.teachers import picture_teacher
from climatenerf.weather.light.captured import COLUMNS, ROWS, CapturedLight
from climatenerf.weather.light.file import load_light, save_light
from climatenerf.weather.light.find_light import find_light
from climatenerf.weather.style import style_in
from climatenerf.weather.weather import Weather

FEW = ("--steps", 30, "--views", 4)


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    """An eighth of the rays of a step: random matter has many samples."""
    monkeypatch.setattr(fine_tune, "RAYS", 512)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return random_run(tmp_path_factory.mktemp("toy"), small("cpu"))


@pytest.fixture(scope="module")
def red(tmp_path_factory):
    """A folder of red pictures, one for each view, in another format than the photos."""
    folder = tmp_path_factory.mktemp("red")
    for index in range(VIEWS):
        Image.new("RGB", (96, 72), (200, 30, 20)).save(folder / f"{index:02d}.jpg")
    return folder


def tensors(run):
    return read_safetensors(run / "field.safetensors")[0]


def paper(run, out, *more):
    return run_cli("stylize", run, "-o", out, "--method", "paper", *FEW, *more)


# --- What stays -----------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize("teacher", ["pictures", "operator"])
def test_only_the_appearance_grid_changes(tmp_path, red, preset, teacher):
    run, out = random_run(tmp_path, small(preset)), tmp_path / "out"
    chosen = ("--pictures", red) if teacher == "pictures" else ("--season", "drought")
    assert paper(run, out, *chosen) == 0
    before, after = tensors(run), tensors(out)
    frozen = {"surface_grid", "surface_resolutions"} if preset == "paper" else set()
    assert before.keys() == after.keys()
    for name in before.keys() - {"appearance_grid"} - frozen:
        assert np.array_equal(before[name], after[name]), name
    assert (before["appearance_grid"] != after["appearance_grid"]).mean() > 0.05
    if preset == "paper":
        assert before["surface_grid"].size == 0
        assert np.array_equal(after["surface_grid"], before["appearance_grid"])
    assert layers_of(run) == layers_of(out)
    assert pictures_of(run) != pictures_of(out)


def layers_of(folder):
    """The bytes of depth, normal and label of three views."""
    run, found = load_run(folder), []
    assert run.field.knows_classes and run.field.knows_normals
    session = RenderSession(run.field, run.scene, Weather(), style=run.style)
    for view in run.scene.views[:3]:
        frame = session.frame(
            run.scene.cameras[0], run.scene.c2w_world(view), layers=("normal", "label")
        )
        assert len(np.unique(frame.layers["label"])) > 2
        assert np.isfinite(frame.layers["depth"]).mean() > 0.3
        found += [frame.layers[name].tobytes() for name in ("depth", "normal", "label")]
    return found


def pictures_of(folder):
    run = load_run(folder)
    return [
        render_view(run.field, run.scene.cameras[0], run.scene.c2w_world(view)).tobytes()
        for view in run.scene.views[:3]
    ]


def test_a_recoloured_twin_of_the_paper_sizes_keeps_its_surface_head():
    field = opaque_field(small("paper"))
    u = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    before, twin = field.surface_raw(u), field.recolourable()
    with torch.no_grad():
        twin.appearance_grid.add_(1.0)
    assert torch.equal(twin.surface_raw(u), before)
    assert torch.equal(field.surface_raw(u), before), "the field itself stays as it is"


def test_light_that_weather_takes_from_the_ground_stays(run, red, tmp_path):
    """Red lawns are no redder light: irradiance and the light of the photos are those of before."""
    out = tmp_path / "out"
    assert paper(run, out, "--pictures", red) == 0
    old, new = load_run(run), load_run(out)
    before = scene_irradiance(old.field, old.scene)
    assert float((scene_irradiance(new.field, new.scene) - before).abs().max()) > 0.02
    assert torch.equal(session_of(new)._irradiance(), before)
    photo = new.field.photo_appearance(0)
    shown = session_of(new, photo)._irradiance()
    torch.testing.assert_close(shown, before, rtol=1e-3, atol=1e-3)  # embeddings of 0: one exposure
    light, made_from = load_light(out / "light.json")
    assert made_from == hash_of_run(out)
    assert light == find_light(old.field, trace_photos(observed(old.field), old.scene), None)


def test_the_light_that_a_run_keeps_is_taken_along(red, tmp_path):
    run, out = random_run(tmp_path, small("cpu")), tmp_path / "out"
    shown = np.ones((ROWS, COLUMNS))
    sky = CapturedLight(np.full(3, 0.25), np.full(3, 0.75), None, 0.0, np.zeros(3), shown, 0.0)
    save_light(run / "light.json", sky, hash_of_run(run))
    assert paper(run, out, "--pictures", red) == 0
    light, made_from = load_light(out / "light.json")
    assert made_from == hash_of_run(out)
    assert light.horizon.tolist() == [0.25] * 3 and light.zenith.tolist() == [0.75] * 3


def session_of(run, appearance=None):
    return RenderSession(run.field, run.scene, Weather(), style=run.style, appearance=appearance)


# --- What is learned ------------------------------------------------------------------------------


def test_colours_approach_the_pictures(run, red, tmp_path, capsys):
    assert paper(run, tmp_path / "out", "--pictures", red) == 0
    err = capsys.readouterr().err
    assert "training views:" in err and "other views:" in err
    old, new = load_run(run), load_run(tmp_path / "out")
    view = old.scene.views[1]
    picture = [
        render_view(each.field, old.scene.cameras[0], old.scene.c2w_world(view))
        for each in (old, new)
    ]
    opaque = march(old.field, *shot_rays(old)).transmittance < 0.2
    shown = [p.reshape(-1, 3)[opaque.numpy()].mean(0) for p in picture]
    redness = [s[0] - s[1:].mean() for s in shown]
    assert redness[1] > redness[0] + 0.15
    record = new.style.fine_tuned
    assert (record.teacher, record.steps, record.views, record.width) == ("pictures", 30, 4, 48)
    assert record.psnr[1] > record.psnr[0] + 3
    assert new.style.classes == ()


def shot_rays(run):
    shot = choose_shots(run.scene, 6, 480, 0)[1]
    return shot.rays(torch.device("cpu"))


def test_the_baked_season_looks_as_the_operator(run, tmp_path):
    assert run_cli("stylize", run, "-o", tmp_path / "plain", "--season", "drought") == 0
    shortened = ("--steps", 120, "--views", 6)
    baking = ("--bake", "--season", "drought", *shortened)
    assert run_cli("stylize", run, "-o", tmp_path / "baked", *baking) == 0
    clean, operator, baked = (frame(f) for f in (run, tmp_path / "plain", tmp_path / "baked"))
    assert np.abs(operator - clean).mean() > 0.02
    assert ((baked - operator) ** 2).mean() < 0.4 * ((clean - operator) ** 2).mean()
    assert style_in(tmp_path / "baked").sky == style_in(tmp_path / "plain").sky


def frame(folder):
    """The first view as `render` shows it, with the style of the run."""
    run = load_run(folder)
    session = RenderSession(run.field, run.scene, Weather(), style=run.style)
    pose = run.scene.c2w_world(run.scene.views[0])
    return session.frame(run.scene.cameras[0], pose).picture.astype(float) / 255


def test_cached_rays_show_what_a_render_shows(run):
    loaded = load_run(run)
    shot = choose_shots(loaded.scene, 6, 480, 0)[1]
    assert len(shot.pixels) == 48 * 36
    rays = march(loaded.field, *shot.rays(torch.device("cpu")))
    linear = matter(loaded.field, rays) + rays.behind
    picture = fine_tune.encode_srgb(linear).clamp(0, 1).reshape(36, 48, 3).numpy()
    assert np.array_equal(picture, render_view(loaded.field, shot.camera, shot.c2w))
    some = torch.tensor([900, 3, 3, 1700])
    found, whole = matter(loaded.field, rays.rows(some)), linear[some] - rays.behind[some]
    torch.testing.assert_close(found, whole, rtol=1e-4, atol=1e-6)


def test_a_field_that_teaches_itself_has_nothing_to_learn(run):
    """Also where a part of the sky is behind the matter; rays that show mostly sky are left."""
    field = load_run(run).field
    rays = march(field, *shot_rays(load_run(run)))
    assert ((rays.transmittance > 0.05) & (rays.transmittance < 0.5)).sum() > 20
    lesson = fine_tune.lesson_of(rays, matter(field, rays))
    assert 0 < len(lesson.rays) < len(rays)
    assert float(lesson.rays.transmittance.max()) < 0.5
    assert fine_tune.psnr(field, lesson) > 90
    assert np.isnan(fine_tune.psnr(field, lesson.none()))


def test_views_are_spread_and_their_pixels_bounded(run, monkeypatch):
    scene = load_run(run).scene
    shots = choose_shots(scene, 3, 24, 5)
    assert [shot.name for shot in shots] == ["00.png", "02.png", "05.png"]
    assert {(shot.camera.width, shot.camera.height) for shot in shots} == {(24, 18)}
    monkeypatch.setattr("climatenerf.styling.paper.shots.MAX_RAYS", 300)
    few = choose_shots(scene, 3, 24, 5)
    assert all(len(np.unique(shot.pixels)) == 100 for shot in few)
    assert np.array_equal(few[1].pixels, choose_shots(scene, 3, 24, 5)[1].pixels)
    assert not np.array_equal(few[1].pixels, choose_shots(scene, 3, 24, 6)[1].pixels)


def test_wct_teaches(run, tmp_path):
    weights, style = save_wct(tmp_path / "weights"), tmp_path / "style.png"
    noise = np.random.default_rng(0).integers(120, 255, (64, 96, 3), dtype=np.uint8)
    Image.fromarray(noise).save(style)
    assert paper(run, tmp_path / "out", "--style", style, "--wct", weights) == 0
    record = style_in(tmp_path / "out")
    assert record.fine_tuned.teacher == "wct"
    assert [source.file for source in record.sources] == ["style.png"]
    assert not np.array_equal(
        tensors(run)["appearance_grid"], tensors(tmp_path / "out")["appearance_grid"]
    )


def test_strength_scales_the_gain_that_pictures_teach(run):
    field = load_run(run).field
    shot = choose_shots(load_run(run).scene, 3, 24, 0)[0]
    clean = matter(field, march(field, *shot.rays(torch.device("cpu"))))

    def darker(shot, picture):
        return 0.5 * picture

    full, half, none = (
        picture_teacher(field, "pictures", "", darker, strength).teach(shot, clean)
        for strength in (1.0, 0.5, 0.0)
    )
    assert torch.equal(none, clean)
    torch.testing.assert_close(half, (full + clean) / 2, rtol=1e-5, atol=1e-6)
    assert float(full.mean()) < 0.6 * float(clean.mean())


def test_a_fit_ends_when_other_views_stop_improving():
    assert not fine_tune.exhausted([20.0, 21.0, 22.0, 23.0, 24.0, 25.0])
    assert fine_tune.exhausted([20.0, 21.0, 21.0, 21.0, 20.9, 20.8])
    assert not fine_tune.exhausted([20.0, 21.0, 21.0, 21.0]), "too few to tell"
    assert not fine_tune.exhausted([float("nan")] * 9)


def test_learning_rates_fall_exponentially():
    rates = [fine_tune.learning_rate(step, 100) for step in (0, 50, 100)]
    assert rates == pytest.approx([1e-2, (1e-2 * 5e-4) ** 0.5, 5e-4])


# --- Interruption ---------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", ["targets", "colours"])
def test_a_resumed_fit_gives_the_same_bytes(run, red, tmp_path, monkeypatch, stop):
    monkeypatch.setattr(fine_tune, "INTERVAL", 10)
    monkeypatch.setattr("climatenerf.styling.paper.paper_run.INTERVAL", 10)
    assert paper(run, tmp_path / "whole", "--pictures", red) == 0

    learn, done = fine_tune.FineTuning._learn, []

    def interrupted(self, lesson):
        if self.step == (0 if stop == "targets" else 17):
            raise KeyboardInterrupt
        done.append(self.step)
        learn(self, lesson)

    out = tmp_path / "parts"
    with monkeypatch.context() as patch:
        patch.setattr(fine_tune.FineTuning, "_learn", interrupted)
        assert paper(run, out, "--pictures", red) != 0
    assert not (out / "field.safetensors").exists()
    assert (out / ".fine-tuning" / "target_0003.safetensors").is_file()
    shutil.copytree(out, tmp_path / "copy")

    def counted(self, lesson):
        done.append(self.step)
        learn(self, lesson)

    done.clear()
    with monkeypatch.context() as patch:
        patch.setattr(fine_tune.FineTuning, "_learn", counted)
        assert paper(run, out, "--pictures", red) == 0
    assert done[0] == (0 if stop == "targets" else 10), "it continues"
    for name in ("field.safetensors", "style.json", "scene.json", "config.json"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert not (out / ".fine-tuning").exists()


def test_an_unfinished_fit_is_not_continued_with_other_options(
    run, red, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"

    def stopped(self, lesson):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fine_tune.FineTuning, "_learn", stopped)
        assert paper(run, out, "--pictures", red) != 0
    asked = ("stylize", run, "-o", out, "--method", "paper", "--pictures", red, "--views", 4)
    assert "with other options" in error_message(capsys, *asked, "--steps", 31)
    target = out / ".fine-tuning" / "target_0001.safetensors"
    target.write_bytes(target.read_bytes()[:-3] + b"abc")
    assert "is damaged; remove it" in error_message(capsys, *asked, "--steps", 30)
    target.unlink()
    assert run_cli(*asked, "--steps", 30) == 0
    assert "already holds a run" in error_message(capsys, *asked, "--steps", 30)


# --- Refusals -------------------------------------------------------------------------------------


def test_pictures_that_do_not_fit_are_refused(run, red, tmp_path, capsys):
    asked = ("stylize", run, "-o", tmp_path / "out", "--method", "paper", *FEW)
    absent = error_message(capsys, *asked, "--pictures", tmp_path / "absent")
    assert "there is no folder" in absent
    some = tmp_path / "some"
    shutil.copytree(red, some)
    (some / "03.jpg").unlink()
    assert "no picture of 03.png" in error_message(capsys, *asked, "--pictures", some)
    assert not (tmp_path / "out").exists()
    Image.new("RGB", (96, 40)).save(some / "03.jpg")
    assert "other proportions" in error_message(capsys, *asked, "--pictures", some)
    (some / "03.jpg").write_bytes(b"no picture")
    other = (*asked[:3], tmp_path / "other", *asked[4:])
    assert "cannot be read" in error_message(capsys, *other, "--pictures", some)
    assert not (tmp_path / "out" / "field.safetensors").exists()


def test_options_that_contradict_one_another_are_refused(run, red, tmp_path, capsys):
    style = tmp_path / "style.png"
    Image.new("RGB", (8, 8)).save(style)

    def message(*options):
        return error_message(capsys, "stylize", run, "-o", tmp_path / "out", *options)

    assert "--pictures belongs to --method paper" in message("--pictures", red)
    way = ("--method", "paper")
    assert "--wct needs style photos" in message(*way, "--season", "winter", "--wct", red)
    assert "--editor needs a text" in message(*way, "--season", "winter", "--editor", red)
    assert "leave --season" in message(*way, "--season", "winter", "--pictures", red)
    assert "give one of --wct" in message(*way, "--pictures", red, "--wct", red)
    assert "give one of --season" in message(*way)
    assert "--steps must be at least 1" in message(*way, "--season", "winter", "--steps", 0)
    assert "another layout" in message(
        *way, "--style", textured(style), "--wct", bad_weights(tmp_path)
    )
    assert "no model_index.json" in message(*way, "--text", "snow", "--editor", red)
    assert not (tmp_path / "out").exists()


def textured(path):
    noise = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path


def bad_weights(folder):
    weights = save_wct(folder / "bad")
    torch.save({"model": {}}, weights / "encoder3.pth")
    return weights


def test_the_record_of_a_fine_tuning_is_checked(run, red, tmp_path, capsys):
    out = tmp_path / "out"
    assert paper(run, out, "--pictures", red) == 0
    file = out / "style.json"
    data = json.loads(file.read_text())
    data["fine_tuned"]["steps"] = -1
    file.write_text(json.dumps(data))
    message = error_message(capsys, "stylize", out, "-o", tmp_path / "more", "--season", "autumn")
    assert "steps" in message and "style.json" in message
