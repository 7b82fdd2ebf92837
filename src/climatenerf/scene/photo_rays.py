"""Where the rays of a photo end on a fitted field. `render.photo_rays` traces them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.cameras import Camera
from climatenerf.scene.scene import View


@dataclass(frozen=True)
class PhotoRays:
    """Where the rays of a photo end on the field, at a reduced size."""

    view: View
    camera: Camera
    """Its camera at the reduced size."""
    c2w: Float[np.ndarray, "4 4"]
    x: Float[np.ndarray, "h w 3"]
    """Ends, world m; infinite in the sky."""
    t: Float[np.ndarray, "h w"]
    """Ray lengths, m; +inf in the sky."""
    d: Float[np.ndarray, "h w 3"]
    """Unit directions."""
    normal: Float[np.ndarray, "h w 3"]
    """Unit normals, world axes; 0 in the sky."""
    label: UInt8[np.ndarray, "h w"]
    """Classes of the field."""
    transmittance: Float[np.ndarray, "h w"]
    """Fraction of the light that passes everything."""
