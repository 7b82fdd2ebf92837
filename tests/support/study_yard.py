"""A yard in closed form that studies of weather render: a hedge, a house and level ground."""

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, TERRAIN, VEGETATION
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.scene import Scene, View
from climatenerf.studies.shot import Place, Shot
from climatenerf.verification.setting import protocol_of
from climatenerf.weather.weather import Weather
from support.holed_ground import LabelledField

CAMERA = Camera(64, 40, 48.0, 48.0, 32.0, 20.0)
PITCH = 0.06  # tangent of the angle at which cameras look down
BOX = ((-20.0, -20.0, -1.0), (20.0, 20.0, 5.0))
SOLIDS = (
    HalfSpace(colour=(0.2, 0.22, 0.1)),
    Box((-4.0, 6.0, 0.0), (-1.0, 8.0, 2.4), (0.5, 0.2, 0.12)),
    Box((1.0, 7.0, 0.0), (5.0, 8.0, 1.6), (0.06, 0.12, 0.03)),
)
ZENITH, HORIZON = (0.5, 0.7, 1.0), (0.9, 0.9, 0.9)
FIELD = AnalyticField(SOLIDS, zenith=ZENITH, horizon=HORIZON, box=BOX)
"""Without normals its light is not looked for, which takes some ten seconds."""
LABELLED = LabelledField(
    SOLIDS, zenith=ZENITH, horizon=HORIZON, box=BOX, classes=(TERRAIN, BUILDING, VEGETATION)
)


def pose(forward: tuple[float, float, float], eye=(0.0, 0.0, 1.6)) -> Float[np.ndarray, "4 4"]:
    """A camera with a level horizon."""
    ahead = np.array(forward) / np.linalg.norm(forward)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, np.cross(ahead, right), ahead, np.array(eye)], axis=-1)
    return c2w


def yard_place(root) -> Place:
    """The yard with two photos, whose cameras look down."""
    poses = [pose((0.0, 1.0, -PITCH)), pose((0.1, 1.0, -PITCH), (0.5, -0.5, 1.6))]
    views = [View(f"{i}.jpg", root / f"{i}.jpg", 0, each) for i, each in enumerate(poses)]
    return Place(protocol_of(FIELD), Scene(root, "toy", (CAMERA,), tuple(views)))


def patch_shot(root, weather: Weather) -> Shot:
    """A patch of ground with blocks, on which snow grows quickly, from above."""
    field = AnalyticField(
        [
            HalfSpace(colour=(0.3, 0.3, 0.3)),
            *(
                Box((x, y, 0.0), (x + 0.25, y + 0.25, 0.2))
                for x in (-0.8, -0.1, 0.6)
                for y in (0, 0.6)
            ),
        ],
        box=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)),
    )
    c2w = pose((0.0, 1.0, -1.3), (0.0, -1.0, 1.6))
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0)
    scene = Scene(root, "toy", (camera,), (View("0.jpg", root / "0.jpg", 0, c2w),))
    return Shot(Place(protocol_of(field), scene), "0.jpg", camera, c2w, weather)


def yard_shot(root, weather: Weather) -> Shot:
    """The yard from its first photo."""
    place = yard_place(root)
    return Shot(place, "0.jpg", CAMERA, place.scene.c2w_world(place.scene.views[0]), weather)
