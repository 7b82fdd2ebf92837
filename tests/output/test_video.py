import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.output.video import MovieWriter, find_ffmpeg, write_png


def frames(count, width, height):
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    for i in range(count):
        picture = np.stack([x, y, np.full_like(x, i / count)], axis=-1)
        yield np.round(40 + 170 * picture).astype(np.uint8)


def decoded(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    info = next(reader)
    width, height = info["size"]
    return info, [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_movie_shows_the_frames_in_their_colours(tmp_path, size):
    path = tmp_path / "a.mp4"
    with MovieWriter(path, size, 12) as movie:
        for frame in frames(10, *size):
            movie.add(frame)
    info, decoded_frames = decoded(path)
    assert info["fps"] == 12 and info["codec"] == "h264" and "yuv420p" in info["pix_fmt"]
    assert "bt709" in info["pix_fmt"]
    assert len(decoded_frames) == 10 and decoded_frames[0].shape == (48, 64, 3)
    assert (movie.note is None) == (size == (64, 48))
    for frame, expected in zip(decoded_frames, frames(10, *size), strict=True):
        gap = frame[: size[1], : size[0]].astype(float) - expected
        assert np.abs(gap).mean() < 3 and abs(gap.mean()) < 1.5, "a wrong matrix shifts by more"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_a_failed_block_leaves_the_earlier_movie(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), MovieWriter(path, (64, 48), 12) as movie:
        for frame in frames(2, 64, 48):
            movie.add(frame)
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_frames_are_saved_without_ffmpeg(tmp_path, monkeypatch):
    def nowhere():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", nowhere)
    with pytest.raises(UserError, match="pip install imageio-ffmpeg"):
        find_ffmpeg()
    with (
        pytest.raises(UserError, match="pip install imageio-ffmpeg"),
        MovieWriter(tmp_path / "a.mp4", (64, 48), 12) as movie,
    ):
        assert movie.problem is not None
        for i, frame in enumerate(frames(3, 64, 48)):
            write_png(tmp_path / f"{i}.png", frame, "clean")
            movie.add(frame)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.png", "1.png", "2.png"]


@pytest.mark.parametrize(
    "program", ["import sys; sys.exit('Unknown encoder libx264')", "import time; time.sleep(0.1)"]
)
def test_a_failing_ffmpeg_is_a_user_error(tmp_path, monkeypatch, program):
    # The first stands for an ffmpeg that exits at once, the second for one without output.
    fake = tmp_path / "ffmpeg"
    fake.write_text(f"#!{sys.executable}\n{program}\n")
    fake.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(fake))
    path = tmp_path / "out" / "a.mp4"
    with pytest.raises(UserError) as caught, MovieWriter(path, (640, 480), 12) as movie:
        for frame in frames(4, 640, 480):
            movie.add(frame)
    assert "libx264" in str(caught.value) and not any(path.parent.iterdir())
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(tmp_path / "absent"))
    with pytest.raises(UserError, match="does not start"), MovieWriter(path, (64, 48), 12):
        pass


def test_an_unwritable_path_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(UserError, match="not a folder"),
        MovieWriter(tmp_path / "file" / "a.mp4", (64, 48), 12),
    ):
        pass


def test_wrong_frames_are_refused(tmp_path):
    with (
        pytest.raises(ValueError, match="in a movie of"),
        MovieWriter(tmp_path / "a.mp4", (64, 48), 12) as movie,
    ):
        movie.add(np.zeros((64, 48, 3), np.uint8))


@pytest.mark.parametrize("text", ["flood 0.5 m", "überflutet 0.5 m"])
def test_a_png_is_marked_as_simulated(tmp_path, text):
    frame = next(frames(1, 9, 7))
    write_png(tmp_path / "a.png", frame, text)
    with Image.open(tmp_path / "a.png") as image:
        assert image.info["simulated"] == text
        assert np.array_equal(np.asarray(image), frame)
