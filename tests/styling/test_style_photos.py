"""Styles from photos: reading, classes, the linear map, and measured season files."""

import numpy as np
import pytest
from PIL import Image

from climatenerf.core.classes import ROAD, SKY, TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA, to_linear
from climatenerf.styling.colour_map import colour_map, photo_style
from climatenerf.styling.measure import palette_of, season_of_photos
from climatenerf.styling.style_photos import (
    StylePhotos,
    licence_beside,
    parse_region,
    read_style_photos,
)
from climatenerf.weather.season.palettes import read_palettes
from climatenerf.weather.style import Source

RNG = np.random.default_rng(0)
LEAVES = RNG.uniform(0.0, 1.0, (4000, 3)) ** 2 * [0.5, 0.8, 0.2]
TO_AUTUMN = np.array([[1.5, 0.3, 0.1], [0.3, 0.9, 0.2], [0.1, 0.2, 0.7]])  # symmetric, positive


# --- the map --------------------------------------------------------------------------------------


def test_the_map_is_found_where_the_other_place_is_a_symmetric_map_of_ours():
    """Monge's map is the only symmetric positive one, so it must be the one that made theirs."""
    np.testing.assert_allclose(colour_map(LEAVES, LEAVES @ TO_AUTUMN), TO_AUTUMN, atol=2e-3)


def test_second_moments_become_those_of_the_other_place_and_exposure_passes_through():
    theirs = RNG.uniform(0, 1, (3000, 3)) * [0.9, 0.5, 0.3]
    found = colour_map(LEAVES, theirs)
    new = LEAVES @ found.T
    np.testing.assert_allclose(
        new.T @ new / len(new), theirs.T @ theirs / len(theirs), rtol=2e-3, atol=1e-4
    )
    np.testing.assert_allclose(colour_map(4 * LEAVES, 4 * theirs), found, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("factor", "bound"), [(100.0, 5.0), (0.001, 0.2)])
def test_the_map_is_bounded(factor, bound):
    found = colour_map(LEAVES, factor * LEAVES)
    np.testing.assert_allclose(found, bound * np.eye(3), atol=1e-6)


def test_colours_without_blue_have_a_finite_map():
    theirs = LEAVES * [1.0, 1.0, 0.0]
    assert np.isfinite(colour_map(theirs, LEAVES)).all()
    assert np.isfinite(colour_map(LEAVES, np.zeros((600, 3)))).all()


def test_classes_that_photos_do_not_show_stay_and_are_named():
    photos = StylePhotos({VEGETATION: LEAVES, TERRAIN: LEAVES[:499]}, ())
    ours = {VEGETATION: LEAVES, TERRAIN: LEAVES, ROAD: LEAVES}
    style, notes = photo_style("x", ours, photos, 0.5, 4.0, 0)
    assert [each.kind for each in style.classes] == [VEGETATION]
    assert style.classes[0].strength == 0.5 and style.sky is None
    named = " ".join(notes)
    assert "terrain stays" in named and "road stays" in named and "sky stays" in named


def test_a_class_that_is_rare_on_one_side_stays():
    photos = StylePhotos({VEGETATION: LEAVES[:600], ROAD: np.tile(LEAVES, (40, 1))}, ())
    style, notes = photo_style("x", {VEGETATION: LEAVES}, photos, 1.0, 4.0, 0)
    assert style.classes == () and "vegetation stays" in " ".join(notes)


def test_the_sky_takes_the_photos_colour():
    sky = np.full((600, 3), [0.4, 0.6, 0.8])
    style, _ = photo_style("x", {}, StylePhotos({SKY: sky}, ()), 1.0, 4.0, 0)
    np.testing.assert_allclose(style.sky.colour, sky[0] / (sky[0] @ LUMA))


@pytest.mark.parametrize("kind", [SKY, VEGETATION])
def test_black_classes_count_as_not_shown(kind):
    photos = StylePhotos({TERRAIN: LEAVES, kind: np.zeros((600, 3))}, ())
    style, notes = photo_style("x", {TERRAIN: LEAVES, VEGETATION: LEAVES}, photos, 1.0, 4.0, 0)
    assert [each.kind for each in style.classes] == [TERRAIN] and style.sky is None
    assert ("sky stays" if kind == SKY else "vegetation stays") in " ".join(notes)
    assert set(season_of_photos(photos)) == {"note", "terrain"}


# --- reading --------------------------------------------------------------------------------------


def photo(path, picture=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = RNG.integers(0, 255, (40, 60, 3)) if picture is None else picture
    Image.fromarray(np.asarray(picture, np.uint8)).save(path)
    return path


def test_label_files_tell_the_classes(tmp_path):
    path = photo(tmp_path / "images" / "a.png")
    labels = np.full((40, 60), 8, np.uint8)  # vegetation among Cityscapes' train ids
    labels[:10], labels[10:12] = 10, 255
    (tmp_path / "labels").mkdir()
    Image.fromarray(labels).save(tmp_path / "labels" / "a.png")
    (tmp_path / "LICENSE.md").write_text("Made by\n  somebody, CC BY 4.0")
    photos = read_style_photos([tmp_path])
    assert set(photos.colours) == {VEGETATION, SKY} and photos.notes == ()
    assert len(photos.colours[SKY]) == 600 and len(photos.colours[VEGETATION]) == 28 * 60
    shown = to_linear(np.asarray(Image.open(path)) / 255)
    np.testing.assert_allclose(photos.colours[SKY], shown[:10].reshape(-1, 3))
    assert photos.sources[0].licence == "Made by somebody, CC BY 4.0"
    assert len(photos.sources[0].sha256) == 64


def test_regions_replace_labels(tmp_path):
    path = photo(tmp_path / "a.png")
    photos = read_style_photos([path], [parse_region("terrain=0,0.5,1,1")])
    shown = to_linear(np.asarray(Image.open(path)) / 255)
    np.testing.assert_allclose(photos.colours[TERRAIN], shown[20:].reshape(-1, 3))
    assert set(photos.colours) == {TERRAIN}


def test_without_labels_all_pixels_stand_for_plants_and_ground(tmp_path):
    photos = read_style_photos([photo(tmp_path / "a.png")])
    assert set(photos.colours) == {VEGETATION, TERRAIN}
    assert "no labels" in photos.notes[0]


def test_grey_cmyk_and_16_bit_photos_are_read(tmp_path):
    grey = RNG.integers(0, 255, (40, 60), np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    Image.fromarray(RNG.integers(0, 255, (40, 60, 4), np.uint8), "CMYK").save(tmp_path / "c.jpg")
    colours = read_style_photos([tmp_path]).colours[VEGETATION]
    assert colours.shape == (3 * 2400, 3) and np.isfinite(colours).all() and colours.max() <= 1


@pytest.mark.parametrize(
    ("picture", "named"),
    [(np.zeros((40, 60, 3)), "is black"), (np.full((40, 60, 3), 90), "one colour")],
)
def test_photos_without_colours_are_refused(tmp_path, picture, named):
    path = photo(tmp_path / "a.png", picture)
    with pytest.raises(UserError, match=named):
        read_style_photos([path])


def test_labels_of_another_size_and_absent_photos_are_refused(tmp_path):
    path = photo(tmp_path / "a.png")
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(tmp_path / "labels" / "a.png")
    with pytest.raises(UserError, match="another size"):
        read_style_photos([path])
    with pytest.raises(UserError, match="no style photo"):
        read_style_photos([tmp_path / "b.png"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="holds no photo"):
        read_style_photos([tmp_path / "empty"])


@pytest.mark.parametrize(
    "text", ["leaves=0,0,1,1", "terrain", "terrain=0,0,1", "terrain=0,0,1,2", "terrain=1,0,0,1",
             "terrain=a,0,1,1", "terrain=nan,0,1,1"],
)  # fmt: skip
def test_wrong_regions_are_refused(text):
    with pytest.raises(UserError, match="--style-region must be"):
        parse_region(text)


# --- measured season files ------------------------------------------------------------------------


def test_a_long_licence_ends_with_a_sentence(tmp_path):
    path = photo(tmp_path / "a.png")
    sentence = "Photo by somebody, https://creativecommons.org/licenses/by-sa/4.0/deed.en. "
    (tmp_path / "LICENSE").write_text(8 * sentence)
    assert licence_beside(path) == (8 * sentence).strip()
    (tmp_path / "LICENSE").write_text(90 * sentence)
    found = licence_beside(path)
    assert len(found) <= 2000 and found.endswith("deed.en.")


def test_a_measured_season_names_the_licence_of_its_photos():
    source = Source("a.png", "00", "CC BY-SA 4.0, by somebody.")
    tables = season_of_photos(StylePhotos({VEGETATION: LEAVES}, (source,)))
    assert tables["note"].endswith("CC BY-SA 4.0, by somebody.")


def test_a_palette_holds_the_colours_that_leaves_have_at_any_brightness():
    kinds = np.array([[0.3, 1.1, 0.2], [1.8, 0.8, 0.1], [1.0, 1.0, 0.9], [0.6, 1.0, 0.5]])
    kinds = kinds / (kinds @ LUMA)[:, None]
    leaves = np.repeat(kinds, 500, axis=0) * RNG.uniform(0.1, 0.4, (2000, 1))
    expected = kinds[np.argsort(kinds[:, 0])]
    np.testing.assert_allclose(palette_of(leaves), expected, atol=1e-6)


def test_a_measured_season_can_be_read_back():
    sky = np.full((600, 3), [0.4, 0.6, 0.8])
    tables = season_of_photos(StylePhotos({VEGETATION: LEAVES, SKY: sky}, ()))
    palettes = read_palettes(tables, "a.toml")
    assert palettes.terrain is None and len(palettes.vegetation.palette) == 4
    np.testing.assert_allclose(palettes.sky.colour, sky[0] / (sky[0] @ LUMA), atol=2e-3)
    with pytest.raises(UserError, match="fewer than 500 pixels"):
        season_of_photos(StylePhotos({ROAD: LEAVES}, ()))
