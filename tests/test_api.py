"""The functions of the library, on a small random field."""

import json

import numpy as np
import pytest
from PIL import Image
from support.random_field import random_field
from support.scene_builders import look_at

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.storage import write_json
from climatenerf.field.checkpoint import save_field
from climatenerf.render import run_terrain
from climatenerf.scene import Camera, Scene, View, save_scene
from climatenerf.scene.terrain import Terrain, load_terrain

SIZE = (32, 18)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of five photos on a line that face the centre of the random field."""
    folder = tmp_path_factory.mktemp("api") / "run"
    folder.mkdir()
    views = []
    for i in range(5):
        path = folder / f"{i:04d}.png"
        Image.fromarray(np.full((36, 64, 3), 40 * i, np.uint8)).save(path)
        c2w = look_at((0.2 * i, -4.0, 0.6), (1.0, -2.0, 0.5))
        views.append(View(path.name, path, 0, c2w, "train"))
    camera = Camera(64, 36, 50.0, 50.0, 32.0, 18.0)
    save_scene(Scene(folder, "test", (camera,), tuple(views)), folder)
    save_field(random_field(), folder)
    write_json(folder / "config.json", {"schema_version": 1, "downscale": 1})
    return climatenerf.load_run(folder)


def pictures(folder):
    return [np.asarray(Image.open(path)) for path in sorted((folder / "frames").glob("*.png"))]


def test_a_run_has_the_camera_of_a_photo(run):
    camera, c2w = run.camera("0002", SIZE)
    assert (camera.width, camera.height) == SIZE
    assert np.allclose(c2w, run.scene.c2w_world(run.scene.views[2]))
    assert run.camera()[0].width == 64
    with pytest.raises(UserError, match="no view"):
        run.camera("nobody")


def test_a_movie_is_rendered_in_parts_by_several_calls(run, tmp_path):
    weather = climatenerf.Weather(smog=climatenerf.Smog(visibility=20.0), seed=3)
    options = {"weather": weather, "frames": 3, "size": SIZE, "layers": ["depth"]}
    whole = climatenerf.render_movie(run, tmp_path / "whole", **options)
    assert whole == tmp_path / "whole" / "movie.mp4"
    notes = []
    for part in ((2, 2), (1, 2)):
        made = climatenerf.render_movie(
            run.folder, tmp_path / "parts", **options, part=part, note=notes.append
        )
        assert made == tmp_path / "parts" / "frames"
    assert [n for n in notes if "finished" in n] == [
        "1 of 3 frames are finished",
        "3 of 3 frames are finished",
    ]
    joined = climatenerf.render_movie(run, tmp_path / "parts", **options, join_only=True)
    assert joined.read_bytes() == whole.read_bytes()
    sidecars = [(tmp_path / name / "movie.json").read_bytes() for name in ("whole", "parts")]
    assert sidecars[0] == sidecars[1] and json.loads(sidecars[0])["seed"] == 3


def test_a_weather_file_and_an_appearance_change_the_frames(run, tmp_path):
    file = tmp_path / "weather.toml"
    file.write_text('[smog]\nvisibility = { "0 s" = "100 m", "1 s" = "2 m" }\n')
    options = {"path": "still:0002", "frames": 2, "fps": 1.0, "size": SIZE}
    for name, more in (
        ("clear", {}),
        ("smog", {"weather": file}),
        ("photo", {"appearance": "0004.png"}),
    ):
        climatenerf.render_movie(run, tmp_path / name, **options, **more)
    clear, smog, photo = (pictures(tmp_path / name) for name in ("clear", "smog", "photo"))
    assert np.array_equal(*clear) and not np.array_equal(*smog)
    assert not np.array_equal(clear[0], photo[0])


def test_completed_ground_is_in_frames_layers_and_the_sidecar(run, tmp_path, monkeypatch):
    """A floor at z = -1 below all that the random field holds; it is found once."""
    calls = []

    def find(field, scene, progress=None):
        calls.append(field)
        flat = np.zeros((81, 81), np.float32)
        no, unknown = np.zeros(flat.shape, bool), np.full(flat.shape, 255, np.uint8)
        return Terrain((-9.0, -12.0), 0.25, flat - 1.0, flat + 0.1, unknown, no, no)

    (run.folder / "terrain.npz").unlink(missing_ok=True)
    monkeypatch.setattr(run_terrain, "find_terrain", find)
    options = {"path": "still:0002", "frames": 1, "size": SIZE, "layers": ["seen", "depth"]}
    found = {}
    for name, complete in (("with", True), ("again", True), ("without", False)):
        movie = climatenerf.render_movie(run, tmp_path / name, **options, complete_ground=complete)
        sidecar = json.loads((movie.parent / "movie.json").read_text())
        assert sidecar["complete_ground"] is complete
        seen = np.load(movie.parent / "seen" / "0000.npz")["seen"]
        measured = sidecar["frames"][0]["measured"]["completed_ground_fraction"]
        assert measured == pytest.approx(1 - seen.mean(), abs=1e-4)
        assert "seen" in sidecar["layers"]
        found[name] = pictures(movie.parent)[0], seen, sidecar["render"]
    assert calls == [run.field] and (run.folder / "terrain.npz").is_file()
    assert found["with"][2] == found["again"][2] != found["without"][2], "frames have other keys"
    assert np.array_equal(found["with"][0], found["again"][0])
    assert found["with"][1].min() < 0.5 and (found["without"][1] == 1).all()
    changed = (found["with"][0] != found["without"][0]).any(-1)
    assert changed.any() and not changed[found["with"][1] > 0.999].any()
    (run.folder / "terrain.npz").unlink()


def test_a_run_that_shows_no_ground_keeps_its_field(run):
    """The random field is fog: no photo's ray ends on ground."""
    saved = run.folder / "terrain.npz"
    saved.unlink(missing_ok=True)
    assert run.completed() is run.field
    assert load_terrain(saved) == (None, run.checkpoint)
    saved.write_bytes(b"damaged")
    with pytest.raises(UserError, match="delete it, and the next render makes it again"):
        run.completed()
    saved.unlink()


def test_invalid_arguments_are_refused_before_anything_is_written(run, tmp_path):
    for options, message in (
        ({"layers": ["colour"]}, "no layer 'colour'"),
        ({"layers": ["label"]}, "without class labels"),
        ({"part": (3, 2)}, "part 3 of 2 does not exist"),
        ({"part": (1, 2), "join_only": True}, "ask for one of them"),
        ({"supersample": 9}, "from 1 to 8"),
        ({"fps": 0.0}, "frame rate"),
        ({"weather": tmp_path / "absent.toml"}, "absent.toml"),
        ({"appearance": "nobody"}, "no training photo"),
    ):
        with pytest.raises(UserError, match=message):
            climatenerf.render_movie(run, tmp_path / "out", **options)
    with pytest.raises(UserError, match='the folder to write into is ""'):
        climatenerf.render_movie(run, "")
    with pytest.raises(UserError, match='the folder to write into is ""'):
        climatenerf.fit(run.scene, "")
    with pytest.raises(UserError, match="no loss 'beauty'"):
        climatenerf.fit(run.scene, tmp_path / "out", losses={"beauty": 1.0})
    with pytest.raises(UserError, match="does not exist"):
        climatenerf.load_run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_without_held_out_photos_has_no_scores(run):
    assert climatenerf.evaluate(run)["psnr"] is None
