"""The expected values of `climatenerf verify`, against known values and quadrature."""

import ast
from pathlib import Path

import numpy as np
import pytest

from climatenerf.verification import closed_forms
from climatenerf.verification.closed_forms import (
    brewster_reflectance,
    diffuse_reflectance,
    fresnel,
    linear_from_display,
    normal_reflectance,
    plane_distance,
    sky_optical_depth,
    stratified_optical_depth,
    wet_radiance,
)

N = 1.333


def test_closed_forms_are_independent_of_the_program():
    tree = ast.parse(Path(closed_forms.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {getattr(node, "module", None) or node.names[0].name for node in imports}
    assert names == {"numpy", "jaxtyping"}


def test_fresnel_at_published_angles():
    angles = np.radians([0.0, 30.0, 60.0, 75.0, 80.0, 85.0])
    expected = [0.0204, 0.0214, 0.0597, 0.212, 0.348, 0.584]
    assert fresnel(angles, N) == pytest.approx(expected, rel=0.01)
    assert fresnel(np.array(2e-3), N) == pytest.approx(normal_reflectance(N), rel=1e-6)
    assert fresnel(np.arctan(np.array(N)), N) == pytest.approx(brewster_reflectance(N), rel=1e-9)


@pytest.mark.parametrize("ior", [1.333, 1.5])
def test_diffuse_reflectance_is_the_mean_fresnel_reflectance(ior):
    cosine, weight = np.polynomial.legendre.leggauss(200)
    cosine, weight = (cosine + 1) / 2, weight / 2
    mean = (weight * 2 * cosine * fresnel(np.arccos(cosine), ior)).sum()
    assert diffuse_reflectance(ior) == pytest.approx(mean, rel=1e-5)
    assert diffuse_reflectance(1.333) == pytest.approx(0.0664, abs=1e-4)


def test_a_white_bottom_stays_white_and_others_darken():
    assert wet_radiance(1.0, 1.0, N) == pytest.approx(1.0)
    path_traced = [wet_radiance(albedo, albedo, N) for albedo in (0.1, 0.3, 0.6)]
    # These include what the surface lets through upwards, 1 - R(0) = .98.
    assert np.array(path_traced) * 0.98 == pytest.approx([0.076, 0.202, 0.453], abs=0.025)


def test_optical_depth_in_strata_against_quadrature():
    sigma, falloff, base = 0.05, 2.0, 0.5
    for start, end, length in ((1.6, 0.0, 4.0), (3.0, 1.0, 2.5), (0.2, 0.1, 7.0), (0.1, 5.0, 6.0)):
        z = start + (end - start) * (np.arange(200_000) + 0.5) / 200_000
        extinction = sigma * np.exp(-np.maximum(z - base, 0) / falloff)
        found = stratified_optical_depth(
            sigma, falloff, base, start, np.array(end), np.array(length)
        )
        assert found == pytest.approx(extinction.mean() * length, rel=1e-6)
    far = stratified_optical_depth(
        sigma, falloff, base, 1.6, np.array(201.6), np.array(200.0 / 0.3)
    )
    assert sky_optical_depth(sigma, falloff, base, 1.6, np.array(0.3)) == pytest.approx(far)


def test_display_values_and_planes():
    assert linear_from_display(0.5) == pytest.approx(0.21404, abs=1e-5)
    assert linear_from_display(0.04) == pytest.approx(0.04 / 12.92)
    rays = np.array([[0.0, 0.0, -1.0], [0.0, 0.6, -0.8], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    distance = plane_distance(np.array([0.0, 0.0, 1.6]), rays)
    assert distance == pytest.approx([1.6, 2.0, np.inf, np.inf])
