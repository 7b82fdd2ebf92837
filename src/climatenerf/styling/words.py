"""A season from a short text, by a list of words: "late autumn, dry lawns". No torch.

Each phrase between commas names a season, a colour or a state, and what has it: leaves, ground or
sky; without a noun a season changes everything, and a colour the leaves.
"""

import re
from dataclasses import dataclass, replace

from climatenerf.core.errors import UserError
from climatenerf.weather.season.palettes import (
    ClassPalette,
    Palettes,
    palettes_of,
    unit_luminance,
)
from climatenerf.weather.style import Colour, SkyPalette

SEASONS = {
    "autumn": "autumn", "autumnal": "autumn", "fall": "autumn", "october": "autumn",
    "november": "autumn", "winter": "winter", "wintry": "winter", "bare": "winter",
    "dead": "winter", "january": "winter", "february": "winter", "drought": "drought",
    "dry": "drought", "parched": "drought", "withered": "drought", "straw": "drought",
    "wildfire": "wildfire", "fire": "wildfire", "smoky": "wildfire",
}  # fmt: skip
COLOURS: dict[str, Colour] = {
    "red": (2.6, 0.55, 0.35), "orange": (1.9, 0.82, 0.16), "golden": (1.55, 0.96, 0.14),
    "yellow": (1.35, 1.0, 0.12), "brown": (1.5, 0.92, 0.5), "grey": (1.0, 1.0, 1.0),
    "gray": (1.0, 1.0, 1.0), "white": (1.0, 1.0, 1.02), "green": (0.7, 1.13, 0.35),
    "blue": (0.6, 1.0, 2.1), "purple": (1.6, 0.75, 1.7), "pink": (1.6, 0.8, 1.1),
}  # fmt: skip
NOUNS = {
    "leaf": "vegetation", "leaves": "vegetation", "foliage": "vegetation", "tree": "vegetation",
    "trees": "vegetation", "hedge": "vegetation", "hedges": "vegetation", "bush": "vegetation",
    "bushes": "vegetation", "forest": "vegetation", "plants": "vegetation",
    "lawn": "terrain", "lawns": "terrain", "grass": "terrain", "meadow": "terrain",
    "field": "terrain", "fields": "terrain", "ground": "terrain", "soil": "terrain",
    "sky": "sky", "skies": "sky", "clouds": "sky",
}  # fmt: skip
SKIES = {"overcast": "grey", "cloudy": "grey", "dull": "grey"}
WEAKER = {"slightly", "little", "early", "somewhat"}
STRONGER = {"very", "deep", "strong", "strongly", "completely"}
DARKER = {"late": 0.85, "dark": 0.7}
BRIGHTER = {"bright": 1.2, "pale": 1.15, "light": 1.15}
NEGATIONS = {"not", "no", "without", "never"}
FILLERS = {"a", "an", "the", "of", "in", "with", "under", "all", "day", "season", "colours",
           "colors", "coloured", "colored", "scene", "place"}  # fmt: skip
HALF = 0.5  # of the strength, by a weaker word


@dataclass(frozen=True)
class Reading:
    """What a text means.

    Attributes:
        palettes: the colours.
        understood: phrases that were understood, each with what it does.
        unknown: words without a rule.
    """

    palettes: Palettes
    understood: tuple[str, ...]
    unknown: tuple[str, ...]


def read_text(text: str) -> Reading:
    """Return the season that a text describes.

    Raises:
        UserError: nothing in it is understood.
    """
    palettes = Palettes(note=f'From the text "{text[:200]}".')
    understood, unknown = [], []
    for words in _phrases(text.lower()):
        known = [word for word in words if _has_rule(word)]
        meaning = Palettes() if NEGATIONS & set(words) else _meaning(known)
        parts = {name: part for name, part in vars(meaning).items() if name != "note" and part}
        if not parts:
            unknown += [word for word in words if word not in FILLERS]
            continue
        seasons = [word for word in known if word in SEASONS]
        unknown += [word for word in words if word not in known and word not in FILLERS]
        unknown += [word for word in seasons[1:] if SEASONS[word] != SEASONS[seasons[0]]]
        idle = [word for word in known if word in WEAKER | STRONGER][:-1]  # the last one counts
        if parts.keys() == {"sky"}:  # its brightness is that of the light
            idle += [word for word in known if word in DARKER or word in BRIGHTER]
        unknown += idle
        known = [word for word in known if word not in idle]
        palettes = replace(palettes, **parts)
        understood.append(f'"{" ".join(known)}" changes {", ".join(parts)}')
    if not understood:
        raise UserError(
            f'no rule for the text "{text[:60]}"; name a season ({", ".join(sorted(set(SEASONS)))})'
            f" or a colour ({', '.join(COLOURS)}), and what has it (leaves, lawns, sky)"
        )
    return Reading(palettes, tuple(understood), tuple(dict.fromkeys(unknown)))


def _phrases(text: str) -> list[list[str]]:
    """Return the words of each phrase; colours before "and" go to the noun behind it."""
    phrases: list[list[str]] = []
    pending: list[str] = []
    parts = re.split(r"([,;.]|\band\b|\bwith\b|\bunder\b)", text)
    for phrase, separator in zip(parts[::2], [*parts[1::2], ","], strict=True):
        words = pending + re.findall(r"[\w'-]+", phrase)
        colours_alone = bool(words) and all(word in {*COLOURS, *FILLERS} for word in words)
        pending = words if separator == "and" and colours_alone else []
        if words and not pending:
            phrases.append(words)
    return phrases


def _has_rule(word: str) -> bool:
    tables = SEASONS, COLOURS, NOUNS, SKIES, WEAKER, STRONGER, DARKER, BRIGHTER
    return any(word in table for table in tables)


def _meaning(words: list[str]) -> Palettes:
    """Return what the known words of a phrase change; nothing without a season or a colour."""
    targets = {NOUNS[word] for word in words if word in NOUNS}
    targets |= {"sky" for word in words if word in SKIES}
    seasons = [SEASONS[word] for word in words if word in SEASONS]
    colours = [COLOURS[SKIES.get(word, word)] for word in words if word in {*COLOURS, *SKIES}]
    found = Palettes()
    if seasons:
        season = palettes_of(seasons[0])
        parts = {
            name: getattr(season, name) for name in targets or ("vegetation", "terrain", "sky")
        }
        found = replace(found, **parts)
    if colours:
        palette = tuple(unit_luminance(colour) for colour in colours)
        for name in targets or {"vegetation"}:
            found = replace(found, **{name: _coloured(name, palette)})
    return _modified(found, words)


def _coloured(name: str, palette: tuple[Colour, ...]) -> ClassPalette | SkyPalette:
    if name == "sky":
        return SkyPalette(palette[0], 0.0, 0.75)
    return ClassPalette(palette, 0.85, 1.0, 0.2)


def _modified(palettes: Palettes, words: list[str]) -> Palettes:
    """Return palettes made weaker, stronger, darker or brighter."""
    factor, brightness = 1.0, 1.0
    for word in words:
        factor = HALF if word in WEAKER else 1.2 if word in STRONGER else factor
        brightness *= DARKER.get(word, BRIGHTER.get(word, 1.0))

    def changed(part: ClassPalette | None) -> ClassPalette | None:
        if part is None:
            return None
        strength = min(part.strength * factor, 1.0)
        return replace(part, strength=strength, brightness=part.brightness * brightness)

    sky = palettes.sky
    if sky is not None:
        sky = replace(sky, share=min(sky.share * factor, 1.0))
    return replace(
        palettes,
        vegetation=changed(palettes.vegetation),
        terrain=changed(palettes.terrain),
        sky=sky,
    )
