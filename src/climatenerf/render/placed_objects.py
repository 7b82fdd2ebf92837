"""Objects of known size put into a scene: a staff gauge, and a figure as tall as a person.

They are part of the field, so that water covers and mirrors them and fog hides them. No photo shows
them: light, terrain and snowfall are prepared without them. Heights on the gauge are metres above
the ground datum.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from climatenerf.core.classes import PERSON, SOLID_OF
from climatenerf.core.device import to_device
from climatenerf.core.samples import PLACED
from climatenerf.field.inserted import FieldWithSurface
from climatenerf.field.protocol import RadianceField, observed

FIGURE_HEIGHT = 1.75
"""m."""
GAUGE_WIDTH = 0.18
"""m."""
BURIED = 0.3  # m, of the gauge below the ground
EXTENT = 0.02  # m, of a sample on an object
NEAR_SURFACE = 0.02  # m; positions this near to an object lie on it
TEXELS = 200  # of the gauge's face, per metre
GROUND_ALBEDO = 0.12  # of what lights objects from below


class PlacedObject(Protocol):
    """An opaque object. Positions and directions are tensors [n, 3], in world metres."""

    def distance(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Ray length to its surface from outside, m; +inf where it is missed."""
        ...

    def signed_distance(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Distance to its surface, m; negative inside."""
        ...

    def albedo(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear reflectance at positions on its surface."""
        ...


@dataclass(frozen=True)
class StaffGauge:
    """A square staff with marks every decimetre and numbers every half metre.

    Attributes:
        base: where it stands, world m.
        top: height of its upper end, world m.
        datum: height of its zero, world m.
        yaw: direction that a face looks to, counterclockwise from +x, rad.
    """

    base: tuple[float, float, float]
    top: float
    datum: float
    yaw: float

    @property
    def _bottom(self) -> float:
        return self.base[2] - BURIED

    def _local(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Turn vectors into the staff's axes."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        turned = cosine * x[:, 0] + sine * x[:, 1], cosine * x[:, 1] - sine * x[:, 0], x[:, 2]
        return torch.stack(turned, dim=-1)

    def _centred(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        middle = x.new_tensor([*self.base[:2], (self._bottom + self.top) / 2])
        return self._local(x - middle)

    def _half(self, x: Tensor) -> Float[Tensor, "3"]:
        return x.new_tensor([GAUGE_WIDTH / 2, GAUGE_WIDTH / 2, (self.top - self._bottom) / 2])

    def distance(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Ray length to the surface by the slab method, m; +inf where it is missed."""
        o, d, half = self._centred(rays_o), self._local(rays_d), self._half(rays_o)
        d = torch.where(d.abs() < 1e-9, 1e-9, d)  # a ray along a face: 0/0
        first, second = (-half - o) / d, (half - o) / d
        enters = torch.minimum(first, second).amax(-1)
        leaves = torch.maximum(first, second).amin(-1)
        return torch.where((enters < leaves) & (enters > 0), enters, torch.inf)

    def signed_distance(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Distance to the surface, m; negative inside."""
        q = self._centred(x).abs() - self._half(x)
        return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)

    def albedo(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear reflectance of the printed faces."""
        at = self._centred(x)
        front = at[:, 0].abs() >= at[:, 1].abs()
        # Across the face, from its left edge as seen from outside.
        across = torch.where(front, at[:, 1] * at[:, 0].sign(), -at[:, 0] * at[:, 1].sign())
        face = to_device(self._face, x.device)
        rows, columns = face.shape[:2]
        row = ((self.top - x[:, 2]) * TEXELS).long().clamp(0, rows - 1)
        column = ((across / GAUGE_WIDTH + 0.5) * columns).long().clamp(0, columns - 1)
        shade = face[row, column].float() / 255
        return (0.03 + 0.72 * shade)[:, None].expand(-1, 3)

    @functools.cached_property
    def _face(self) -> UInt8[np.ndarray, "rows columns"]:
        return gauge_face(self.top - self.datum, self.top - self._bottom)


def gauge_face(top: float, length: float) -> UInt8[np.ndarray, "rows columns"]:
    """Draw the face of a staff gauge, 200 texels a metre, 0 black.

    Args:
        top: height of its upper end above zero, m.
        length: of the staff, m.
    """
    columns, rows = round(GAUGE_WIDTH * TEXELS), math.ceil(length * TEXELS)
    image = Image.new("L", (columns, rows), 255)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=16)

    def row(height: float) -> int:
        return round((top - height) * TEXELS)

    lowest = math.floor((top - length) * 10) - 1
    for tenth in range(lowest, math.ceil(top * 10) + 1):
        if tenth % 2 == 0:
            draw.rectangle((0, row((tenth + 1) / 10), columns // 4, row(tenth / 10) - 1), fill=0)
        draw.line((0, row(tenth / 10), columns // 2, row(tenth / 10)), fill=0)
        if tenth % 5 == 0:
            at = row(tenth / 10)
            draw.line((0, at, columns, at), fill=0, width=2)
            text = f"{tenth / 10:.1f}".replace("-", "\u2212")
            draw.text((columns - 1, at - 2), text, fill=0, font=font, anchor="rs")
    return np.array(image)


@dataclass(frozen=True)
class Capsule:
    """All points within a radius (m) of the segment from `start` to `end` (m)."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


def figure_parts() -> tuple[Capsule, ...]:
    """Return the parts of a standing figure of 1.75 m, facing +x, with its feet at the origin."""
    sides = (-1.0, 1.0)
    legs = [Capsule((0.0, 0.1 * s, 0.07), (0.0, 0.09 * s, 0.82), 0.07) for s in sides]
    arms = [Capsule((0.0, 0.24 * s, 1.36), (0.03, 0.29 * s, 0.85), 0.048) for s in sides]
    trunk = [Capsule((0.0, 0.07 * s, 0.92), (0.0, 0.1 * s, 1.32), 0.12) for s in sides]
    head = [Capsule((0.0, 0.0, 1.6), (0.0, 0.0, 1.645), 0.105)]
    neck = [Capsule((0.0, 0.0, 1.35), (0.0, 0.0, 1.55), 0.06)]
    return tuple(legs + arms + trunk + head + neck)


@dataclass(frozen=True)
class Figure:
    """A plain figure of 1.75 m.

    Attributes:
        base: where it stands, world m.
        yaw: direction that it looks to, counterclockwise from +x, rad.
    """

    base: tuple[float, float, float]
    yaw: float

    @functools.cached_property
    def _parts(self) -> tuple[Capsule, ...]:
        """The parts in world metres."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        x0, y0, z0 = self.base

        def placed(p: tuple[float, float, float]) -> tuple[float, float, float]:
            x, y, z = p
            return x0 + cosine * x - sine * y, y0 + sine * x + cosine * y, z0 + z

        return tuple(
            Capsule(placed(part.start), placed(part.end), part.radius) for part in figure_parts()
        )

    def distance(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Ray length to the surface, m; +inf where it is missed."""
        t = torch.full_like(rays_o[:, 0], torch.inf)
        middle = rays_o.new_tensor(self.base) + rays_o.new_tensor([0, 0, FIGURE_HEIGHT / 2])
        to_middle = middle - rays_o
        missed = torch.linalg.cross(to_middle, rays_d, dim=-1).norm(dim=-1)
        near = (missed < FIGURE_HEIGHT / 2 + 0.1).nonzero()[:, 0]  # a sphere around all of it
        for part in self._parts:
            own = _capsule_distance(part, rays_o[near], rays_d[near])
            t[near] = torch.minimum(t[near], own)
        return t

    def signed_distance(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Distance to the surface, m; negative inside."""
        parts = []
        for part in self._parts:
            start, end = x.new_tensor(part.start), x.new_tensor(part.end)
            along = end - start
            share = ((x - start) @ along / along.square().sum()).clamp(0, 1)
            parts.append((x - start - share[:, None] * along).norm(dim=-1) - part.radius)
        return torch.stack(parts).amin(0)

    def albedo(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear reflectance: dark trousers, an orange vest, a head."""
        height = x[:, 2:] - self.base[2]
        trousers, vest, head = (
            x.new_tensor(c) for c in ((0.05, 0.06, 0.09), (0.55, 0.2, 0.04), (0.4, 0.27, 0.2))
        )
        return torch.where(height < 0.88, trousers, torch.where(height < 1.46, vest, head))


def _capsule_distance(
    part: Capsule, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """Ray length to a capsule from outside, m; +inf where it is missed."""
    start, end = rays_o.new_tensor(part.start), rays_o.new_tensor(part.end)
    axis, o = end - start, rays_o - start
    length = axis.square().sum()
    # The infinite cylinder: |o + t d|^2 without the part along the axis is the squared radius.
    d_axis, o_axis = rays_d @ axis, o @ axis
    a = (length - d_axis.square()).clamp_min(1e-9)  # a ray along the axis: 0/0
    b = length * (o * rays_d).sum(-1) - o_axis * d_axis
    c = length * (o.square().sum(-1) - part.radius**2) - o_axis.square()
    root = b.square() - a * c
    t = (-b - root.clamp_min(0).sqrt()) / a
    at = o_axis + t * d_axis
    nearest = torch.where((root > 0) & (at > 0) & (at < length) & (t > 0), t, torch.inf)
    for centre in (start, end):
        from_centre = rays_o - centre
        b = (from_centre * rays_d).sum(-1)
        root = b.square() - from_centre.square().sum(-1) + part.radius**2
        t = -b - root.clamp_min(0).sqrt()
        nearest = torch.where((root > 0) & (t > 0), torch.minimum(nearest, t), nearest)
    return nearest


@dataclass(frozen=True)
class PlacedField(FieldWithSurface):
    """A field (`field.protocol.RadianceField`) with objects in it.

    Attributes:
        field: the field.
        objects: what stands in it.
        irradiance: linear irradiance on open level ground, which lights the objects.
    """

    surface_id = PLACED
    extent = EXTENT
    objects: Sequence[PlacedObject]
    irradiance: Float[Tensor, "3"]

    def _nearest(self, x: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Signed distance (m) to the nearest object, and its index."""
        distances = torch.stack([each.signed_distance(x) for each in self.objects])
        return distances.min(0)

    def crossing(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Return the ray lengths (m) at which rays meet the first object; +inf elsewhere."""
        t = torch.stack([each.distance(rays_o, rays_d) for each in self.objects]).amin(0)
        return torch.where(t > t_min, t, torch.inf)

    def on_surface(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions (world m) lie on an object."""
        return self._nearest(x)[0].abs() < NEAR_SURFACE

    def solid(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions (world m) lie in an object."""
        return self._nearest(x)[0] < 0

    def surface_radiance(
        self, x: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None
    ) -> Float[Tensor, "n 3"]:
        """Return linear radiance of matt objects below an even sky, at positions (world m)."""
        up = self.surface_normal(x)[:, 2:]
        # An even hemisphere above, darker ground below: the closed form for a tilted plane.
        sky, ground = (1 + up) / 2, GROUND_ALBEDO * (1 - up) / 2
        nearest = self._nearest(x)[1]
        albedo = torch.empty_like(x)
        for index, each in enumerate(self.objects):
            mine = nearest == index
            albedo[mine] = each.albedo(x[mine])
        return albedo * (sky + ground) * self.irradiance / math.pi

    def surface_normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return outward unit normals, by central differences of the signed distance."""
        step = 1e-3  # m
        slopes = []
        for axis in range(3):
            shift = torch.zeros(3, device=x.device)
            shift[axis] = step
            slopes.append(self._nearest(x + shift)[0] - self._nearest(x - shift)[0])
        return torch.nn.functional.normalize(torch.stack(slopes, dim=-1), dim=-1)

    def surface_class(self, x: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Return the class of objects: all count as persons."""
        return torch.full((x.shape[0],), int(SOLID_OF[PERSON]), device=x.device)

    def observed_only(self) -> RadianceField:
        """The field that photos show: without the objects."""
        return observed(self.field)


def with_objects(
    field: RadianceField, objects: Sequence[PlacedObject], irradiance: Float[Tensor, "3"]
) -> RadianceField:
    """Return a field with objects in it, or the field itself without any.

    Args:
        field: any field.
        objects: what stands in it.
        irradiance: linear irradiance on open level ground; see `render.irradiance`.
    """
    if not objects:
        return field
    light = to_device(irradiance.detach().cpu().numpy(), field.bounds[0].device)
    return PlacedField(field, tuple(objects), light)
