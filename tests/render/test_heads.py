"""Density normals, predicted normals and classes: values, gradients, dependencies."""

import torch
from support.random_field import random_field

from climatenerf.core.classes import SOLID
from climatenerf.field.density_slope import finite_difference_normal
from climatenerf.ops import reference


def log_density(field, q):
    """Logarithm of the reference density in double precision."""
    layers = [
        (w.detach().double(), b.detach().double())
        for w, b in zip(field.geometry_net[::2], field.geometry_net[1::2], strict=True)
    ]
    grid = field.geometry_grid.detach().double()
    return reference.density(q, grid, field.geometry_resolutions, layers).log()


def positions(n=400, half=3.0, seed=1):
    return (torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) * 2 * half


def test_density_normals_match_finite_differences():
    """Central differences of the twin, inside the core and in the contracted shell."""
    field, q = random_field(full=True), positions()
    h = 1e-5
    slope = torch.stack(
        [
            (log_density(field, q.double() + h * e) - log_density(field, q.double() - h * e)) / h
            for e in torch.eye(3).double()
        ],
        dim=-1,
    )
    steep = slope.norm(dim=-1) > 0.1 * slope.norm(dim=-1).median()
    expected = -torch.nn.functional.normalize(slope, dim=-1)
    cosine = (field.density_normal(q).double() * expected).sum(-1)[steep]
    # Few points lie within h of a cell face, where the slope is discontinuous.
    assert cosine.quantile(0.02) > 0.999, cosine.quantile(0.02)


def test_density_normals_have_unit_length_and_are_finite_at_the_middle():
    field = random_field(full=True)
    q = torch.cat([torch.zeros(1, 3), positions()])
    normal = field.density_normal(q)
    assert torch.isfinite(normal).all()
    assert torch.allclose(normal[1:].norm(dim=-1), torch.ones(400), atol=1e-5)


def test_constant_density_has_a_zero_normal_and_finite_gradients():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_grid.zero_()
    q = positions(20, half=0.5)
    assert (field.density_normal(q) == 0).all()
    field.requires_grad_(True)
    finite_difference_normal(field.raw_density, q, torch.full((20,), 1e-2)).sum().backward()
    assert torch.isfinite(field.geometry_grid.grad).all()


def test_finite_difference_normals_converge_and_have_gradients_to_the_density():
    """Short steps agree except for points whose step crosses a cell face."""
    field, q = random_field(full=True), positions(half=0.8)
    analytic = field.density_normal(q)
    with torch.no_grad():
        near = finite_difference_normal(field.raw_density, q, torch.full((400,), 2e-3))
        far = finite_difference_normal(field.raw_density, q, torch.full((400,), 0.3))
    agree = (analytic * near).sum(-1)
    assert agree.median() > 0.999 and agree.mean() > (analytic * far).sum(-1).mean() + 0.1
    outside = 3.0 * torch.nn.functional.normalize(q, dim=-1)
    with torch.no_grad():
        slope = finite_difference_normal(field.raw_density, outside, torch.full((400,), 2e-3))
    assert (slope * field.density_normal(outside)).sum(-1).median() > 0.999
    field.requires_grad_(True)
    finite_difference_normal(field.raw_density, q, torch.full((400,), 1e-2))[:, 0].sum().backward()
    assert (field.geometry_grid.grad != 0).any()


def test_the_surface_head_depends_on_its_own_grid_only():
    """Changes of appearance or geometry leave normals and classes bit-identical."""
    field, u = random_field(full=True), torch.rand(50, 3)
    with torch.no_grad():
        field.surface_grid.normal_()
        normal, logits = field.surface_at(u)
        field.appearance_grid.add_(1.0)
        field.geometry_grid.add_(1.0)
        again = field.surface_at(u)
    assert logits.shape == (50, len(SOLID))
    assert torch.allclose(normal.norm(dim=-1), torch.ones(50), atol=1e-5)
    assert torch.equal(normal, again[0]) and torch.equal(logits, again[1])
