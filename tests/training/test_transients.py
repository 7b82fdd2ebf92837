import pytest
import torch

from climatenerf.training import losses
from climatenerf.training.schedule import Schedule
from climatenerf.training.settings import FitSettings, Losses
from climatenerf.training.transients import TransientMasks

PRICE = Losses().transient
RATE = Schedule().masks[1] * FitSettings().net_rate


def train(error_at, images=4, steps=600):
    """Fit masks to images with the squared error `error_at(image, position)`."""
    torch.manual_seed(0)
    masks = TransientMasks(images)
    adam = torch.optim.Adam(masks.parameters(), lr=RATE)
    for _ in range(steps):
        image, xy = torch.randint(images, (1024,)), torch.rand(1024, 2)
        error = error_at(image, xy)
        price = torch.full((1024,), PRICE)
        loss = losses.masked_colour_loss(error, error, masks(image, xy), price)
        adam.zero_grad()
        loss.backward()
        adam.step()
    return masks


def person(image, xy):
    """A person in the left half of image 1."""
    return (image == 1) & (xy[:, 0] > 0.2) & (xy[:, 0] < 0.4) & (xy[:, 1] > 0.3)


@pytest.mark.slow
def test_an_object_in_one_photo_is_masked_there_only():
    masks = train(lambda image, xy: 0.003 + 0.1 * person(image, xy))
    image, xy = torch.randint(4, (8000,)), torch.rand(8000, 2)
    with torch.no_grad():
        m = masks(image, xy)
    there = person(image, xy)
    assert m[there].mean() > 0.8, m[there].mean()
    assert m[~there].mean() < 0.03, m[~there].mean()
    assert m[image != 1].max() < 0.2  # images are independent
    fractions = masks.masked_fractions()
    assert (
        fractions[1].isclose(torch.tensor(0.2 * 0.7), atol=0.03) and not fractions[[0, 2, 3]].any()
    )


def test_a_static_capture_is_not_masked():
    """Noise and fine texture stay below the price on average."""
    masks = train(lambda image, xy: 0.03 * torch.rand(len(image)) ** 2)
    with torch.no_grad():
        m = masks(torch.randint(4, (8000,)), torch.rand(8000, 2))
    assert (m > 0.5).float().mean() < 0.02


@pytest.mark.slow
def test_masks_can_turn_on_late():
    """The logarithm keeps a gradient at M near 0; here a person appears late."""
    step = iter(range(10**9))
    masks = train(lambda image, xy: 0.1 * person(image, xy) * (next(step) > 400), steps=700)
    image, xy = torch.randint(4, (8000,)), torch.rand(8000, 2)
    with torch.no_grad():
        m = masks(image, xy)
    there = person(image, xy)
    assert m[there].mean() > 0.8 and m[~there].mean() < 0.05, (m[there].mean(), m[~there].mean())


def test_the_price_decides_the_minimum_of_the_masked_loss():
    """The best M is near 1 exactly if the unexplained error exceeds the price."""
    price, m = torch.tensor([PRICE]), torch.linspace(0.001, 0.999, 999)[:, None]
    for unexplained, best in ((2 * PRICE, 0.999), (0.5 * PRICE, 2 * losses.RESTING_MASK)):
        off = torch.tensor([unexplained])
        found = [losses.masked_colour_loss(off * 0, off, each, price) for each in m]
        assert abs(float(m[int(torch.stack(found).argmin())]) - best) < 1e-3


def test_gradients_of_colours_and_masks_come_from_their_errors():
    error, unexplained = torch.tensor([0.3, 0.3]), torch.tensor([0.0, 0.2])
    mask, price = torch.tensor([0.25, 0.25]), torch.full((2,), PRICE)
    for each in (error, unexplained, mask):
        each.requires_grad_()
    losses.masked_colour_loss(error, unexplained, mask, price).backward()
    assert error.grad is not None and torch.allclose(error.grad, torch.full((2,), 0.75 / 2))
    assert unexplained.grad is None
    expected = PRICE - unexplained.detach() - PRICE * losses.RESTING_MASK / 0.25
    assert mask.grad is not None and torch.allclose(mask.grad, expected / 2)


def test_features_are_bilinear_and_independent_between_images():
    """Compare with bilinear interpolation in each image alone, at borders and inside."""
    generator = torch.Generator().manual_seed(0)
    masks = TransientMasks(300, generator)
    image = torch.randint(0, 300, (500,), generator=generator)
    xy = torch.rand(500, 2, generator=generator)
    xy[:100, 1], xy[100:200, 1], xy[200:250, 0] = 0.0, 1.0, 1.0
    xy[0], image[0], xy[1], image[1] = 1.0, 299, 0.0, 0
    found = masks.features(image, xy)
    expected = []
    for level in masks.levels:
        pictures = level[image].permute(0, 3, 1, 2)
        at = (2 * xy - 1)[:, None, None]
        bilinear = torch.nn.functional.grid_sample(
            pictures, at, padding_mode="border", align_corners=False
        )
        expected.append(bilinear[:, :, 0, 0])
    assert torch.allclose(found, torch.cat(expected, dim=-1), atol=2e-4)
    image[1:] = 150
    (gradient,) = torch.autograd.grad(masks.features(image[1:], xy[1:]).sum(), masks.levels[3])
    assert (gradient[150] != 0).any() and (gradient[torch.arange(300) != 150] == 0).all()
