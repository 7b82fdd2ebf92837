"""Diagnose why pictures have no pose, and suggest a remedy."""

import contextlib
import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.sfm.photo_import import PhotoImport

MIN_MATCHES = 30  # verified matches that link two pictures
MAX_BLURRED = 0.08  # sharpness over its median; sharp pictures of plain walls have more
MAX_SOFT = 0.3  # sharpness over its median: blurred, or of a subject with little detail
MIN_BRIGHTNESS, MAX_BRIGHTNESS = 0.08, 0.92  # mean grey value
# Largest |M M^T - I| of a rotation. A translation by 1 % of the distance gives about as much.
MAX_ROTATION_ERROR = 0.02
MIN_HOMOGRAPHY_FRACTION = 0.9  # of the pairs that a single homography must explain
_HOMOGRAPHY_CONFIGS = (4, 5, 6)  # COLMAP's "planar", "panoramic" and "planar or panoramic"
_PAIR = 2147483647  # COLMAP numbers the pair (a, b), a < b, as a * _PAIR + b


@dataclass(frozen=True)
class Unposed:
    """A picture without pose.

    Attributes:
        name: file name of the picture.
        source: original file.
        reason: probable cause, one clause.
        remedy: what to photograph again, one clause.
        neighbours: the best matching pictures, with their numbers of verified matches.
    """

    name: str
    source: str
    reason: str
    remedy: str
    neighbours: tuple[tuple[str, int], ...]


def read_only(database: Path) -> sqlite3.Connection:
    """Open COLMAP's database read-only. The URI quotes "#", "?" and "%" in the path."""
    return sqlite3.connect(database.resolve().as_uri() + "?mode=ro", uri=True, timeout=1.0)


def verified_matches(database: Path) -> dict[tuple[str, str], int]:
    """Return the number of geometrically verified matches of each pair of pictures, if > 0."""
    with contextlib.closing(read_only(database)) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        rows = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0")
        pairs = {}
        for pair, count in rows:
            first, second = divmod(pair, _PAIR)
            pairs[names[first], names[second]] = int(count)
    return pairs


def diagnose(imported: PhotoImport, registered: tuple[str, ...], database: Path) -> list[Unposed]:
    """Return the probable cause for each picture without pose.

    Args:
        imported: all pictures.
        registered: names of the pictures with poses.
        database: COLMAP's database.
    """
    pairs = verified_matches(database)
    partners: dict[str, list[tuple[str, int]]] = {}
    for (a, b), count in pairs.items():
        partners.setdefault(a, []).append((b, count))
        partners.setdefault(b, []).append((a, count))
    sources = {picture.name: picture.source for picture in imported.pictures}
    typical = float(np.median([picture.sharpness for picture in imported.pictures]))
    posed = set(registered)
    unposed = []
    for picture in imported.pictures:
        if picture.name in posed:
            continue
        best = sorted(partners.get(picture.name, []), key=lambda pair: -pair[1])[:3]
        to_posed = max((n for other, n in best if other in posed), default=0)
        detail = picture.sharpness / max(typical, 1e-9)
        near = f" (best: {sources[best[0][0]]}, {best[0][1]} matches)" if best else ""
        if picture.brightness < MIN_BRIGHTNESS or picture.brightness > MAX_BRIGHTNESS:
            side = "dark" if picture.brightness < MIN_BRIGHTNESS else "bright"
            reason, remedy = f"far too {side}", "take it again with locked exposure"
        elif detail < MAX_BLURRED:
            reason = f"blurred ({detail:.0%} of the usual detail)"
            remedy = "take it again with a steady camera"
        elif to_posed >= MIN_MATCHES:
            reason = f"it matches others{near}, but its pose is ambiguous"
            remedy = "take two more beside it, a step apart"
        elif best and best[0][1] >= MIN_MATCHES:
            reason = f"it matches only pictures that are not connected to the rest{near}"
            remedy = "take pictures between these and the others that overlap by two thirds"
        elif detail < MAX_SOFT:
            reason = f"few matches{near}; it has {detail:.0%} of the usual detail"
            remedy = "take it again if it is blurred, else take more pictures around it"
        else:
            reason = f"too little overlap with any other picture{near}"
            remedy = "take pictures between it and its neighbours that overlap by two thirds"
        unposed.append(Unposed(picture.name, picture.source, reason, remedy, tuple(best)))
    return unposed


def is_pure_rotation(imported: PhotoImport, database: Path) -> bool:
    """Return True if the camera only rotated between the pictures, so that they have no parallax.

    The homography between two such pictures is K R K^-1 (Hartley and Zisserman 2004, 8.4.2). With
    the right focal length, M = K^-1 H K is then a rotation. For a plane seen from two positions it
    is not a rotation at any focal length.

    Args:
        imported: all pictures.
        database: COLMAP's database with verified pairs.
    """
    sizes = {picture.name: (picture.width, picture.height) for picture in imported.pictures}
    with contextlib.closing(read_only(database)) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        rows = connection.execute(
            "SELECT pair_id, config, H FROM two_view_geometries WHERE rows >= ?", (MIN_MATCHES,)
        ).fetchall()
    pairs = [
        (*divmod(pair, _PAIR), h) for pair, config, h in rows if config in _HOMOGRAPHY_CONFIGS and h
    ]
    if not pairs or len(pairs) < MIN_HOMOGRAPHY_FRACTION * len(rows):
        return False
    shapes = np.array([[sizes[names[i]], sizes[names[j]]] for i, j, _ in pairs], float)
    maps = np.array([np.frombuffer(h, np.float64).reshape(3, 3) for *_, h in pairs])
    errors = [_rotation_errors(maps, shapes, focal) for focal in np.geomspace(0.4, 6.0, 80)]
    return min(float(np.median(error)) for error in errors) < MAX_ROTATION_ERROR


def _rotation_errors(
    maps: Float[np.ndarray, "n 3 3"], shapes: Float[np.ndarray, "n 2 2"], focal: float
) -> Float[np.ndarray, "n"]:
    """Return |M M^T - I| of M = K2^-1 H K1, scaled to determinant 1.

    Args:
        maps: homographies H from the first to the second picture of each pair, in pixels.
        shapes: (width, height) of both pictures of each pair, pixels.
        focal: focal length over the longer side.
    """
    k = np.zeros((len(shapes), 2, 3, 3))
    k[..., 0, 0] = k[..., 1, 1] = focal * shapes.max(-1)
    k[..., :2, 2], k[..., 2, 2] = shapes / 2, 1.0
    m = np.linalg.inv(k[:, 1]) @ maps @ k[:, 0]
    m = m / np.cbrt(np.linalg.det(m))[:, None, None]
    return np.linalg.norm(m @ m.transpose(0, 2, 1) - np.eye(3), axis=(1, 2))
