"""Which views a page shows, which water levels, and where gauge and figure stand."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import GROUND
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError, one_line
from climatenerf.field.protocol import RadianceField, device_of, ground_height
from climatenerf.paths.camera_path import still
from climatenerf.paths.framing import train_views
from climatenerf.render.placed_objects import Figure, PlacedObject, StaffGauge
from climatenerf.render.session import RenderSession
from climatenerf.scene import Scene

WIDTHS = 640, 960  # pixels, least and greatest of the pictures, unless a size is given
SMALL = 240  # pixels across, of the pictures in which ground is looked for
TURN = 3.0  # m of distance that one radian between view directions counts as
LEVELS = 5
FAR = 40.0  # m; ground beyond says nothing of where water stands
CLEARANCE = 0.3  # m, of the cameras above the highest water
UPRIGHT = 0.9  # z of normals of level ground
ON_TERRAIN = 0.2  # m; what is this near to the terrain is ground
NEAREST, BEST, FARTHEST = 3.0, 6.0, 14.0  # m, of gauge and figure from the camera
APART = 0.9  # m, of gauge and figure
SHOWN_AGAIN = 12.0  # m within which another view's gauge counts as seen


@dataclass(frozen=True)
class PageView:
    """One view of a page.

    Attributes:
        name: of the photo whose pose it has.
        camera: intrinsics of the picture.
        c2w: pose, world m.
    """

    name: str
    camera: Camera
    c2w: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Ground:
    """The ground that a view shows, in a small picture.

    Attributes:
        x: positions of all pixels, world m; inf for the sky.
        ground: which pixels show level ground.
        t: ray lengths, m.
    """

    x: Float[np.ndarray, "h w 3"]
    ground: Bool[np.ndarray, "h w"]
    t: Float[np.ndarray, "h w"]


def page_views(
    scene: Scene, names: Sequence[str], count: int, size: tuple[int, int] | None
) -> list[PageView]:
    """Return the named views, or `count` that differ most in position and direction.

    Raises:
        UserError: there is no photo of a name.
    """
    if not names:
        names = [view.name for view in spread(scene, count)]
    views = []
    for name in dict.fromkeys(names):
        try:
            still(scene, name, 1, None)
        except UserError as error:
            known = ", ".join(view.name for view in scene.views[:3])
            raise UserError(
                f"there is no photo {one_line(name, 60)!r}; give --views as a number of views,"
                f" or as names of photos such as {known}"
            ) from error
        path = still(scene, name, 1, size)
        camera = path.cameras[0]
        if size is None:
            width = min(max(camera.width, WIDTHS[0]), WIDTHS[1])
            camera = camera.resized(width, round(width * camera.height / camera.width))
        views.append(PageView(name, camera, path.c2w[0]))
    return views


def spread(scene: Scene, count: int) -> list:
    """Return photos far from each other: the most central first, then the farthest from all."""
    views = train_views(scene)
    poses = np.stack([scene.c2w_world(view) for view in views])
    at, look = poses[:, :3, 3], poses[:, :3, 2]
    middle = np.median(at, axis=0)
    chosen = [int(np.argmin(np.linalg.norm(at - middle, axis=1)))]
    distance = np.full(len(views), np.inf)
    while len(chosen) < min(count, len(views)):
        last = chosen[-1]
        turn = np.arccos(np.clip(look @ look[last], -1, 1))
        moved = np.linalg.norm(at - at[last], axis=1) + TURN * turn
        distance = np.minimum(distance, moved)
        chosen.append(int(np.argmax(distance)))
    return [views[i] for i in sorted(chosen)]


def find_ground(session: RenderSession, view: PageView) -> Ground:
    """Render a view small and dry, and find the ground in it.

    Ground is what lies at the height of the terrain. Without a terrain it is what faces up and, if
    there are labels of ground, has one.
    """
    camera = view.camera
    camera = camera.resized(SMALL, max(1, round(SMALL * camera.height / camera.width)))
    layers = session.frame(camera, view.c2w, layers=("normal", "label")).layers
    t = layers["depth"].astype(float)
    x = positions(camera, view.c2w, t)
    shown = np.isfinite(t)
    known = terrain_height(session.field, x[shown])
    if np.isfinite(known).any():
        ground = np.zeros(t.shape, bool)
        ground[shown] = np.abs(x[shown][:, 2] - known) < ON_TERRAIN
        return Ground(x, ground, t)
    ground = shown & (layers["normal"][..., 2] > UPRIGHT)
    if "label" in layers and np.isin(layers["label"], GROUND).any():
        ground &= np.isin(layers["label"], GROUND)
    return Ground(x, ground, t)


def terrain_height(field: RadianceField, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the height of the terrain below or above positions (world m); NaN if unknown."""
    xy = to_device(x[:, :2].astype(np.float32), device_of(field))
    return to_numpy(ground_height(field, xy)).astype(float)


def positions(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], t: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Return where rays of given lengths (m) end, world m; inf for the sky."""
    d = camera.directions() @ c2w[:3, :3].T
    shown = np.isfinite(t)[..., None]
    return np.where(shown, c2w[:3, 3] + np.where(shown, t[..., None], 0.0) * d, np.inf)


def water_levels(
    given: Sequence[float], grounds: Sequence[Ground], views: Sequence[PageView], datum: float
) -> list[float]:
    """Return the water levels to render, m above the datum, ascending.

    Without given ones: five from the lowest ground that is seen nearby to a metre above it, or to
    the higher ground, below the cameras.

    Raises:
        UserError: a level lies above a camera, or below all ground.
    """
    lowest_eye = min(float(view.c2w[2, 3]) for view in views) - datum
    heights = [g.x[..., 2][g.ground & (g.t < FAR)] - datum for g in grounds]
    z = np.concatenate([*heights, np.zeros(0)])
    if given:
        if max(given) > lowest_eye - 0.05:
            raise UserError(
                f"a water level of {max(given):g} m lies above a camera at {lowest_eye:.2f} m;"
                " give lower --levels, or other --views"
            )
        if z.size and max(given) < z.min():
            raise UserError(
                f"a water level of {max(given):g} m lies below all ground in these views, which"
                f" begins at {z.min():.2f} m; give higher --levels, or other --views"
            )
        return sorted(set(given))
    if z.size < 10:
        raise UserError("these views show no level ground; name others by --views, or --levels")
    low, high = np.quantile(z, [0.03, 0.9])
    top = min(max(low + 1.0, high + 0.3), lowest_eye - CLEARANCE)
    steps = np.linspace(low, max(top, low + 0.1), LEVELS + 1)[1:]
    return sorted({round(float(level) * 20) / 20 for level in steps})


def placed_objects(
    views: Sequence[PageView], grounds: Sequence[Ground], datum: float, top: float
) -> list[PlacedObject]:
    """Return a gauge and a figure in front of each view that does not show another's.

    Args:
        views: of the page.
        grounds: what ground each shows.
        datum: zero of the gauge, world m.
        top: highest water, m above the datum.
    """
    found: list[PlacedObject] = []
    bases: list[np.ndarray] = []
    for view, ground in zip(views, grounds, strict=True):
        if any(_shows(view, base) for base in bases):
            continue
        base = _free_ground(view, ground)
        if base is None:
            continue
        right = view.c2w[:3, 0] * np.array([1.0, 1.0, 0.0])
        right /= max(float(np.linalg.norm(right)), 1e-6)  # 1e-6: a camera on its side
        toward = view.c2w[:2, 3] - base[:2]
        yaw = math.atan2(toward[1], toward[0])
        beside = base + APART * right
        beside[2] = _height_near(ground, beside, base[2])
        height = max(datum + top + 0.4, base[2] + 1.2)
        at = float(base[0]), float(base[1]), float(base[2])
        other = float(beside[0]), float(beside[1]), float(beside[2])
        found += [StaffGauge(at, height, datum, yaw), Figure(other, yaw)]
        bases.append(base)
    return found


def _shows(view: PageView, base: Float[np.ndarray, "3"]) -> bool:
    """Whether a point is in the middle of a view and near."""
    local = view.c2w[:3, :3].T @ (base - view.c2w[:3, 3])
    if not NEAREST < local[2] < SHOWN_AGAIN:
        return False
    camera = view.camera
    column = camera.fx * local[0] / local[2] + camera.cx
    row = camera.fy * local[1] / local[2] + camera.cy
    return 0.1 < column / camera.width < 0.9 and 0.2 < row / camera.height < 0.95


def _free_ground(view: PageView, ground: Ground) -> Float[np.ndarray, "3"] | None:
    """Return a place on level ground beside the middle of a view; None if there is none."""
    rows, columns = np.nonzero(ground.ground & (ground.t > NEAREST) & (ground.t < FARTHEST))
    if not len(rows):
        return None
    height, width = ground.ground.shape
    x = ground.x[rows, columns]
    across = columns / width
    flat = np.array([_is_flat(ground, each) for each in x[:: max(1, len(x) // 400)]])
    x, across = x[:: max(1, len(x) // 400)], across[:: max(1, len(across) // 400)]
    t = np.linalg.norm(x - view.c2w[:3, 3], axis=1)
    cost = np.abs(np.log(t / BEST)) + 2 * np.abs(np.abs(across - 0.45) - 0.12)
    cost = np.where(flat & (across > 0.15) & (across < 0.7), cost, np.inf)
    best = int(np.argmin(cost))
    return x[best].copy() if np.isfinite(cost[best]) else None


def _is_flat(ground: Ground, x: Float[np.ndarray, "3"]) -> bool:
    """Whether what is seen within a metre of a point is ground of about its height."""
    near = np.linalg.norm(ground.x[..., :2] - x[:2], axis=-1) < 1.1
    z = ground.x[..., 2][near]
    return bool(near.sum() >= 4 and np.ptp(z) < 0.3 and ground.ground[near].mean() > 0.8)


def _height_near(ground: Ground, x: Float[np.ndarray, "3"], otherwise: float) -> float:
    """Height of the ground at a place, m, from the nearest pixels of ground."""
    distance = np.linalg.norm(ground.x[..., :2] - x[:2], axis=-1)
    near = ground.ground & (distance < 0.4)
    return float(np.median(ground.x[..., 2][near])) if near.any() else otherwise
