"""The vertical vanishing point of a capture, from straight line segments in its images.

Segments are line-support regions (Burns, Hanson and Riseman 1986): connected pixels with similar
gradient directions. Only edges that may be vertical according to an initial up direction are
followed. Each segment and the camera centre span its *interpretation plane*. The planes of vertical
segments all contain the vertical, so up is the direction closest to orthogonal to their normals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.scene.images import downscaled_camera, load_image
from climatenerf.scene.scene import Scene

SEARCH_CONE = 25.0  # degrees: largest lean of an edge from the initial up direction
INLIER = 1.5  # degrees between a segment and the vertical through it
MAX_IMAGES = 32
MAX_SIDE = 900  # pixels: larger images are downscaled
_BIN = 22.5  # degrees: range of gradient directions in a line-support region


@dataclass(frozen=True)
class VanishingPoint:
    """The vertical vanishing direction and its support.

    Attributes:
        up: Unit vector, input frame, in the hemisphere of the initial direction.
        sigma: Standard error of `up`, degrees, along its least certain axis.
        segments: Number of segments consistent with `up`.
        images: Number of images with such segments.
        fraction: Fraction of them by length among all candidate segments.
    """

    up: Float[np.ndarray, " 3"]
    sigma: float
    segments: int
    images: int
    fraction: float


def upright_segments(
    grey: Float[np.ndarray, "h w"], camera: Camera, guess: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, " n"]]:
    """Detect the straight segments of an image that may be vertical.

    Args:
        grey: Brightness, 0 to 255.
        camera: Camera of the image, at the size of `grey`.
        guess: Unit vector near up, camera frame.

    Returns:
        End points (segment, end, xy) and lengths, both in pixels.
    """
    gx, gy = _gradient(grey)
    strength = np.hypot(gx, gy)
    vertical = _vertical_direction(camera, guess)
    # The gradient is orthogonal to its edge, so it has no component along a vertical edge.
    lean = np.abs(gx * vertical[..., 0] + gy * vertical[..., 1])
    strong = strength > max(4.0, 0.7 * float(strength.mean()))
    ys, xs = np.nonzero(strong & (lean < np.sin(np.radians(SEARCH_CONE)) * strength))
    angle = np.degrees(np.arctan2(gy[ys, xs], gx[ys, xs])) % 360.0
    shape = grey.shape
    first = _regions(ys, xs, ((angle + _BIN / 2) // _BIN).astype(np.int64), shape)
    second = _regions(ys, xs, (angle // _BIN).astype(np.int64), shape)
    # Two overlapping partitions of the directions: an edge near a bin boundary of one falls within
    # a bin of the other. Each pixel votes for its larger region, and a region needs the votes of
    # most of its pixels.
    size1, size2 = np.bincount(first)[first], np.bincount(second)[second]
    prefers_first = size1 >= size2
    fits = [
        _fit_segments(xs, ys, strength[ys, xs], labels, votes, shape)
        for labels, votes in ((first, prefers_first), (second, ~prefers_first))
    ]
    return np.concatenate([f[0] for f in fits]), np.concatenate([f[1] for f in fits])


def _gradient(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Sobel gradient, brightness per pixel; 0 at the border.

    Not `scipy.ndimage.sobel`, which sums in another order: its rounding moves gradients of exactly
    0 degrees across a bin boundary.
    """
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    a = grey
    gx[1:-1, 1:-1] = (
        (a[:-2, 2:] - a[:-2, :-2]) + 2 * (a[1:-1, 2:] - a[1:-1, :-2]) + (a[2:, 2:] - a[2:, :-2])
    ) / 8
    gy[1:-1, 1:-1] = (
        (a[2:, :-2] - a[:-2, :-2]) + 2 * (a[2:, 1:-1] - a[:-2, 1:-1]) + (a[2:, 2:] - a[:-2, 2:])
    ) / 8
    return gx, gy


def _vertical_direction(camera: Camera, guess: np.ndarray) -> Float[np.ndarray, "h w 2"]:
    """Return the image direction of the vertical at each pixel, ignoring lens distortion.

    Unit vectors, except for 0 at the vanishing point.
    """
    pixels = camera.pixel_centres()
    x = (pixels[..., 0] - camera.cx) / camera.fx
    y = (pixels[..., 1] - camera.cy) / camera.fy
    direction = np.stack([guess[0] - guess[2] * x, guess[1] - guess[2] * y], axis=-1)
    direction = direction * (camera.fx, camera.fy)
    # 1e-9: at the vanishing point the direction is 0 / 0; 0 accepts edges of any direction there.
    return direction / np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-9)


def _regions(
    ys: Int[np.ndarray, " n"],
    xs: Int[np.ndarray, " n"],
    kind: Int[np.ndarray, " n"],
    shape: tuple[int, ...],
) -> Int[np.ndarray, " n"]:
    """Label connected components (8 neighbours) of pixels of equal kind.

    Args:
        ys: Pixel rows.
        xs: Pixel columns.
        kind: Direction bin of each pixel.
        shape: Height and width of the image.

    Returns:
        Component of each pixel, numbered from 0 in the order of their first pixels.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(ys)
    if not count:
        return np.empty(0, np.int64)
    index = np.full((shape[0] + 2, shape[1] + 2), -1, dtype=np.int64)
    index[ys + 1, xs + 1] = np.arange(count)
    edges = []
    for dy, dx in ((0, 1), (1, -1), (1, 0), (1, 1)):
        neighbour = index[ys + 1 + dy, xs + 1 + dx]
        linked = (neighbour >= 0) & (kind[neighbour] == kind)
        edges.append(np.stack([np.nonzero(linked)[0], neighbour[linked]]))
    a, b = np.concatenate(edges, axis=1)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _fit_segments(
    xs: Int[np.ndarray, " n"],
    ys: Int[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    labels: Int[np.ndarray, " n"],
    votes: Bool[np.ndarray, " n"],
    shape: tuple[int, ...],
) -> tuple[Float[np.ndarray, "k 2 2"], Float[np.ndarray, " k"]]:
    """Fit segments by total least squares to the long, thin regions with a majority of votes.

    Args:
        xs: Pixel columns.
        ys: Pixel rows.
        weight: Gradient magnitude of each pixel.
        labels: Region of each pixel, numbered from 0.
        votes: Whether each pixel votes for its region.
        shape: Height and width of the image.

    Returns:
        End points (segment, end, xy) and lengths, both in pixels.
    """
    if not len(xs):
        return np.zeros((0, 2, 2)), np.zeros(0)
    total = np.bincount(labels, weight)
    x, y = xs + 0.5, ys + 0.5
    mx, my = np.bincount(labels, weight * x) / total, np.bincount(labels, weight * y) / total
    dx, dy = x - mx[labels], y - my[labels]
    cxx = np.bincount(labels, weight * dx * dx) / total
    cyy = np.bincount(labels, weight * dy * dy) / total
    cxy = np.bincount(labels, weight * dx * dy) / total
    angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    ux, uy = np.cos(angle), np.sin(angle)
    thickness = np.sqrt(np.maximum(cxx * uy**2 + cyy * ux**2 - 2 * cxy * ux * uy, 0))
    along = dx * ux[labels] + dy * uy[labels]
    start, end = np.zeros(len(total)), np.zeros(len(total))
    np.minimum.at(start, labels, along)
    np.maximum.at(end, labels, along)
    length = end - start
    elected = np.bincount(labels, votes) > 0.5 * np.bincount(labels)
    min_length = max(12.0, 0.02 * float(np.hypot(shape[0], shape[1])))
    good = elected & (length > min_length) & (thickness < 1.2) & (thickness < 0.04 * length)
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
    """Return unit normals, input frame, of the segments' interpretation planes.

    Args:
        ends: End points (segment, end, xy), pixels.
        camera: Camera of the image.
        rotation: Camera-to-input rotation.
    """
    rays = camera.directions(ends).astype(np.float64)
    normals = np.cross(rays[:, 0], rays[:, 1])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True) @ rotation.T


def vanishing_point_from_normals(
    normals: Float[np.ndarray, "n 3"],
    lengths: Float[np.ndarray, " n"],
    image: Int[np.ndarray, " n"],
    guess: Float[np.ndarray, " 3"],
) -> VanishingPoint | None:
    """Return the direction most orthogonal to the normals, by RANSAC and iterative reweighting.

    Args:
        normals: Unit interpretation-plane normals, input frame.
        lengths: Length of each segment, any unit, used as its weight.
        image: Index of the image of each segment.
        guess: Initial up direction, unit vector; the search is limited to `SEARCH_CONE` / 1.25.

    Returns:
        None if there are fewer than four segments.
    """
    if len(normals) < 4:
        return None
    random = np.random.default_rng(0)
    i, j = random.choice(len(normals), (2, 4000), p=lengths / lengths.sum())
    candidates = np.cross(normals[i], normals[j])
    size = np.linalg.norm(candidates, axis=-1)
    # Nearly parallel normals do not determine a direction.
    candidates = candidates[size > 1e-3] / size[size > 1e-3, None]
    candidates *= np.sign(candidates @ guess)[:, None]
    candidates = candidates[candidates @ guess > np.cos(np.radians(SEARCH_CONE / 1.25))]
    candidates = np.concatenate([candidates, guess[None]])
    limit = np.sin(np.radians(INLIER))
    scores = [
        lengths @ np.maximum(0, 1 - (np.abs(normals @ part.T) / limit) ** 2)
        for part in np.array_split(candidates, max(1, len(candidates) // 256))
    ]
    up = candidates[np.concatenate(scores).argmax()]
    for _ in range(30):
        weight = lengths * np.maximum(0, 1 - ((normals @ up) / limit) ** 2) ** 2
        values, vectors = np.linalg.eigh((normals * weight[:, None]).T @ normals)
        refined = vectors[:, 0] * np.sign(vectors[:, 0] @ guess)
        converged, up = abs(refined @ up) > 1 - 1e-12, refined
        if converged:
            break
    residual = np.abs(normals @ up)
    inlier = residual < limit
    # Segments of one image often lie on the same physical edge, so the images count as independent
    # samples, not the segments.
    images = len(np.unique(image[inlier]))
    spread = np.degrees(np.sqrt(np.average(residual[inlier] ** 2, weights=lengths[inlier])))
    # 1e-12 and 1e-9: without inliers, or with parallel normals only, sigma is large but finite.
    values = np.linalg.eigvalsh((normals * weight[:, None]).T @ normals / max(weight.sum(), 1e-12))
    sigma = spread / np.sqrt(max(values[1], 1e-9) * max(images, 1))
    return VanishingPoint(
        up=up,
        sigma=float(sigma),
        segments=int(inlier.sum()),
        images=images,
        fraction=float(lengths[inlier].sum() / lengths.sum()),
    )


def vanishing_point_with_split_error(
    normals: Float[np.ndarray, "n 3"],
    lengths: Float[np.ndarray, " n"],
    image: Int[np.ndarray, " n"],
    guess: Float[np.ndarray, " 3"],
) -> VanishingPoint | None:
    """Return `vanishing_point_from_normals` with the difference of two image halves in its sigma.

    Accidental alignments give each half another direction; vertical edges give both the same.
    Arguments and result are as for `vanishing_point_from_normals`.
    """
    whole = vanishing_point_from_normals(normals, lengths, image, guess)
    if whole is None:
        return None
    halves = []
    for half in (0, 1):
        # Consecutive images show the same edges, so blocks of four are assigned to a half.
        member = (image // 4) % 2 == half
        halves.append(
            vanishing_point_from_normals(normals[member], lengths[member], image[member], guess)
        )
    if halves[0] is None or halves[1] is None:
        return replace(whole, sigma=SEARCH_CONE)
    difference = np.degrees(np.linalg.norm(np.cross(halves[0].up, halves[1].up)))
    return replace(whole, sigma=float(np.hypot(whole.sigma, 0.5 * difference)))


def find_vanishing_point(scene: Scene, guess: Float[np.ndarray, " 3"]) -> VanishingPoint | None:
    """Return the vertical vanishing point of a scene, from up to `MAX_IMAGES` of its images.

    Args:
        scene: Poses in the input frame; the images are read from disk.
        guess: Initial up direction, unit vector, input frame.

    Returns:
        None if there are fewer than four candidate segments.

    Raises:
        UserError: An image cannot be read.
    """
    step = -(-len(scene.views) // MAX_IMAGES)
    normals, lengths, image = [], [], []
    for i, view in enumerate(scene.views[::step]):
        camera = scene.cameras[view.camera]
        downscale = max(1, round(max(camera.width, camera.height) / MAX_SIDE))
        grey = load_image(view, scene, downscale).astype(np.float64) @ (0.299, 0.587, 0.114)
        camera = downscaled_camera(camera, downscale)
        rotation = view.c2w[:3, :3]
        ends, length = upright_segments(grey, camera, rotation.T @ guess)
        normals.append(segment_normals(ends, camera, rotation))
        # In image diagonals, so that images of different sizes have the same weight.
        lengths.append(length / np.hypot(camera.width, camera.height))
        image.append(np.full(len(length), i))
    return vanishing_point_with_split_error(
        np.concatenate(normals), np.concatenate(lengths), np.concatenate(image), guess
    )
