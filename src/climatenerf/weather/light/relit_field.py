"""A field under another light: the radiance of every sample times new over old irradiance.

Diffuse surfaces send light in proportion to the light that they receive, so the ratio needs no
albedo. It is wrong for what is glossy, and for what photos clip.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import SOLID_OF, VEGETATION
from climatenerf.field.grouping import shared_lookups
from climatenerf.field.normals import normals_at
from climatenerf.field.wrapped import RecolouredField
from climatenerf.weather.light.reference_albedo import ReferenceAlbedo
from climatenerf.weather.light.scene_light import DARKEST, MAX_CHANGE, SceneLight

LEAVES = int(SOLID_OF[VEGETATION])
HORIZON = -0.05  # sine of the elevation above which a ray may have sky behind it
DARK = 0.02  # radiance; less is no sky by day
LIKE_SKY = 0.4  # of the logarithms of a colour over the sky's
MAX_ALBEDO = 0.9  # white paint
MAX_LEAF_ALBEDO = 0.5  # yellow leaves in autumn
SHOULDER, BRIGHTEST = 0.8, 6.0  # of these bounds, see `bounded`
SHADIEST = 1 / 3  # of the light in the open; what is known of places is less certain
SHARED = 0.4  # m along a ray, within which samples share the change of their light


@dataclass(frozen=True)
class RelitField(RecolouredField):
    """A field (`field.protocol.RadianceField`) under another light.

    Attributes:
        field: the field as photographed.
        old: the light of its photos.
        new: the light that it is shown in.
        new_sky: whether the sky is the new light's; else the photographed one.
        brighter: the new light in the open over the old one, by luma. Changes are bounded about it.
        white: luma of perfectly white, level ground in the open under the new light.
        albedo: the usual albedo of surfaces, by which photos tell the sun's light from its shadow;
            None: geometry alone tells.
    """

    old: SceneLight
    new: SceneLight
    new_sky: bool
    brighter: float = 1.0
    white: float = 0.0
    albedo: ReferenceAlbedo | None = None

    def recoloured(
        self,
        colour: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance under the new light."""
        if ray is None:
            normal, kind = normals_at(self.field, x, d)
            ratio, most = self.change(colour, x, normal, kind)
            return bounded(colour * ratio, most)
        middle, group = shared_lookups(x, d, ray, SHARED)
        place, along = x[middle], d[ray[middle]]
        normal, kind = normals_at(self.field, place, along)
        ratio, most = self.change(colour[middle], place, normal, kind)
        relit = bounded(colour * ratio[group], most[group])
        if not self.new_sky:
            return relit
        leaves = ((kind == LEAVES)[group] & (d[ray, 2] > HORIZON)).nonzero()[:, 0]
        return relit.index_copy(
            0, leaves, self._under_new_sky(relit[leaves], colour[leaves], d[ray[leaves]])
        )

    def _under_new_sky(
        self, relit: Float[Tensor, "s 3"], colour: Float[Tensor, "s 3"], d: Float[Tensor, "s 3"]
    ) -> Float[Tensor, "s 3"]:
        """Show the new sky where leaves have the colour of the old one behind them.

        A fit puts haze of the sky's colour around twigs that are finer than a pixel.
        """
        old = self.old.radiance(d).clamp(DARK, 1.0)  # photos show no more than white
        off = (colour.clamp(DARK, 1.0) / old).log().square().sum(-1)
        like = torch.exp(-off / (2 * LIKE_SKY**2))[:, None]
        return relit + like * (self.new.radiance(d) - relit)

    def change(
        self,
        radiance: Float[Tensor, "s 3"],
        x: Float[Tensor, "s 3"],
        normal: Float[Tensor, "s 3"],
        kind: Int[Tensor, "s"],
    ) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s 3"]]:
        """New over old irradiance, and the bound on the radiance of surfaces in the new light.

        Far trees in a sun that was not found would glow under an overcast sky. Under the sky of the
        photos they are right, whatever light was found, and the bound is infinite.

        Args:
            radiance: of the samples in the photos.
            x: positions, world m.
            normal: unit.
            kind: classes, as indices in `core.classes.SOLID`.
        """
        old, new = SceneLight.shaded((self.old, self.new), x, normal)
        if self.old.sun is None:
            new = new + self.new.direct(x, normal)
        else:
            lit, full = self.old.visibility(x, normal), self.old.full_sun(normal)
            direct = lit[:, None] * full
            if self.albedo is not None:
                beam = self.old.sun_irradiance
                direct, wrong = self.albedo.sunlight(radiance, x, kind, old, full, beam, lit)
                normal, (old, new) = self._mended(x, normal, wrong, (old, new))
            if self.new.sun is self.old.sun:  # the sun of the photos keeps its shadows
                new = new + direct * (self.new.sun_irradiance / self.old.sun_irradiance)
            else:
                new = new + self.new.direct(x, normal)
            old = old + direct
        ratio = (new / old).clamp(self.brighter / MAX_CHANGE, self.brighter * MAX_CHANGE)
        if not self.new_sky:
            return ratio, torch.full_like(ratio, math.inf)
        # Normals err. A surface receives as much as level ground, or more.
        up = torch.zeros_like(normal)
        up[:, 2] = 1.0
        light = torch.maximum(new, self.new.irradiance(x, up))
        albedo = torch.where(kind == LEAVES, MAX_LEAF_ALBEDO, MAX_ALBEDO)[:, None]
        return ratio, albedo * light.clamp_min(SHADIEST * self.white * math.pi) / math.pi

    def _mended(
        self,
        x: Float[Tensor, "s 3"],
        normal: Float[Tensor, "s 3"],
        wrong: Float[Tensor, "s"],
        shaded: tuple[Float[Tensor, "s 3"], ...],
    ) -> tuple[Float[Tensor, "s 3"], tuple[Float[Tensor, "s 3"], ...]]:
        """Turn normals that are probably wrong to the photos' sun, and look up their shade anew.

        A lit leaf whose normal points down would otherwise get the light of an underside.
        """
        assert self.old.sun is not None
        rows = (wrong > 0.5).nonzero()[:, 0]
        normal = normal.clone()
        normal[rows] = normal.new_tensor(self.old.sun.direction)
        again = SceneLight.shaded((self.old, self.new), x[rows], normal[rows])
        return normal, tuple(a.index_copy(0, rows, b) for a, b in zip(shaded, again, strict=True))

    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the sky."""
        return self.new.radiance(d) if self.new_sky else self.field.sky(d, appearance)


def bounded(radiance: Float[Tensor, "s 3"], most: Float[Tensor, "s 3"]) -> Float[Tensor, "s 3"]:
    """The same colours, darker where a channel is near or above its bound.

    From `SHOULDER` of the bound on that channel rises with the logarithm, up to the bound at
    `BRIGHTEST` of it: what was estimated too bright keeps its texture.
    """
    over = (radiance / (SHOULDER * most.clamp_min(DARKEST))).amax(-1)  # without light: 0/0
    slope = (1 / SHOULDER - 1) / math.log(BRIGHTEST / SHOULDER)
    kept = (1 + slope * over.clamp_min(1).log()).clamp(max=1 / SHOULDER) / over.clamp_min(1)
    return radiance * kept[:, None]
