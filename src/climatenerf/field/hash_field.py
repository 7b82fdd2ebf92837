"""The radiance field: hash grids, their networks, a directional sky, an occupancy grid.

Geometry depends on the geometry grid alone. The appearance grid, the view direction and a vector
per image give colour. A small third grid gives normals and classes; in the paper (§3.1) they read
the appearance grid, so that a change of appearance would change them.

Methods take and return world metres unless they name grid units: (x - centre) / unit, where the
ball of radius 1 holds the core of the scene, or unit-cube coordinates: `reference.contract` of
grid units.
"""

import copy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from climatenerf.core.classes import SOLID
from climatenerf.core.samples import MIN_TAU, MIN_WEIGHT, Samples
from climatenerf.core.vectors import unit as unit_vector
from climatenerf.field import activations, capabilities
from climatenerf.field import spherical_harmonics as directions
from climatenerf.field.networks import (
    dense_layers,
    level_resolutions,
    uniform_parameter,
    weights_and_biases,
)
from climatenerf.field.occupancy import Occupancy
from climatenerf.field.presets import FieldSize
from climatenerf.field.sampler import Sampler
from climatenerf.ops import encoding, fused_render, marching, network, reference


class Field(nn.Module):
    """A trainable radiance field (`field.protocol.RadianceField`) of hash grids and networks."""

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
        """Make an untrained field on the CPU; `.to(device)` moves it.

        Args:
            size: sizes of grids and networks.
            images: number of training images, each with an appearance vector.
            centre: middle of the scene, world metres.
            unit: metres per grid unit.
            near: ray length at which camera rays begin, m; nothing nearer to a camera is rendered.
            generator: source of the initial values, on the CPU; None: PyTorch's global one.
        """
        super().__init__()
        self.size = size
        self.unit = unit
        self.near = near
        self.pruning_threshold = MIN_TAU
        """Optical depth below which a sample of a camera ray counts as empty; a fit raises it."""
        self.register_buffer("centre", torch.tensor(centre, dtype=torch.float32, device="cpu"))
        levels = {
            "geometry": (size.geometry_finest, size.geometry_levels),
            "appearance": (size.appearance_finest, size.appearance_levels),
            "surface": (size.surface_finest, size.surface_levels),
            "sky": (size.sky_finest, size.sky_levels),
        }
        for grid, (finest, count) in levels.items():
            resolutions = level_resolutions(size.coarsest, finest, count)
            self.register_buffer(f"{grid}_resolutions", resolutions)
        self.geometry_grid = uniform_parameter(
            (size.geometry_levels, 2**size.geometry_log2_rows, 2), 1e-4, generator
        )
        self.appearance_grid = uniform_parameter(
            (size.appearance_levels, 2**size.appearance_log2_rows, 2), 1e-4, generator
        )
        self.geometry_net = dense_layers(
            generator, 2 * size.geometry_levels, size.geometry_hidden, 1
        )
        # A thin haze everywhere at first: dense enough for gradients, thin enough to prune.
        nn.init.constant_(self.geometry_net[-1], -1.5)
        self.colour_net = dense_layers(generator, 2 * size.appearance_levels, size.colour_hidden, 3)
        self.view_net = dense_layers(generator, 16 + size.embedding, size.colour_hidden)
        nn.init.zeros_(self.view_net[0][:16])  # at first colour does not depend on the direction
        self.surface_grid = uniform_parameter(
            (size.surface_levels, 2**size.surface_log2_rows, 2), 1e-4, generator
        )
        inputs = 2 * (size.surface_levels or size.appearance_levels)
        self.surface_net = dense_layers(generator, inputs, size.surface_hidden, 3 + len(SOLID))
        self.sky_grid = uniform_parameter(
            (size.sky_levels, 2**size.sky_log2_rows, 2), 1e-4, generator
        )
        inputs = 16 + 2 * size.sky_levels + size.embedding
        self.sky_net = dense_layers(generator, inputs, size.sky_hidden, size.sky_hidden, 3)
        self.embeddings = nn.Parameter(torch.zeros(images, size.embedding, device="cpu"))
        # Whether the normals and the classes of the surface head were trained.
        self.register_buffer("learned", torch.zeros(2, dtype=torch.bool, device="cpu"))
        # Coarse at first; `Occupancy.refine` halves the cells later.
        self.occupancy = Occupancy(size.cascades, size.occupancy_side // 2)

    # --- coordinates -------------------------------------------------------------------------

    def to_grid(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Convert world metres to grid units."""
        return (x - self.centre) / self.unit

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner (world m) of the cube that holds all density."""
        half = 2.0 ** (self.size.cascades - 1) * self.unit
        return self.centre - half, self.centre + half

    @property
    def mean_embedding(self) -> Float[Tensor, "1 e"]:
        """Mean appearance vector of the training images."""
        return self.embeddings.mean(0, keepdim=True)

    def _appearance(self, vector: Float[Tensor, "1 e"] | None, n: int) -> Float[Tensor, "n e"]:
        """Return an appearance vector, or the mean one for None, for each of n rays."""
        return (self.mean_embedding if vector is None else vector).expand(n, -1)

    def photo_appearance(self, index: int) -> Float[Tensor, "1 e"]:
        """Return the appearance of a training photo."""
        return self.embeddings[[index]].detach()

    @property
    def capabilities(self) -> frozenset[str]:
        """Optional methods that this field answers; see `field.capabilities`."""
        learned = {capabilities.NORMALS} if self.knows_normals else set()
        learned |= {capabilities.CLASSES} if self.knows_classes else set()
        # The fused kernel runs on NVIDIA GPUs only.
        fused = {capabilities.FUSED} if fused_render.is_available(self.geometry_grid) else set()
        always = {capabilities.DENSITY, capabilities.APPEARANCE, capabilities.OBSERVED}
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

    @property
    def density_net(self) -> marching.Net:
        """Encoding and network of the density, as the kernels take them."""
        w1, b1, w2, b2 = self.geometry_net
        return self.geometry_grid, self.geometry_resolutions, w1, b1, w2, b2

    @property
    def sampler(self) -> Sampler:
        """Marching through the cells that are occupied now."""
        return Sampler(
            self.occupancy,
            self.density_net,
            self.centre,
            self.unit,
            self.near,
            self.pruning_threshold,
        )

    def grid_density(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return the density (1/grid unit) at positions in grid units, without gradient."""
        return marching.density(q, self.density_net)

    @torch.no_grad()
    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return the extinction (1/m) at world positions, zero in cells that are not occupied."""
        q = self.to_grid(x)
        return self.grid_density(q) * self.occupancy.occupied_at(q) / self.unit

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
        capacity: int | None = None,
    ) -> Samples:
        """Return the samples of rays (world m) where there is density; see `Sampler.march`."""
        return self.sampler.march(
            rays_o, rays_d, t_min, t_max, step_scale, jitter, stop, pruning_threshold, capacity
        )

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
        """Composite whole rays in one launch on a GPU; see `field.protocol.RadianceField`.

        The twin is `field.compositing.composited`.
        """
        sampler = self.sampler
        ray_hidden = self._ray_hidden(rays_d, self._appearance(appearance, rays_o.shape[0]))
        endless, start = torch.full_like(t_min, 1e9), torch.zeros_like(t_min)
        found = fused_render.composite(
            (self.to_grid(rays_o), rays_d),
            sampler.spans(t_min, endless, start),
            self.occupancy.cells(),
            sampler.steps(step_scale, pruning_threshold),
            (stop, MIN_WEIGHT),
            self.density_net,
            (self.appearance_grid, self.appearance_resolutions, *self.colour_net),
            ray_hidden,
        )
        return found[:, :3], found[:, 4], found[:, 3] * self.unit

    def sample_positions(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], samples: Samples
    ) -> Float[Tensor, "s 3"]:
        """Return the unit-cube coordinates of samples on rays (world m)."""
        rays = (self.to_grid(rays_o), rays_d)
        return marching.positions(rays, samples.offsets, samples.t / self.unit)

    def raw_density(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s"]:
        """Return the logarithm of the density per contracted length at unit-cube coordinates."""
        grid, resolutions = self.geometry_grid, self.geometry_resolutions
        layers = weights_and_biases(self.geometry_net)
        return network.encoded_mlp(u, grid, resolutions, layers)[:, 0]

    def density_with_gradient(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s"]:
        """Return the density (1/grid unit) at unit-cube coordinates, with gradients."""
        return activations.density_from_raw(self.raw_density(u), u)

    def density_normal(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return unit vectors against the density's gradient at positions in grid units.

        Analytic, from the encoding's slopes; 0 where the density is constant. No gradient.
        """
        return -unit_vector(marching.density_slopes(q, self.density_net))

    def recolourable(self) -> "Field":
        """Return the same field with an appearance grid of its own, which may then change.

        Normals and classes stay the same to the bit. Where they read the appearance grid (the
        paper's sizes), the twin's surface grid is the present appearance grid. All other parameters
        are shared.
        """
        twin, size = copy.copy(self), self.size
        for kind in ("_parameters", "_buffers"):
            twin.__dict__[kind] = dict(self.__dict__[kind])
        if not size.surface_levels:
            twin.size = replace(
                size,
                surface_levels=size.appearance_levels,
                surface_log2_rows=size.appearance_log2_rows,
                surface_finest=size.appearance_finest,
            )
            twin.surface_grid = self.appearance_grid
            twin.surface_resolutions = self.appearance_resolutions.clone()  # files share nothing
        twin.appearance_grid = nn.Parameter(self.appearance_grid.detach().clone())
        return twin

    def observed_only(self) -> "Field":
        """Return the same field without cells that no training image has seen.

        It shares all parameters. Photos do not constrain space that they do not show, and haze
        left there would shelter the ground from snow and sun. Where no cell is marked as seen yet,
        early in a fit, all are kept. The pruning threshold is the smallest one: rays of snow and
        sun begin next to surfaces, with fine steps.
        """
        twin = copy.copy(self)
        twin.pruning_threshold = MIN_TAU
        if not bool(self.occupancy.seen.any()):
            return twin
        twin.__dict__["_modules"] = dict(self._modules)
        twin.occupancy = self.occupancy.observed_only()
        return twin

    # --- colour ------------------------------------------------------------------------------

    def colour_at(
        self,
        u: Float[Tensor, "s 3"],
        ray: Int[Tensor, "s"],
        rays_d: Float[Tensor, "n 3"],
        embedding: Float[Tensor, "n e"],
    ) -> Float[Tensor, "s 3"]:
        """Return the linear radiance of samples along their rays.

        Args:
            u: unit-cube coordinates.
            ray: index of the ray of each sample.
            rays_d: unit directions of the rays.
            embedding: appearance vector of each ray.
        """
        return self._radiance(u, ray, self._ray_hidden(rays_d, embedding))

    def _ray_hidden(
        self, rays_d: Float[Tensor, "n 3"], embedding: Float[Tensor, "n e"]
    ) -> Float[Tensor, "n h"]:
        """Return what each ray adds to the first hidden layer of its samples' colours."""
        weight, bias = self.view_net
        x = torch.cat([directions.harmonics(rays_d), embedding], dim=-1)
        return torch.addmm(bias, x, weight)

    def _radiance(
        self, u: Float[Tensor, "s 3"], ray: Int[Tensor, "s"], shared: Float[Tensor, "n h"]
    ) -> Float[Tensor, "s 3"]:
        grid, resolutions = self.appearance_grid, self.appearance_resolutions
        layers = weights_and_biases(self.colour_net)
        return activations.radiance(network.encoded_mlp(u, grid, resolutions, layers, shared, ray))

    def surface_raw(self, u: Float[Tensor, "s 3"]) -> Float[Tensor, "s 3+c"]:
        """Return normals of any length (world axes), then class logits (of `SOLID`), at u.

        u: unit-cube coordinates. The input of `ops.compositing.surface`.
        """
        if self.size.surface_levels:
            grid, resolutions = self.surface_grid, self.surface_resolutions
        else:
            grid, resolutions = self.appearance_grid, self.appearance_resolutions
        return network.encoded_mlp(u, grid, resolutions, weights_and_biases(self.surface_net))

    def surface_at(
        self, u: Float[Tensor, "s 3"]
    ) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s c"]]:
        """Return unit normals (world axes) and class logits (of `SOLID`) at unit-cube u."""
        raw = self.surface_raw(u)
        # 1e-6: an output of 0 has no direction, and its gradient would be NaN.
        return unit_vector(raw[:, :3], 1e-6), raw[:, 3:]

    @torch.no_grad()
    def surface_heads(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k c"]]:
        """Return the learned normals and class logits of some samples on rays (world m)."""
        return self.surface_at(self.sample_positions(rays_o, rays_d, samples)[selected])

    def sky_colour(
        self, d: Float[Tensor, "n 3"], embedding: Float[Tensor, "n e"]
    ) -> Float[Tensor, "n 3"]:
        """Return the linear radiance of the sky in unit directions d, per appearance vector."""
        # Clouds are finer than the harmonics: without the grid, floating density would model
        # them. In directions that no photo shows the grid stays near zero.
        detail = encoding.hash_encode(0.5 + 0.499 * d, self.sky_grid, self.sky_resolutions)
        x = torch.cat([directions.harmonics(d).T, detail.T, embedding.T])
        return activations.radiance(network.mlp(x.T, weights_and_biases(self.sky_net)))

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
        """Return the linear radiance at world positions; see `field.protocol.RadianceField`.

        The colour depends on the position; `ids` is not used.
        """
        u = reference.contract(self.to_grid(x))
        rows = torch.arange(x.shape[0], device=x.device) if ray is None else ray
        return self.colour_at(u, rows, d, self._appearance(appearance, d.shape[0]))

    @torch.no_grad()
    def sky(
        self, d: Float[Tensor, "n 3"], appearance: Float[Tensor, "1 e"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """Return the linear radiance of the sky; `appearance` None: the training images' mean."""
        return self.sky_colour(d, self._appearance(appearance, d.shape[0]))
