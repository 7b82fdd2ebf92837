"""Captures that end before their time: a full disk, a folder that cannot be written, a kill."""

import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycolmap")
STREET = Path(str(files("climatenerf") / "assets" / "street"))
CAPTURE = [sys.executable, "-m", "climatenerf", "capture"]


@pytest.fixture
def photos(tmp_path):
    return some_photos(tmp_path / "photos", 6)


def some_photos(folder, count):
    folder.mkdir()
    for path in sorted((STREET / "images").iterdir())[:count]:
        shutil.copy(path, folder)
    return folder


def on_disk(folder, mounting, command):
    """Runs a command with a disk of its own mounted at a folder; the files there are gone after."""
    inner = f'mount -t tmpfs {mounting} tmpfs "$0" && exec "$@"'
    words = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    folder.mkdir(exist_ok=True)
    if (
        shutil.which("unshare") is None
        or subprocess.run([*words, inner, str(folder), "true"], capture_output=True).returncode
    ):
        pytest.skip("this system lets nobody mount a disk of his own")
    return subprocess.run([*words, inner, str(folder), *command], capture_output=True, text=True)


@pytest.mark.parametrize("size", ["100k", "700k", "1500k"])
def test_a_full_disk_is_one_sentence(photos, tmp_path, size):
    disk = tmp_path / "disk"
    done = on_disk(disk, f"-o size={size}", [*CAPTURE, photos, "-o", disk / "scene"])
    last = done.stderr.replace("\r", "\n").strip().splitlines()[-1]
    assert done.returncode == 2 and last.startswith("climatenerf: the disk is full")
    assert "Traceback" not in done.stderr and "left out" not in done.stderr


def test_a_folder_that_cannot_be_written(photos, tmp_path):
    disk = tmp_path / "disk"
    done = on_disk(disk, "-o ro", [*CAPTURE, photos, "-o", disk / "scene"])
    assert done.returncode == 2 and "no permission" in done.stderr
    assert "Traceback" not in done.stderr
    (tmp_path / "file").write_text("in the way")
    done = subprocess.run(
        [*CAPTURE, photos, "-o", tmp_path / "file"], capture_output=True, text=True
    )
    assert done.returncode == 2 and "is a file" in done.stderr


@pytest.mark.parametrize(
    ("how", "status"), [(signal.SIGKILL, -9), (signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
def test_killed_in_the_middle_and_run_again(tmp_path, how, status):
    photos = some_photos(tmp_path / "photos", 14)
    command = [*CAPTURE, str(photos), "-o", str(tmp_path / "scene")]
    database = tmp_path / "scene" / "work" / "database.db"
    process = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests themselves run in the background Ctrl-C is ignored, and that is inherited.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    for _ in range(600):
        if database.exists():  # features are being looked for, six photos at a time
            break
        time.sleep(0.05)
    process.send_signal(how)
    _, told = process.communicate(timeout=60)
    assert process.returncode == status and "Traceback" not in told
    assert ("climatenerf: interrupted" in told) == (how != signal.SIGKILL)
    for _ in range(100):
        if not others(tmp_path):
            break
        time.sleep(0.1)
    assert not others(tmp_path), "the worker ends with the process that began it"
    assert not (tmp_path / "scene" / "scene.json").exists()
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 2) and "Traceback" not in done.stderr
    # These photos of the street may or may not make a place; that is the mapper's to say.
    assert done.returncode == 0 or "fit together" in done.stderr


def others(folder):
    """Workers that are still at work in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cwd"):
        try:
            words = path.with_name("cmdline").read_bytes()
            opened = [os.readlink(fd) for fd in path.with_name("fd").iterdir()]
        except OSError:
            continue
        if b"climatenerf.sfm.worker" in words and any(str(folder) in name for name in opened):
            found.append(path)
    return found


@pytest.mark.slow
def test_a_photo_of_200_megapixels(tmp_path):
    """Of noise, so that it is no easy one; decoding it may take memory, but not many times over."""
    from climatenerf.sfm.photo_import import MAX_SIDE, import_photos

    (tmp_path / "in").mkdir()
    rng = np.random.default_rng(0)
    tile = Image.fromarray(rng.integers(0, 255, (1000, 1000, 3), dtype=np.uint8))
    large = Image.new("RGB", (16320, 12240))
    for x in range(0, 16320, 1000):
        for y in range(0, 12240, 1000):
            large.paste(tile, (x, y))
    large.save(tmp_path / "in" / "large.png", compress_level=1)
    large.save(tmp_path / "in" / "large.jpg", quality=80)
    tile.save(tmp_path / "in" / "small.jpg")
    taken = import_photos(tmp_path / "in", tmp_path / "work", lambda done, total: None)
    assert not taken.unusable
    assert {max(p.width, p.height) for p in taken.pictures} == {MAX_SIDE, 1000}
