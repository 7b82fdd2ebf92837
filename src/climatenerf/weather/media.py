"""Light through one or several participating media, in closed form wherever there is one.

A sample absorbs at one place, so its light crosses the media in front of it alone. One medium turns
radiance L into T L + (1 - T) c, with T = exp(-tau) and c its own radiance (Beer-Lambert; Max 1995).
Several media that overlap share each stretch of the ray in proportion to their optical depths; the
ray is cut where a medium begins or ends, and finely enough for smooth fall-offs. For homogeneous
media, in layers or overlapping, that is exact.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.weather.world import Medium

PIECES = 16  # cuts of a ray beside those that media ask for
FAR = 1e6  # m; where media overlap, infinite rays are cut up to here
_OPAQUE = 1e4  # optical depth behind which nothing is seen
_TINY = 1e-30  # optical depth that keeps the mean colour of an empty stretch finite: 0/0


def transmittance(
    media: Sequence[Medium],
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t: Float[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Transmittance of all media from each origin (m) to ray length t (m; may be +inf)."""
    depths = [medium.optical_depth(rays_o, rays_d, t) for medium in media]
    return torch.exp(-torch.stack(depths).sum(0)) if len(depths) > 1 else torch.exp(-depths[0])


def attenuate(
    media: Sequence[Medium],
    radiance: Float[Tensor, "n 3"],
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t: Float[Tensor, "n"],
) -> Float[Tensor, "n 3"]:
    """Linear radiance at ray length t (m; may be +inf) as it arrives at the origin."""
    if len(media) == 1:
        weight = _by_channel(media[0], media[0].optical_depth(rays_o, rays_d, t)).neg().exp()
        return weight * radiance + (1 - weight) * media[0].source(rays_o, rays_d)
    arriving, passed = torch.zeros_like(radiance), torch.ones_like(radiance)
    start = torch.zeros_like(t)
    before = [torch.zeros_like(t) for _ in media]
    sources = [medium.source(rays_o, rays_d) for medium in media]
    for end in _cuts(media, rays_o, rays_d, t):
        after = [medium.optical_depth(rays_o, rays_d, end) for medium in media]
        # A stretch of no length adds nothing, whatever roundings say.
        depths = [
            _by_channel(medium, torch.where(end > start, (b - a).clamp_min(0), 0.0))
            for medium, a, b in zip(media, before, after, strict=True)
        ]
        total = torch.stack(depths).sum(0)
        own = sum(d * c for d, c in zip(depths, sources, strict=True))
        own = own / total.clamp_min(_TINY)
        transmitted = torch.exp(-total)
        arriving = arriving + passed * (1 - transmitted) * own
        passed, start, before = passed * transmitted, end, after
    return arriving + passed * radiance


def _by_channel(medium: Medium, depth: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Optical depth of each colour channel."""
    exponent = getattr(medium, "exponent", None)
    if exponent is None:
        return depth[:, None].expand(-1, 3)
    # 0 times the infinite depth of an endless ray would be NaN.
    return depth.clamp_max(_OPAQUE)[:, None] * exponent


def _cuts(
    media: Sequence[Medium],
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t: Float[Tensor, "n"],
) -> list[Float[Tensor, "n"]]:
    """Ends of stretches, ascending, up to t: where media change, and in steps that grow."""
    end = t.clamp_max(FAR)
    # From about a metre on each stretch is longer than the last one by the same factor.
    exponent = torch.linspace(0, 1, PIECES + 1, device=t.device)[1:-1]
    growing = (1 + end[:, None]) ** exponent - 1
    breaks = [medium.breaks(rays_o, rays_d) for medium in media]
    cuts = torch.cat([growing, *breaks, end[:, None]], dim=-1)
    return list(torch.minimum(cuts, end[:, None]).clamp_min(0).sort(-1).values.unbind(-1))
