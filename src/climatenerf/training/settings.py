"""How a field is fitted, as plain values. Imports no torch."""

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Losses:
    """Weight of each loss beside the colour's, which is 1; 0 switches it off.

    Each is a mean over the rays of a step (docs/physics.md); lengths are in grid units.
    """

    distortion: float = 1e-2
    """Weight along a ray gathers at one place."""
    opacity: float = 2e-4
    """Entropy: rays see matter or sky, not half of each."""
    solid: float = 0.1
    """Light left on rays that point below the horizon, where no sky is."""
    sky: float = 1.0
    """Matter on rays that photos agree to end in the sky."""
    sky_fill: float = 1e-2
    """Sky where no photo looked differs from its surroundings."""
    flat: float = 1e-2
    """Surfaces bend between neighbouring pixels."""
    points: float = 1e-1
    """Distance of matter from sparse points, where photos are known to show them."""
    ground: float = 0.25
    """Distance of matter from the ground that sparse points show, on rays labelled ground."""
    monocular: float = 1e-2
    """Depth differs from a network's relative depth, up to scale and shift for each image."""
    classes: float = 4e-2
    """Cross-entropy of the classes; moves no matter."""
    normals: float = 4e-2
    """Predicted normals differ from the density's; moves no matter."""
    bend: float = 0.0
    """The density's normals differ from the predicted ones: moves matter, costs a third more, and
    wants normals above 0."""
    transient: float = 0.02
    """Price of a pixel that is taken for transient, in squared display values; 0: none is."""


@dataclass(frozen=True)
class FitSettings:
    """How a field is fitted."""

    preset: str = "cpu"
    minutes: float | None = 5.0
    """Stop after this many minutes; None: by steps alone."""
    steps: int | None = None
    """Stop after this many steps; None: by minutes alone."""
    samples_per_step: int = 2**16
    grid_rate: float = 2e-2
    """Learning rate of the hash grids at the start."""
    net_rate: float = 1e-2
    """Learning rate of networks, sky and appearance at the start."""
    final_rate: float = 0.1
    """Both rates end at this share of their start."""
    decay: float = 0.5
    """The appearance grid's values fall by this times their learning rate a step; 0: never."""
    losses: Losses = field(default_factory=Losses)
    appearance: bool = True
    """A vector for each image takes up its exposure and light."""
    sky_labels: bool = True
    """What is labelled sky is known to be; False: it is a class that nobody named."""
    carve: bool = True
    """What no photo has in view, or photos agree to be sky, is kept empty from the beginning."""
    match: bool = True
    """Photos are searched for what their neighbours show alike, as more measured points."""
    crowded: float = 3.0
    """Gradients shrink within this many times the nearest distance to a camera; 0: nowhere."""
    cautious: bool = True
    """Colours depend on the view once a quarter of the fit is over, and matter near cameras is
    believed bit by bit until then; False: both from the first step, as in a plain NGP."""
    thin: float = 0.1
    """Optical depth below which a sample on a ray counts as empty at the end of a fit, and in what
    is rendered from it; until half of the fit 1e-3."""
    opaque_sky: bool = False
    """The paper's sky loss: sky rays end on matter far away, instead of on none."""
    refine_poses: bool = False
    """Correct the cameras while fitting."""
    seed: int = 0


PAPER = FitSettings(
    preset="paper",
    losses=Losses(
        distortion=3e-4,
        opacity=2e-4,
        solid=0.0,
        sky=1e-1,
        sky_fill=0.0,
        flat=0.0,
        points=0.0,
        ground=0.0,
        monocular=1.0,
        classes=4e-2,
        normals=7e-4,
    ),
    opaque_sky=True,
    decay=0.0,
    carve=False,
    match=False,
    crowded=0.0,
    cautious=False,
    thin=1e-3,
)
"""The paper's (supplement, "Training Details"), whose print "3^{-4}" is a mis-set 3e-4."""


def settings_of(preset: str, device: str = "cpu") -> FitSettings:
    """The settings that go with a preset of `field.presets` on a device, "cpu" or "cuda"."""
    own = PAPER if preset == "paper" else FitSettings(preset=preset)
    # A GPU takes as long for a small step as for a large one.
    return replace(own, samples_per_step=2**20) if device == "cuda" else own
