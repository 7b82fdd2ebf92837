"""Cameras and sessions of the checks: small pictures of scenes in closed form."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_numpy
from climatenerf.field.analytic import AnalyticField
from climatenerf.field.compositing import composited
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.render.session import Frame, RenderSession
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.weather import Weather

Vector = tuple[float, float, float]
AnyField = AnalyticField | RadianceField
IOR = 1.333
"""Refractive index of the water in all checks."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera in a place.

    Attributes:
        camera: intrinsics.
        c2w: camera-to-world pose, m, OpenCV axes.
    """

    camera: Camera
    c2w: Float[np.ndarray, "4 4"]

    @property
    def eye(self) -> Float[np.ndarray, "3"]:
        """Position, m."""
        return self.c2w[:3, 3]

    def directions(self) -> Float[np.ndarray, "h w 3"]:
        """Unit directions of the pixels in the world, of a camera without distortion."""
        camera = self.camera
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
        rays = rays @ self.c2w[:3, :3].T
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def mirrored(self, level: float) -> "Viewpoint":
        """The mirror image in the horizontal plane at height `level`, m."""
        mirror = np.diag([1.0, 1.0, -1.0, 1.0])
        mirror[2, 3] = 2 * level
        return replace(self, c2w=mirror @ self.c2w)


def looking(eye: Vector, forward: Vector) -> Float[np.ndarray, "4 4"]:
    """Return a pose with a level horizon; one that looks straight down has +x at its right."""
    ahead = np.array(forward) / np.linalg.norm(forward)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    if not right.any():
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, np.array(eye)], axis=-1)
    return pose


def session_in(field: AnalyticField, weather: Weather, viewpoint: Viewpoint) -> RenderSession:
    """Prepare weather in a field. The ground datum is z = 0, and snow is finest at the origin."""
    camera = Camera(64, 36, 40.0, 40.0, 32.0, 18.0)
    pose = looking(tuple(viewpoint.eye.tolist()), (0.0, 1.0, -0.3))
    view = View("view.png", Path("view.png"), 0, pose)
    scene = Scene(Path("."), "analytic", (camera,), (view,))
    eye = np.array([[0.0, 0.0, viewpoint.eye[2]]])
    return RenderSession(protocol_of(field), scene, weather, eye, effects=EFFECTS)


def frame_in(field: AnalyticField, weather: Weather, viewpoint: Viewpoint) -> Frame:
    """Render one frame of a field in weather."""
    return session_in(field, weather, viewpoint).frame(viewpoint.camera, viewpoint.c2w)


def radiance(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """Return a frame's linear radiance in double precision."""
    return to_numpy(frame.linear).astype(np.float64)


def protocol_of(field: AnyField) -> RadianceField:
    """Return the field by the type of its protocol, of which the analytic one has a part."""
    return cast(RadianceField, field)


def sky_of(field: AnyField, viewpoint: Viewpoint) -> Float[np.ndarray, "h w 3"]:
    """Return the radiance of a field's sky in the direction of each pixel."""
    device = device_of(protocol_of(field))
    _, rays_d = camera_rays(viewpoint.camera, viewpoint.c2w, device)
    sky = to_numpy(field.sky(rays_d)).astype(np.float64)
    return sky.reshape(viewpoint.camera.height, viewpoint.camera.width, 3)


def clear_fraction(field: AnyField, viewpoint: Viewpoint) -> Float[np.ndarray, "h w"]:
    """Return the fraction of each pixel's light that comes from the sky, without weather."""
    device = device_of(protocol_of(field))
    rays_o, rays_d = camera_rays(viewpoint.camera, viewpoint.c2w, device)
    near = torch.full((rays_o.shape[0],), field.near, device=device)
    _, transmittance, _ = composited(protocol_of(field), rays_o, rays_d, near)
    return to_numpy(transmittance).reshape(viewpoint.camera.height, viewpoint.camera.width)
