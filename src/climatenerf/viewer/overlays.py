"""Measured layers as pictures, with their legends."""

import numpy as np
from jaxtyping import UInt8

from climatenerf.page.drawings import class_legend, label_picture
from climatenerf.render.session import Frame

NEAR, FAR = 1.0, 60.0  # m, of the depth's grey levels
DEEPEST = 2.0  # m, of water
THICKEST = 0.5  # m, of snow
LAYERS = {
    "": "picture",
    "depth": f"depth: bright {NEAR:g} m, dark {FAR:g} m and more, black sky",
    "normal": "normals: red +x, green +y, blue +z",
    "label": "classes: ",
    "water_depth": f"water depth: light 0 m, dark blue {DEEPEST:g} m and more",
    "snow_thickness": f"snow thickness: dark 0 m, bright {THICKEST:g} m and more",
}
"""Layers that can be shown, and what their colours mean."""


def legend(layer: str) -> str:
    """Return what the colours of a layer mean."""
    if layer != "label":
        return LAYERS[layer]
    return LAYERS[layer] + ", ".join(f"{name} {colour}" for name, colour in class_legend())


def picture_of(layer: str, frame: Frame) -> UInt8[np.ndarray, "h w 3"]:
    """Return a layer of a frame as a picture; "" and layers that it lacks give the frame."""
    if layer not in frame.layers:
        return frame.picture
    values = frame.layers[layer]
    if layer == "label":
        return label_picture(values.astype(np.uint8))
    if layer == "normal":
        return (127.5 * (values + 1)).astype(np.uint8)
    if layer == "depth":
        share = np.log(np.maximum(values, NEAR) / NEAR) / np.log(FAR / NEAR)
        grey = np.where(np.isfinite(values), 1 - 0.85 * np.clip(share, 0, 1), 0)
        return np.repeat((255 * grey).astype(np.uint8)[..., None], 3, axis=-1)
    scale, colour = (DEEPEST, (0, 40, 140)) if layer == "water_depth" else (THICKEST, (255,) * 3)
    share = np.clip(values / scale, 0, 1)[..., None]
    base = 0.45 * frame.picture if layer == "snow_thickness" else frame.picture
    light = np.array((190, 225, 255)) if layer == "water_depth" else base
    mixed = (1 - share) * light + share * np.array(colour)
    return np.where(values[..., None] > 0, mixed, base).astype(np.uint8)
