"""Why pictures got no pose, and what to do about it."""

import contextlib
import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.sfm.photo_import import PhotoImport

MIN_MATCHES = 30  # verified ones that a picture needs with a posed one
BLURRED = 0.08  # of the median sharpness; a sharp picture of plain walls has more
SOFT = 0.3  # of the median sharpness: blurred, or of a plain subject
DARK, BRIGHT = 0.08, 0.92  # mean grey value
MAX_ROTATION_ERROR = (
    0.02  # deviation from a rotation; a step of a hundredth of the distance makes as much
)
MIN_HOMOGRAPHY_FRACTION = 0.9  # of the pairs that one homography explains
_HOMOGRAPHY_CONFIGS = (4, 5, 6)  # COLMAP's planar, panoramic, and either
_PAIR = 2147483647  # COLMAP numbers the pair (a, b), a < b, as a * _PAIR + b


@dataclass(frozen=True)
class Unposed:
    """A picture without pose.

    Attributes:
        name: of the picture.
        source: the file it came from.
        reason: probable reason, one clause.
        remedy: what to photograph again, one clause.
        neighbours: the pictures that it fits best, with the number of verified matches.
    """

    name: str
    source: str
    reason: str
    remedy: str
    neighbours: tuple[tuple[str, int], ...]


def read_only(database: Path) -> sqlite3.Connection:
    """Opens COLMAP's database without changing it; "#", "?" and "%" in its path are quoted."""
    return sqlite3.connect(database.resolve().as_uri() + "?mode=ro", uri=True, timeout=1.0)


def verified_matches(database: Path) -> dict[tuple[str, str], int]:
    """Number of geometrically verified matches of each pair of pictures that has any."""
    with contextlib.closing(read_only(database)) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        rows = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0")
        pairs = {}
        for pair, count in rows:
            first, second = divmod(pair, _PAIR)
            pairs[names[first], names[second]] = int(count)
    return pairs


def diagnose(imported: PhotoImport, registered: tuple[str, ...], database: Path) -> list[Unposed]:
    """The probable reason for each picture without pose, the likeliest first."""
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
        if picture.brightness < DARK or picture.brightness > BRIGHT:
            side = "dark" if picture.brightness < DARK else "bright"
            reason, remedy = f"far too {side}", "take it again with the exposure locked"
        elif detail < BLURRED:
            reason = f"blurred ({detail:.0%} of the usual detail)"
            remedy = "take it again, holding still"
        elif to_posed >= MIN_MATCHES:
            reason = f"fits others{near} but its place stays ambiguous"
            remedy = "take two more from beside it, a step apart"
        elif best and best[0][1] >= MIN_MATCHES:
            reason = f"fits only pictures that are cut off from the rest{near}"
            remedy = "take pictures that lead from these to the others, two thirds in common"
        elif detail < SOFT:
            reason = f"few matches{near}; it has {detail:.0%} of the usual detail"
            remedy = "if it looks blurred take it again, else take pictures that lead to it"
        else:
            reason = f"too little in common with any other{near}"
            remedy = "take pictures between it and its neighbours, two thirds in common"
        unposed.append(Unposed(picture.name, picture.source, reason, remedy, tuple(best)))
    return unposed


def is_pure_rotation(imported: PhotoImport, database: Path) -> bool:
    """Whether the pictures differ by turning the camera alone: then they hold no depth.

    Two such pictures are mapped onto each other by K R K^-1 (Hartley & Zisserman 2004, 8.4.2): with
    the right focal length what is left of the homography is a rotation. Of a plane seen from two
    places it never is.
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
    """|M M^T - I| of M = K2^-1 H K1, for a focal length over the longer side."""
    k = np.zeros((len(shapes), 2, 3, 3))
    k[..., 0, 0] = k[..., 1, 1] = focal * shapes.max(-1)
    k[..., :2, 2], k[..., 2, 2] = shapes / 2, 1.0
    m = np.linalg.inv(k[:, 1]) @ maps @ k[:, 0]
    m = m / np.cbrt(np.linalg.det(m))[:, None, None]
    return np.linalg.norm(m @ m.transpose(0, 2, 1) - np.eye(3), axis=(1, 2))
