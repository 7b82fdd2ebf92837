"""A season file from photos: palettes of leaves and ground, and the sky's colour. No torch.

Colours are measured at luminance 1, since the exposure of the photos is unknown.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2

from climatenerf.core.classes import SKY, TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA
from climatenerf.styling.style_photos import MIN_PIXELS, StylePhotos, is_shown

COLOURS = 4  # of a palette
DARKEST, BRIGHTEST = 0.1, 0.98  # quantiles of luminance: noise and clipped pixels are left out
STRENGTH = 0.85
GATE = 0.5  # of what is not green
SKY_SHARE = 0.75


def season_of_photos(photos: StylePhotos) -> dict[str, Any]:
    """Return the tables of a season file, as `palettes.read_palettes` reads them.

    Args:
        photos: colours by class.

    Raises:
        UserError: the photos show neither plants nor ground.
    """
    tables: dict[str, Any] = {}
    for name, kind in (("vegetation", VEGETATION), ("terrain", TERRAIN)):
        colours = photos.colours.get(kind)
        if colours is not None and is_shown(colours):
            tables[name] = {
                "palette": palette_of(colours).round(3).tolist(),
                "strength": STRENGTH,
                "brightness": 1.0,
                "gate": GATE,
            }
    if not tables:
        raise UserError(
            f"the photos show fewer than {MIN_PIXELS} pixels of plants and ground; name them with"
            " --style-region or --labels"
        )
    sky = photos.colours.get(SKY)
    if sky is not None and is_shown(sky):
        mean = sky.mean(0)
        colour = mean / (mean @ np.array(LUMA))
        tables["sky"] = {
            "colour": colour.round(3).tolist(), "gradient": 0.0, "share": SKY_SHARE,
        }  # fmt: skip
    licences = sorted({source.licence for source in photos.sources} - {""})
    note = " ".join(["Measured from photos; brightness 1 keeps the luminance.", *licences])
    return {"note": note, **tables}


def palette_of(colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 3"]:
    """Return typical colours of luminance 1, from the greenest to the reddest.

    Args:
        colours: linear colours of one class.
    """
    luminance = colours @ np.array(LUMA)
    low, high = np.quantile(luminance, [DARKEST, BRIGHTEST])
    # 1e-4: black pixels have no colour, 0/0.
    used = (luminance >= max(low, 1e-4)) & (luminance <= high)
    if not used.any():
        used = luminance > 1e-4
    even = colours[used] / luminance[used, None]
    centres, _ = kmeans2(even, COLOURS, minit="++", rng=0)  # type: ignore
    centres = centres / (centres @ np.array(LUMA))[:, None]
    return centres[np.argsort(centres[:, 0])]
