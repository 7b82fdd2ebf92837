from dataclasses import replace

import numpy as np
import pytest
import torch
from support.toy_scene import TINY, make_scene

from climatenerf.field.normalisation import find_extent
from climatenerf.training.poses import PoseCorrections, rotations
from climatenerf.training.run import load_pixels
from climatenerf.training.settings import FitSettings
from climatenerf.training.setup import make_trainer


@pytest.mark.slow
def test_perturbed_poses_are_recovered_in_part(tmp_path):
    """Of rotations by about four degrees a fifth is recovered soon, with `refine_poses` only."""
    scene = make_scene(tmp_path)
    views = scene.of_split("train")
    true = torch.from_numpy(np.stack([scene.c2w_world(v) for v in views])).float()
    torch.manual_seed(0)
    wrong = 0.05 * torch.randn(len(views), 3)
    given = true.clone()
    given[:, :3, :3] = rotations(wrong) @ true[:, :3, :3]
    pixels = load_pixels(scene, 1)
    pixels.c2w = given
    extent = find_extent(true.numpy().astype(float), None)
    settings = FitSettings(
        size=TINY, minutes=None, steps=400, samples_per_step=2**14, refine_poses=True
    )
    trainer = make_trainer(pixels, extent, settings)
    trainer.run(lambda _: None)
    found = trainer.poses.corrected(given, trainer.field.unit).detach()
    errors = [
        (poses[:, :3, :3] @ true[:, :3, :3].transpose(1, 2)).diagonal(dim1=1, dim2=2).sum(-1)
        for poses in (given, found)
    ]
    # The mean, since the median of twenty angles varies by a third with the seed of the fit.
    before, after = (torch.rad2deg(torch.acos(((t - 1) / 2).clamp(-1, 1))).mean() for t in errors)
    assert after < 0.8 * before, (before, after)
    still = make_trainer(pixels, extent, replace(settings, refine_poses=False, steps=100))
    still.run(lambda _: None)
    assert torch.equal(still.poses.rotation, torch.zeros_like(still.poses.rotation))


def test_rotations_are_orthonormal_and_have_known_values():
    vectors = torch.randn(20, 3)
    r = rotations(vectors)
    assert torch.allclose(r @ r.transpose(1, 2), torch.eye(3).expand(20, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(r), torch.ones(20), atol=1e-5)
    quarter = rotations(torch.tensor([[0.0, 0.0, torch.pi / 2]]))[0]
    assert torch.allclose(quarter @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-4, 0.0316, 0.0317, 0.3, 3.0])
def test_rotations_equal_the_matrix_exponential_with_gradients(size):
    """Also on both sides of the angle below which series are used."""
    generator = torch.Generator().manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=-1) * size
    weights = torch.randn(20, 3, 3, generator=generator)

    def exponential(vectors):
        x, y, z = vectors.unbind(-1)
        none = 0 * x
        rows = [none, -z, y, z, none, -x, -y, x, none]
        return torch.linalg.matrix_exp(torch.stack(rows, dim=-1).view(-1, 3, 3))

    found = []
    for function, kind in ((rotations, torch.float32), (exponential, torch.float64)):
        given = vectors.detach().clone().to(kind).requires_grad_()
        out = function(given)
        (out * weights.to(kind)).sum().backward()
        assert given.grad is not None
        found.append((out.detach().double(), given.grad.double()))
    assert torch.allclose(found[0][0], found[1][0], atol=3e-7 * max(1, size))
    assert torch.allclose(found[0][1], found[1][1], atol=3e-5)


def test_zero_corrections_change_nothing_and_have_finite_gradients():
    poses = PoseCorrections(3)
    image = torch.tensor([0, 2, 1])
    o, d = torch.randn(3, 3), torch.nn.functional.normalize(torch.randn(3, 3), dim=-1)
    o2, d2 = poses.rays(o, d, image, 5.0)
    assert torch.equal(o2, o) and torch.allclose(d2, d)
    (o2.sum() + (d2 * torch.randn(3, 3)).sum() + poses.loss()).backward()
    assert poses.rotation.grad is not None and torch.isfinite(poses.rotation.grad).all()
    assert (poses.rotation.grad != 0).any()
    c2w = torch.eye(4).repeat(3, 1, 1)
    assert torch.allclose(poses.corrected(c2w, 5.0), c2w)


def test_corrected_poses_give_the_corrected_rays():
    poses = PoseCorrections(2)
    with torch.no_grad():
        poses.rotation.copy_(0.1 * torch.randn(2, 3))
        poses.translation.copy_(0.1 * torch.randn(2, 3))
    c2w = torch.eye(4).repeat(2, 1, 1)
    c2w[1, :3, :3] = rotations(torch.randn(1, 3))[0]
    c2w[:, :3, 3] = torch.randn(2, 3)
    image, ahead = torch.tensor([0, 1]), torch.tensor([0.1, -0.2, 0.97])
    with torch.no_grad():
        o, d = poses.rays(c2w[:, :3, 3], c2w[:, :3, :3] @ ahead, image, 4.0)
        corrected = poses.corrected(c2w, 4.0)
    assert torch.allclose(corrected[:, :3, 3], o, atol=1e-6)
    assert torch.allclose(corrected[:, :3, :3] @ ahead, d, atol=1e-6)
