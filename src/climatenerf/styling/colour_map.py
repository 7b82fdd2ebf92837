"""A style from photos: the linear map that gives a class the colours of the same class elsewhere.

With the uncentred second moments S of our colours and R of theirs, the map of least change is
A = S^-1/2 (S^1/2 R S^1/2)^1/2 S^-1/2 (Monge-Kantorovich, Pitie and Kokaram 2007, without means). It
is linear, so black stays black and the exposure passes through.
"""

import numpy as np
from jaxtyping import Float

from climatenerf.core.classes import CLASS_NAMES, SKY, SOLID
from climatenerf.core.srgb import LUMA
from climatenerf.styling.style_photos import MIN_PIXELS, StylePhotos, is_shown
from climatenerf.weather.style import ClassStyle, SkyPalette, Style

FLOOR = 1e-5  # added to the moments' diagonal: a class without blue has a singular matrix
GAINS = (0.2, 5.0)  # bounds of the map's eigenvalues
MAX_RATIO = 100.0  # of the fractions of a class here and there
SKY_SHARE = 0.75  # of the photographed sky that the style's replaces


def colour_map(
    ours: Float[np.ndarray, "n 3"], theirs: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the map A of linear colours c to A c.

    Args:
        ours: linear colours of a class in the scene.
        theirs: linear colours of it in the style photos.
    """
    floor = FLOOR * np.eye(3)
    s, r = (colours.T @ colours / len(colours) + floor for colours in (ours, theirs))
    values, vectors = np.linalg.eigh(transport_map(s, r))
    return vectors @ np.diag(values.clip(*GAINS)) @ vectors.T


def transport_map(
    s: Float[np.ndarray, "3 3"], r: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the symmetric map A with A S A = R, the one that moves colours least.

    Args:
        s: moments or covariance of the colours that are moved, positive definite.
        r: those to be reached.
    """
    root, inverse = _power(s, 0.5), _power(s, -0.5)
    found = inverse @ _power(root @ r @ root, 0.5) @ inverse
    return (found + found.T) / 2


def _power(matrix: Float[np.ndarray, "3 3"], exponent: float) -> Float[np.ndarray, "3 3"]:
    """Return a power of a positive matrix."""
    values, vectors = np.linalg.eigh(matrix)
    # 1e-12: rounding can make the least eigenvalue negative, which has no root.
    return vectors @ np.diag(values.clip(1e-12) ** exponent) @ vectors.T


def photo_style(
    name: str,
    ours: dict[int, Float[np.ndarray, "n 3"]],
    photos: StylePhotos,
    strength: float,
    patch: float,
    seed: int,
) -> tuple[Style, tuple[str, ...]]:
    """Return the style of photos for a scene, and a sentence for each class that stays.

    Args:
        name: of the style.
        ours: linear colours of the scene's classes.
        photos: colours of the style photos.
        strength: fraction of the change that is made.
        patch: size of places that turn alike, m; kept for seasons.
        seed: of their noise.
    """
    notes = list(photos.notes)
    here, there = (
        sum(len(colours) for colours in each.values()) for each in (ours, photos.colours)
    )
    classes = []
    for kind in map(int, SOLID):
        own, new = ours.get(kind, np.zeros((0, 3))), photos.colours.get(kind, np.zeros((0, 3)))
        if not len(own):
            continue
        if not is_shown(new):
            how = f"show fewer than {MIN_PIXELS} pixels of it" if len(new) else "do not show it"
            notes.append(f"{CLASS_NAMES[kind]} stays: the style photos {how}")
            continue
        ratio = (len(own) / here) / (len(new) / there)
        if not 1 / MAX_RATIO < ratio < MAX_RATIO:
            notes.append(
                f"{CLASS_NAMES[kind]} stays: the style photos show {100 * len(new) / there:.1f} %"
                f" of it, the scene {100 * len(own) / here:.1f} %"
            )
            continue
        matrix = colour_map(own, new)
        classes.append(ClassStyle(kind, np.zeros((1, 3)), matrix, strength, 1.0))
    sky = None
    colours = photos.colours.get(SKY, np.zeros((0, 3)))
    if is_shown(colours):
        mean = colours.mean(0)
        red, green, blue = (mean / (mean @ np.array(LUMA))).tolist()
        sky = SkyPalette((red, green, blue), 0.0, SKY_SHARE * strength)
    else:
        notes.append("the sky stays: the style photos do not show it")
    return Style(name, tuple(classes), sky, patch, seed, photos.sources), tuple(notes)
