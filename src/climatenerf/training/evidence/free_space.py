"""Free-space constraint: where space must be empty, and where density near the ground is an error.

A cell of the occupancy grid is forced empty in four cases:

1. No view sees it.
2. It lies right in front of a camera.
3. The views agree that only sky is behind it.
4. It is above the ground, and most views see ground behind it.

Cells near sparse points are protected from the first three, and cells in which most views see an
obstacle from the second.

Elsewhere, density above the ground is penalised but allowed: a crest may hide a ditch and what is
in it, and the ground height does not resolve every step. Obstacles on the ground are exempt, with a
margin of one cell: at first a trunk is haze wider than the trunk. Once the field has learned its
own classes, density in that margin that it classifies as ground is penalised too.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.classes import SOLID
from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.hash_field import Field
from climatenerf.field.occupancy import dilated
from climatenerf.ops import reference
from climatenerf.scene.terrain_fit import Heights
from climatenerf.training.dataset import TrainingPixels, is_ground
from climatenerf.training.evidence.frusta import intersects_frustum, within_camera_range
from climatenerf.training.evidence.ground_height import GroundHeight, fit_ground_height
from climatenerf.training.evidence.ground_sweep import ground_pictures
from climatenerf.training.evidence.sparse_depth import SparseDepth, concatenate
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Buffers

CHUNK = 2**18  # cells looked up at once, to bound the memory of their centres
SAME_POINT = 1e-4  # grid units within which two measurements are of one point
STEP = 0.05  # grid units along a ray over which its approach to the ground is measured
MIN_APPROACH = 0.02  # descent over distance; flatter rays give no position, at worst 0/0
SURFACE_ERROR = 0.02  # m, of the height of a measured point of the ground
DEPTH_ERROR = 0.01  # of its ray length
MIN_POINTS = 20  # of a photo, for its camera's clearance
NEAR_QUANTILE = 0.02  # of the distances of a photo's points: the nearest, without outliers
CLEARANCE_FACTOR = 0.8  # of that distance; matter closer to the camera would show points


class FreeSpace:
    """Forces cells of a field's occupancy empty; finds samples off the ground."""

    def __init__(
        self,
        field: Field,
        pixels: TrainingPixels,
        sparse: SparseDepth | None,
        settings: FitSettings,
        matched: SparseDepth | None = None,
    ):
        """Fit the ground and force the first cells empty.

        Args:
            field: Its occupancy is changed in place.
            pixels: The training photos, with label hulls if there are labels.
            sparse: Sparse depth of those photos.
            settings: `free_space` switches forced empty cells, `losses.ground_height` the ground.
            matched: depths from multi-view stereo, which show the ground as well.
        """
        self.field, self.pixels, self.sparse, self.matched = field, pixels, sparse, matched
        self.enabled, self.poses_move = settings.free_space, settings.refine_poses
        self.class_of_logit = to_device(SOLID, field.centre.device)
        self.uses_ground = settings.losses.ground_height > 0
        self.fit_ground()
        self.force_empty()

    def fit_ground(self) -> None:
        """Fit the ground height; split the points into ground, steps of the ground and obstacles.

        Sets `ground` (None if it is not used or not found), and in grid units `step_points`, ground
        points that the height cannot follow, and `obstacle_points`, all that are not ground.
        """
        q = self.field.centre.new_zeros(0, 3)
        self.ground, self.step_points, on_ground = None, q, q.new_zeros(0, dtype=torch.bool)
        if self.uses_ground:
            self.ground = self.find_ground()
        if self.uses_ground and self.sparse is not None:
            q, on_ground = self.classify_points(self.sparse)
        if self.ground is not None:
            # Steps and banks must not be flattened.
            height = self.ground.height_above(q)[0]
            is_step = on_ground & (height.abs() > self.ground.tolerance_at(q))
            self.step_points, on_ground = q[is_step], on_ground & ~is_step
        self.obstacle_points = q[~on_ground]
        self.obstacle_hull = None

    def find_ground(self) -> GroundHeight | None:
        """Fit the ground height to measured points on rays labelled ground, and to the photos."""
        kinds = [each for each in (self.sparse, self.matched) if each is not None]
        if not kinds:
            return None
        rays = concatenate(kinds)
        rays = rays.select(is_ground(self.pixels.label_towards(rays.image, rays.rays_d)))
        t, slope = (to_numpy(each).astype(np.float64) for each in (rays.depth, rays.rays_d[:, 2]))
        heights = Heights(
            to_numpy(rays.points).astype(np.float64),
            np.hypot(SURFACE_ERROR, DEPTH_ERROR * t * np.abs(slope)),
        )
        centre = to_numpy(self.field.centre).astype(np.float64)
        unit, device = self.field.unit, self.field.centre.device
        return fit_ground_height(heights, centre, unit, ground_pictures(self.pixels), device)

    def classify_points(
        self, sparse: SparseDepth
    ) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, "p"]]:
        """Return each point once, in grid units, and whether most of its views label it ground."""
        on_ground = is_ground(self.pixels.label_towards(sparse.image, sparse.rays_d))
        rounded = (self.field.to_grid(sparse.points) / SAME_POINT).round()
        unique, row, views = rounded.unique(dim=0, return_inverse=True, return_counts=True)
        votes = unique.new_zeros(unique.shape[0]).index_add(0, row, on_ground.float())
        return unique * SAME_POINT, votes > 0.5 * views

    def force_empty(self, everywhere: bool = True) -> None:
        """Force cells of the occupancy empty, for good unless a sparse point protects them.

        Args:
            everywhere: Test all cells; else only the occupied ones, which is faster.
        """
        hull, occupancy = self.pixels.sky_hull, self.field.occupancy
        self.rasterise_points()
        if not self.enabled:
            return
        cells = torch.arange(occupancy.occupied.numel(), device=occupancy.occupied.device)
        if not everywhere:
            cells = cells[occupancy.occupied.view(-1) > 0]
        centre, size = occupancy.cell_centres(cells)
        x = centre * self.field.unit + self.field.centre
        radius = size * (self.field.unit * 3**0.5 / 2)
        empty = torch.zeros_like(cells, dtype=torch.bool)
        if not self.poses_move:  # poses still change: so do the frusta
            empty = ~intersects_frustum(x, radius, self.pixels.frusta)
            # The points may lie on what is behind a car, which many photos show.
            empty |= self.too_near_camera(x, radius) & ~self.obstacle.view(-1)[cells]
        if hull is not None:
            empty |= hull.consensus(x, radius)
        forced = occupancy.forced_empty.view(-1)
        forced[cells[empty]] = True
        forced[dilated(self.protected).view(-1)] = False
        if self.ground is not None:
            rows = self.ground.is_above_crests(centre, size * (3**0.5 / 2)).nonzero()[:, 0]
            rows = rows[self.in_ground_hull(centre[rows], radius[rows])]
            rows = rows[~self.obstacle.view(-1)[cells[rows]]]
            forced[cells[rows]] = True
        occupancy.occupied.view(-1)[forced] = 0

    def too_near_camera(
        self, x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return which balls lie in front of a camera, much closer than all it observes.

        A dark lump there can explain a corner of a few photos, and other photos hardly see so small
        a volume. Near surfaces have sparse points of their own. Smooth ground may have none, so
        space near the ground height is excluded.

        Args:
            x: Ball centres, world m.
            radius: Ball radii, m.
        """
        if self.sparse is None:
            return x.new_zeros(x.shape[0], dtype=torch.bool)
        count = self.pixels.c2w.shape[0]
        clearance = x.new_zeros(count)
        for image in range(count):
            depth = self.sparse.depth[self.sparse.image == image]
            if depth.numel() >= MIN_POINTS:
                clearance[image] = CLEARANCE_FACTOR * depth.quantile(NEAR_QUANTILE)
        centres = self.pixels.c2w[:, :3, 3]
        near = within_camera_range(x, radius, self.pixels.frusta, centres, clearance)
        if self.ground is not None:
            height, valid = self.ground.height_above(self.field.to_grid(x))
            tolerance = self.ground.tolerance_at(self.field.to_grid(x))
            near &= ~valid | (height > radius / self.field.unit + tolerance)
        return near

    def rasterise_points(self) -> None:
        """Mark the cells of points, at the occupancy's present resolution.

        Sets `protected` (cells of sparse points), `obstacle` and `near_step` (each with a margin of
        one cell), all [cascades side side side].
        """
        self.protected = torch.zeros_like(self.field.occupancy.occupied, dtype=torch.bool)
        if self.sparse is not None:
            self.protected = self.cells_containing(self.field.to_grid(self.sparse.points))
        if self.obstacle_hull is None:
            self.obstacle_hull = self.find_obstacles()
        # Upsample: to find the obstacles again at a finer resolution takes seconds.
        while self.obstacle_hull.shape[1] < self.field.occupancy.side:
            for axis in (1, 2, 3):
                self.obstacle_hull = self.obstacle_hull.repeat_interleave(2, dim=axis)
        self.obstacle = dilated(self.cells_containing(self.obstacle_points) | self.obstacle_hull)
        self.near_step = dilated(self.cells_containing(self.step_points))

    def find_obstacles(self) -> Bool[Tensor, "cascades side side side"]:
        """Return the cells near the ground height in which most views see an obstacle."""
        occupancy, hull = self.field.occupancy, self.pixels.obstacle_hull
        obstacle = torch.zeros_like(occupancy.occupied, dtype=torch.bool)
        if self.ground is None or hull is None:
            return obstacle
        for cells in torch.arange(obstacle.numel(), device=obstacle.device).split(CHUNK):
            centre, _ = occupancy.cell_centres(cells)
            valid = self.ground.height_above(centre)[1].nonzero()[:, 0]
            x = centre[valid] * self.field.unit + self.field.centre
            obstacle.view(-1)[cells[valid]] = hull.consensus(x, torch.zeros_like(x[:, 0]))
        return obstacle

    def cells_containing(self, q: Float[Tensor, "n 3"]) -> Bool[Tensor, "cascades side side side"]:
        """Return the occupancy's cells that contain positions q (grid units)."""
        marked = torch.zeros_like(self.field.occupancy.occupied, dtype=torch.bool)
        cells, inside = self.field.occupancy.cell_index(q)
        marked.view(-1)[cells[inside]] = True
        return marked

    def in_sky_hull(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which positions x (world m) have only sky behind them by consensus.

        False in cells of sparse points; true everywhere if labels do not carve.
        """
        hull = self.pixels.sky_hull
        if hull is None or not self.enabled:
            return x.new_ones(x.shape[0], dtype=torch.bool)
        empty = hull.consensus(x, torch.zeros_like(x[:, 0]))
        cells, _ = self.field.occupancy.cell_index(self.field.to_grid(x))
        return empty & ~self.protected.view(-1)[cells]

    def in_ground_hull(
        self, q: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return which balls have only ground behind them by consensus.

        Args:
            q: Ball centres, grid units.
            radius: Ball radii, m.
        """
        hull = self.pixels.ground_hull
        if hull is None:
            return q.new_zeros(q.shape[0], dtype=torch.bool)
        return hull.consensus(q * self.field.unit + self.field.centre, radius)

    def ground_offsets(
        self,
        q: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
        buffers: Buffers,
        use_classes: bool = False,
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Bool[Tensor, "k"]]:
        """Find samples of rays labelled ground that lie off the ground, and their target depth.

        A sample is penalised if most views see ground behind it and it is away from obstacles; with
        `use_classes` also if the field classifies it as ground and it is away from steps.

        Args:
            q: Sample positions, grid units.
            rays_d: Unit directions of their rays.
            t: Ray length of the samples, grid units.
            buffers: Index lists of the step.
            use_classes: Whether the field's own classes are reliable yet.

        Returns:
            Indices of samples off the ground (a fixed-capacity buffer repeats the last one), the
            ray length (grid units) at which their ray meets the ground, and which of them are
            penalised.
        """
        if self.ground is None:
            return t.new_zeros(0, dtype=torch.long), t[:0], t[:0] > 0
        height, _ = self.ground.height_above(q)
        height_ahead, _ = self.ground.height_above(q + STEP * rays_d)
        approach = (height - height_ahead) / STEP
        excess = height.sign() * (height.abs() - self.ground.tolerance_at(q)).clamp_min(0.0)
        held = self.ground.holds(q) & (approach > MIN_APPROACH)
        off = buffers.indices("off ground", held & (excess != 0))
        cells, _ = self.field.occupancy.cell_index(q[off])
        penalised = torch.zeros_like(off, dtype=torch.bool)
        if use_classes:
            penalised = self.classified_as_ground(q[off]) & ~self.near_step.view(-1)[cells]
        rest = buffers.indices("ground hull", ~penalised & ~self.obstacle.view(-1)[cells])
        penalised[rest] = self.in_ground_hull(q[off[rest]], q.new_zeros(rest.shape[0]))
        # The filler of a buffer may be a ray that does not approach the ground: 0/0.
        to_ground = excess[off] / approach[off].clamp_min(MIN_APPROACH)
        return off, (t[off] + to_ground).clamp_min(0.0), penalised

    @torch.no_grad()
    def classified_as_ground(self, q: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return where the field's own classes at q (grid units) are ground."""
        _, logits = self.field.surface_at(reference.contract(q))
        return is_ground(self.class_of_logit[logits.argmax(-1)])
