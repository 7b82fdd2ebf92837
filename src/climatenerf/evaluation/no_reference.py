"""Scores of a fit without true geometry: ground, neighbours, floating matter, sky, points.

Every score is a number or None; `score_reasons` says why one is None. They distinguish a field
whose geometry carries weather from one that only looks right from the positions of the photos.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import GROUND, MERGED, SKY
from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.compositing import chunks, composited
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.scene.images import load_image, load_labels
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.scene.terrain import Terrain
from climatenerf.scene.withheld import is_withheld

MEETS_GROUND = (0.1, 0.2)  # m; bounds of two errors of the terrain, within which an end is ground
NEAR_GROUND = 15.0  # m; ground further away is seen too flat to measure its roughness
PATCH = 2.0  # m, side of a patch of ground that a plane is fitted to
MIN_ENDS = 12  # of a patch
MAX_LUMP = 0.5  # m; larger deviations count as this
PAIRS = 16  # photos that are compared with a neighbour
PAIR_ANGLE = 0.5  # rad between the axes of neighbours at most
BASELINE = 0.08  # median depths between neighbours: nearer ones agree whatever the depth is
HIDDEN = 0.05  # relative; an end that a neighbour sees something nearer in front of is hidden
INFINITY = 1e6  # m; where rays end that meet nothing
TOO_LITTLE_GROUND = "the photos show too little ground"
VOXEL = 0.5  # m, in which ends are connected to components
NEAR_FLOATING = 20.0  # m; further away ends are too sparse to be connected
MAIN = 0.05  # fraction of all ends that makes a component part of the scene
STANDS = 1.0  # m above the terrain within which a component stands on the ground
MAX_POINTS = 20_000  # observations of withheld points that are scored
EMPTY = 0.99  # of the light passes empty sky


NAMES = (
    "ground.present",
    "ground.roughness_cm",
    "neighbours.psnr",
    "sky.empty",
    "floating.components",
    "floating.share",
    "points.abs_rel",
)


def no_scores(reason: str) -> dict[str, Any]:
    """Return every score as None for one reason."""
    return dict.fromkeys(NAMES) | {"score_reasons": dict.fromkeys(NAMES, reason)}


def no_reference_scores(
    field: RadianceField, scene: Scene, photos: list[PhotoRays], terrain: Terrain | None
) -> dict[str, Any]:
    """Return the scores by name, and `score_reasons` for those that are None.

    Args:
        field: the fitted field.
        scene: the capture.
        photos: rays of its photos on the fitted field.
        terrain: its ground.
    """
    labels = [_labels(each, scene) for each in photos]
    found: dict[str, tuple[float | int | None, str]] = {
        "ground.present": _ground_present(photos, labels, terrain),
        "ground.roughness_cm": _roughness(photos, labels),
        "neighbours.psnr": _neighbours(photos, labels, scene),
        "sky.empty": _sky_empty(photos, labels),
    }
    components, share, reason = _floating(photos, terrain)
    found |= {
        "floating.components": (components, reason),
        "floating.share": (share, reason),
    }
    found["points.abs_rel"] = _withheld_points(field, scene)
    scores: dict[str, Any] = {name: value for name, (value, _) in found.items()}
    reasons = {name: why for name, (value, why) in found.items() if value is None}
    return scores | {"score_reasons": reasons}


def _labels(photo: PhotoRays, scene: Scene) -> UInt8[np.ndarray, "h w"] | None:
    """Return the merged classes of a photo's own labels at the size of its rays."""
    labels = load_labels(photo.view, scene)
    if labels is None:
        return None
    height, width = photo.t.shape
    row = ((np.arange(height) + 0.5) / height * labels.shape[0]).astype(int)
    column = ((np.arange(width) + 0.5) / width * labels.shape[1]).astype(int)
    return MERGED[labels[row[:, None], column]]


def _labelled_ground(
    photos: list[PhotoRays], labels: list[UInt8[np.ndarray, "h w"] | None]
) -> list[tuple[PhotoRays, Bool[np.ndarray, "h w"]]]:
    pairs = zip(photos, labels, strict=True)
    return [(photo, np.isin(label, GROUND)) for photo, label in pairs if label is not None]


def _ground_present(
    photos: list[PhotoRays],
    labels: list[UInt8[np.ndarray, "h w"] | None],
    terrain: Terrain | None,
) -> tuple[float | None, str]:
    """Return the fraction of pixels labelled ground whose rays end on the ground.

    Ends beyond the raster do not count. Since the terrain is fitted to such ends, the score tells
    holes, lumps and rough ground, and not a ground that is wrong as a whole.
    """
    if terrain is None:
        return None, TOO_LITTLE_GROUND
    met, total = 0, 0
    for photo, ground in _labelled_ground(photos, labels):
        x = photo.x[ground]
        finite = np.isfinite(x).all(-1)
        inside = np.zeros(len(x), bool)
        inside[finite] = terrain.contains(x[finite, :2])
        height = terrain.sample(terrain.height, x[inside, :2])
        error = terrain.sample(terrain.error, x[inside, :2])
        met += int((np.abs(x[inside, 2] - height) < np.clip(2 * error, *MEETS_GROUND)).sum())
        total += int(inside.sum() + (~finite).sum())
    if not total:
        return None, "no photo has labels of ground"
    return met / total, ""


def _roughness(
    photos: list[PhotoRays], labels: list[UInt8[np.ndarray, "h w"] | None]
) -> tuple[float | None, str]:
    """Return the RMS distance (cm) of ends on ground from planes through patches of 2 m.

    Photo and field must both classify an end as ground: single photos label forests as ground.
    """
    labelled = _labelled_ground(photos, labels)
    if not sum(int(ground.sum()) for _, ground in labelled):
        return None, "no photo has labels of ground"
    parts = [np.zeros((0, 3))]
    for photo, ground in labelled:
        agreed = ground & np.isin(photo.label, GROUND)
        parts.append(photo.x[agreed & (photo.t < NEAR_GROUND)])
    x = np.concatenate(parts)
    if len(x) < MIN_ENDS:
        return None, "the field has hardly any near ground where photos are labelled so"
    x = x - x.mean(0)
    patch = np.unique(np.floor(x[:, :2] / PATCH), axis=0, return_inverse=True)[1].reshape(-1)
    squares, count = 0.0, 0
    for rows in np.split(np.argsort(patch), np.cumsum(np.bincount(patch))[:-1]):
        if len(rows) < MIN_ENDS:
            continue
        flat = np.c_[x[rows, :2], np.ones(len(rows))]
        plane = np.linalg.lstsq(flat, x[rows, 2], rcond=None)[0]
        rest = np.clip(x[rows, 2] - flat @ plane, -MAX_LUMP, MAX_LUMP)
        squares, count = squares + float((rest**2).sum()), count + len(rows)
    if not count:
        return None, "the photos show no patch of ground closely"
    return 100 * float(np.sqrt(squares / count)), ""


def _sky_empty(
    photos: list[PhotoRays], labels: list[UInt8[np.ndarray, "h w"] | None]
) -> tuple[float | None, str]:
    """Return the fraction of pixels labelled sky that light passes."""
    passed = [
        photo.transmittance[label == SKY] > EMPTY
        for photo, label in zip(photos, labels, strict=True)
        if label is not None
    ]
    if not passed or not sum(each.size for each in passed):
        return None, "no photo has labels of sky"
    return float(np.concatenate(passed).mean()), ""


def _neighbours(
    photos: list[PhotoRays], labels: list[UInt8[np.ndarray, "h w"] | None], scene: Scene
) -> tuple[float | None, str]:
    """Return the PSNR (dB) of photos against neighbours that are warped by the field's depth.

    Exposures are equalised by a gain per pair and channel. An end that the neighbour has something
    nearer in front of does not count; one that the neighbour looks past does. A ray that meets
    nothing is warped as if it ended at infinity, unless its label is sky: a hole is an error.
    """
    eyes = np.stack([each.c2w[:3, 3] for each in photos])
    axes = np.stack([each.c2w[:3, 2] for each in photos])
    squares, count = 0.0, 0
    for i in np.unique(np.linspace(0, len(photos) - 1, PAIRS).astype(int)):
        near = photos[i].t[np.isfinite(photos[i].t)]
        distance = np.linalg.norm(eyes - eyes[i], axis=-1)
        distance[axes @ axes[i] <= np.cos(PAIR_ANGLE)] = 0.0
        apart = np.flatnonzero(distance > 1e-6)  # a photo from the same spot shows nothing
        if not len(apart) or not near.size:
            continue
        wanted = max(BASELINE * float(np.median(near)), 1e-6)  # matter at the eye: log 0
        j = int(apart[np.abs(np.log(distance[apart] / wanted)).argmin()])
        mine, other = (_colours(photos[k], scene) for k in (i, j))
        x = np.where(
            np.isfinite(photos[i].t)[..., None],
            photos[i].x,
            eyes[i] + INFINITY * photos[i].d,
        ).reshape(-1, 3)
        at, seen = _project(photos[j].camera, photos[j].c2w, x)
        if labels[i] is not None:
            seen &= np.isfinite(photos[i].t).reshape(-1) | (labels[i] != SKY).reshape(-1)
        pixel = at.astype(int)
        length = np.linalg.norm(x - eyes[j], axis=-1)
        seen[seen] &= photos[j].t[pixel[seen, 1], pixel[seen, 0]] > (1 - HIDDEN) * length[seen]
        if seen.sum() < MIN_ENDS:
            continue
        a = mine.reshape(-1, 3)[seen].astype(np.float64)
        b = _bilinear(other, at[seen])
        gain = a.mean(0) / np.maximum(b.mean(0), 1.0)  # a black photo: 0/0
        squares += float((((a - gain * b) / 255) ** 2).sum())
        count += a.size
    if count:
        return -10 * float(np.log10(max(squares / count, 1e-10))), ""  # equal pictures: log 0
    if not any(np.isfinite(each.t).any() for each in photos):
        return None, "no ray of a photo meets anything"
    return None, "no photo has a neighbour that shows the same"


def _colours(photo: PhotoRays, scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    """Return a photo at the size of its rays."""
    size = (photo.camera.width, photo.camera.height)
    picture = Image.fromarray(load_image(photo.view, scene))
    return np.asarray(picture.resize(size, Image.Resampling.BOX))


def _project(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], x: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Return where positions appear (x, y; px), and which are finite and inside the frame."""
    finite = np.isfinite(x).all(-1)
    found = np.zeros((len(x), 2))
    inside = np.zeros(len(x), bool)
    at = camera.project((x[finite] - c2w[:3, 3]) @ c2w[:3, :3])
    good = ((at >= 0) & (at < (camera.width, camera.height))).all(-1)  # NaN behind: False
    inside[finite] = good
    found[inside] = at[good]
    return found, inside


def _bilinear(
    picture: UInt8[np.ndarray, "h w 3"], at: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate a picture between the centres of its pixels."""
    rows = [at[:, 1] - 0.5, at[:, 0] - 0.5]
    channels = np.moveaxis(picture.astype(np.float64), -1, 0)
    sampled = [ndimage.map_coordinates(each, rows, order=1, mode="nearest") for each in channels]
    return np.stack(sampled, axis=-1)


def _floating(
    photos: list[PhotoRays], terrain: Terrain | None
) -> tuple[int | None, float | None, str]:
    """Return number and share of pixels of components that nothing connects with the scene.

    Ends are gathered in voxels; components of neighbouring voxels are part of the scene if they
    hold many ends or stand on the ground.
    """
    if terrain is None:
        return None, None, TOO_LITTLE_GROUND
    x = np.concatenate([each.x[each.t < NEAR_FLOATING] for each in photos])
    if len(x) < MIN_ENDS:
        return None, None, "the photos show nothing near"
    at = np.floor((x - x.min(0)) / VOXEL).astype(int)
    grid = np.zeros(at.max(0) + 1, bool)
    grid[tuple(at.T)] = True
    # Two voxels apart still counts as connected: rays are sparse.
    components: Any = ndimage.label(ndimage.binary_dilation(grid, np.ones((3, 3, 3))))
    component = components[0][tuple(at.T)]
    ends = np.bincount(component, minlength=components[1] + 1)
    above = x[:, 2] - terrain.sample(terrain.height, x[:, :2])
    lowest = np.full(components[1] + 1, np.inf)
    np.minimum.at(lowest, component, above)
    floats = (ends > 0) & (ends < MAIN * len(x)) & (lowest > STANDS)
    pixels = sum(each.t.size for each in photos)
    return int(floats.sum()), float(ends[floats].sum() / pixels), ""


def _withheld_points(field: RadianceField, scene: Scene) -> tuple[float | None, str]:
    """Return the mean relative error of depth at sparse points that no fit used, at most 1 each."""
    points = scene.points_world()
    if points is None:
        return None, "the capture has no sparse points"
    origins, ends = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for view in scene.of_split("train"):
        if view.seen is not None:
            ends.append(points[view.seen[is_withheld(view.seen)]])
            origins.append(np.broadcast_to(scene.c2w_world(view)[:3, 3], ends[-1].shape))
    origin, end = np.concatenate(origins), np.concatenate(ends)
    depth = np.linalg.norm(end - origin, axis=-1)
    good = depth > 0
    if not good.any():
        return None, "no photo's points are recorded"
    origin, end, depth = origin[good], end[good], depth[good]
    step = -(-len(depth) // MAX_POINTS)
    origin, end, depth = origin[::step], end[::step], depth[::step]
    device = device_of(field)
    rays_o = to_device(origin.astype(np.float32), device)
    rays_d = to_device(((end - origin) / depth[:, None]).astype(np.float32), device)
    found = []
    for chunk in chunks(rays_o):
        near = torch.full_like(rays_o[chunk, 0], field.near)
        _, transmittance, length = composited(field, rays_o[chunk], rays_d[chunk], near)
        # 1e-6: a ray that meets nothing, 0/0; its error counts as 1.
        found.append(to_numpy(length / (1 - transmittance).clamp_min(1e-6)))
    error = np.abs(np.concatenate(found) - depth) / depth
    return float(np.minimum(error, 1.0).mean()), ""
