"""A yard photographed in the sun, in closed form: what a fitted field of it would answer.

Level ground, a wall and a block under an even sky and a hard sun. Radiance is albedo times the
irradiance over pi, shadows included; what surfaces send to each other is left out of it.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from climatenerf.core.classes import BUILDING, SOLID, TERRAIN
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.field.capabilities import CLASSES, DENSITY, NORMALS
from climatenerf.scene import Camera, Scene, View

WALL = Box((-8.0, 6.0, 0.0), (8.0, 6.6, 4.0))
BLOCK = Box((-2.0, -1.0, 0.0), (0.0, 1.0, 2.0))
ROOF = Box((3.0, -2.0, 2.2), (7.0, 2.0, 2.3))
SOLIDS = (HalfSpace(), WALL, BLOCK, ROOF)
GROUND_ALBEDO, WALL_ALBEDO = 0.15, 0.3
SKY = 0.5  # radiance
TO_SUN = np.array([0.5, -0.5, 1 / np.sqrt(2)])
SUN = 3.0  # irradiance across its rays
BOX = ((-40.0, -40.0, -1.0), (40.0, 40.0, 9.0))


@dataclass(frozen=True)
class SunlitYard(AnalyticField):
    """The yard with learned normals and classes."""

    sun: float = SUN

    def surface_heads(self, rays_o, rays_d, samples, selected):
        """Normals and classes of the nearest solid's nearest face."""
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        return normals(self, x), logits(self, x)

    def colour(self, x, d, ray=None, *, ids=None, appearance=None):
        """Radiance in the sun and the even sky."""
        normal = normals(self, x)
        received = SKY * np.pi * (1 + normal[:, 2]) / 2
        facing = (normal @ x.new_tensor(TO_SUN)).clamp_min(0)
        received = received + facing * self.sun * in_sun(x + 0.02 * normal)
        ground = logits(self, x).argmax(-1) == SOLID.tolist().index(TERRAIN)
        albedo = torch.where(ground, GROUND_ALBEDO, WALL_ALBEDO)
        return (albedo * received / np.pi)[:, None].expand(-1, 3)


def normals(field, x):
    """Unit normals of the nearest face."""
    distance = torch.stack([solid.distance(x).abs() for solid in field.solids], -1)
    result = torch.zeros_like(x)
    result[:, 2] = 1.0
    nearest = distance.argmin(-1)
    for k, solid in enumerate(field.solids):
        if isinstance(solid, Box):
            low, high = x.new_tensor(solid.lower), x.new_tensor(solid.upper)
            offset = torch.cat([low - x, x - high], -1)
            face = offset.abs().argmin(-1)
            axes = torch.cat([-torch.eye(3), torch.eye(3)])
            result = torch.where((nearest == k)[:, None], axes[face], result)
    return result


def logits(field, x):
    """Sure classes: terrain, and building for all boxes."""
    distance = torch.stack([solid.distance(x).abs() for solid in field.solids], -1)
    kind = torch.where(distance.argmin(-1) == 0, TERRAIN, BUILDING)
    places = torch.tensor([SOLID.tolist().index(int(k)) for k in range(7) if k in SOLID])
    index = torch.searchsorted(torch.tensor(SOLID), kind)
    return 10.0 * torch.nn.functional.one_hot(places[index], len(SOLID)).float()


def in_sun(x, sun=TO_SUN):
    """1 where the ray towards the sun meets no solid, else 0."""
    d = x.new_tensor(sun).expand_as(x).contiguous()
    free = torch.ones(len(x), dtype=torch.bool)
    for solid in SOLIDS[1:]:
        enter, leave = solid.interval(x, d)
        free &= ~((enter < leave) & (leave > 1e-3))
    return free.float()


def sunlit_yard(sun=SUN):
    """The field."""
    capabilities = frozenset({DENSITY, NORMALS, CLASSES})
    even = (SKY,) * 3
    return SunlitYard(
        SOLIDS, zenith=even, horizon=even, box=BOX, capabilities=capabilities, sun=sun
    )


def yard_scene():
    """Photos from a ring of cameras around the yard, looking inwards and a little down."""
    camera = Camera(160, 100, 110.0, 110.0, 80.0, 50.0)
    views = []
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 10, endpoint=False)):
        eye = np.array([6 * np.cos(angle), 4.5 * np.sin(angle), 1.7])
        ahead = np.array([-np.cos(angle), -np.sin(angle), -0.12])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(ahead, right), ahead, eye], -1)
        views.append(View(f"{index}.png", Path(f"{index}.png"), 0, pose))
    return Scene(Path("."), "yard", (camera,), tuple(views))


def without_sun():
    """The same yard under its sky alone."""
    return dataclasses.replace(sunlit_yard(), sun=0.0)
