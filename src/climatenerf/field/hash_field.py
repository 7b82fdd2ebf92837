"""The radiance field: hash grids, their networks, a directional sky, an occupancy grid.

Geometry depends on the geometry grid alone; the appearance grid, the view direction and a
per-image vector give colour; a small third grid gives normals and classes (paper §3.1, where they
read the appearance grid: then a change of appearance would change them). Callers speak world
metres; inside, lengths are in grid units: (x - centre) / unit, where the ball of radius 1 holds the
core of the scene.
"""

import copy
import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from climatenerf.core.classes import SOLID
from climatenerf.core.samples import MIN_TAU, MIN_WEIGHT, Samples
from climatenerf.core.vectors import unit as unit_vector
from climatenerf.field import activations, protocol
from climatenerf.field import spherical_harmonics as directions
from climatenerf.field.occupancy import Occupancy
from climatenerf.field.presets import FieldSize
from climatenerf.ops import compositing, encoding, fused_render, marching, network, reference

STEP_MIN = 1.0 / 256  # smallest marching step, grid units
STEP_CONE = 1.0 / 160  # marching step per length travelled


def _resolutions(coarsest: int, finest: int, levels: int) -> Int[Tensor, "levels"]:
    growth = math.log(finest / coarsest) / max(levels - 1, 1)
    return torch.tensor([int(coarsest * math.exp(growth * i) + 1e-6) for i in range(levels)])


def _uniform(
    shape: tuple[int, ...], bound: float, generator: torch.Generator | None
) -> nn.Parameter:
    """A parameter drawn from (-bound, bound) on the CPU, so that a seed means the same anywhere."""
    drawn = torch.empty(shape, device="cpu").uniform_(-bound, bound, generator=generator)
    return nn.Parameter(drawn.to(torch.get_default_device()))


def _layers(generator: torch.Generator | None, *widths: int) -> nn.ParameterList:
    """Weights [in, out] and biases [out] in turn; He initialisation."""
    parameters = []
    for i, o in zip(widths[:-1], widths[1:], strict=True):
        parameters += [_uniform((i, o), math.sqrt(6.0 / i), generator)]
        parameters += [nn.Parameter(torch.zeros(o))]
    return nn.ParameterList(parameters)


def _pairs(parameters: nn.ParameterList) -> list[tuple[Tensor, Tensor]]:
    return list(zip(parameters[::2], parameters[1::2], strict=True))


class Field(nn.Module):
    """A radiance field in world metres; see the module's docstring."""

    centre: Tensor
    geometry_resolutions: Tensor
    appearance_resolutions: Tensor
    surface_resolutions: Tensor
    sky_resolutions: Tensor
    learned: Tensor

    def __init__(
        self,
        size: FieldSize,
        images: int,
        centre: Float[np.ndarray, "3"],
        unit: float,
        near: float = 0.0,
        generator: torch.Generator | None = None,
    ):
        """Makes an untrained field.

        Args:
            size: sizes of grids and networks.
            images: number of training images, each with an appearance vector.
            centre: middle of the scene, world metres.
            unit: metres per grid unit.
            near: no matter is believed nearer to a camera than this, m.
            generator: source of the initial values, on the CPU; None: PyTorch's global one.
        """
        super().__init__()
        self.size = size
        self.unit = unit
        self.near = near
        self.thin = MIN_TAU
        """Optical depth below which a sample on a camera's ray is empty; see `training.fit`."""
        self.register_buffer("centre", torch.tensor(centre, dtype=torch.float32))
        self.register_buffer(
            "geometry_resolutions",
            _resolutions(size.coarsest, size.geometry_finest, size.geometry_levels),
        )
        self.register_buffer(
            "appearance_resolutions",
            _resolutions(size.coarsest, size.appearance_finest, size.appearance_levels),
        )
        self.register_buffer(
            "surface_resolutions",
            _resolutions(size.coarsest, size.surface_finest, size.surface_levels),
        )
        self.register_buffer(
            "sky_resolutions", _resolutions(size.coarsest, size.sky_finest, size.sky_levels)
        )
        self.geometry_grid = _uniform(
            (size.geometry_levels, 2**size.geometry_log2_rows, 2), 1e-4, generator
        )
        self.appearance_grid = _uniform(
            (size.appearance_levels, 2**size.appearance_log2_rows, 2), 1e-4, generator
        )
        self.geometry_net = _layers(generator, 2 * size.geometry_levels, size.geometry_hidden, 1)
        # Thin haze everywhere to begin with: dense enough to learn from, thin enough to prune.
        nn.init.constant_(self.geometry_net[-1], -1.5)
        self.colour_net = _layers(generator, 2 * size.appearance_levels, size.colour_hidden, 3)
        self.view_net = _layers(generator, 16 + size.embedding, size.colour_hidden)
        nn.init.zeros_(self.view_net[0][:16])  # colours alike from all sides to begin with
        self.surface_grid = _uniform(
            (size.surface_levels, 2**size.surface_log2_rows, 2), 1e-4, generator
        )
        inputs = 2 * (size.surface_levels or size.appearance_levels)
        self.surface_net = _layers(generator, inputs, size.surface_hidden, 3 + len(SOLID))
        self.sky_grid = _uniform((size.sky_levels, 2**size.sky_log2_rows, 2), 1e-4, generator)
        inputs = 16 + 2 * size.sky_levels + size.embedding
        self.sky_net = _layers(generator, inputs, size.sky_hidden, size.sky_hidden, 3)
        self.embeddings = nn.Parameter(torch.zeros(images, size.embedding))
        # Whether normals and classes were learned: an untrained head says nothing.
        self.register_buffer("learned", torch.zeros(2, dtype=torch.bool))
        # Coarse to begin with; `Occupancy.refine` halves the cells later.
        self.occupancy = Occupancy(size.cascades, size.occupancy_side // 2)

    # --- coordinates -------------------------------------------------------------------------

    def to_grid(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """World metres to grid units."""
        return (x - self.centre) / self.unit

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner (m) of the cube that holds all density."""
        half = 2.0 ** (self.size.cascades - 1) * self.unit
        return self.centre - half, self.centre + half

    @property
    def mean_embedding(self) -> Float[Tensor, "1 e"]:
        """The training images' mean appearance."""
        return self.embeddings.mean(0, keepdim=True)

    def _appearance(self, chosen: Float[Tensor, "1 e"] | None, n: int) -> Float[Tensor, "n e"]:
        """The chosen appearance, or the training images' mean, for n rays."""
        return (self.mean_embedding if chosen is None else chosen).expand(n, -1)

    @property
    def capabilities(self) -> frozenset[str]:
        """What this field answers beside colours; see `field.protocol`."""
        learned = {protocol.NORMALS} if self.knows_normals else set()
        learned |= {protocol.CLASSES} if self.knows_classes else set()
        # The fused kernel runs on GPUs alone.
        fused = {protocol.FUSED} if fused_render.takes_whole_rays(self.geometry_grid) else set()
        always = {protocol.DENSITY, protocol.APPEARANCE, protocol.OBSERVED}
        return frozenset(always | learned | fused)

    @property
    def knows_normals(self) -> bool:
        """Whether the normals of `surface_at` were learned."""
        return bool(self.learned[0])

    @property
    def knows_classes(self) -> bool:
        """Whether the classes of `surface_at` were learned."""
        return bool(self.learned[1])

    # --- geometry ----------------------------------------------------------------------------

    def _net(self) -> marching.Net:
        """The density's encoding and network."""
        w1, b1, w2, b2 = self.geometry_net
        return self.geometry_grid, self.geometry_resolutions, w1, b1, w2, b2

    def grid_density(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Density (1/grid unit) at positions in grid units, without gradient."""
        return marching.density(q, self._net())

    @torch.no_grad()
    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Extinction (1/m) at world positions, zero in cells known to be empty."""
        q = self.to_grid(x)
        return self.grid_density(q) * self.occupancy_at(q) / self.unit

    def _cells(self, q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Tensor]:
        """Flat index of each position's occupancy cell, and whether it is inside all cascades."""
        reach = q.abs().amax(-1)
        cascade = reach.clamp_min(1.0).log2().ceil().long()
        inside = cascade < self.size.cascades
        cascade = cascade.clamp_max(self.size.cascades - 1)
        half = (2.0**cascade)[:, None]
        side = self.occupancy.side
        index = ((q + half) / (2 * half) * side).long().clamp(0, side - 1)
        flat = ((cascade * side + index[:, 0]) * side + index[:, 1]) * side + index[:, 2]
        return flat, inside

    def occupancy_at(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """1 where the cell of a position (grid units) is occupied, else 0; 0 outside all cells."""
        cells, inside = self._cells(q)
        return self.occupancy.occupied.view(-1)[cells].float() * inside

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
        step_scale: float = 1.0,
        jitter: Float[Tensor, "n"] | None = None,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
        room: int | None = None,
    ) -> Samples:
        """Samples of rays where matter is, without gradient.

        Args:
            rays_o: origins, m.
            rays_d: unit directions.
            t_min: ray length at which to begin, m.
            t_max: ray length at which to end (may be infinite), m.
            step_scale: factor on the step length.
            jitter: share of the first step by which each ray's comb is shifted; default 0.
            stop: transmittance at which a ray ends.
            pruning_threshold: optical depth below which a sample counts as empty; default: the
                field's, which suits the steps of camera rays. Rays that begin beside matter have
                finer steps.
            room: how many samples there are to be, the rest 0; default: as many as it takes.
        """
        threshold = self.thin if pruning_threshold is None else pruning_threshold
        if jitter is None:
            jitter = torch.zeros_like(t_min)
        offsets, (t, dt, sigma) = marching.march(
            (self.to_grid(rays_o), rays_d),
            torch.stack([t_min / self.unit, t_max / self.unit, jitter], dim=-1),
            self.occupancy.cells(),
            (STEP_MIN * step_scale, STEP_CONE * step_scale, threshold),
            stop,
            self._net(),
            room,
        )
        return Samples(offsets, t * self.unit, dt * self.unit, sigma / self.unit)

    @torch.no_grad()
    def composite(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        step_scale: float = 1.0,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
        """`render.volume.composited` of rays in one launch, on a GPU."""
        shared = self._seen_from(rays_d, self._appearance(appearance, rays_o.shape[0]))
        threshold = self.thin if pruning_threshold is None else pruning_threshold
        endless, start = torch.full_like(t_min, 1e9), torch.zeros_like(t_min)
        found = fused_render.composite(
            (self.to_grid(rays_o), rays_d),
            torch.stack([t_min / self.unit, endless, start], dim=-1),
            self.occupancy.cells(),
            (STEP_MIN * step_scale, STEP_CONE * step_scale, threshold),
            (stop, MIN_WEIGHT),
            self._net(),
            ((self.appearance_grid, self.appearance_resolutions, *self.colour_net), shared),
        )
        return found[:, :3], found[:, 4], found[:, 3] * self.unit

    def sample_positions(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], samples: Samples
    ) -> Float[Tensor, "s 3"]:
        """Unit-cube coordinates of samples on rays in world m."""
        rays = (self.to_grid(rays_o), rays_d)
        return marching.positions(rays, samples.offsets, samples.t / self.unit)

    def raw_density(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s"]:
        """Logarithm of the density per contracted length at unit-cube coordinates."""
        grid, resolutions = self.geometry_grid, self.geometry_resolutions
        return network.encoded_mlp(u, grid, resolutions, _pairs(self.geometry_net))[:, 0]

    def density_with_gradient(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s"]:
        """Density (1/grid unit) at unit-cube coordinates, with gradients to the parameters."""
        return activations.thinned_density(self.raw_density(u), u)

    def density_normal(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Unit vectors against the density's gradient at positions in grid units, no gradient.

        Analytic, from the encoding's slopes; 0 where the density does not change.
        """
        return -unit_vector(marching.density_slopes(q, self._net()))

    def sloped_normal(
        self, q: Float[Tensor, "n 3"], step: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """As `density_normal`, by differences over `step` (grid units), with gradients to the
        parameters: the corners of a tetrahedron give the slope by four densities."""
        k = torch.arange(4)
        x, y = 1.0 - 2.0 * (k // 2), 1.0 - 2.0 * (k % 2)
        corners = torch.stack([x, y, x * y], dim=-1)
        around = q[:, None] + step[:, None, None] * corners
        flat = around.reshape(-1, 3)
        thinned = flat.square().sum(-1).clamp_min(1.0).log()
        raw = (self.raw_density(reference.contract(flat)) - thinned).view(-1, 4, 1)
        # 1e-6: where the density is even its direction's gradient would be NaN.
        return -unit_vector((raw * corners).sum(1), 1e-6)

    @torch.no_grad()
    def keep_occupied(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        some: Int[Tensor, "k"],
    ) -> None:
        """Tells the occupancy of density met at some samples of rays (world m).

        A thin surface fills little of its cells; looks at random places miss it again and again.
        """
        ray = samples.ray_index()[some]
        cells, inside = self._cells(self.to_grid(rays_o[ray] + samples.t[some, None] * rays_d[ray]))
        density = self.occupancy.density.view(-1)
        met = samples.sigma[some] * self.unit * inside
        density.scatter_reduce_(0, cells, met, "amax")

    @torch.no_grad()
    def mark_seen(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], least: float = 0.02
    ) -> None:
        """Notes the cells that rays of training pixels (world m) see: weight above `least`."""
        n = rays_o.shape[0]
        samples = self.march(rays_o, rays_d, torch.full((n,), self.near), torch.full((n,), 1e9))
        weights, _ = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        keep = (weights > least).nonzero()[:, 0]
        ray = samples.ray_index()[keep]
        x = rays_o[ray] + samples.t[keep, None] * rays_d[ray]
        cells, inside = self._cells(self.to_grid(x))
        self.occupancy.seen.view(-1)[cells[inside]] = 1

    def observed_only(self) -> "Field":
        """The same field without what no training image has seen (shares all parameters).

        Photos say nothing about space that they do not show; haze left there would shelter the
        ground from snow and sun. Early in a fit all is haze and nothing is seen: all is trusted.
        Rays of snow and sun begin beside matter, with fine steps, so next to none counts as empty.
        """
        twin = copy.copy(self)
        twin.thin = MIN_TAU
        if not bool(self.occupancy.seen.any()):
            return twin
        twin.__dict__["_modules"] = dict(self._modules)
        twin.occupancy = Occupancy(self.size.cascades, self.occupancy.side)
        near_seen = nn.functional.max_pool3d(
            self.occupancy.seen[:, None].float(), 3, stride=1, padding=1
        )[:, 0]
        twin.occupancy.occupied = self.occupancy.occupied * near_seen.to(torch.uint8)
        return twin

    # --- colour ------------------------------------------------------------------------------

    def colour_at(
        self,
        u: Float[Tensor, "s 3"],
        ray: Int[Tensor, "s"],
        rays_d: Float[Tensor, "n 3"],
        embedding: Float[Tensor, "n e"],
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance of samples at unit-cube coordinates u, seen along their rays.

        Args:
            u: unit-cube coordinates.
            ray: the ray of each sample.
            rays_d: unit directions of the rays.
            embedding: appearance of each ray.
        """
        return self._coloured(u, ray, self._seen_from(rays_d, embedding))

    def _seen_from(
        self, rays_d: Float[Tensor, "n 3"], embedding: Float[Tensor, "n e"]
    ) -> Float[Tensor, "n h"]:
        """What a ray's samples share: one layer, added to the first of the samples' own."""
        weight, bias = self.view_net
        x = torch.cat([directions.harmonics(rays_d), embedding], dim=-1)
        return torch.addmm(bias, x, weight)

    def _coloured(
        self, u: Float[Tensor, "s 3"], ray: Int[Tensor, "s"], shared: Float[Tensor, "n h"]
    ) -> Float[Tensor, "s 3"]:
        grid, resolutions = self.appearance_grid, self.appearance_resolutions
        layers = _pairs(self.colour_net)
        return activations.radiance(network.encoded_mlp(u, grid, resolutions, layers, shared, ray))

    def surface_raw(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s 3+c"]:
        """Predicted normals of any length (world axes) and class logits (of `SOLID`), unit-cube u.

        As `compositing.surface` takes them.
        """
        if self.size.surface_levels:
            grid, resolutions = self.surface_grid, self.surface_resolutions
        else:
            grid, resolutions = self.appearance_grid, self.appearance_resolutions
        return network.encoded_mlp(u, grid, resolutions, _pairs(self.surface_net))

    def surface_at(
        self, u: Float[Tensor, "s 3"]
    ) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s c"]]:
        """Predicted normals (unit, world axes) and class logits (of `SOLID`) at unit-cube u."""
        raw = self.surface_raw(u)
        # 1e-6: a network that gives 0 has no direction, and its gradient would be NaN.
        return unit_vector(raw[:, :3], 1e-6), raw[:, 3:]

    @torch.no_grad()
    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Learned normals and class logits of some samples on rays in world m."""
        return self.surface_at(self.sample_positions(rays_o, rays_d, samples)[selected])

    def sky_colour(
        self, d: Float[Tensor, "n 3"], embedding: Float[Tensor, "n e"]
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the sky in direction d, in the appearance given."""
        # Clouds need finer detail than the harmonics have: what the sky cannot show, floating
        # matter would. Where no photo looked the grid is blank and the harmonics go on.
        detail = encoding.hash_encode(0.5 + 0.499 * d, self.sky_grid, self.sky_resolutions)
        x = torch.cat([directions.harmonics(d).T, detail.T, embedding.T])
        return activations.radiance(network.mlp(x.T, _pairs(self.sky_net)))

    @torch.no_grad()
    def colour(
        self,
        x: Float[Tensor, "s 3"],
        d: Float[Tensor, "n 3"],
        ray: Int[Tensor, "s"] | None = None,
        *,
        ids: Int[Tensor, "s"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
    ) -> Float[Tensor, "s 3"]:
        """Linear radiance at world positions; see `field.protocol.RadianceField.colour`.

        The position alone decides: `ids` is not used.
        """
        u = reference.contract(self.to_grid(x))
        rows = torch.arange(x.shape[0]) if ray is None else ray
        return self.colour_at(u, rows, d, self._appearance(appearance, d.shape[0]))

    @torch.no_grad()
    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of the sky; `appearance` None: the mean of the training images."""
        return self.sky_colour(d, self._appearance(appearance, d.shape[0]))
