"""A field under another light: the radiance of every sample times new over old irradiance.

Diffuse surfaces send light in proportion to the light that they receive, so the ratio needs no
albedo. It is wrong for what is glossy, and for what photos clip.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import FUSED
from climatenerf.field.compositing import composited
from climatenerf.field.protocol import RadianceField, observed
from climatenerf.weather.light.normals import normals_at
from climatenerf.weather.light.reference_albedo import ReferenceAlbedo
from climatenerf.weather.light.scene_light import MOST, SceneLight


@dataclass(frozen=True)
class RelitField:
    """A field (`field.protocol.RadianceField`) under another light.

    Attributes:
        field: the field as photographed.
        old: the light of its photos.
        new: the light that it is shown in.
        new_sky: whether the sky is the new light's; else the photographed one.
        albedo: the usual albedo of surfaces, by which photos tell the sun's light from its shadow;
            None: geometry alone tells.
    """

    field: RadianceField
    old: SceneLight
    new: SceneLight
    new_sky: bool
    albedo: ReferenceAlbedo | None = None

    @property
    def near(self) -> float:
        """Ray length at which camera rays begin, m."""
        return self.field.near

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner of the box that holds all density, m."""
        return self.field.bounds

    @property
    def capabilities(self) -> frozenset[str]:
        """Those of the field, but for rendering in one launch."""
        return self.field.capabilities - {FUSED}

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
        step_scale: float = 1.0,
        *,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
    ) -> Samples:
        """Samples of the field."""
        return self.field.march(
            rays_o, rays_d, t_min, t_max, step_scale, stop=stop, pruning_threshold=pruning_threshold
        )

    def colour(
        self,
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None = None,
        *,
        ids: Int[Tensor, "s"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance under the new light."""
        colour = self.field.colour(x, d, ray, ids=ids, appearance=appearance)
        along = d if ray is None else d[ray]
        normal, kind = normals_at(self.field, x, along)
        return colour * self.ratio(colour, x, normal, kind)

    def ratio(
        self,
        radiance: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        normal: Float[Tensor, "s 3"],
        kind: Int[Tensor, "s"],
    ) -> Float[Tensor, "s 3"]:
        """New over old irradiance.

        Args:
            radiance: of the samples in the photos.
            x: positions, world m.
            normal: unit.
            kind: classes, as indices in `core.classes.SOLID`.
        """
        old, new = SceneLight.shaded((self.old, self.new), x, normal)
        if self.old.sun is None:
            new = new + self.new.direct(x, normal)
            return (new / old).clamp(1 / MOST, MOST)
        lit = self.old.visibility(x, normal)
        full = self.old.full_sun(normal)
        if self.albedo is not None:
            lit = self.albedo.lit(radiance, x, kind, old, old + full, lit)
        if self.new.sun is self.old.sun:  # the sun of the photos keeps its shadows
            new = new + lit[:, None] * self.new.full_sun(normal)
        else:
            new = new + self.new.direct(x, normal)
        old = old + lit[:, None] * full
        return (new / old).clamp(1 / MOST, MOST)

    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the sky."""
        return self.new.radiance(d) if self.new_sky else self.field.sky(d, appearance)

    def composite(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        step_scale: float = 1.0,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Radiance, transmittance and weighted sum of ray lengths (m), in several launches."""
        given = t_min, step_scale, stop, pruning_threshold, appearance
        return composited(self, rays_o, rays_d, *given)

    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction at positions (m), 1/m."""
        return self.field.density(x)

    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Normals and class logits of some samples."""
        return self.field.surface_heads(rays_o, rays_d, samples, selected)

    def observed_only(self) -> "RelitField":
        """The same, without density that no photo shows."""
        return replace(self, field=observed(self.field))

    def photo_appearance(self, index: int) -> Float[Tensor, "1 e"]:
        """Appearance of a training photo."""
        return self.field.photo_appearance(index)
