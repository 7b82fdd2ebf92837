"""Import of photos and videos: orientation, formats, damaged files, reuse and pairs to match."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.hdr_signals import CHART, patches
from support.photo_builders import exif, photo

from climatenerf.core.errors import UserError
from climatenerf.core.hdr import KNEE
from climatenerf.core.srgb import to_linear
from climatenerf.scene import image_files
from climatenerf.scene.images import to_rgb
from climatenerf.sfm import photo_import as module
from climatenerf.sfm import video as video_module
from climatenerf.sfm.photo_import import import_photos, open_upright
from climatenerf.sfm.reconstruct import (
    EXHAUSTIVE_UP_TO,
    camera_groups,
    image_pairs,
    retry_pairs,
)
from climatenerf.sfm.video import sharpness, small_grey


def no_progress(*_):
    pass


def fill(folder, count=4):
    for i in range(count):
        photo(folder / f"{i}.jpg", seed=i)


# Transpose from the picture as shown to the stored pixels.
STORED = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_upright(tmp_path, orientation):
    fill(tmp_path / "in", 3)
    shown = photo(tmp_path / "x.png", (80, 48))
    stored = shown if STORED[orientation] is None else shown.transpose(STORED[orientation])
    stored.save(tmp_path / "in" / "rotated.jpg", quality=98, exif=exif(orientation))
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    one = next(p for p in imported.pictures if p.source == "rotated.jpg")
    assert (one.width, one.height) == (80, 48)
    image = Image.open(imported.folder / one.name)
    assert image.getexif().get(0x0112, 1) == 1
    r, g, _ = image.getpixel((4, 4))
    assert r > 200 and g < 60


def test_formats_sizes_and_camera_groups(tmp_path, monkeypatch):
    folder = tmp_path / "in"
    photo(folder / "a.jpg", (400, 300), exif(equivalent=26))
    photo(folder / "b.jpg", (400, 300), exif(equivalent=26), seed=1)
    photo(folder / "c.jpg", (400, 300), exif(equivalent=52), seed=2)
    photo(folder / "sub" / "a.png", (300, 400), seed=3)
    photo(folder / "wide.webp", (500, 200), seed=4)
    photo(folder / "grey.png").convert("L").save(folder / "grey.png")
    (folder / "notes.txt").write_text("not a photo")
    photo(folder / ".thumbnails" / "a.jpg")
    monkeypatch.chdir(folder / "sub")
    imported = import_photos(Path(".."), tmp_path / "work", no_progress)
    assert [p.source for p in imported.pictures] == [
        "a.jpg", "b.jpg", "c.jpg", "grey.png", "sub/a.png", "wide.webp",
    ]  # fmt: skip
    assert len({p.name for p in imported.pictures}) == 6
    assert sorted(len(group) for group in camera_groups(imported.pictures)) == [1, 1, 1, 1, 2]


def test_heic(tmp_path):
    pi_heif = pytest.importorskip("pi_heif")
    pi_heif.register_heif_opener()
    fill(tmp_path / "in", 3)
    (tmp_path / "in" / "bad.heic").write_bytes(b"\x00" * 100)
    # Stored rotated, with an orientation and a phone's EXIF; written by pillow-heif 1.4.
    shutil.copy(Path(__file__).with_name("upright.heic"), tmp_path / "in")
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert len(imported.pictures) == 4 and "bad.heic" in imported.unusable
    one = next(p for p in imported.pictures if p.source == "upright.heic")
    assert (one.width, one.height) == (48, 64) and one.exif.camera == "Apple iPhone 12"
    assert one.exif.focal == pytest.approx(26 / 43.2666 * 80 / 64, rel=1e-3)
    assert one.exif.gps == pytest.approx((47.3769, 8.5417, 410))
    assert one.exif.down_as_shown == pytest.approx((0.08, 0.87, 0.48), abs=0.02)
    r, g, _ = Image.open(imported.folder / one.name).getpixel((4, 4))
    assert r > 200 and g < 60, "the red block is at the upper left"
    again = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert again.pictures == imported.pictures, "the record stores all fields"


def test_unusable_files_are_skipped_with_a_reason(tmp_path):
    fill(tmp_path / "in")
    (tmp_path / "in" / "text.png").write_text("I am a text file\n" * 50)
    (tmp_path / "in" / "empty.jpg").write_bytes(b"")
    whole = (tmp_path / "in" / "0.jpg").read_bytes()
    (tmp_path / "in" / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert len(imported.pictures) == 4
    assert set(imported.unusable) == {"text.png", "empty.jpg", "cut.jpg"}
    assert "empty" in imported.unusable["empty.jpg"]
    assert "is not a picture" in imported.unusable["text.png"]
    assert "damaged or cut off" in imported.unusable["cut.jpg"]
    (tmp_path / "in" / "gone.jpg").symlink_to("nowhere")
    (tmp_path / "in" / "folder.jpg").mkdir()
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert "link to a file that does not exist" in imported.unusable["gone.jpg"]
    for message in imported.unusable.values():
        assert "<" not in message and "Errno" not in message


def test_too_few_usable_pictures_name_the_cause(tmp_path):
    fill(tmp_path / "in", 2)
    (tmp_path / "in" / "empty.jpg").write_bytes(b"")
    with pytest.raises(UserError, match="2 usable .*; unusable: empty.jpg is empty"):
        import_photos(tmp_path / "in", tmp_path / "work", no_progress)


def test_large_pictures_are_reduced_and_huge_ones_refused(tmp_path, monkeypatch):
    fill(tmp_path / "in", 3)
    monkeypatch.setattr(module, "MAX_SIDE", 100)
    monkeypatch.setattr(image_files, "MAX_PIXELS", 100_000)
    photo(tmp_path / "in" / "large.jpg", (300, 150))
    photo(tmp_path / "in" / "huge.png", (600, 400))
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    large = next(p for p in imported.pictures if p.source == "large.jpg")
    assert (large.width, large.height) == (100, 50)
    assert "huge.png has 600x400 pixels, above the limit" in imported.unusable["huge.png"]


def test_second_run_reads_only_changed_files(tmp_path, monkeypatch):
    fill(tmp_path / "in")
    first = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    opened = []
    original = module.open_upright
    monkeypatch.setattr(module, "open_upright", lambda p: opened.append(p.name) or original(p))
    assert import_photos(tmp_path / "in", tmp_path / "work", no_progress).pictures == first.pictures
    assert not opened
    photo(tmp_path / "in" / "2.jpg", (48, 64), seed=9)
    record = first.folder / "1.json"
    record.write_text(record.read_text()[:20])  # killed while writing
    again = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert opened == ["1.jpg", "2.jpg"]
    assert (again.pictures[2].width, again.pictures[2].height) == (48, 64)


def test_blur_reduces_sharpness():
    rng = np.random.default_rng(0)
    sharp = Image.fromarray(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8))
    soft = sharp.resize((160, 120)).resize((640, 480))
    assert sharpness(small_grey(soft)) < 0.2 * sharpness(small_grey(sharp))


@pytest.fixture
def video(tmp_path):
    """Two seconds at 30 frames a second; every other tenth of a second is blurred."""
    import imageio_ffmpeg

    path = tmp_path / "walk.mp4"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", "160x120", "-r", "30", "-i", "-", "-pix_fmt", "yuv420p"]
    rng = np.random.default_rng(0)
    base = Image.fromarray(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)).resize(
        (160, 120), Image.Resampling.NEAREST
    )
    frames = b""
    for i in range(60):
        picture = base.resize((16, 12)).resize((160, 120)) if (i // 3) % 2 else base
        frames += np.asarray(picture).tobytes()
    subprocess.run([*command, str(path)], input=frames, check=True)
    return path


def test_sharpest_frame_of_each_interval_is_used(video, tmp_path, monkeypatch):
    monkeypatch.setattr(video_module, "VIDEO_FRAMES", 6)
    imported = import_photos(video, tmp_path / "work", no_progress)
    assert imported.is_video and 5 <= len(imported.pictures) <= 7
    sharp = [p.sharpness for p in imported.pictures]
    assert min(sharp) > 0.5 * max(sharp), "no blurred frame"
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "work" / "frames").glob("*.jpg")}
    import_photos(video, tmp_path / "work", no_progress)
    assert stamps == {p: p.stat().st_mtime_ns for p in stamps}, "frames are reused"


def test_unusable_sources_name_a_remedy(tmp_path):
    (tmp_path / "bad.mp4").write_bytes(b"not a video" * 100)
    with pytest.raises(UserError, match="cannot be decoded"):
        import_photos(tmp_path / "bad.mp4", tmp_path / "work", no_progress)
    (tmp_path / "song.mp3").write_bytes(b"x")
    with pytest.raises(UserError, match="neither .*; give the folder"):
        import_photos(tmp_path / "song.mp3", tmp_path / "work", no_progress)
    with pytest.raises(UserError, match="does not exist"):
        import_photos(tmp_path / "absent", tmp_path / "work", no_progress)


def test_pairs_to_match():
    assert len(image_pairs(20, False)) == 190
    assert (
        len(image_pairs(EXHAUSTIVE_UP_TO, False)) == EXHAUSTIVE_UP_TO * (EXHAUSTIVE_UP_TO - 1) / 2
    )
    for n, is_video in ((500, False), (90, True)):
        pairs = image_pairs(n, is_video)
        assert len(set(pairs)) == len(pairs) and all(0 <= i < j < n for i, j in pairs)
        assert len(pairs) < 0.5 * n * (n - 1) / 2
        for i in range(n - 1):
            assert (i, i + 1) in pairs
        assert (0, n // 10 * 10 - 10) in pairs, "a loop closure from end to start"


def test_pictures_without_pose_are_matched_again():
    assert retry_pairs([True, False, True], [(0, 1)]) == [(1, 2)]
    assert retry_pairs([True, True, True], [(0, 1)]) == []
    assert retry_pairs([True, False, True], image_pairs(3, False)) == []
    many = retry_pairs([i % 2 == 0 for i in range(400)], [])
    assert 5_000 < len(many) <= 10_000 and len(set(many)) == len(many)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["jpg", "webp", "tif"])
def test_damaged_exif_does_not_fail(tmp_path, kind):
    """Random bytes of the EXIF block are changed: the photo is read, or skipped with a reason."""
    data = exif(6, 4.2, 26, (47.0, 8.0, 400.0), gravity=(0.0, -1.0, 0.0), lens="back")
    photo(tmp_path / f"whole.{kind}", (40, 30), data)
    whole = bytearray((tmp_path / f"whole.{kind}").read_bytes())
    start = whole.find(b"Maker") - 200
    rng = np.random.default_rng(0)
    for _ in range(150):
        changed = whole.copy()
        for at in rng.integers(max(start, 12), start + 500, 3):
            changed[at % len(changed)] = rng.integers(256)
        (tmp_path / f"a.{kind}").write_bytes(changed)
        try:
            image, found, _ = open_upright(tmp_path / f"a.{kind}")
        except UserError:
            continue
        assert image.mode == "RGB" and 1 <= found.orientation <= 8


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "CMYK", "I;16", "P"])
@pytest.mark.parametrize("kind", ["tif", "png", "jpg"])
def test_pictures_of_every_mode_are_rotated_once(tmp_path, kind, mode):
    if kind == "jpg" and mode in ("RGBA", "I;16", "P"):
        pytest.skip("JPEG does not support this mode")
    if kind == "png" and mode == "CMYK":
        pytest.skip("PNG does not support this mode")
    bright = 60000 if mode == "I;16" else 230
    values = np.zeros((30, 40), np.uint16 if mode == "I;16" else np.uint8)
    values[:10, :10] = bright  # upper left as stored: upper right with orientation 6
    image = Image.fromarray(values)
    image = image if mode == "I;16" else image.convert(mode)
    data = Image.Exif()
    data[0x0112] = 6
    image.save(tmp_path / f"a.{kind}", exif=data)
    shown = open_upright(tmp_path / f"a.{kind}").image
    assert shown.size == (30, 40)
    assert min(shown.getpixel((26, 3))) > 200 and max(shown.getpixel((3, 3))) < 60
    assert max(shown.getpixel((26, 36))) < 60


@pytest.mark.parametrize("name", ["HLG", "PQ"])
def test_hdr_photos_are_tone_mapped_and_reported_once(tmp_path, name):
    """A chart of 10 bits with an nclx box, written by pillow-heif 1.8."""
    pytest.importorskip("pi_heif")
    for i in range(3):
        chart = Path(__file__).with_name(f"chart-{name.lower()}.heic")
        photo(tmp_path / "in" / f"{i}.jpg", seed=i)
        shutil.copy(chart, tmp_path / "in" / f"chart{i}.HIF")
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert imported.notes == (f"3 of 6 photos are HDR ({name}); they are tone-mapped to sRGB.",)
    one = next(p for p in imported.pictures if p.source == "chart0.HIF")
    found = patches(Image.open(imported.folder / one.name), 16)
    below = to_linear(CHART / 255).max(axis=1) <= KNEE
    assert np.abs(found - CHART)[below].max() <= 3
    again = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    assert again.pictures == imported.pictures and again.notes == imported.notes
    large, _, _ = open_upright(tmp_path / "in" / "chart0.HIF")
    assert large.size == (96, 64)


def test_hdr_photos_are_reduced(monkeypatch):
    pytest.importorskip("pi_heif")
    monkeypatch.setattr(module, "MAX_SIDE", 48)
    small = open_upright(Path(__file__).with_name("chart-hlg.heic")).image
    assert small.size == (48, 32)
    assert np.abs(np.asarray(small)[4, 4].astype(int) - CHART[0]).max() <= 3


def test_gain_maps_are_reported_once_and_not_used(tmp_path):
    for i in range(3):
        xmp = b'<rdf:Description hdrgm:Version="1.0"/>'
        photo(tmp_path / "in" / f"{i}.jpg", seed=i, xmp=xmp)
    imported = import_photos(tmp_path / "in", tmp_path / "work", no_progress)
    (note,) = imported.notes
    assert "3 of 3 photos have an HDR gain map, which is not used" in note


@pytest.mark.parametrize("mode", ["I;16", "RGBA", "LA", "P", "CMYK", "L", "RGB", "1"])
def test_reduction_of_each_mode_equals_that_of_its_rgb_picture(mode, monkeypatch):
    monkeypatch.setattr(module, "MAX_SIDE", 90)
    rng = np.random.default_rng(0)
    if mode == "I;16":
        image = Image.fromarray(rng.integers(0, 65536, (300, 700)).astype(np.uint16))
    else:
        image = Image.fromarray(rng.integers(0, 256, (300, 700, 3), dtype=np.uint8)).convert(mode)
    if mode == "RGBA":
        image.putalpha(Image.fromarray(rng.integers(0, 256, (300, 700), dtype=np.uint8)))
    whole = Image.fromarray(to_rgb(image))
    whole.thumbnail((90, 90), Image.Resampling.LANCZOS, reducing_gap=3.0)
    np.testing.assert_array_equal(module._reduced(image).convert("RGB"), whole)
