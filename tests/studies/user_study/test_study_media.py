"""Metadata is cut out of pictures and movies without a change of a pixel."""

import io
import subprocess

import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin
from support.compare_folders import write_movie, write_picture

from climatenerf.core.errors import UserError
from climatenerf.output.video import find_ffmpeg
from climatenerf.studies.user_study.media import (
    NOISE,
    catch_picture,
    read_media,
    still_picture,
    with_noise,
)

SECRET = b"made by METHOD-X"


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def frames(path):
    """Return all frames of a movie of 32x18 pixels as RGB."""
    command = [find_ffmpeg(), "-loglevel", "error", "-i", str(path), "-pix_fmt", "rgb24"]
    done = subprocess.run([*command, "-f", "rawvideo", "-"], capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, 18, 32, 3)


@pytest.mark.parametrize("progressive", [False, True])
def test_jpeg(tmp_path, progressive):
    path = tmp_path / "a.jpg"
    write_picture(path, 1)
    exif = Image.Exif()
    exif[0x010E] = SECRET.decode()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.open(path).save(
        path, exif=exif, comment=SECRET, icc_profile=profile, progressive=progressive
    )
    path.write_bytes(path.read_bytes() + SECRET)
    before = path.read_bytes()
    media = read_media(path, "picture")
    assert before.count(SECRET) == 3 and SECRET not in media.data
    assert (pixels(media.data) == pixels(before)).all()
    assert Image.open(io.BytesIO(media.data)).info["icc_profile"] == profile
    assert (media.type, media.size, media.suffix) == ("image/jpeg", (32, 18), ".jpg")


def test_png(tmp_path):
    path = tmp_path / "a.png"
    text = PngImagePlugin.PngInfo()
    text.add_text("key", SECRET.decode())
    text.add_itxt("simulated", SECRET.decode())
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (9, 7, 4), np.uint8))
    picture.save(path, pnginfo=text)
    before = path.read_bytes()
    media = read_media(path, "picture")
    assert before.count(SECRET) == 2 and SECRET not in media.data
    after = np.asarray(Image.open(io.BytesIO(media.data)))
    assert (after == np.asarray(picture)).all() and media.type == "image/png"


def test_mp4(tmp_path):
    path, named = tmp_path / "a.mp4", tmp_path / "named.mp4"
    write_movie(path, 3)
    secret = SECRET.decode()
    about = ["-metadata", f"title={secret}", "-metadata:s:v", f"handler_name={secret}"]
    command = [find_ffmpeg(), "-loglevel", "error", "-i", path, "-c", "copy", *about, named]
    subprocess.run(command, check=True)
    media = read_media(named, "movie")
    clean = tmp_path / "clean.mp4"
    clean.write_bytes(media.data)
    assert named.read_bytes().count(SECRET) == 2 and SECRET not in media.data
    assert len(media.data) == named.stat().st_size and media.size == (32, 18)
    assert len(frames(path)) == 6 and (frames(clean) == frames(path)).all()
    assert b"simulated" in path.read_bytes() and b"simulated" not in read_media(path, "movie").data


def test_boxes_inside_themselves_end(tmp_path):
    """A file of a million nested boxes ends in a sentence, not in a recursion."""
    path = tmp_path / "a.mp4"
    write_movie(path, 3)
    count = 20_000
    nested = b"".join((8 * (count - k)).to_bytes(4, "big") + b"moov" for k in range(count))
    path.write_bytes(path.read_bytes() + nested)
    assert len(read_media(path, "movie").data) == path.stat().st_size


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("text.jpg", "picture", "cannot be decoded"),
        ("cut.jpg", "picture", "cannot be decoded"),
        ("gif.png", "picture", "is a GIF file"),
        ("turned.jpg", "picture", "rotated by its EXIF record"),
        ("text.mp4", "movie", "is no MP4 file"),
        ("cut.mp4", "movie", "cannot be decoded"),
        ("absent.mp4", "movie", "does not exist"),
    ],
)
def test_what_cannot_be_shown_is_refused(tmp_path, name, kind, expected):
    path = tmp_path / name
    if name.startswith("text"):
        path.write_text("no picture")
    elif name == "cut.jpg":
        write_picture(path, 1, (320, 180))
        path.write_bytes(path.read_bytes()[:1500])
    elif name == "gif.png":
        Image.new("RGB", (8, 8)).save(path, format="GIF")
    elif name == "turned.jpg":
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.new("RGB", (8, 8)).save(path, exif=exif)
    elif name == "cut.mp4":
        write_movie(path, 1)
        path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=name) as error:
        read_media(path, kind)
    assert expected in str(error.value)


def test_noise_is_strong_coarse_and_repeatable():
    grey = np.full((90, 640, 3), 128, np.uint8)
    noisy = with_noise(grey, 1)
    cells = noisy[:88].reshape(22, 4, 160, 4, 3)
    assert (cells == cells[:, :1, :, :1]).all(), "cells of four pixels"
    clipped = np.clip(np.random.default_rng(0).normal(128, 255 * NOISE, 10**6), 0, 255)
    assert noisy.std() == pytest.approx(clipped.std(), rel=0.05)
    assert abs(noisy.mean() - 128) < 3
    assert (noisy == with_noise(grey, 1)).all() and (noisy != with_noise(grey, 2)).any()


def test_catch_pictures_of_a_picture_and_of_a_movie(tmp_path):
    movie, picture = tmp_path / "a.mp4", tmp_path / "a.png"
    write_movie(movie, 3)
    write_picture(picture, 3)
    still = pixels(still_picture(movie).data)
    assert np.abs(still - frames(movie)[0].astype(float)).max() < 6
    for path, kind in ((movie, "movie"), (picture, "picture")):
        media = read_media(path, kind)
        clean = still_picture(path) if kind == "movie" else media
        noisy = catch_picture(media, path, 0)
        difference = pixels(noisy.data).astype(float) - pixels(clean.data)
        assert noisy.type == "image/jpeg" and difference.std() > 40
