"""Captures that end early: a full disk, a read-only folder, a signal."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import STREET

pytest.importorskip("pycolmap")
CAPTURE = [sys.executable, "-m", "climatenerf", "capture"]


@pytest.fixture
def photos(tmp_path):
    return street_photos(tmp_path / "photos", 6)


def street_photos(folder, count):
    folder.mkdir()
    for path in sorted((STREET / "images").iterdir())[:count]:
        shutil.copy(path, folder)
    return folder


def on_disk(folder, mounting, command):
    """Run a command with a temporary disk mounted at a folder; skip where that is not allowed."""
    inner = f'mount -t tmpfs {mounting} tmpfs "$0" && exec "$@"'
    args = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    folder.mkdir(exist_ok=True)
    if (
        shutil.which("unshare") is None
        or subprocess.run([*args, inner, str(folder), "true"], capture_output=True).returncode
    ):
        pytest.skip("needs permission to mount a disk in a user namespace")
    return subprocess.run([*args, inner, str(folder), *command], capture_output=True, text=True)


@pytest.mark.parametrize("size", ["100k", "700k", "1500k"])
def test_full_disk_gives_one_error_sentence(photos, tmp_path, size):
    disk = tmp_path / "disk"
    done = on_disk(disk, f"-o size={size}", [*CAPTURE, photos, "-o", disk / "scene"])
    last = done.stderr.replace("\r", "\n").strip().splitlines()[-1]
    assert done.returncode == 2 and last.startswith("climatenerf: the disk is full")
    assert "Traceback" not in done.stderr and "is skipped" not in done.stderr


def test_read_only_folder_gives_one_error_sentence(photos, tmp_path):
    disk = tmp_path / "disk"
    done = on_disk(disk, "-o ro", [*CAPTURE, photos, "-o", disk / "scene"])
    assert done.returncode == 2 and "no permission" in done.stderr
    assert "Traceback" not in done.stderr
    (tmp_path / "file").write_text("in the way")
    done = subprocess.run(
        [*CAPTURE, photos, "-o", tmp_path / "file"], capture_output=True, text=True
    )
    assert done.returncode == 2 and "is a file" in done.stderr


def test_capture_resumes_after_signals(tmp_path):
    photos = street_photos(tmp_path / "photos", 14)
    command = [*CAPTURE, str(photos), "-o", str(tmp_path / "scene")]
    database = tmp_path / "scene" / "work" / "database.db"
    for number, status in ((signal.SIGKILL, -9), (signal.SIGINT, 130), (signal.SIGTERM, 143)):
        process = subprocess.Popen(
            command,
            stderr=subprocess.PIPE,
            text=True,
            # Background processes ignore Ctrl-C, and their children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        for _ in range(600):
            if database.exists() and workers(tmp_path):  # features are being extracted
                break
            time.sleep(0.05)
        process.send_signal(number)
        _, output = process.communicate(timeout=60)
        assert process.returncode == status and "Traceback" not in output
        assert ("climatenerf: interrupted" in output) == (number != signal.SIGKILL)
        for _ in range(100):
            if not workers(tmp_path):
                break
            time.sleep(0.1)
        assert not workers(tmp_path), "the worker ends with its parent"
        assert not (tmp_path / "scene" / "scene.json").exists()
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 2) and "Traceback" not in done.stderr
    # Whether the mapper finds a model for these photos is not tested here.
    assert done.returncode == 0 or "fit together" in done.stderr


def workers(folder):
    """Return the running worker processes of captures below a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cwd"):
        try:
            command = path.with_name("cmdline").read_bytes()
            opened = [os.readlink(fd) for fd in path.with_name("fd").iterdir()]
        except OSError:
            continue
        if b"climatenerf.sfm.worker" in command and any(str(folder) in name for name in opened):
            found.append(path)
    return found


@pytest.mark.slow
def test_photo_of_200_megapixels(tmp_path):
    """Noise compresses badly; decoding must not copy the full picture several times."""
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
    imported = import_photos(tmp_path / "in", tmp_path / "work", lambda done, total: None)
    assert not imported.unusable
    assert {max(p.width, p.height) for p in imported.pictures} == {MAX_SIDE, 1000}
