"""What changes in the course of a fit, as one dataclass of plain numbers. Does not import torch.

Training progress runs from 0 to 1. The methods are pure functions of it.
"""

from dataclasses import dataclass

Rates = tuple[float, float]
"""Learning rates before and after `Schedule.refine_at`, as factors on the networks' rate, >= 0."""


@dataclass(frozen=True)
class Schedule:
    """Numbers that control a fit, with unit and range; rendering needs none of them."""

    # When what begins: training progress, [0,1].
    refine_at: float = 0.25
    """Progress at which surfaces are found, (0,1]. Occupancy cells are halved; view dependence,
    appearance, masks, planarity, normals, monocular depth and pose corrections begin."""
    normals_at: float = 0.35
    """Progress from which the predicted normals, learned since `refine_at`, count as learned."""
    prune_from: float = 0.5
    """Progress from which the pruning threshold rises, [0, finest_at)."""
    sky_edges_at: float = 0.5
    """Progress from which pixels on the sky's edges are drawn more often."""
    finest_at: float = 0.8
    """Progress from which marching steps are as fine as in a render, (0,1]."""

    # Learning rates.
    rate_warm_up: int = 50
    """Steps over which the learning rates rise linearly to their initial values, >= 1."""
    unlabelled_sky: Rates = (0.03, 0.3)
    """Sky where no label separates it from matter: it must not paint the view before there is
    matter."""
    view: Rates = (0.0, 1.0)
    """View-dependent colour with `FitSettings.warm_up`: while colours depend on position alone,
    haze in front of one camera cannot explain that camera's photo."""
    embeddings: Rates = (0.0, 0.02)
    """Appearance vectors. They begin with the view dependence: alone they would explain what the
    direction explains better. They learn slowly: a vector per image suffices to paint every photo
    onto haze."""
    masks: Rates = (0.0, 10.0)
    """Transient masks. They learn fast, before the field explains what one photo shows by haze in
    front of that camera."""
    poses: Rates = (0.0, 0.2)
    """Pose corrections."""

    # Rays and samples.
    first_near: float = 0.6
    """Ray length at which marching begins at first, grid units, >= 0. A wall in front of each
    camera would explain every photo; real near surfaces are seen from elsewhere too."""
    max_step_scale: float = 8.0
    """Marching step at first, over that of a render, >= 1: the occupancy grid is still full."""
    samples_per_ray: int = 40
    """Marching steps grow while rays have more samples than this on average, >= 1."""
    min_samples_per_ray: int = 4
    """Samples for which a ray's cost counts at least, >= 1: rays without samples cost too."""
    first_rays: int = 1024
    """Rays of the first step, >= 1."""
    occupied_weight: float = 0.05
    """Samples of a larger weight mark their cell as occupied, [0,1]. A lamp post fills a tenth of
    the first, large cells, and pruned cells hardly ever come back."""
    selected_per_ray: float = 32.0
    """Samples of a ray selected for gradients, about, where hundreds have small weights, > 0."""
    min_inclusion_probability: float = 0.25
    """Smallest probability of a sample to be selected, (0,1]: below it, noise lets walls grow in
    front of the cameras."""
    max_pruned_light: float = 0.2
    """The pruning threshold may double while samples up to twice as dense hold less than this
    fraction of the light that matter absorbs, [0,1]."""

    # Pixels and rays of single losses.
    triple_fraction: float = 1 / 6
    """Fraction of a batch that are the middles of three pixels in a line, [0, 1/3]."""
    sky_edge_fraction: float = 0.1
    """Fraction of the other pixels drawn from the sky's edges, [0,1]."""
    surface_ray_stride: int = 4
    """Rays for one from which classes and normals are learned, >= 1."""
    depth_ray_stride: int = 16
    """Rays of photos for one with a measured depth, of each kind of measurement, >= 1."""
    sky_prior_directions: int = 64
    """Directions in which the sky is compared with the sky prior, a step, >= 0."""
    ground_weight: float = 1e-3
    """Samples of a smaller weight are not compared with the ground height, [0,1]."""

    # Weights of losses, as factors on those in the settings.
    occlusion_until: float = 0.25
    """Progress at which the occlusion regularisation has fallen to 0, (0,1]: it decides where
    matter begins to form, and would shift surfaces that are found."""
    first_sky_weight: float = 0.2
    """Sky loss until 0.35 of the fit, [0,1]; it is whole from 0.75. Leaves against the sky come
    first, clean edges last: earlier, tree crowns are lost."""
    unlabelled_planarity: float = 0.3
    """Planarity where no label names the surface, [0,1]: a statue is not planar."""
    confident_ground: float = 4.0
    """Ground height loss once the field's own classes separate ground from obstacles, >= 0."""
    relative_mask_price: float = 6.0
    """Smallest price of a mask over the mean squared error, >= 0: early on, everything is wrong."""
    normal_step: float = 1.0
    """Marching steps over which the density's slope is taken, > 0."""

    def surfaces_found(self, progress: float) -> bool:
        """Return whether the losses and rates that need surfaces have begun."""
        return progress > self.refine_at

    def learning_rate(self, final: float, elapsed: float, step: int) -> float:
        """Return the factor on all learning rates in a step.

        Args:
            final: factor at the end, (0,1].
            elapsed: fraction of the time or steps, [0,1].
            step: steps done so far.
        """
        return final**elapsed * min(1.0, (step + 1) / self.rate_warm_up)

    def near(self, first: float, last: float, progress: float) -> float:
        """Return the ray length at which marching begins, from `first` down to `last`."""
        return max(last, first * (1 - progress / self.refine_at))

    def pruning_threshold(self, first: float, last: float, progress: float) -> float:
        """Return the optical depth below which a sample may count as empty, `first` to `last`."""
        risen = (progress - self.prune_from) / (self.finest_at - self.prune_from)
        return first * (last / first) ** min(1.0, max(0.0, risen))

    def step_scale(self, scale: float, samples_per_ray: float, progress: float) -> float:
        """Return the next marching step, over that of a render.

        Coarse steps while the grid is full make early steps many; they must end, since surfaces
        cannot become thinner than a step.
        """
        scale *= 1.03 if samples_per_ray > self.samples_per_ray else 0.98
        coarsest = 1 + (self.max_step_scale - 1) * max(0.0, 1 - progress / self.finest_at)
        return min(coarsest, max(1.0, scale))

    def rays(self, rays: int, samples: int, samples_per_step: int, progress: float) -> int:
        """Return the rays of the next step, so that it has as many samples as budgeted.

        The budget grows at first: early on, many small steps learn faster.

        Args:
            rays: of the last step.
            samples: that they had.
            samples_per_step: the whole budget.
            progress: training progress.
        """
        budget = samples_per_step * min(1.0, 0.25 + 2.5 * progress)
        factor = min(2.0, max(0.5, budget / max(samples, 1)))
        most = max(16384, samples_per_step // self.min_samples_per_ray)
        return int(min(most, max(256, rays * factor)))

    def sky_weight(self, progress: float) -> float:
        """Return the factor on the weight of the sky loss."""
        return min(1.0, max(self.first_sky_weight, 2 * progress - 0.5))

    def occlusion_weight(self, progress: float) -> float:
        """Return the factor on the weight of the occlusion regularisation."""
        return max(0.0, 1 - progress / self.occlusion_until)

    def below_horizon_weight(self, progress: float) -> float:
        """Return the factor on the weight of the below-horizon opacity."""
        return min(1.0, max(0.0, progress / self.refine_at - 0.5))
