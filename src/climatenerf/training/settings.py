"""Settings of a fit, as plain values. Does not import torch."""

from dataclasses import asdict, dataclass, field, replace

from climatenerf.field.presets import PRESETS, FieldSize
from climatenerf.training.schedule import Schedule


@dataclass(frozen=True)
class Losses:
    """Weight of each loss relative to the colour loss, whose weight is 1; 0 switches a loss off.

    Each loss is a mean over the rays of a step (docs/physics.md). Lengths are in grid units. All
    weights are 0 or more.
    """

    distortion: float = 1e-2
    """Spread of the weights along each ray (mip-NeRF 360)."""
    opacity_entropy: float = 2e-4
    """Entropy of the rays' opacity: a ray should meet matter or sky, not half of each."""
    below_horizon_opacity: float = 0.1
    """Squared transmittance of rays below the horizon, where no sky can be."""
    sky: float = 1.0
    """Density on rays that the photos agree to end in the sky."""
    sky_prior: float = 1e-2
    """Difference of the sky from its surroundings in directions that no photo shows."""
    occlusion: float = 5e-3
    """Nearness of what stands on the ground, until surfaces are found: what shows no parallax is
    far away."""
    planarity: float = 1e-2
    """Curvature of surfaces between neighbouring pixels."""
    sparse_depth: float = 1e-1
    """Distance of matter from the sparse points, along rays of photos that show them."""
    ground_height: float = 0.25
    """Distance of matter from the ground height map, on rays labelled ground."""
    monocular_depth: float = 1e-2
    """Difference from a network's relative depth, up to scale and shift for each image."""
    classes: float = 4e-2
    """Cross-entropy of the classes; its gradients do not reach the density."""
    normals: float = 4e-2
    """Difference of the predicted normals from the density's; does not reach the density."""
    normal_consistency: float = 0.0
    """Difference of the density's normals from the predicted ones; its gradients reach the density.
    Costs a third more time, and needs `normals` above 0."""
    transient: float = 0.02
    """Price of masking a pixel as transient, in squared display values; 0 masks none."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit."""

    preset: str = "cpu"
    """Name of the preset that the settings come from."""
    size: FieldSize = field(default_factory=FieldSize)
    """Sizes of the field's grids and networks."""
    minutes: float | None = 5.0
    """Stop after this many minutes, above 0; None: `steps` alone limits the fit."""
    steps: int | None = None
    """Stop after this many steps, at least 1; None: `minutes` alone limits the fit."""
    samples_per_step: int = 2**16
    """Samples evaluated in one step, about."""
    grid_rate: float = 2e-2
    """Initial learning rate of the hash grids."""
    net_rate: float = 1e-2
    """Initial learning rate of the networks, the sky and the appearance vectors."""
    final_rate: float = 0.1
    """Final learning rate as a fraction of the initial one, (0,1]."""
    decay: float = 0.5
    """Weight decay of the appearance grid, times its learning rate a step; 0: none."""
    losses: Losses = field(default_factory=Losses)
    schedule: Schedule = field(default_factory=Schedule)
    appearance: bool = True
    """Learn a vector for each image that holds its exposure and light."""
    sky_labels: bool = True
    """Use the label "sky"; False: pixels labelled sky count as unlabelled."""
    free_space: bool = True
    """Keep space empty that no photo has in view, or that the photos agree to be sky."""
    multiview_stereo: bool = True
    """Match neighbouring photos for more measured depths."""
    near_camera_gradient_scaling: float = 3.0
    """Scale gradients down within this many times the nearest distance to a camera; 0: nowhere."""
    warm_up: bool = True
    """Until a quarter of the fit is over, colours do not depend on the view, and the distance from
    which rays are marched falls to the nearest one; False: neither, as in a plain NGP."""
    pruning_threshold: float = 0.1
    """Optical depth below which a sample on a ray counts as empty at the end of a fit, and in
    frames rendered from it; 1e-3 until half of the fit is over."""
    opaque_sky: bool = False
    """The paper's sky loss: sky rays end on matter far away, instead of on none."""
    refine_poses: bool = False
    """Correct the camera poses during the fit."""
    seed: int = 0
    """Seed of all random numbers."""


PAPER = FitSettings(
    preset="paper",
    size=PRESETS["paper"],
    losses=Losses(
        distortion=3e-4,
        opacity_entropy=2e-4,
        below_horizon_opacity=0.0,
        sky=1e-1,
        sky_prior=0.0,
        occlusion=0.0,
        planarity=0.0,
        sparse_depth=0.0,
        ground_height=0.0,
        monocular_depth=1.0,
        classes=4e-2,
        normals=7e-4,
    ),
    opaque_sky=True,
    decay=0.0,
    free_space=False,
    multiview_stereo=False,
    near_camera_gradient_scaling=0.0,
    warm_up=False,
    pruning_threshold=1e-3,
)
"""The paper's (supplement, "Training Details"), whose print "3^{-4}" is a mis-set 3e-4."""


def settings_of(preset: str, device: str = "cpu") -> FitSettings:
    """Return the settings of a preset of `field.presets` on a device, "cpu" or "cuda"."""
    settings = PAPER if preset == "paper" else FitSettings(preset=preset, size=PRESETS[preset])
    # A GPU takes as long for a small step as for a large one.
    return replace(settings, samples_per_step=2**20) if device == "cuda" else settings


RENAMED_LOSSES = {
    "opacity": "opacity_entropy",
    "solid": "below_horizon_opacity",
    "sky_fill": "sky_prior",
    "flat": "planarity",
    "points": "sparse_depth",
    "ground": "ground_height",
    "monocular": "monocular_depth",
    "bend": "normal_consistency",
}
"""Earlier names of losses and their present names; `--loss` takes both for one version."""
RENAMED_SETTINGS = {
    "carve": "free_space",
    "match": "multiview_stereo",
    "crowded": "near_camera_gradient_scaling",
    "cautious": "warm_up",
    "thin": "pruning_threshold",
}
"""Names of settings in the `config.json` of earlier runs, and their present names."""


def as_config(settings: FitSettings) -> dict:
    """Return the `settings` of a run's `config.json`; the field's size has its own entry there."""
    config = asdict(settings)
    del config["size"]
    # JSON has no tuples.
    config["schedule"] = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in config["schedule"].items()
    }
    return config


def with_present_names(settings: dict) -> dict:
    """Return the `settings` of a run's `config.json` with earlier names replaced."""
    renamed = {RENAMED_SETTINGS.get(name, name): value for name, value in settings.items()}
    if isinstance(renamed.get("losses"), dict):
        losses = renamed["losses"].items()
        renamed["losses"] = {RENAMED_LOSSES.get(name, name): value for name, value in losses}
    return renamed
