"""Where the sun stood, from date, time and place.

Low-precision formulas of the Astronomical Almanac (Michalsky 1988, Solar Energy 40, 227-235), good
to .01 degrees from 1950 to 2050. Refraction is left out: it lifts a sun at 5 degrees by .2 degrees.
"""

import math
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from jaxtyping import Float

from climatenerf.scene.photo_times import time_taken
from climatenerf.scene.scene import Scene

EPOCH = datetime(2000, 1, 1, 12, tzinfo=UTC)
MAX_SPREAD = math.radians(10.0)  # of the sun over the time of a capture, from its middle


def solar_position(latitude: float, longitude: float, time: datetime) -> tuple[float, float]:
    """Elevation of the sun, and its azimuth clockwise from north, rad.

    Args:
        latitude: of the place, degrees north.
        longitude: of the place, degrees east.
        time: with a time zone.
    """
    days = (time - EPOCH).total_seconds() / 86400
    mean = math.radians(280.460 + 0.9856474 * days)
    anomaly = math.radians(357.528 + 0.9856003 * days)
    ecliptic = mean + math.radians(1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    obliquity = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    sidereal = math.radians(280.46062 + 360.98564737 * days + longitude)
    hour = sidereal - ascension
    phi = math.radians(latitude)
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(
        hour
    )
    east = -math.cos(declination) * math.sin(hour)
    north = math.cos(phi) * math.sin(declination) - math.sin(phi) * math.cos(
        declination
    ) * math.cos(hour)
    return math.asin(max(-1.0, min(1.0, up))), math.atan2(east, north) % (2 * math.pi)


def sun_over(
    latitude: float, longitude: float, times: Sequence[datetime]
) -> Float[np.ndarray, "3"] | None:
    """Unit vector (east, north, up) towards the sun in the middle of some times.

    None if it was below the horizon, or moved too far between the times to be one sun.
    """
    if not times:
        return None
    positions = [solar_position(latitude, longitude, time) for time in times]
    towards = np.array(
        [(math.cos(h) * math.sin(a), math.cos(h) * math.cos(a), math.sin(h)) for h, a in positions]
    )
    middle = np.median(towards, axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-9)  # 1e-9: opposite suns have no middle
    if (towards @ middle).min() < math.cos(MAX_SPREAD) or middle[2] <= 0:
        return None
    return middle


def almanac_sun(scene: Scene) -> Float[np.ndarray, "3"] | None:
    """Unit vector towards the sun of a capture, world axes, from its photos' times and GPS.

    None where photos do not tell time, zone and place, or were taken too far apart in time.
    """
    place = scene.georeference
    if not {"latitude", "longitude"} <= place.keys():
        return None
    found = (time_taken(view.path) for view in scene.of_split("train"))
    times = [time for time in found if time is not None]
    return sun_over(place["latitude"], place["longitude"], times)
