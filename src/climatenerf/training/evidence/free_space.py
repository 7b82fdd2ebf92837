"""What photos, labels and sparse points say of space before anything is learned.

Cells that no photo has in view stay empty, as do those right before a camera, those that photos
agree to be before the sky, unless a point lies by them, and those above points of the ground that
most photos see ground behind. Elsewhere matter above the ground costs, but is not forbidden: a
crest may hide a ditch and what is in it, and the map of the ground does not know every step. What
stands on the ground is spared, with a rim about it: a trunk is narrower than the haze that becomes
one. Once the field has learned classes of its own they say better what stands, and lumps in the rim
are pulled as well.
"""

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from climatenerf.core.classes import GROUND, SOLID
from climatenerf.core.device import to_device
from climatenerf.field.hash_field import Field
from climatenerf.ops import reference
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.frusta import intersects_frustum, within_camera_range
from climatenerf.training.evidence.ground_height import fit_ground_height
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Rooms


class FreeSpace:
    """Bars cells of a field's occupancy, and knows where sky and ground are seen."""

    def __init__(
        self,
        field: Field,
        pixels: TrainingPixels,
        points: SparseDepth | None,
        settings: FitSettings,
    ):
        self.field, self.pixels, self.points = field, pixels, points
        self.carves, self.moves = settings.free_space, settings.refine_poses
        self.solid = to_device(SOLID)
        self.knows_ground = settings.losses.ground_height > 0 and points is not None
        self.fit_ground()
        self.force_empty()

    def fit_ground(self) -> None:
        """Draws the map of the ground, and notes points that stand on it, and steps off it."""
        self.ground, self.steps = None, torch.zeros(0, 3)
        places, lies = torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool)
        if self.knows_ground and self.points is not None:
            places, lies = self.classify_points(self.points)
            self.ground = fit_ground_height(places[lies])
        if self.ground is not None:
            # Steps and banks that the map cannot follow are not to be levelled.
            steps = lies & (self.ground.height_above(places)[0].abs() > self.ground.tolerance)
            self.steps, lies = places[steps], lies & ~steps
        self.standing = places[~lies]
        self.hull = None

    def classify_points(
        self, points: SparseDepth
    ) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, "p"]]:
        """Each point once, in grid units, and whether most views that show it label it ground."""
        lies = is_ground(self.pixels.label_towards(points.image, points.rays_d))
        place = (self.field.to_grid(points.ends) / SAME).round()
        once, row, views = place.unique(dim=0, return_inverse=True, return_counts=True)
        votes = torch.zeros(once.shape[0]).index_add(0, row, lies.float())
        return once * SAME, votes > 0.5 * views

    def force_empty(self, everywhere: bool = True) -> None:
        """Bars the cells that are known to be empty.

        Args:
            everywhere: ask of all cells; else of those that are occupied, which is quicker.
        """
        witness, occupancy = self.pixels.sky_hull, self.field.occupancy
        self.rasterise_points()
        if not self.carves:
            return
        cells = torch.arange(occupancy.occupied.numel())
        if not everywhere:
            cells = cells[occupancy.occupied.view(-1) > 0]
        centre, size = occupancy.cell_centres(cells)
        x = centre * self.field.unit + self.field.centre
        radius = size * (self.field.unit * 3**0.5 / 2)
        empty = torch.zeros(cells.shape[0], dtype=torch.bool)
        if not self.moves:  # cameras that are still to turn have something else in view
            empty = ~intersects_frustum(x, radius, self.pixels.frusta)
            empty |= self.too_near_camera(x, radius)
        if witness is not None:
            empty |= witness.consensus(x, radius)
        barred = occupancy.barred.view(-1)
        barred[cells[empty]] = True
        barred[_grown(self.protected).view(-1)] = False
        if self.ground is not None:
            high = self.ground.clears(centre, size * (3**0.5 / 2)).nonzero()[:, 0]
            high = high[self.in_ground_hull(centre[high], radius[high])]
            high = high[~self.obstacle.view(-1)[cells[high]]]
            barred[cells[high]] = True
        occupancy.occupied.view(-1)[barred] = 0

    def too_near_camera(
        self, x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Whether balls (world m) lie before a camera and much nearer than all that it shows.

        What fills a corner of a few photos may as well be a dark lump before them; other photos
        hardly see so small a place. But points are found on what is truly near, except for smooth
        ground, which is spared where its map is known.
        """
        if self.points is None:
            return torch.zeros(x.shape[0], dtype=torch.bool)
        count = self.pixels.c2w.shape[0]
        reach = torch.zeros(count)
        for image in range(count):
            depth = self.points.depth[self.points.image == image]
            if depth.numel() >= MIN_POINTS:
                reach[image] = IN_THE_WAY * depth.quantile(NEAREST)
        eyes = self.pixels.c2w[:, :3, 3]
        before = within_camera_range(x, radius, self.pixels.frusta, eyes, reach)
        if self.ground is not None:
            over, known = self.ground.height_above(self.field.to_grid(x))
            before &= ~known | (over > radius / self.field.unit + self.ground.tolerance)
        return before

    def rasterise_points(self) -> None:
        """Notes the occupancy's cells in which sparse points lie, and those by what stands."""
        ends = torch.zeros(0, 3) if self.points is None else self.field.to_grid(self.points.ends)
        self.protected = self.cells_containing(ends)
        if self.hull is None:
            self.hull = self.find_obstacles()
        while self.hull.shape[1] < self.field.occupancy.side:  # asking of all again takes seconds
            for axis in (1, 2, 3):
                self.hull = self.hull.repeat_interleave(2, dim=axis)
        self.obstacle = _grown(self.cells_containing(self.standing) | self.hull)
        self.stepped = _grown(self.cells_containing(self.steps))

    def find_obstacles(self) -> Bool[Tensor, "k g g g"]:
        """The occupancy's cells where most photos see what stands on the ground."""
        occupancy, witness = self.field.occupancy, self.pixels.obstacle_hull
        stands = torch.zeros_like(occupancy.occupied, dtype=torch.bool)
        if self.ground is None or witness is None:
            return stands
        for cells in torch.arange(stands.numel()).split(AT_ONCE):
            centre, _ = occupancy.cell_centres(cells)
            near = self.ground.height_above(centre)[1].nonzero()[:, 0]
            x = centre[near] * self.field.unit + self.field.centre
            stands.view(-1)[cells[near]] = witness.consensus(x, torch.zeros(near.shape[0]))
        return stands

    def cells_containing(self, q: Float[Tensor, "n 3"]) -> Bool[Tensor, "cascades side side side"]:
        """The occupancy's cells in which places (grid units) lie."""
        held = torch.zeros_like(self.field.occupancy.occupied, dtype=torch.bool)
        cells, inside = self.field._cells(q)
        held.view(-1)[cells[inside]] = True
        return held

    def in_sky_hull(self, x: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether photos agree to see sky behind places x (world m), and no point is by them."""
        witness = self.pixels.sky_hull
        if witness is None or not self.carves:
            return torch.ones(x.shape[0], dtype=torch.bool)
        agreed = witness.consensus(x, torch.zeros(x.shape[0]))
        cells, _ = self.field._cells(self.field.to_grid(x))
        return agreed & ~self.protected.view(-1)[cells]

    def in_ground_hull(
        self, q: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Whether photos agree to see ground behind balls about q (grid units); radius in m."""
        witness = self.pixels.ground_hull
        if witness is None:
            return torch.zeros(q.shape[0], dtype=torch.bool)
        return witness.consensus(q * self.field.unit + self.field.centre, radius)

    def ground_offsets(
        self,
        q: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
        rooms: Rooms,
        classed: bool = False,
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Bool[Tensor, "k"]]:
        """Which samples of rays to the ground lie too far from it, and where (t) they should.

        Only those where most photos see ground, away from what stands on it, and with `classed`
        those that the field takes for ground, away from steps; t in grid units.

        Returns:
            Samples off the ground (in a fixed room the last again and again), where they should be,
            and to which of them all the rest applies.
        """
        if self.ground is None:
            return torch.zeros(0, dtype=torch.long), t[:0], t[:0] > 0
        over, known = self.ground.height_above(q)
        ahead, _ = self.ground.height_above(q + STEP * rays_d)
        nearing = (over - ahead) / STEP
        off = over.sign() * (over.abs() - self.ground.tolerance).clamp_min(0.0)
        far = rooms.chosen("far", known & (nearing > MIN_NEARING) & (off != 0))
        cells, _ = self.field._cells(q[far])
        pulled = torch.zeros(far.shape[0], dtype=torch.bool)
        if classed:
            pulled = self.classified_as_ground(q[far]) & ~self.stepped.view(-1)[cells]
        rest = rooms.chosen("rest", ~pulled & ~self.obstacle.view(-1)[cells])
        pulled[rest] = self.in_ground_hull(q[far[rest]], torch.zeros(rest.shape[0]))
        # Rays that do not near the ground, in a room's rest: 0/0.
        on = off[far] / nearing[far].clamp_min(MIN_NEARING)
        return far, (t[far] + on).clamp_min(0.0), pulled

    @torch.no_grad()
    def classified_as_ground(self, q: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether matter at q (grid units) is ground by the field's own classes."""
        _, logits = self.field.surface_at(reference.contract(q))
        return is_ground(self.solid[logits.argmax(-1)])


def is_ground(label: Int[Tensor, "n"] | UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Whether merged classes are such as lie on the ground."""
    return torch.stack([label == kind for kind in GROUND]).any(0)


def _grown(cells: Bool[Tensor, "k g g g"]) -> Bool[Tensor, "k g g g"]:
    """Cells and their neighbours."""
    return torch.nn.functional.max_pool3d(cells[:, None].float(), 3, 1, padding=1)[:, 0] > 0


AT_ONCE = 2**18  # cells that are asked about: their places take room
SAME = 1e-4  # grid units within which two ends are one point
STEP = 0.05  # grid units over which a ray nears the ground
MIN_NEARING = 0.02  # way down over way along: flatter rays tell nothing, 0/0 at worst
NEAREST = 0.02  # quantile of the distances of a photo's points that stands for the nearest,
MIN_POINTS = 20  # where it has so many
IN_THE_WAY = 0.8  # of that distance: what is nearer shows no point because it is not there
