"""Frames of a patterned plane on disk, as a comparison has rendered them; nothing is rendered."""

from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import ROAD, SKY
from climatenerf.core.srgb import to_display
from climatenerf.output.job import RenderJob
from climatenerf.output.layers import save_layers
from climatenerf.output.video import write_png
from climatenerf.paths.camera_path import CameraPath
from climatenerf.studies.compare.material import MASKS, Material, Rendered
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

WIDTH, HEIGHT = 64, 48
EYE = 2.0  # m above the plane
WEATHERS = {
    "smog": Weather(smog=Smog(visibility=30.0)),
    "flood": Weather(flood=Flood(level=0.5, wind_speed=0.0)),
    "snow": Weather(snow=Snow(depth=0.1)),
}
WATER_X = 6.0  # m, ground from there on is under water
BLUE = np.array([0.1, 0.2, 0.6])  # linear colour of our water and snow


def make_path(frames: int) -> CameraPath:
    """A camera that moves along y, looks along x and down by 15 degrees."""
    tilt = np.radians(15.0)
    forward = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    right = np.array([0.0, -1.0, 0.0])
    c2w = np.repeat(np.eye(4)[None], frames, axis=0)
    c2w[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    c2w[:, :3, 3] = [[0.0, 0.08 * i, EYE] for i in range(frames)]
    camera = Camera(WIDTH, HEIGHT, 50.0, 50.0, WIDTH / 2, HEIGHT / 2)
    return CameraPath(c2w, (camera,) * frames, "test")


def pattern(x: np.ndarray) -> np.ndarray:
    """Linear colour of the plane at positions (..., 2), m: smooth over a pixel."""
    u, v = np.sin(1.1 * x[..., 0]), np.sin(1.7 * x[..., 1] + 0.6 * x[..., 0])
    return 0.3 + 0.2 * np.stack([u, v, u * v], axis=-1)


def make_material(
    folder: Path, effect: str = "flood", frames: int = 3, labels: bool = True
) -> Material:
    """Write the frames and return the material: the ground of our frames is `BLUE` from x = 6 m."""
    path = make_path(frames)
    layers = ("depth", "normal", "label") if labels else ("depth", "normal")
    clean_job = RenderJob("a run", path, 12.0, KeyframedWeather(Weather(), {}), layers=layers)
    weather = KeyframedWeather(WEATHERS[effect], {})
    own_layers = ("depth", MASKS[effect])
    our_job = RenderJob("a run", path, 12.0, weather, layers=own_layers)
    clean, ours = folder / "clean", folder / effect / "climatenerf"
    for index in range(frames):
        rays = path.cameras[index].directions() @ path.c2w[index, :3, :3].T
        down = rays[..., 2] < -1e-3
        depth = np.where(down, EYE / np.where(down, -rays[..., 2], 1.0), np.inf)
        x = path.c2w[index, :3, 3] + np.where(down, depth, 0.0)[..., None] * rays
        linear = np.where(down[..., None], pattern(x[..., :2]), 0.8)
        mask = (down & (x[..., 0] > WATER_X)).astype(np.float32)
        normal = np.where(down[..., None], [0.0, 0.0, 1.0], 0.0)
        label = np.where(down, ROAD, SKY).astype(np.float32)
        weathered = np.where(mask[..., None] > 0, BLUE, linear)
        for job, place, picture, own in (
            (clean_job, clean, linear, {"depth": depth, "normal": normal, "label": label}),
            (our_job, ours, weathered, {"depth": depth, MASKS[effect]: mask}),
        ):
            write_png(place / job.files(index)[0], eight_bit(picture), "test")
            kept = {name: own[name] for name in job.layers}
            save_layers(place, f"{index:04d}", kept)
    return Material(effect, "", Rendered(clean_job, clean), Rendered(our_job, ours), 0.0, 0)


def eight_bit(linear: np.ndarray) -> np.ndarray:
    """Display picture of linear radiance."""
    return (255 * to_display(linear) + 0.5).astype(np.uint8)
