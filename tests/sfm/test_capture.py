"""From photos to a scene through the command line; the embedded street is the ground truth."""

import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import STREET, run_cli
from support.photo_builders import exif, photo

from climatenerf.scene import load_scene, read_scene

pytest.importorskip("pycolmap")
HOME = (47.3769, 8.5417)


def similarity(a, b):
    """Return scale s, rotation R and translation t of b = s R a + t (Umeyama 1991)."""
    ma, mb = a.mean(0), b.mean(0)
    u, d, vt = np.linalg.svd((b - mb).T @ (a - ma))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(d) @ sign) / ((a - ma) ** 2).sum()
    return scale, rotation, mb - scale * rotation @ ma


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A capture of the street's photos with GPS; every third is stored rotated by 90 degrees."""
    truth = read_scene(STREET)
    folder = tmp_path_factory.mktemp("photos")
    lat_m = 111132.954 - 559.822 * math.cos(2 * math.radians(HOME[0]))
    lon_m = 111412.84 * math.cos(math.radians(HOME[0]))
    rng = np.random.default_rng(0)
    for number, view in enumerate(truth.views):
        x, y, z = truth.c2w_world(view)[:3, 3]
        x, y = x + rng.normal(0, 0.15), y + rng.normal(0, 0.15)
        gps = (HOME[0] + y / lat_m, HOME[1] + x / lon_m, 400 + z)
        rotated = number % 3 == 0
        image = Image.open(view.path)
        image = image.transpose(Image.Transpose.ROTATE_90) if rotated else image
        data = exif(6 if rotated else 1, gps=gps)
        image.save(folder / f"{Path(view.name).stem}.jpg", quality=95, exif=data)
    out = tmp_path_factory.mktemp("street") / "scene"
    assert run_cli("capture", folder, "-o", out) == 0
    return truth, out


@pytest.mark.slow
def test_poses_scale_and_up_match_the_truth(captured):
    truth, out = captured
    scene = load_scene(out)
    by_name = {Path(v.name).stem: v for v in truth.views}
    assert len(scene.views) >= 0.95 * len(truth.views)
    estimated = np.stack([scene.c2w_world(v) for v in scene.views])
    true = np.stack([truth.c2w_world(by_name[Path(v.name).stem]) for v in scene.views])
    scale, rotation, shift = similarity(estimated[:, :3, 3], true[:, :3, 3])
    aligned = scale * estimated[:, :3, 3] @ rotation.T + shift
    error = np.linalg.norm(aligned - true[:, :3, 3], axis=-1)
    inlier = error <= 4 * np.median(error)  # one wrong pose must not affect the alignment
    assert inlier.mean() > 0.95
    scale, rotation, shift = similarity(estimated[inlier, :3, 3], true[inlier, :3, 3])
    aligned = scale * estimated[:, :3, 3] @ rotation.T + shift
    extent = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
    assert np.median(np.linalg.norm(aligned - true[:, :3, 3], axis=-1)) < 0.01 * extent
    between = rotation @ estimated[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    angles = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.median(angles) < 0.5
    # GPS gives the scale within 3 % and x to the east; the pictures give up.
    assert scene.scale_source == "gps" and scale == pytest.approx(1, abs=0.03)
    up = np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1)))
    east = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
    assert up < 3 and abs(east) < 3
    assert scene.of_split("heldout"), "some photos are held out"


@pytest.mark.slow
def test_report_and_following_commands(captured, tmp_path, capsys):
    _, out = captured
    text = (out / "report.md").read_text()
    assert re.search(r"Pictures with poses: 6\d of 64", text) and "GPS of 6" in text
    assert Image.open(out / "report.png").size == (1280, 640)
    assert (out / "sparse" / "0" / "images.bin").is_file()
    run = tmp_path / "run"
    assert run_cli("fit", out, "-o", run, "--steps", "2", "--downscale", "4") == 0
    assert json.loads((run / "scene.json").read_text())["scale_source"] == "gps"
    assert run_cli("export", out, "-o", tmp_path / "out") == 0
    assert (tmp_path / "out" / "transforms.json").is_file()


@pytest.mark.slow
def test_second_run_reuses_earlier_results(captured, tmp_path, capsys):
    truth, out = captured
    scene = tmp_path / "scene"
    shutil.copytree(out, scene)
    shutil.rmtree(scene / "images")
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in truth.views:  # new files: pictures are converted again
        shutil.copy(view.path, photos / f"{Path(view.name).stem}.jpg")
    assert run_cli("capture", photos, "-o", scene) == 0
    assert len(list((scene / "images").iterdir())) >= 60


def test_unmatched_photos_give_one_error_sentence(tmp_path, capsys):
    for i in range(4):
        photo(tmp_path / "in" / f"{i}.jpg", (320, 240), seed=i)
    assert run_cli("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    err = capsys.readouterr().err
    assert "fit together" in err and "Traceback" not in err
    assert not (tmp_path / "scene" / "scene.json").exists()


def test_missing_pycolmap_names_the_install_command(tmp_path, capsys, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    photo(tmp_path / "in" / "0.jpg")
    assert run_cli("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    assert "climatenerf[capture]" in capsys.readouterr().err


def street_photo(number, size):
    """An enlarged photo of the street."""
    view = sorted((STREET / "images").iterdir())[number]
    return Image.open(view).convert("RGB").resize(size, Image.Resampling.BICUBIC)


def rotated_view(picture, focal, yaw, pitch, size=(320, 240), lens=350.0):
    """View of a camera in the centre of a larger picture, rotated by yaw and pitch (degrees)."""
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


def test_pure_rotation_gives_one_error_sentence(tmp_path, capsys):
    around = street_photo(10, (1536, 864))
    (tmp_path / "in").mkdir()
    for i, (yaw, pitch) in enumerate([(-9, 0), (-5, 3), (0, 0), (4, -3), (8, 2), (2, 5)]):
        rotated_view(around, 1200, yaw, pitch).save(tmp_path / "in" / f"{i}.jpg", quality=95)
    assert run_cli("capture", tmp_path / "in", "-o", tmp_path / "scene") == 2
    err = capsys.readouterr().err
    assert "from one spot" in err and "Traceback" not in err
    assert not (tmp_path / "scene" / "scene.json").exists()


@pytest.mark.slow
def test_larger_of_two_unconnected_groups_is_kept(tmp_path, capsys):
    """Mirrored photos do not match the others, like photos of another scene."""
    views = sorted((STREET / "images").iterdir())
    (tmp_path / "in").mkdir()
    for path in views[:16]:
        shutil.copy(path, tmp_path / "in" / f"here-{path.stem}{path.suffix}")
    for path in views[:9]:
        mirrored = Image.open(path).convert("RGB").transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        mirrored.save(tmp_path / "in" / f"there-{path.stem}.jpg", quality=95)
    assert run_cli("capture", tmp_path / "in", "-o", tmp_path / "scene") == 0
    output = capsys.readouterr()
    assert re.search(r"2 unconnected groups \(1\d, [789] pictures\)", output.err)
    assert "not connected to the rest" in output.err
    names = [view.name for view in load_scene(tmp_path / "scene").views]
    assert len(names) >= 12 and all(name.startswith("here-") for name in names)
    assert "Unconnected groups of pictures" in (tmp_path / "scene" / "report.md").read_text()


@pytest.mark.slow
def test_capture_of_a_video(tmp_path, capsys):
    """A video of the street's photos in order: only neighbours and loop closures are matched."""
    import imageio_ffmpeg

    truth = read_scene(STREET)
    video = tmp_path / "walk.mov"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", "384x216", "-r", "4", "-i", "-", "-crf", "12", video]
    frames = b"".join(Image.open(view.path).convert("RGB").tobytes() for view in truth.views)
    subprocess.run([str(word) for word in command], input=frames, check=True)
    assert run_cli("capture", video, "-o", tmp_path / "scene") == 0
    output = capsys.readouterr()
    scene = load_scene(tmp_path / "scene")
    assert len(scene.views) > 0.8 * len(truth.views), output.err
    names = [Path(view.name).stem for view in truth.views]
    true = np.stack([truth.c2w_world(truth.views[int(Path(v.name).stem)]) for v in scene.views])
    assert len(set(names)) == len(names) and scene.scale_source == "camera-height-assumed"
    estimated = np.stack([scene.c2w_world(view) for view in scene.views])
    scale, rotation, shift = similarity(estimated[:, :3, 3], true[:, :3, 3])
    aligned = scale * estimated[:, :3, 3] @ rotation.T + shift
    error = np.linalg.norm(aligned - true[:, :3, 3], axis=-1)
    assert np.median(error) < 0.02 * np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
