import os
import threading

import pytest

from climatenerf.core import arrays, parsing, regular_files
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_safetensors
from climatenerf.core.text import read_text
from climatenerf.scene.image_files import open_image
from climatenerf.scene.readers.ply import read_points


def opened(path):
    with open_image(path):
        pass


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


@pytest.mark.parametrize(
    "read",
    [
        parsing.read_bytes,
        parsing.read_json,
        parsing.read_toml,
        read_text,
        arrays.read_npy,
        arrays.read_npz,
        read_safetensors,
        read_points,
        opened,
    ],
)
def test_no_reader_waits_for_a_pipe(pipe, read):
    with pytest.raises(UserError, match="is a pipe in place of a file; give a file"):
        read(pipe)


def test_a_device_is_refused(tmp_path):
    (tmp_path / "endless").symlink_to("/dev/zero")
    with pytest.raises(UserError, match="is a device"):
        parsing.read_bytes(tmp_path / "endless")


def test_a_pipe_of_the_shell_is_read():
    end, start = os.pipe()
    thread = threading.Thread(target=lambda: (os.write(start, b"a = 1"), os.close(start)))
    thread.start()
    assert parsing.read_toml(f"/dev/fd/{end}") == {"a": 1}
    thread.join()
    os.close(end)


def test_a_pipe_of_the_shell_that_gives_nothing_ends(monkeypatch):
    monkeypatch.setattr(regular_files, "STREAM_SECONDS", 0.2)
    end, start = os.pipe()
    with pytest.raises(UserError, match="gave nothing"):
        parsing.read_toml(f"/dev/fd/{end}")
    os.close(end)
    os.close(start)


def test_absent_files_and_folders_are_left_to_the_reader(tmp_path):
    assert regular_files.special_kind(tmp_path / "none") is None
    assert regular_files.special_kind(tmp_path) is None
    assert regular_files.special_kind("a\0b") is None
