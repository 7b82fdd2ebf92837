"""From bare photos to a scene, through the command line: the embedded street against its truth."""

import json
import math
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.photo_builders import exif, photo

from climatenerf import cli
from climatenerf.scene import load_scene, read_scene

pytest.importorskip("pycolmap")
STREET = Path(str(files("climatenerf") / "assets" / "street"))
HOME = (47.3769, 8.5417)


def status(*words):
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as left:
        return left.code


def similarity(a, b):
    """Umeyama's scale, rotation and shift with b = s R a + t."""
    ma, mb = a.mean(0), b.mean(0)
    u, d, vt = np.linalg.svd((b - mb).T @ (a - ma))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(d) @ sign) / ((a - ma) ** 2).sum()
    return scale, rotation, mb - scale * rotation @ ma


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """The street's photos with GPS in them, every third turned on its side, captured."""
    truth = read_scene(STREET)
    folder = tmp_path_factory.mktemp("photos")
    lat_m = 111132.954 - 559.822 * math.cos(2 * math.radians(HOME[0]))
    lon_m = 111412.84 * math.cos(math.radians(HOME[0]))
    rng = np.random.default_rng(0)
    for number, view in enumerate(truth.views):
        x, y, z = truth.c2w_world(view)[:3, 3]
        x, y = x + rng.normal(0, 0.15), y + rng.normal(0, 0.15)
        place = (HOME[0] + y / lat_m, HOME[1] + x / lon_m, 400 + z)
        turned = number % 3 == 0
        image = Image.open(view.path)
        image = image.transpose(Image.Transpose.ROTATE_90) if turned else image
        data = exif(6 if turned else 1, place=place)
        image.save(folder / f"{Path(view.name).stem}.jpg", quality=95, exif=data)
    out = tmp_path_factory.mktemp("street") / "scene"
    assert status("capture", folder, "-o", out) == 0
    return truth, out


@pytest.mark.slow
def test_poses_scale_and_up_against_the_truth(captured):
    truth, out = captured
    scene = load_scene(out)
    by_name = {Path(v.name).stem: v for v in truth.views}
    assert len(scene.views) >= 0.95 * len(truth.views)
    own = np.stack([scene.c2w_world(v) for v in scene.views])
    true = np.stack([truth.c2w_world(by_name[Path(v.name).stem]) for v in scene.views])
    scale, rotation, shift = similarity(own[:, :3, 3], true[:, :3, 3])
    placed = scale * own[:, :3, 3] @ rotation.T + shift
    away = np.linalg.norm(placed - true[:, :3, 3], axis=-1)
    sound = away <= 4 * np.median(away)  # one picture placed wrongly must not turn all others
    assert sound.mean() > 0.95
    scale, rotation, shift = similarity(own[sound, :3, 3], true[sound, :3, 3])
    placed = scale * own[:, :3, 3] @ rotation.T + shift
    extent = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
    assert np.median(np.linalg.norm(placed - true[:, :3, 3], axis=-1)) < 0.01 * extent
    between = rotation @ own[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    angles = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.median(angles) < 0.5
    # GPS: metres within 3 %, x to the east; up from the pictures.
    assert scene.scale_source == "gps" and scale == pytest.approx(1, abs=0.03)
    up = np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1)))
    east = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
    assert up < 3 and abs(east) < 3
    assert scene.of_split("heldout"), "photos are kept for measuring"


@pytest.mark.slow
def test_the_report_and_the_next_command(captured, tmp_path, capsys):
    _, out = captured
    text = (out / "report.md").read_text()
    assert re.search(r"Pictures with poses: 6\d of 64", text) and "GPS of 6" in text
    assert Image.open(out / "report.png").size == (1280, 640)
    assert (out / "sparse" / "0" / "images.bin").is_file()
    run = tmp_path / "run"
    assert status("fit", out, "-o", run, "--steps", "2", "--downscale", "4") == 0
    assert json.loads((run / "scene.json").read_text())["scale_source"] == "gps"
    assert status("export", out, "-o", tmp_path / "out") == 0
    assert (tmp_path / "out" / "transforms.json").is_file()


@pytest.mark.slow
def test_a_second_run_goes_on_from_what_is_there(captured, tmp_path, capsys):
    truth, out = captured
    scene = tmp_path / "scene"
    shutil.copytree(out, scene)
    shutil.rmtree(scene / "images")
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in truth.views:  # other files: the pictures are taken in anew, the rest is kept
        shutil.copy(view.path, photos / f"{Path(view.name).stem}.jpg")
    assert status("capture", photos, "-o", scene) == 0
    assert len(list((scene / "images").iterdir())) >= 60


def test_photos_that_fit_nowhere_are_one_clear_sentence(tmp_path, capsys):
    for i in range(4):
        photo(tmp_path / "in" / f"{i}.jpg", (320, 240), seed=i)
    assert status("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    err = capsys.readouterr().err
    assert "fit together" in err and "Traceback" not in err
    assert not (tmp_path / "scene" / "scene.json").exists()


def test_two_photos_and_a_scene_that_is_there_already(tmp_path, capsys):
    for i in range(2):
        photo(tmp_path / "in" / f"{i}.jpg", seed=i)
    assert status("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    assert "2 usable" in capsys.readouterr().err
    shutil.copytree(STREET, tmp_path / "mine")
    before = (tmp_path / "mine" / "scene.json").read_bytes()
    assert status("capture", tmp_path / "in", "-o", tmp_path / "mine") == 2
    assert "already holds" in capsys.readouterr().err
    assert (tmp_path / "mine" / "scene.json").read_bytes() == before


def test_without_pycolmap_the_remedy_is_told(tmp_path, capsys, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    photo(tmp_path / "in" / "0.jpg")
    assert status("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    assert "climatenerf[capture]" in capsys.readouterr().err


def street_photo(number, size):
    """A large picture with as much detail as the street's photos have."""
    view = sorted((STREET / "images").iterdir())[number]
    return Image.open(view).convert("RGB").resize(size, Image.Resampling.BICUBIC)


def turned(picture, focal, yaw, pitch, size=(320, 240), lens=350.0):
    """What a camera sees that is turned in the centre of a picture of the surroundings."""
    a, b = math.radians(yaw), math.radians(pitch)
    about_y = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    k0 = np.array([[focal, 0, picture.width / 2], [0, focal, picture.height / 2], [0, 0, 1]])
    k1 = np.array([[lens, 0, size[0] / 2], [0, lens, size[1] / 2], [0, 0, 1]])
    h = k0 @ about_y @ about_x @ np.linalg.inv(k1)
    coefficients = (h / h[2, 2]).ravel()[:8]
    return picture.transform(
        size, Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BICUBIC
    )


def test_photos_from_one_spot_are_told_so(tmp_path, capsys):
    around = street_photo(10, (1536, 864))
    (tmp_path / "in").mkdir()
    for i, (yaw, pitch) in enumerate([(-9, 0), (-5, 3), (0, 0), (4, -3), (8, 2), (2, 5)]):
        turned(around, 1200, yaw, pitch).save(tmp_path / "in" / f"{i}.jpg", quality=95)
    assert status("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    err = capsys.readouterr().err
    assert "from one spot" in err and "Traceback" not in err
    assert not (tmp_path / "scene" / "scene.json").exists()


@pytest.mark.slow
def test_of_two_places_the_larger_is_kept(tmp_path, capsys):
    """Mirrored photos are those of another place: nothing in them fits the others."""
    views = sorted((STREET / "images").iterdir())
    (tmp_path / "in").mkdir()
    for path in views[:16]:
        shutil.copy(path, tmp_path / "in" / f"here-{path.stem}{path.suffix}")
    for path in views[:9]:
        mirrored = Image.open(path).convert("RGB").transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        mirrored.save(tmp_path / "in" / f"there-{path.stem}.jpg", quality=95)
    assert status("capture", tmp_path / "in", "-o", tmp_path / "scene") == 0
    told = capsys.readouterr()
    assert re.search(r"2 groups that do not fit together \(1\d, [789] pictures\)", told.err)
    assert "cut off from the rest" in told.err
    names = [view.name for view in load_scene(tmp_path / "scene").views]
    assert len(names) >= 12 and all(name.startswith("here-") for name in names)
    assert "Groups that do not fit together" in (tmp_path / "scene" / "report.md").read_text()


@pytest.mark.slow
def test_a_video_of_the_street(tmp_path, capsys):
    """The street's photos in their order as a film: compared with neighbours, not all with all."""
    import imageio_ffmpeg

    truth = read_scene(STREET)
    video = tmp_path / "walk.mov"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", "384x216", "-r", "4", "-i", "-", "-crf", "12", video]
    frames = b"".join(Image.open(view.path).convert("RGB").tobytes() for view in truth.views)
    subprocess.run([str(word) for word in command], input=frames, check=True)
    assert status("capture", video, "-o", tmp_path / "scene") == 0
    told = capsys.readouterr()
    scene = load_scene(tmp_path / "scene")
    assert len(scene.views) > 0.8 * len(truth.views), told.err
    names = [Path(view.name).stem for view in truth.views]
    true = np.stack([truth.c2w_world(truth.views[int(Path(v.name).stem)]) for v in scene.views])
    assert len(set(names)) == len(names) and scene.scale_source == "camera-height-assumed"
    own = np.stack([scene.c2w_world(view) for view in scene.views])
    scale, rotation, shift = similarity(own[:, :3, 3], true[:, :3, 3])
    away = np.linalg.norm(scale * own[:, :3, 3] @ rotation.T + shift - true[:, :3, 3], axis=-1)
    assert np.median(away) < 0.02 * np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
