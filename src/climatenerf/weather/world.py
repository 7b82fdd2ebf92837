"""What a ray can meet at one moment: the field, and lists of what the weather has put into it.

Four kinds of things act on a ray. A *medium* fills space and attenuates what is behind it. *Matter*
lies on the scene and brings samples of its own. A *surface* cuts rays off and shades them by
tracing further ones. The field is the scene itself. Lengths are metres, z is up, radiance linear.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.protocol import RadianceField
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.weather.style import Style
from climatenerf.weather.weather import Weather

SKY_OPACITY = 0.5  # rays whose sky weighs more have no surface
TINY = math.exp(-12)  # keeps means over nothing finite: 0/0


class Medium(Protocol):
    """A participating medium that absorbs, and has a radiance of its own.

    Its attribute `exponent`, if it has one, is the optical depth of red, green and blue over
    `optical_depth`.
    """

    @property
    def mask(self) -> str:
        """Name of the layer with the fraction of light that the medium adds."""
        ...

    def optical_depth(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Optical depth from each origin (m) to ray length t (m; may be +inf)."""
        ...

    def source(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "*n 3"]:
        """Radiance of the infinitely thick medium, one for all rays or one a ray."""
        ...

    def breaks(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n b"]:
        """Ray lengths (m) at which its extinction jumps or bends; +inf for none."""
        ...


class Matter(Protocol):
    """Solid matter on the scene, such as snow: density and colour of its own.

    Its method `covers`, if it has one, says at which positions (m, [n, 3]) upward surfaces of the
    field belong below it: a fitted surface is rough, and would reach out of thin matter. `veiled`
    says where upward surfaces of ground classes do: far ground hangs in veils. Its method
    `colour_towards`, if it has one, gives what an eye sees in place of `colour`; see `snow.layer`.
    """

    @property
    def mask(self) -> str:
        """Name of the layer with the fraction of the pixel that shows this matter."""
        ...

    @property
    def thickness_layer(self) -> str:
        """Name of the layer with its thickness, m."""
        ...

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
    ) -> Samples:
        """Samples along rays, front to back, where it has density."""
        ...

    def colour(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear radiance at positions (m)."""
        ...

    def normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Outward unit normal at positions (m)."""
        ...

    def thickness(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Height above the ground beneath, m."""
        ...


@dataclass(frozen=True)
class RaySamples:
    """Merged samples of rays, with what the integrator knows of them."""

    samples: Samples
    ray: Int[Tensor, "s"]
    """Ray of each sample."""
    weights: Float[Tensor, "s"]
    """Fraction of its ray's light that ends on each sample."""


@dataclass(frozen=True)
class SurfaceHits:
    """Rays that arrive at a surface."""

    rays_o: Float[Tensor, "n 3"]
    rays_d: Float[Tensor, "n 3"]
    t: Float[Tensor, "n"]
    """Ray length to the surface, m."""
    t_bottom: Float[Tensor, "n"]
    """Mean ray length of what lies behind the surface, m; 0 where nothing does."""
    pixel_angle: Float[Tensor, "n"]
    """Angle that a pixel spans, rad."""


TraceRadiance = Callable[
    [Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"]], Float[Tensor, "n 3"]
]
"""Radiance along further rays: origins (m), unit directions, pixel angles (rad)."""


class Surface(Protocol):
    """A surface that shades rays by tracing further ones, such as water."""

    @property
    def mask(self) -> str:
        """Name of the layer with the fraction of the pixel that shows this surface."""
        ...

    @property
    def extra_layers(self) -> tuple[str, ...]:
        """Names of the layers that `shade` gives besides the mask."""
        ...

    @property
    def level(self) -> float:
        """World height below which matter is submerged, m."""
        ...

    @property
    def calm(self) -> "Surface":
        """The surface without waves, as reflected and refracted rays meet it."""
        ...

    def distance(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Ray length to the surface, from either side, m; +inf where it is missed."""
        ...

    def inside(self, rays_o: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether origins lie in the body behind the surface."""
        ...

    def fraction_behind(
        self,
        world: "World",
        along: RaySamples,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "s"]:
        """Fraction of each sample that lies behind the surface, which rays meet at length t (m)."""
        ...

    def attenuate(
        self,
        world: "World",
        radiance: Float[Tensor, "n 3"],
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Radiance at ray length t (m) as it arrives at an eye inside the body."""
        ...

    def shade(
        self, world: "World", hits: SurfaceHits, trace: TraceRadiance
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], dict[str, Float[Tensor, "n"]]]:
        """What arriving rays see of the surface.

        Args:
            world: everything at this moment.
            hits: the rays.
            trace: traces further rays through the whole world, with one surface hit less to go.

        Returns:
            Radiance, unit normals, and the layers named in `extra_layers`.
        """
        ...


class Light(Protocol):
    """The light of the place at one moment."""

    def irradiance(
        self,
        x: Float[Tensor, "n 3"],
        normal: Float[Tensor, "n 3"],
        diffuse: Float[Tensor, "n"] | None = None,
    ) -> Float[Tensor, "n 3"]:
        """Irradiance of surfaces at positions x (m) with unit normals, linear.

        Args:
            x: positions.
            normal: unit normals.
            diffuse: fraction of the light without the sun's own that arrives; None: all of it.
        """
        ...

    def open_irradiance(self) -> Float[Tensor, "3"]:
        """Irradiance of level ground in the open."""
        ...

    def reflected_sky(
        self, d: Float[Tensor, "n 3"], sky: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Sky as surfaces reflect it, in unit directions d where the field's sky is `sky`.

        Photos clip a bright sky at white; what reflects it receives it all.
        """
        ...

    def sun_elevation(self) -> float | None:
        """Elevation of a sun that casts shadows, rad; None without one."""
        ...

    def mean_radiance(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Mean over all directions of the radiance that arrives at x (m), without a hard sun."""
        ...

    def visibility(
        self, x: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Fraction of a hard sun that surfaces at x (m) with unit normals see; 0 without one."""
        ...

    def beam(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]] | None:
        """Unit vector towards a hard sun and its irradiance across its rays; None without one."""
        ...


@dataclass(frozen=True)
class World:
    """Everything that a ray can meet at one moment.

    Attributes:
        field: the fitted field, or any other.
        appearance: exposure and light in which the field is rendered; None: the mean of all photos.
        media: what fills the air.
        matters: what lies on the scene.
        surfaces: what cuts rays off.
        light: what falls on snow, water and air; None where nothing asks for it.
    """

    field: RadianceField
    appearance: Float[Tensor, "1 e"] | None = None
    media: tuple[Medium, ...] = ()
    matters: tuple[Matter, ...] = ()
    surfaces: tuple[Surface, ...] = ()
    light: Light | None = None

    @property
    def layer_names(self) -> tuple[str, ...]:
        """Layers that rays through this world have."""
        names = [medium.mask for medium in self.media]
        for matter in self.matters:
            names += [matter.mask, matter.thickness_layer]
        for surface in self.surfaces:
            names += [surface.mask, *surface.extra_layers]
        return tuple(names)


@dataclass
class RenderOutput:
    """What rays see; all per ray, radiance linear."""

    rgb: Float[Tensor, "n 3"]
    depth: Float[Tensor, "n"]
    """Ray length to the visible surface (water counts), m; +inf for sky."""
    normal: Float[Tensor, "n 3"]
    """Of surfaces and matter of the weather; 0 elsewhere: the field's come later (`frame.py`)."""
    transmittance: Float[Tensor, "n"]
    """Of all media up to that surface."""
    layers: dict[str, Float[Tensor, "n"]] = field(default_factory=dict)
    """Layers of the effects that are present, by name."""


def concatenate(parts: Sequence[RenderOutput], order: Int[Tensor, "n"] | slice) -> RenderOutput:
    """The rays of all parts in one output, then in the given order. All have the same layers."""

    def joined(values: list[Tensor]) -> Tensor:
        return torch.cat(values)[order]

    return RenderOutput(
        joined([part.rgb for part in parts]),
        joined([part.depth for part in parts]),
        joined([part.normal for part in parts]),
        joined([part.transmittance for part in parts]),
        {name: joined([part.layers[name] for part in parts]) for name in parts[0].layers},
    )


@dataclass(frozen=True)
class Kept:
    """Where effects keep what they found in a field, for the next render.

    Attributes:
        folder: the run folder.
        checkpoint: identity of the field.
    """

    folder: Path
    checkpoint: str


@dataclass(frozen=True)
class Preparation:
    """What an effect is prepared from.

    Attributes:
        field: the fitted field, or any other.
        scene: its capture.
        moments: the weather at all moments of the movie at which the effect is present.
        camera_positions: world m; detail is finest around them.
        appearance: exposure and light of the field's colours; None: the mean of all photos.
        irradiance: gives the linear irradiance on open level ground; computed at its first call.
        progress: called with what is being done and the fraction that is done, [0, 1].
        photo_rays: gives where the rays of the photos end on the field; None for a field that has
            neither normals nor classes.
        kept: where to keep what was found; None: nowhere.
        style: new colours of the scene, of the run; None: those of the photos.
    """

    field: RadianceField
    scene: Scene
    moments: tuple[Weather, ...]
    camera_positions: Float[np.ndarray, "m 3"]
    appearance: Float[Tensor, "1 e"] | None
    irradiance: Callable[[], Float[Tensor, "3"]]
    progress: Callable[[str, float], None]
    photo_rays: Callable[[], list[PhotoRays]] | None = None
    kept: Kept | None = None
    style: Style | None = None

    def __getstate__(self) -> dict[str, object]:
        """Leave the receiver of progress out of a pickle: it belongs to one process."""
        return {**self.__dict__, "progress": unreported}


def unreported(what: str, fraction: float) -> None:
    """Take a report of progress and show it to nobody."""
