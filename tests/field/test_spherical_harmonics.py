import numpy as np
import torch

from climatenerf.field.spherical_harmonics import spherical_harmonics


def test_harmonics_are_orthonormal_over_the_sphere():
    """Gauss-Legendre nodes in z, uniform nodes in azimuth: exact for products of degree 6."""
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) / 16 * 2 * np.pi
    z, azimuth = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    d = torch.tensor(np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1))
    area = torch.tensor(np.repeat(weight, 16) * 2 * np.pi / 16)
    y = spherical_harmonics(d)
    assert y.shape == (128, 16)
    assert torch.allclose((y * area[:, None]).T @ y, torch.eye(16).double(), atol=1e-12)


def test_opposite_directions_differ_by_the_sign_of_odd_degrees():
    d = torch.nn.functional.normalize(torch.randn(50, 3).double(), dim=-1)
    degree = torch.tensor([0, *[1] * 3, *[2] * 5, *[3] * 7])
    assert torch.allclose(spherical_harmonics(-d), spherical_harmonics(d) * (-1.0) ** degree)
