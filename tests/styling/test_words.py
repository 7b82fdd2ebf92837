"""Seasons from a text."""

import pytest

from climatenerf.core.errors import UserError
from climatenerf.styling.words import read_text
from climatenerf.weather.season.palettes import palettes_of

AUTUMN, DROUGHT, WINTER = (palettes_of(name) for name in ("autumn", "drought", "winter"))


def test_phrases_name_seasons_and_what_has_them():
    reading = read_text("late autumn, dry lawns")
    palettes = reading.palettes
    assert palettes.vegetation.palette == AUTUMN.vegetation.palette
    assert palettes.vegetation.brightness == pytest.approx(0.85 * AUTUMN.vegetation.brightness)
    assert palettes.terrain == DROUGHT.terrain and palettes.sky == AUTUMN.sky
    assert reading.unknown == () and len(reading.understood) == 2


def test_colours_go_to_the_leaves_or_to_what_is_named():
    palettes = read_text("red and golden trees").palettes
    assert palettes.terrain is None and palettes.vegetation.palette[0][0] > 1.3
    assert len(read_text("red golden trees").palettes.vegetation.palette) == 2
    sky = read_text("grey sky").palettes.sky
    assert sky.colour == pytest.approx((1, 1, 1))
    assert read_text("overcast").palettes.sky == sky


def test_words_make_a_season_weaker_or_stronger():
    weaker, stronger = (read_text(f"{word} winter").palettes for word in ("slightly", "very"))
    assert weaker.vegetation.strength == pytest.approx(0.5 * WINTER.vegetation.strength)
    assert weaker.sky.share == pytest.approx(0.5 * WINTER.sky.share)
    assert stronger.vegetation.strength == 1


def test_what_has_no_rule_is_told():
    reading = read_text("winter with cherry blossom")
    assert reading.unknown == ("cherry", "blossom")
    assert reading.palettes.vegetation == WINTER.vegetation
    with pytest.raises(UserError, match="no rule for"):
        read_text("cherry blossom")
    with pytest.raises(UserError, match="no rule for"):
        read_text("trees")


def test_colours_joined_by_and_are_one_palette():
    palettes = read_text("yellow and red leaves and grey sky").palettes
    assert len(palettes.vegetation.palette) == 2 and palettes.sky.colour == pytest.approx((1, 1, 1))


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("winter, autumn sky", {"autumn", "sky"}),  # autumn has no sky of its own
        ("winter autumn", {"autumn"}),
        ("winter, not red leaves", {"not", "red", "leaves"}),
        ("brown lawn and dark", {"dark"}),
        ("dark grey sky", {"dark"}),  # its brightness is that of the light
        ("very slightly autumn", {"very"}),
    ],
)
def test_every_word_without_effect_is_named(text, unknown):
    assert set(read_text(text).unknown) == unknown


def test_light_green_leaves_change_wholly():
    plain, light = (read_text(f"{word}green leaves").palettes for word in ("", "light "))
    assert light.vegetation.strength == plain.vegetation.strength
    assert light.vegetation.brightness > plain.vegetation.brightness
