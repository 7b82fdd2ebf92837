"""The specification of every kernel: slow, obvious PyTorch, in the precision of its arguments.

Vocabulary. Grid units: lengths divided so that the scene's core is the ball of radius 1; `q` is a
position in grid units, `u` the same position after contraction, in the unit cube. Rays are packed:
the samples of ray r are `offsets[r]:offsets[r + 1]`, front to back. `tau` is a sample's optical
depth sigma·dt, `weights` its rendering weight. Functions work on the last axis or on packed
samples; autograd gives the gradients. Tests compare the fast kernels with these functions.
"""

import torch
from jaxtyping import Float, Int, Integer
from torch import Tensor

from climatenerf.core.vectors import unit
from climatenerf.ops.step_limits import MAX_STEPS


def contract(q: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Return unit-cube coordinates: mip-NeRF 360's contraction (Eq. 10), then (x+2)/4.

    The contraction keeps the ball of radius 1 and maps the rest of space to the shell up to 2.
    """
    m = q.norm(dim=-1, keepdim=True).clamp_min(1.0)  # inside the ball the factor is exactly 1
    return (q * (2.0 - 1.0 / m) / m / 4.0 + 0.5).clamp(0.0, 0.999999)


def hash_rows(corner: Int[Tensor, "*n 3"], resolution: int, table_size: int) -> Int[Tensor, "*n"]:
    """Return the row of a lattice corner: its index if the level fits the table, else a hash.

    The hash is that of Müller et al. 2022.
    """
    x, y, z = corner.unbind(-1)
    side = resolution + 1
    if side**3 <= table_size:
        return x + side * (y + side * z)
    # Wrap-around of the products at 32 bits does not change the low bits that the mask keeps.
    return (x ^ (y * 2654435761) ^ (z * 805459861)) & (table_size - 1)


def hash_encode(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
) -> Float[Tensor, "n features"]:
    """Return the multi-resolution hash encoding: trilinear features of each level, concatenated."""
    features = []
    for level, resolution in enumerate(resolutions.tolist()):
        p = u * resolution
        base = p.floor()
        frac = p - base
        total = 0.0
        for bits in range(8):
            step = torch.tensor([bits & 1, bits >> 1 & 1, bits >> 2], device=u.device)
            rows = hash_rows(base.long() + step, resolution, table.shape[1])
            weight = torch.where(step.bool(), frac, 1.0 - frac).prod(-1)
            total = total + weight[:, None] * table[level, rows]
        features.append(total)
    return torch.cat(features, dim=-1)


def mlp(
    x: Float[Tensor, "n i"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """Return the output of layers (weight [in, out], bias [out]) with a ReLU between them.

    `shared[row]`, if given, is added to the first layer before its ReLU: inputs that the samples of
    a ray share (direction, appearance) pass through that layer once per ray.
    """
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if index == 0 and shared is not None:
            x = x + shared[row]
        if index + 1 < len(layers):
            x = x.relu()
    return x


def density(
    q: Float[Tensor, "n 3"], table: Tensor, resolutions: Tensor, layers: list[tuple[Tensor, Tensor]]
) -> Float[Tensor, "n"]:
    """Return the density (1/grid unit): exp of the geometry network, per contracted length.

    The contraction shortens radial lengths by |q|^2. Dividing by it gives the initial haze of a
    field a finite optical depth to infinity. exp(15) = 3e6 is opaque at any step.
    """
    raw = mlp(hash_encode(contract(q), table, resolutions), layers)[:, 0]
    return raw.clamp_max(15.0).exp() / q.square().sum(-1).clamp_min(1.0)


def density_slopes(
    q: Float[Tensor, "n 3"],
    table: Tensor,
    resolutions: Tensor,
    layers: list[tuple[Tensor, Tensor]],
) -> Float[Tensor, "n 3"]:
    """Return the gradient of the density's logarithm, which cannot overflow."""
    with torch.enable_grad():
        q = q.detach().requires_grad_()
        raw = mlp(hash_encode(contract(q), table, resolutions), layers)[:, 0]
        log_density = raw - q.square().sum(-1).clamp_min(1.0).log()
        return torch.autograd.grad(log_density.sum(), q)[0]


def render_weights(
    tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> tuple[Float[Tensor, "s"], Float[Tensor, "rays"]]:
    """Return w_i = T_i (1 - exp(-tau_i)), T_i = exp(-sum of tau before i), and T behind all."""
    weights, transmittance = [], []
    for start, stop in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        ray = tau[start:stop]
        before = torch.cat([ray.new_zeros(1), ray.cumsum(0)])
        weights.append((-before[:-1]).exp() * -torch.expm1(-ray))
        transmittance.append((-before[-1]).exp())
    return torch.cat(weights), torch.stack(transmittance)


def accumulate(
    weights: Float[Tensor, "s"], values: Float[Tensor, "s c"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays c"]:
    """Return the sum of weights·values over each ray."""
    return torch.stack(
        [
            (weights[a:b, None] * values[a:b]).sum(0)
            for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True)
        ]
    )


def surface(
    weights: Float[Tensor, "s"],
    raw: Float[Tensor, "s 3+c"],
    target: Float[Tensor, "s 3"] | None,
    offsets: Int[Tensor, "rays+1"],
) -> tuple[Float[Tensor, "rays c"], Float[Tensor, "rays"]]:
    """Accumulate the surface head's output, normals (of any length) before class logits.

    Return the accumulated logits, and the error of normals: the sum of weights·|n - target|², n the
    unit vector (Verbin et al. 2022), or 0 without a target.
    """
    logits = accumulate(weights, raw[:, 3:], offsets)
    if target is None:
        return logits, torch.zeros_like(logits[:, 0])
    # 1e-6: an output of 0 has no direction, and its gradient would be NaN.
    error = (unit(raw[:, :3], 1e-6) - target).square().sum(-1, keepdim=True)
    return logits, accumulate(weights, error, offsets)[:, 0]


def distortion(
    weights: Float[Tensor, "s"],
    s: Float[Tensor, "s"],
    ds: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, "rays"]:
    """Return the distortion loss of mip-NeRF 360 (Eq. 15) per ray, by the double sum."""
    losses = []
    for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        w, p = weights[a:b], s[a:b]
        pairs = (w[:, None] * w[None, :] * (p[:, None] - p[None, :]).abs()).sum()
        losses.append(pairs + (w * w * ds[a:b]).sum() / 3.0)
    return torch.stack(losses)


def march(
    ray_o: Float[Tensor, "3"],
    ray_d: Float[Tensor, "3"],
    span: tuple[float, float, float],
    occupied: Integer[Tensor, "k g g g"],
    steps: tuple[float, float, float],
    stop: float,
    density_at,
    skips: tuple[int, ...] = (1,),
) -> list[tuple[float, float, float]]:
    """Return the samples (t, dt, sigma) of one ray in occupied space, front to back.

    span = (t_min, t_max, fraction of the first step to skip, in [0,1)). A step is
    max(steps[0], steps[1]·t) long; with an optical depth below steps[2] it counts as empty. In an
    empty cell whole steps are skipped until the ray has left it, or has left the block of skip³
    cells around it if all of these are empty, for the first such block of `skips`. The ray ends
    where the transmittance falls below `stop`, or after `MAX_STEPS`. Cascade k covers the cube of
    half side 2^k.
    """
    cascades, side = occupied.shape[:2]
    far = 2.0 ** (cascades - 1)
    t, end, jitter = span
    for o, d in zip(ray_o.tolist(), ray_d.tolist(), strict=True):
        if d == 0:
            if abs(o) > far:
                return []
        else:
            near_face, far_face = sorted(((-far - o) / d, (far - o) / d))
            t, end = max(t, near_face), min(end, far_face)
    t += jitter * max(steps[0], steps[1] * t)
    samples, tau = [], 0.0
    for _ in range(MAX_STEPS):
        if not (t < end and tau < -torch.log(torch.tensor(stop, device="cpu")).item()):
            break
        dt = min(max(steps[0], steps[1] * t), end - t)
        middle = t + dt / 2
        q = ray_o + middle * ray_d
        cascade = 0
        while q.abs().max() > 2.0**cascade and cascade < cascades - 1:
            cascade += 1
        half = 2.0**cascade
        cell = 2.0 * half / side
        index = ((q + half) / cell).long().clamp(0, side - 1)
        if occupied[cascade, index[0], index[1], index[2]]:
            sigma = density_at(q[None])[0].item()
            if sigma * dt > steps[2]:
                samples.append((middle, dt, sigma))
                tau += sigma * dt
            t += dt
        else:
            for skip in skips:
                x, y, z = (index // skip * skip).tolist()
                if not occupied[cascade, x : x + skip, y : y + skip, z : z + skip].any():
                    cell, index = cell * skip, index // skip
                    break
            edge = (index + (ray_d > 0)) * cell - half
            exit_length = torch.where(ray_d != 0, (edge - ray_o) / ray_d, torch.inf).min().item()
            t += dt * max(-((middle - exit_length) // dt), 1.0)
    return samples


def merge_order(
    t_a: Float[Tensor, "a"],
    offsets_a: Int[Tensor, "rays+1"],
    t_b: Float[Tensor, "b"],
    offsets_b: Int[Tensor, "rays+1"],
) -> tuple[Int[Tensor, "a+b"], Int[Tensor, "rays+1"]]:
    """Return the order that merges two packed lists of samples by t, and the merged offsets."""
    order = []
    for r in range(offsets_a.shape[0] - 1):
        a = torch.arange(int(offsets_a[r]), int(offsets_a[r + 1]), device=t_a.device)
        b = torch.arange(int(offsets_b[r]), int(offsets_b[r + 1]), device=t_b.device)
        t = torch.cat([t_a[a], t_b[b]])
        order.append(torch.cat([a, b + t_a.shape[0]])[torch.argsort(t, stable=True)])
    return torch.cat(order), offsets_a + offsets_b
