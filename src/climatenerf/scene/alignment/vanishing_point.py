"""The vertical vanishing point of a capture, from straight line segments in its pictures.

Segments are line-support regions (Burns, Hanson and Riseman 1986): connected pixels whose gradients
point the same way. Only edges that could be upright, going by a first guess of up, are followed.
Each segment and the camera's centre span a plane; upright segments' planes all contain the
vertical, so up is the direction closest to orthogonal to their normals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.scene.images import downscaled_camera, load_image
from climatenerf.scene.scene import Scene

GUESS_CONE = 25.0  # degrees: how far an edge may lean away from the first guess
INLIER = 1.5  # degrees between a segment and the vertical through it
MAX_IMAGES = 32
LONGEST_SIDE = 900  # pixels: larger pictures are reduced first
_BIN = 22.5  # degrees of gradient direction in one line-support region


@dataclass(frozen=True)
class VerticalLines:
    """The vertical vanishing direction and what supports it.

    Attributes:
        up: Unit vector, input frame, on the same side as the first guess.
        sigma: Standard error of `up`, degrees, in its least certain direction.
        segments: Number of segments that agree with `up`.
        images: Number of pictures these come from.
        share: Their share, by length, of all segments that were considered.
    """

    up: Float[np.ndarray, " 3"]
    sigma: float
    segments: int
    images: int
    share: float


def upright_segments(
    grey: Float[np.ndarray, "h w"], camera: Camera, guess: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, " n"]]:
    """Straight segments of a picture that may be upright.

    Args:
        grey: Brightness, 0 to 255.
        camera: The picture's camera, at the picture's size.
        guess: Unit vector near up, in the camera's frame.

    Returns:
        End points (segment, end, xy) in pixels, and lengths in pixels.
    """
    gx, gy = _gradient(grey)
    strength = np.hypot(gx, gy)
    upright = _upright_direction(camera, guess)
    # An upright edge's gradient is across it, so along the edge the gradient has no component.
    lean = np.abs(gx * upright[..., 0] + gy * upright[..., 1])
    strong = strength > max(4.0, 0.7 * float(strength.mean()))
    ys, xs = np.nonzero(strong & (lean < np.sin(np.radians(GUESS_CONE)) * strength))
    angle = np.degrees(np.arctan2(gy[ys, xs], gx[ys, xs])) % 360.0
    shape = grey.shape
    first = _regions(ys, xs, ((angle + _BIN / 2) // _BIN).astype(np.int64), shape)
    second = _regions(ys, xs, (angle // _BIN).astype(np.int64), shape)
    # Each pixel votes for the larger of its two regions; a region needs most of its pixels.
    size1, size2 = np.bincount(first)[first], np.bincount(second)[second]
    wins = size1 >= size2
    found = []
    for labels, mine in ((first, wins), (second, ~wins)):
        found.append(_fit(xs, ys, strength[ys, xs], labels, mine, shape))
    ends = np.concatenate([f[0] for f in found])
    return ends, np.concatenate([f[1] for f in found])


def _gradient(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sobel gradient, brightness per pixel; the outermost pixels get none."""
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    a = grey
    gx[1:-1, 1:-1] = (
        (a[:-2, 2:] - a[:-2, :-2]) + 2 * (a[1:-1, 2:] - a[1:-1, :-2]) + (a[2:, 2:] - a[2:, :-2])
    ) / 8
    gy[1:-1, 1:-1] = (
        (a[2:, :-2] - a[:-2, :-2]) + 2 * (a[2:, 1:-1] - a[:-2, 1:-1]) + (a[2:, 2:] - a[:-2, 2:])
    ) / 8
    return gx, gy


def _upright_direction(camera: Camera, guess: np.ndarray) -> Float[np.ndarray, "h w 2"]:
    """Unit image direction of the guessed vertical at each pixel (lens distortion left out)."""
    pixels = camera.pixel_centres()
    x = (pixels[..., 0] - camera.cx) / camera.fx
    y = (pixels[..., 1] - camera.cy) / camera.fy
    direction = np.stack([guess[0] - guess[2] * x, guess[1] - guess[2] * y], axis=-1)
    direction = direction * (camera.fx, camera.fy)
    # At the vanishing point itself the direction is 0 / 0; such a pixel then fits any edge.
    return direction / np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-9)


def _regions(
    ys: Int[np.ndarray, " n"], xs: Int[np.ndarray, " n"], kind: Int[np.ndarray, " n"], shape
) -> Int[np.ndarray, " n"]:
    """Connected components (8 neighbours) of pixels of the same kind, numbered from 0."""
    index = np.full((shape[0] + 2, shape[1] + 2), -1, dtype=np.int64)
    index[ys + 1, xs + 1] = np.arange(len(ys))
    pairs = []
    for dy, dx in ((0, 1), (1, -1), (1, 0), (1, 1)):
        other = index[ys + 1 + dy, xs + 1 + dx]
        linked = (other >= 0) & (kind[other] == kind)
        pairs.append(np.stack([np.nonzero(linked)[0], other[linked]]))
    a, b = np.concatenate(pairs, axis=1)
    label = np.arange(len(ys))
    while True:
        # Hook the larger root under the smaller one, then flatten all trees.
        low, high = np.minimum(label[a], label[b]), np.maximum(label[a], label[b])
        if (low == high).all():
            break
        np.minimum.at(label, high, low)
        while (label[label] != label).any():
            label = label[label]
    return np.unique(label, return_inverse=True)[1]


def _fit(
    xs: np.ndarray,
    ys: np.ndarray,
    weight: np.ndarray,
    labels: np.ndarray,
    mine: np.ndarray,
    shape: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Total-least-squares segments through the regions that are long, thin and mostly `mine`."""
    if not len(xs):
        return np.zeros((0, 2, 2)), np.zeros(0)
    total = np.bincount(labels, weight)
    x, y = xs + 0.5, ys + 0.5
    mx, my = np.bincount(labels, weight * x) / total, np.bincount(labels, weight * y) / total
    dx, dy = x - mx[labels], y - my[labels]
    cxx = np.bincount(labels, weight * dx * dx) / total
    cyy = np.bincount(labels, weight * dy * dy) / total
    cxy = np.bincount(labels, weight * dx * dy) / total
    turn = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    ux, uy = np.cos(turn), np.sin(turn)
    across = np.sqrt(np.maximum(cxx * uy**2 + cyy * ux**2 - 2 * cxy * ux * uy, 0))
    along = dx * ux[labels] + dy * uy[labels]
    start, end = np.zeros(len(total)), np.zeros(len(total))
    np.minimum.at(start, labels, along)
    np.maximum.at(end, labels, along)
    length = end - start
    owned = np.bincount(labels, mine) > 0.5 * np.bincount(labels)
    shortest = max(12.0, 0.02 * float(np.hypot(shape[0], shape[1])))
    good = owned & (length > shortest) & (across < 1.2) & (across < 0.04 * length)
    ends = np.stack(
        [
            np.stack([mx + start * ux, my + start * uy], axis=-1),
            np.stack([mx + end * ux, my + end * uy], axis=-1),
        ],
        axis=1,
    )
    return ends[good], length[good]


def segment_normals(
    ends: Float[np.ndarray, "n 2 2"], camera: Camera, rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals, input frame, of the planes that segments span with the camera's centre."""
    rays = camera.directions(ends).astype(np.float64)
    normals = np.cross(rays[:, 0], rays[:, 1])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True) @ rotation.T


def vertical_from_normals(
    normals: Float[np.ndarray, "n 3"],
    lengths: Float[np.ndarray, " n"],
    image: Int[np.ndarray, " n"],
    guess: Float[np.ndarray, " 3"],
) -> VerticalLines | None:
    """The direction most orthogonal to the normals, robustly: RANSAC, then reweighting.

    Args:
        normals: Unit interpretation-plane normals, input frame.
        lengths: Length of each segment, any unit; its weight.
        image: Which picture each segment is from.
        guess: First guess of up; directions beyond `GUESS_CONE` / 1.25 of it are not tried.

    Returns:
        None if there are too few segments to try.
    """
    if len(normals) < 4:
        return None
    random = np.random.default_rng(0)
    chance = lengths / lengths.sum()
    i, j = random.choice(len(normals), (2, 4000), p=chance)
    trial = np.cross(normals[i], normals[j])
    size = np.linalg.norm(trial, axis=-1)
    trial = trial[size > 1e-3] / size[size > 1e-3, None]
    trial *= np.sign(trial @ guess)[:, None]
    trial = trial[trial @ guess > np.cos(np.radians(GUESS_CONE / 1.25))]
    trial = np.concatenate([trial, guess[None]])
    limit = np.sin(np.radians(INLIER))
    scores = [
        lengths @ np.maximum(0, 1 - (np.abs(normals @ part.T) / limit) ** 2)
        for part in np.array_split(trial, max(1, len(trial) // 256))
    ]
    up = trial[np.concatenate(scores).argmax()]
    for _ in range(30):
        weight = lengths * np.maximum(0, 1 - ((normals @ up) / limit) ** 2) ** 2
        values, vectors = np.linalg.eigh((normals * weight[:, None]).T @ normals)
        new = vectors[:, 0] * np.sign(vectors[:, 0] @ guess)
        done, up = abs(new @ up) > 1 - 1e-12, new
        if done:
            break
    residual = np.abs(normals @ up)
    inlier = residual < limit
    # Segments of one picture often repeat one physical edge: count pictures, not segments, as
    # independent when estimating the error.
    pictures = len(np.unique(image[inlier]))
    spread = np.degrees(np.sqrt(np.average(residual[inlier] ** 2, weights=lengths[inlier])))
    values = np.linalg.eigvalsh((normals * weight[:, None]).T @ normals / max(weight.sum(), 1e-12))
    sigma = spread / np.sqrt(max(values[1], 1e-9) * max(pictures, 1))
    return VerticalLines(
        up=up,
        sigma=float(sigma),
        segments=int(inlier.sum()),
        images=pictures,
        share=float(lengths[inlier].sum() / lengths.sum()),
    )


def vertical_lines(scene: Scene, guess: Float[np.ndarray, " 3"]) -> VerticalLines | None:
    """The vertical vanishing direction over all pictures of a scene (at most `MAX_IMAGES`).

    Args:
        scene: Poses in the input frame; pictures are read from disk.
        guess: Unit vector near up, input frame.

    Returns:
        None if the pictures have next to no straight upright edges.
    """
    step = -(-len(scene.views) // MAX_IMAGES)
    normals, lengths, image = [], [], []
    for i, view in enumerate(scene.views[::step]):
        camera = scene.cameras[view.camera]
        shrink = max(1, round(max(camera.width, camera.height) / LONGEST_SIDE))
        grey = load_image(view, scene, shrink).astype(np.float64) @ (0.299, 0.587, 0.114)
        camera = downscaled_camera(camera, shrink)
        rotation = view.c2w[:3, :3]
        ends, length = upright_segments(grey, camera, rotation.T @ guess)
        normals.append(segment_normals(ends, camera, rotation))
        # In picture diagonals, so that pictures of different sizes weigh the same.
        lengths.append(length / np.hypot(camera.width, camera.height))
        image.append(np.full(len(length), i))
    return _with_halves(
        np.concatenate(normals), np.concatenate(lengths), np.concatenate(image), guess
    )


def _with_halves(
    normals: Float[np.ndarray, "n 3"],
    lengths: Float[np.ndarray, " n"],
    image: Int[np.ndarray, " n"],
    guess: Float[np.ndarray, " 3"],
) -> VerticalLines | None:
    """`vertical_from_normals`, with what two halves of the pictures disagree by in its error.

    Edges that agree by chance give each half another direction; real uprights give the same.
    """
    whole = vertical_from_normals(normals, lengths, image, guess)
    if whole is None:
        return None
    halves = []
    for half in (0, 1):
        # Neighbouring pictures see the same edges: blocks of four keep the halves apart.
        mine = (image // 4) % 2 == half
        halves.append(vertical_from_normals(normals[mine], lengths[mine], image[mine], guess))
    if halves[0] is None or halves[1] is None:
        return replace(whole, sigma=GUESS_CONE)
    apart = np.degrees(np.linalg.norm(np.cross(halves[0].up, halves[1].up)))
    return replace(whole, sigma=float(np.hypot(whole.sigma, 0.5 * apart)))
