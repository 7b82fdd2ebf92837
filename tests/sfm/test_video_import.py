"""Frames of HDR videos are tone-mapped to sRGB; those of SDR videos are left alone."""

import subprocess

import numpy as np
import pytest
from PIL import Image
from support.hdr_signals import CHART, chart_image, hlg_signal, patches, pq_signal, write_video

from climatenerf.core.hdr import KNEE
from climatenerf.core.srgb import to_display, to_linear
from climatenerf.sfm.photo_import import import_photos

BELOW_KNEE = to_linear(CHART / 255).max(axis=1) <= KNEE


def frames_of(folder, *video, **options):
    path = folder / "clip.mov"
    done = write_video(path, *video, **options)
    if done.returncode:
        pytest.skip(f"this ffmpeg cannot write the video: {done.stderr.decode().strip()[-200:]}")
    imported = import_photos(path, folder / "work", lambda *_: None)
    return imported, np.asarray(Image.open(imported.folder / imported.pictures[0].name))


def hue(colours):
    """Return the hue angle, radians, and the chroma of opponent colours."""
    r, g, b = np.moveaxis(np.asarray(colours, float), -1, 0)
    a, c = r - g, 0.5 * (r + g) - b
    return np.arctan2(c, a), np.hypot(a, c)


@pytest.mark.parametrize(
    ("trc", "encode", "name"),
    [("arib-std-b67", hlg_signal, "HLG"), ("smpte2084", pq_signal, "PQ")],
)
def test_chart_in_hdr_video_keeps_its_colours(tmp_path, trc, encode, name):
    imported, frame = frames_of(tmp_path, encode(chart_image()), trc)
    assert len(imported.pictures) == 6
    (note,) = imported.notes
    assert f"is HDR ({name}); its frames are tone-mapped to sRGB" in note
    found = patches(frame)
    assert np.abs(found - CHART)[BELOW_KNEE].max() <= 4
    white = found[18]
    assert white.min() > 234 and white.max() < 243 and np.ptp(white) <= 4
    (angle, chroma), (expected, _) = hue(found), hue(CHART)
    turn = np.angle(np.exp(1j * (angle - expected)))[chroma > 30]
    assert len(turn) >= 12 and np.abs(turn).max() < 0.1
    again = import_photos(tmp_path / "clip.mov", tmp_path / "work", lambda *_: None)
    assert again.notes == imported.notes and again.pictures == imported.pictures


def test_unnamed_matrix_of_hdr_video_is_that_of_bt2020(tmp_path):
    signal, path = hlg_signal(chart_image()), tmp_path / "named.mov"
    if (done := write_video(path, signal, "arib-std-b67")).returncode:
        pytest.skip(done.stderr.decode()[-200:])
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-i", str(path)]
    command += ["-c", "copy", "-bsf:v", "hevc_metadata=matrix_coefficients=2"]
    subprocess.run([*command, str(tmp_path / "clip.mp4")], check=True)
    imported = import_photos(tmp_path / "clip.mp4", tmp_path / "work", lambda *_: None)
    found = patches(np.asarray(Image.open(imported.folder / imported.pictures[0].name)))
    assert np.abs(found - CHART)[BELOW_KNEE].max() <= 4


def test_sdr_video_of_ten_bits_is_unchanged(tmp_path):
    """The frames are those of ffmpeg's plain conversion, byte for byte."""
    import imageio_ffmpeg

    signal = to_display(chart_image())
    imported, _ = frames_of(tmp_path, signal, "bt709", "bt709", "bt709")
    assert imported.notes == ()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i"]
    command += [str(tmp_path / "clip.mov"), "-vf", "scale='min(2000,iw)':-2"]
    (tmp_path / "plain").mkdir()
    command += ["-fps_mode", "passthrough", "-q:v", "2", str(tmp_path / "plain" / "%04d.jpg")]
    subprocess.run(command, check=True)
    plain = sorted(path.read_bytes() for path in (tmp_path / "plain").iterdir())
    frames = (tmp_path / "work" / "frames").glob("*.jpg")
    assert sorted(path.read_bytes() for path in frames) == plain
