"""The kernel that recolours samples, beside its slow twin in float64."""

import pytest
import torch

from climatenerf.ops import recolouring as r


def classes(kinds=3, colours=4):
    g = torch.Generator().manual_seed(1)
    return r.ClassColours(
        torch.tensor([2, 0, 4][:kinds]),
        torch.rand(kinds, generator=g),
        torch.tensor([0.0, 0.3, 1.0][:kinds]),
        2 * torch.rand(kinds, colours, 3, generator=g),
        torch.tensor([1, colours, 2][:kinds]),
        torch.randn(kinds, 3, 3, generator=g),
    )


def samples(count=4000):
    g = torch.Generator().manual_seed(0)
    colour = torch.rand(count, 3, generator=g) ** 3
    colour[:10] = 0.0
    logits = 3 * torch.randn(count // 4, 6, generator=g)
    group = torch.arange(count) // 4
    x = 100 * torch.rand(count, 3, generator=g) - 50
    return colour, logits, group, x


def double(each):
    values = {name: t.double() if t.is_floating_point() else t for name, t in vars(each).items()}
    return r.ClassColours(**values)


@pytest.mark.parametrize("white", [(1.0, 1.0, 1.0), (1.6, 0.9, 0.5)])
def test_the_kernel_equals_its_twin(white):
    given, noise, light = samples(), r.mottle(0), torch.tensor(white)
    fast = r.recoloured_samples(*given, noise, 4.0, light, classes())
    slow = [t.double() if t.is_floating_point() else t for t in (*given, noise)]
    expected = r.recoloured_samples(*slow, 4.0, light.double(), double(classes()))
    torch.testing.assert_close(fast, expected.float(), rtol=2e-4, atol=2e-5)
    assert float((fast - given[0]).abs().max()) > 0.2 and (fast[:10] == 0).all()


def test_no_strength_changes_nothing():
    given = samples(100)
    none = vars(classes()) | {"strength": torch.zeros(3)}
    found = r.recoloured_samples(*given, r.mottle(0), 4.0, torch.ones(3), r.ClassColours(**none))
    assert torch.equal(found, given[0])


def test_transposed_colours_are_recoloured():
    """Networks give colours whose columns are contiguous."""
    colour, *rest = samples(100)
    turned = colour.T.contiguous().T
    assert not turned.is_contiguous()
    given = r.mottle(0), 4.0, torch.ones(3), classes()
    expected = r.recoloured_samples(colour, *rest, *given)
    torch.testing.assert_close(r.recoloured_samples(turned, *rest, *given), expected)
