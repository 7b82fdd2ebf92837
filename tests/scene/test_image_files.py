"""Opening of image files: HEIC in posed captures, sizes, colour profiles, HDR signals."""

import shutil
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile, PngImagePlugin, features
from support.hdr_signals import CHART, chart_image, hlg_signal, patches, pq_signal
from support.icc_profiles import cicp_profile, display_p3
from support.scene_builders import ring, write_colmap, write_transforms

from climatenerf.cli import main
from climatenerf.core.errors import UserError
from climatenerf.core.hdr import KNEE
from climatenerf.core.srgb import to_linear
from climatenerf.scene import image_files, load_image, read_scene
from climatenerf.scene.image_files import Hdr, differs_from_srgb, has_gain_map, hdr_of, open_image
from climatenerf.scene.images import read_header

HEIC = Path(__file__).parents[1] / "sfm" / "upright.heic"  # 48x64 as shown, stored rotated
NAMES = [f"{i}.HEIC" for i in range(4)]
BELOW_KNEE = to_linear(CHART / 255).max(axis=1) <= KNEE


def heic_capture(root, layout):
    (root / "images").mkdir(parents=True)
    for name in NAMES:
        shutil.copy(HEIC, root / "images" / name)
    poses = ring(len(NAMES))
    if layout == "colmap":
        camera = (1, "PINHOLE", 48, 64, (50.0, 50.0, 24.0, 32.0))
        write_colmap(root / "sparse" / "0", poses, NAMES, [camera])
    else:
        names = [f"images/{name}" for name in NAMES]
        write_transforms(root / "transforms.json", poses, names, fl_x=50.0)
    return root


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_posed_capture_of_heic_photos_is_read_upright(tmp_path, layout):
    pytest.importorskip("pi_heif")
    scene = read_scene(heic_capture(tmp_path, layout))
    header = read_header(scene.views[0].path)
    assert (header.width, header.height, header.orientation) == (48, 64, 1)
    assert (scene.cameras[0].width, scene.cameras[0].height) == (48, 64)
    image = load_image(scene.views[0], scene)
    r, g, _ = image[4, 4]
    assert image.shape == (64, 48, 3) and r > 200 and g < 60, "the red block is at the upper left"
    assert load_image(scene.views[0], scene, 2).shape == (32, 24, 3)


def test_heic_is_recognised_by_its_content(tmp_path):
    pytest.importorskip("pi_heif")
    shutil.copy(HEIC, tmp_path / "renamed.jpg")
    assert read_header(tmp_path / "renamed.jpg").height == 64


@pytest.mark.parametrize("verb", ["fit", "capture"])
def test_missing_heic_decoder_is_one_sentence(tmp_path, monkeypatch, capsys, verb):
    root = heic_capture(tmp_path / "in", "colmap")
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    monkeypatch.delitem(Image.OPEN, "HEIF", raising=False)
    source = root if verb == "fit" else root / "images"
    assert main([verb, str(source), "-o", str(tmp_path / "out")]) == 2
    errors = capsys.readouterr().err.strip()
    assert 'is a HEIC file; run `pip install "climatenerf[capture]"`' in errors.replace("\n", " ")
    assert "Traceback" not in errors


def test_damaged_heic_is_named(tmp_path):
    pytest.importorskip("pi_heif")
    root = heic_capture(tmp_path, "colmap")
    whole = HEIC.read_bytes()
    (root / "images" / NAMES[1]).write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(UserError, match="1.HEIC"):
        scene = read_scene(root)
        load_image(scene.views[1], scene)


def test_size_limit_is_one_clear_sentence(tmp_path, monkeypatch):
    Image.new("L", (600, 400)).save(tmp_path / "huge.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_header(tmp_path / "huge.png").width == 600, "Pillow's own limit is lifted"
    assert Image.MAX_IMAGE_PIXELS == 100
    monkeypatch.setattr(image_files, "MAX_PIXELS", 100_000)
    with pytest.raises(UserError, match="huge.png has 600x400 pixels, above the limit of 0.1 mega"):
        read_header(tmp_path / "huge.png")


def png_scene(root, save):
    (root / "images").mkdir(parents=True)
    names = [f"{i}.png" for i in range(3)]
    for name in names:
        save(root / "images" / name)
    camera = (1, "PINHOLE", 192, 128, (150.0, 150.0, 96.0, 64.0))
    write_colmap(root / "sparse" / "0", ring(3), names, [camera])
    return read_scene(root)


def test_wide_gamut_photos_of_a_posed_capture_become_srgb(tmp_path):
    profile = display_p3()
    colour = Image.new("RGB", (192, 128), (200, 100, 50))
    scene = png_scene(tmp_path, lambda path: colour.save(path, icc_profile=profile))
    assert differs_from_srgb(profile)
    # Display P3 to sRGB by the matrix of the primaries, in linear light.
    matrix = [[1.2249, -0.2249, 0], [-0.0420, 1.0420, 0], [-0.0197, -0.0786, 1.0983]]
    linear = np.array(matrix) @ (np.array([200, 100, 50]) / 255) ** 2.2
    expected = 255 * np.where(linear < 0.0031, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(load_image(scene.views[0], scene)[5, 5], expected, atol=2)


def test_photos_with_an_srgb_profile_are_not_changed(tmp_path):
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    pixels = np.random.default_rng(0).integers(0, 256, (128, 192, 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    scene = png_scene(tmp_path, lambda path: image.save(path, icc_profile=profile))
    np.testing.assert_array_equal(load_image(scene.views[0], scene), pixels)
    assert not differs_from_srgb(profile) and not differs_from_srgb(b"damaged")


@pytest.mark.parametrize(("code", "encode"), [(18, hlg_signal), (16, pq_signal)])
def test_hdr_photos_named_by_their_profile_are_tone_mapped(tmp_path, code, encode):
    values = np.rint(encode(chart_image()) * 255).astype(np.uint8)
    profile = cicp_profile(9, code)
    scene = png_scene(
        tmp_path, lambda path: Image.fromarray(values).save(path, icc_profile=profile)
    )
    found = patches(load_image(scene.views[0], scene))
    # 8 bits of PQ resolve 3 % of luminance only, which is 8 values of the red of cyan.
    assert np.abs(found - CHART)[BELOW_KNEE].max() <= (3 if code == 18 else 10)


@pytest.mark.parametrize(("code", "encode"), [(18, hlg_signal), (16, pq_signal)])
def test_hdr_png_named_by_a_chunk_is_tone_mapped(tmp_path, code, encode):
    values = np.rint(encode(chart_image()) * 255).astype(np.uint8)
    chunks = PngImagePlugin.PngInfo()
    chunks.add_text("Comment", "x" * 5000)
    chunks.add(b"cICP", bytes([9, code, 0, 1]))
    scene = png_scene(tmp_path, lambda path: Image.fromarray(values).save(path, pnginfo=chunks))
    assert [each.code for each in scene.findings if each.code == "photo-hdr"]
    found = patches(load_image(scene.views[0], scene))
    assert np.abs(found - CHART)[BELOW_KNEE].max() <= (3 if code == 18 else 10)


@pytest.mark.skipif(not features.check("avif"), reason="Pillow lacks AVIF")
@pytest.mark.parametrize(("code", "encode"), [(18, hlg_signal), (16, pq_signal)])
def test_hdr_avif_is_tone_mapped(tmp_path, code, encode):
    values = np.rint(encode(chart_image()) * 255).astype(np.uint8)

    def save(path):
        Image.fromarray(values).save(path, "AVIF", quality=100, subsampling="4:4:4")
        data = path.read_bytes()
        at = data.index(b"colrnclx") + 8
        path.write_bytes(data[:at] + bytes([0, 9, 0, code]) + data[at + 4 :])

    scene = png_scene(tmp_path, save)
    found = patches(load_image(scene.views[0], scene))
    assert np.abs(found - CHART)[BELOW_KNEE].max() <= (10 if code == 18 else 20)


def test_the_header_of_a_png_is_read_without_its_pixels(tmp_path, monkeypatch):
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 30)).save(tmp_path / "b.png", exif=exif)
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("decoded"))
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda self: pytest.fail("decoded"))
    assert read_header(tmp_path / "a.png").width == 40
    assert read_header(tmp_path / "b.png").orientation == 6


def test_pictures_that_are_programs_are_refused(tmp_path):
    head = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n%%EndComments\nshowpage\n"
    (tmp_path / "a.jpg").write_bytes(head)
    with pytest.raises(UserError, match="cannot be read"):
        read_header(tmp_path / "a.jpg")


def test_signals_are_found_in_profiles_and_nclx_boxes():
    image = Image.new("RGB", (2, 2))
    assert hdr_of(image) is None
    image.info["icc_profile"] = cicp_profile(12, 16)
    assert hdr_of(image) == Hdr("PQ", "p3")
    image.info["icc_profile"] = cicp_profile(1, 13)
    assert hdr_of(image) is None
    image.info["icc_profile"] = cicp_profile(9, 18)[:140]
    assert hdr_of(image) is None
    image.info["nclx_profile"] = {"color_primaries": 9, "transfer_characteristics": 18}
    assert hdr_of(image) == Hdr("HLG", "bt2020")


def test_gain_maps_are_recognised():
    image = Image.new("RGB", (2, 2))
    assert not has_gain_map(image)
    image.info["xmp"] = b'<rdf:Description hdrgm:Version="1.0"/>'
    assert has_gain_map(image)
    image.info = {"aux": {"urn:com:apple:photo:2020:aux:hdrgainmap": [5]}}
    assert has_gain_map(image)


def test_downscaled_strips_equal_the_whole(tmp_path, monkeypatch):
    from climatenerf.scene import images

    pixels = np.random.default_rng(1).integers(0, 256, (128, 192, 3), dtype=np.uint8)
    scene = png_scene(tmp_path, Image.fromarray(pixels).save)
    for downscale in (2, 3, 5):
        whole = load_image(scene.views[0], scene, downscale)
        with monkeypatch.context() as patch:
            patch.setattr(images, "_STRIP", 2000)
            np.testing.assert_array_equal(load_image(scene.views[0], scene, downscale), whole)


def test_wide_grey_in_strips_equals_the_whole(tmp_path, monkeypatch):
    from climatenerf.scene import images

    grey = np.random.default_rng(2).integers(0, 65536, (50, 40)).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "a.png")
    monkeypatch.setattr(images, "_STRIP", 300)
    with open_image(tmp_path / "a.png") as image:
        found = images.to_rgb(image)
    np.testing.assert_array_equal(found[..., 1], np.rint(grey / 65535 * 255))
