"""A field under another light: the radiance of every sample times new over old irradiance.

Diffuse surfaces send light in proportion to the light that they receive, so the ratio needs no
albedo. It is wrong for what is glossy, and for what photos clip.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.field.protocol import observed
from climatenerf.field.wrapped import WrappedField
from climatenerf.weather.light.normals import normals_at
from climatenerf.weather.light.reference_albedo import ReferenceAlbedo
from climatenerf.weather.light.scene_light import MOST, SceneLight


@dataclass(frozen=True)
class RelitField(WrappedField):
    """A field (`field.protocol.RadianceField`) under another light.

    Attributes:
        field: the field as photographed.
        old: the light of its photos.
        new: the light that it is shown in.
        new_sky: whether the sky is the new light's; else the photographed one.
        albedo: the usual albedo of surfaces, by which photos tell the sun's light from its shadow;
            None: geometry alone tells.
    """

    old: SceneLight
    new: SceneLight
    new_sky: bool
    albedo: ReferenceAlbedo | None = None

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

    def observed_only(self) -> "RelitField":
        """The same, without density that no photo shows."""
        return replace(self, field=observed(self.field))
