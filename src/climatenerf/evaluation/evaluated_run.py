"""A fitted run together with its ground truth, and the renders that scores are computed from."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.core.errors import UserError
from climatenerf.core.srgb import to_display
from climatenerf.evaluation.baselines import CleanView
from climatenerf.evaluation.reference import Reference, Truth, WeatherTruth, world_rays
from climatenerf.field.compositing import RENDER_STEP
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.ops import compositing
from climatenerf.render.frame import FrameOptions, see_frame
from climatenerf.render.session import RenderSession
from climatenerf.render.volume import camera_rays
from climatenerf.scene import Camera, Scene, View
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.world import Kept, World

Picture = UInt8[np.ndarray, "h w 3"]
ENDLESS = 1e9  # m, ray length without a bound


@dataclass(frozen=True)
class EvaluatedRun:
    """What is evaluated: a fitted field, its scene, and the ground truth."""

    field: RadianceField
    scene: Scene
    reference: Reference
    completed: RadianceField | None = None
    """The field with ground where no photo shows it, for renders in weather; None: `field`."""
    kept: Kept | None = None
    """The run folder, where light that was found is kept."""
    sessions: dict[bytes, RenderSession] = dataclasses.field(default_factory=dict, repr=False)
    """One for each set of cameras; light is gathered once for all weathers."""

    def camera(self, truth: Truth) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
        """Return the camera of a test view and its pose in the run's own world, m."""
        view = find_view(self.scene, truth)
        assert view is not None
        return self.scene.cameras[view.camera], self.scene.c2w_world(view)


def find_view(scene: Scene, truth: Truth) -> View | None:
    """Return the scene's view of a test view; some readers call it `images/NAME`."""
    return {Path(view.name).name: view for view in scene.views}.get(truth.name)


def check_views(scene: Scene, reference: Reference) -> None:
    """Check that a scene has all test views, held out and at full size.

    Raises:
        UserError: a test view is missing, was fitted to, or has another size.
    """
    for truth in reference.truths:
        view = find_view(scene, truth)
        if view is None:
            raise UserError(
                f"the run lacks the test view {truth.name}; fit the whole reference set"
            )
        if view.split == "train":
            raise UserError(
                f"the run was fitted to the test view {truth.name}, so it cannot be measured by it;"
                " fit without --holdout"
            )
        camera = scene.cameras[view.camera]
        if (camera.height, camera.width) != truth.depth.shape:
            raise UserError(
                f"the run has {truth.name} at {camera.width}x{camera.height} pixels, the reference"
                f" set at {truth.depth.shape[1]}x{truth.depth.shape[0]}; fit its own pictures"
            )


def display_8bit(linear: Float[np.ndarray, "h w 3"]) -> Picture:
    """Return linear radiance as 8-bit display values."""
    return (to_display(linear) * 255 + 0.5).astype(np.uint8)


def clean_view(run: EvaluatedRun, truth: Truth) -> CleanView:
    """Render a test view without weather."""
    return render_clean(run.field, *run.camera(truth))


def render_clean(field: RadianceField, camera: Camera, c2w: Float[np.ndarray, "4 4"]) -> CleanView:
    """Render a field without weather from any camera (pose in world m)."""
    linear, layers = see_frame(World(field), camera, c2w, FrameOptions(normals=True))
    rays_d = world_rays(camera, c2w)
    return CleanView(
        linear.double().numpy(), layers["depth"], layers["normal"], rays_d, c2w, camera
    )


def prepare_weather(
    run: EvaluatedRun, weather: KeyframedWeather, time: float, poses: list[np.ndarray]
) -> RenderSession:
    """Prepare a weather at one time (s) for cameras at some poses (world m)."""
    positions = np.stack([pose[:3, 3] for pose in poses])
    key = positions.tobytes() + np.float64(time).tobytes()
    if key in run.sessions:
        run.sessions[key].change(weather)
    else:
        moment = np.array([time])
        field = run.completed or run.field
        run.sessions[key] = RenderSession(
            field, run.scene, weather, positions, moment, effects=EFFECTS, kept=run.kept
        )
    return run.sessions[key]


def render_weather(
    run: EvaluatedRun, case: WeatherTruth
) -> list[tuple[Float[np.ndarray, "h w 3"], dict[str, np.ndarray]]]:
    """Render the test views in one weather; return linear radiance and layers of each."""
    return render_world(run, weather_world(run, case))


def weather_world(run: EvaluatedRun, case: WeatherTruth) -> World:
    """Everything that rays can meet in one weather, with detail around the test views."""
    poses = [run.camera(truth)[1] for truth in run.reference.truths]
    return prepare_weather(run, case.weather, case.time, poses).world(case.time)


def render_world(
    run: EvaluatedRun, world: World
) -> list[tuple[Float[np.ndarray, "h w 3"], dict[str, np.ndarray]]]:
    """Render the test views of a world; return linear radiance and layers of each."""
    rendered = [see_frame(world, *run.camera(truth)) for truth in run.reference.truths]
    return [(linear.double().numpy(), layers) for linear, layers in rendered]


@torch.no_grad()
def transmittance_to(
    field: RadianceField,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    t_max: Float[torch.Tensor, "n"],
) -> Float[torch.Tensor, "n"]:
    """Return the transmittance of each pixel's ray up to a ray length, m."""
    rays_o, rays_d = camera_rays(camera, c2w, t_max.device)
    start = torch.full_like(t_max, field.near)
    samples = field.march(rays_o, rays_d, start, t_max.clamp_min(field.near), RENDER_STEP)
    return compositing.render_weights(samples.sigma * samples.dt, samples.offsets)[1]


@torch.no_grad()
def depth_spread(
    field: RadianceField, camera: Camera, c2w: Float[np.ndarray, "4 4"]
) -> Float[torch.Tensor, "n"]:
    """Return the standard deviation of the weights' ray lengths over their mean, for each pixel.

    0 is a sharp surface. Haze around a surface does not change the depth, but it attenuates snow
    and smog. Pixels with an opacity up to 0.5 give NaN.
    """
    rays_o, rays_d = camera_rays(camera, c2w, device_of(field))
    near = torch.full((rays_o.shape[0],), field.near, device=rays_o.device)
    samples = field.march(rays_o, rays_d, near, torch.full_like(near, ENDLESS), RENDER_STEP)
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    # 1e-6: rays that meet no density, 0/0.
    ray, opacity = samples.ray_index(), (1 - transmittance).clamp_min(1e-6)
    normalised = weights / opacity[ray]
    mean = torch.zeros_like(transmittance).index_add(0, ray, normalised * samples.t)
    squared = normalised * (samples.t - mean[ray]).square()
    variance = torch.zeros_like(transmittance).index_add(0, ray, squared)
    return torch.where(opacity > 0.5, variance.sqrt() / mean, torch.nan)
