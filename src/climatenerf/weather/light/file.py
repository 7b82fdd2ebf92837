"""The light of a run's photos on disk: `light.json` in the run folder."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, write_json
from climatenerf.field.protocol import RadianceField
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.weather.light.captured import (
    COLUMNS,
    ROWS,
    CapturedLight,
    UnknownLight,
    elevation_azimuth,
)
from climatenerf.weather.light.find_light import find_light
from climatenerf.weather.light.solar_position import almanac_sun
from climatenerf.weather.world import Kept

FILE_NAME = "light.json"
SCHEMA_VERSION = 6
"""1 knew no sun of the calendar, 2 let the zenith rise beside a lobe, 3 kept faint lobes, 4 took
noise for two suns, 5 held a lobe to the mean of the ground."""
NO_REASON = "the photos show too little of it"  # of files that were written without one


def light_of_photos_in(
    kept: Kept | None,
    scene: Scene,
    field: RadianceField,
    photo_rays: Callable[[], list[PhotoRays]],
) -> CapturedLight | UnknownLight:
    """Read the light of a run's photos, or find it and save it there.

    Args:
        kept: the run folder and the field's identity; None: nothing is read or saved.
        scene: the capture, whose photos may tell time and place.
        field: the fitted field.
        photo_rays: gives the rays of its photos.

    Raises:
        UserError: the file is damaged.
    """
    path = None if kept is None else kept.folder / FILE_NAME
    if kept is not None and path is not None and path.is_file():
        light, made_from = load_light(path)
        if made_from == kept.checkpoint and read_json(path).get("schema_version") == SCHEMA_VERSION:
            return light
    light = find_light(field, photo_rays(), almanac_sun(scene))
    if kept is not None and path is not None:
        with contextlib.suppress(UserError, OSError):  # a folder of somebody else: found again
            save_light(path, light, kept.checkpoint)
    return light


def save_light(path: Path, light: CapturedLight | UnknownLight, checkpoint: str) -> None:
    """Write the light, or why none could be found, and the identity of its field."""
    data: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "checkpoint": checkpoint}
    if isinstance(light, CapturedLight):
        sun = None
        if light.sun is not None:
            elevation, azimuth = np.degrees(elevation_azimuth(light.sun))
            sun = {
                "elevation_deg": float(elevation),
                "azimuth_deg": float(azimuth),
                "error_deg": float(np.degrees(light.sun_error)),
                "direction": light.sun.tolist(),
                "width_deg": float(np.degrees(light.width)),
                ("irradiance" if light.hard else "radiance"): light.lobe.tolist(),
            }
        data["light"] = {
            "horizon": light.horizon.tolist(),
            "zenith": light.zenith.tolist(),
            "sun": sun,
            "almanac": _almanac(light),
            "shown": np.round(light.shown, 3).tolist(),
        }
    else:
        data |= {"light": None, "reason": light.reason}
    write_json(path, data)


def _almanac(light: CapturedLight) -> dict[str, Any] | None:
    """The sun by date, time and place."""
    if light.almanac is None:
        return None
    elevation, azimuth = np.degrees(elevation_azimuth(light.almanac))
    difference = light.almanac_difference
    return {
        "elevation_deg": float(elevation),
        "azimuth_deg": float(azimuth),
        "direction": light.almanac.tolist(),
        "difference_deg": None if difference is None else float(np.degrees(difference)),
    }


def load_light(path: Path) -> tuple[CapturedLight | UnknownLight, str]:
    """Read a light and the identity of the field that it was found in.

    Raises:
        UserError: the file is damaged.
    """
    data = read_json(path, "the light of the photos")
    try:
        found, checkpoint = data["light"], str(data["checkpoint"])
        if found is None:
            return UnknownLight(str(data.get("reason", NO_REASON))), checkpoint
        sun = found["sun"]
        shown = np.array(found["shown"], float)
        if shown.shape != (ROWS, COLUMNS):
            raise ValueError("shown")
        vectors = [np.array(found[name], float) for name in ("horizon", "zenith")]
        direction, width, lobe, error = None, 0.0, np.zeros(3), 0.0
        if sun is not None:
            direction = np.array(sun["direction"], float)
            width, error = np.radians([sun["width_deg"], sun["error_deg"]])
            lobe = np.array(sun.get("irradiance", sun.get("radiance")), float)
            vectors += [direction, lobe]
        almanac = found.get("almanac")
        if almanac is not None:
            almanac = np.array(almanac["direction"], float)
            vectors.append(almanac)
        if any(vector.shape != (3,) or not np.isfinite(vector).all() for vector in vectors):
            raise ValueError("a vector")
    except (KeyError, TypeError, ValueError) as error_:
        raise UserError(f"{path} is damaged ({error_}); delete it, and it is made again") from None
    light = CapturedLight(
        vectors[0], vectors[1], direction, float(width), lobe, shown, float(error), almanac
    )
    return light, checkpoint
