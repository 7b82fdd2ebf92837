import torch

from climatenerf.training import losses
from climatenerf.training.schedule import Schedule
from climatenerf.training.settings import FitSettings, Losses
from climatenerf.training.transients import TransientMasks

PRICE = Losses().transient
RATE = Schedule().masks[1] * FitSettings().net_rate


def train(error_at, images=4, steps=600):
    """Masks of images whose squared error at (image, place) is given."""
    torch.manual_seed(0)
    masks = TransientMasks(images)
    adam = torch.optim.Adam(masks.parameters(), lr=RATE)
    for _ in range(steps):
        image, place = torch.randint(images, (1024,)), torch.rand(1024, 2)
        error = error_at(image, place)
        price = torch.full((1024,), PRICE)
        loss = losses.masked_colour_loss(error, error, masks(image, place), price)
        adam.zero_grad()
        loss.backward()
        adam.step()
    return masks


def person(image, place):
    """Someone stands in the left half of image 1, waist high."""
    return (image == 1) & (place[:, 0] > 0.2) & (place[:, 0] < 0.4) & (place[:, 1] > 0.3)


def test_what_one_photo_shows_is_masked_there_and_nowhere_else():
    masks = train(lambda image, place: 0.003 + 0.1 * person(image, place))
    image, place = torch.randint(4, (8000,)), torch.rand(8000, 2)
    with torch.no_grad():
        m = masks(image, place)
    there = person(image, place)
    assert m[there].mean() > 0.8, m[there].mean()
    assert m[~there].mean() < 0.03, m[~there].mean()
    assert m[image != 1].max() < 0.2  # images do not leak into each other
    shares = masks.masked_fractions()
    assert shares[1].isclose(torch.tensor(0.2 * 0.7), atol=0.03) and not shares[[0, 2, 3]].any()


def test_a_static_capture_is_left_alone():
    """Noise and fine texture stay below the price on average."""
    masks = train(lambda image, place: 0.03 * torch.rand(len(image)) ** 2)
    with torch.no_grad():
        m = masks(torch.randint(4, (8000,)), torch.rand(8000, 2))
    assert (m > 0.5).float().mean() < 0.02


def test_a_capture_without_anything_amiss_does_not_wear_masks_out():
    """With nothing to push against, M would sink to 0 and never come back: someone comes late."""
    step = iter(range(10**9))
    masks = train(lambda image, place: 0.1 * person(image, place) * (next(step) > 400), steps=700)
    image, place = torch.randint(4, (8000,)), torch.rand(8000, 2)
    with torch.no_grad():
        m = masks(image, place)
    there = person(image, place)
    assert m[there].mean() > 0.8 and m[~there].mean() < 0.05, (m[there].mean(), m[~there].mean())


def test_masked_loss_is_lowest_at_the_price():
    """Turning M on pays exactly where the unexplained error is above the price."""
    price, m = torch.tensor([PRICE]), torch.linspace(0.001, 0.999, 999)[:, None]
    for unexplained, best in ((2 * PRICE, 0.999), (0.5 * PRICE, 2 * losses.RESTING_MASK)):
        off = torch.tensor([unexplained])
        found = [losses.masked_colour_loss(off * 0, off, each, price) for each in m]
        assert abs(float(m[int(torch.stack(found).argmin())]) - best) < 1e-3


def test_colours_learn_from_their_error_and_masks_from_what_is_unexplained():
    error, unexplained = torch.tensor([0.3, 0.3]), torch.tensor([0.0, 0.2])
    mask, price = torch.tensor([0.25, 0.25]), torch.full((2,), PRICE)
    for each in (error, unexplained, mask):
        each.requires_grad_()
    losses.masked_colour_loss(error, unexplained, mask, price).backward()
    assert error.grad is not None and torch.allclose(error.grad, torch.full((2,), 0.75 / 2))
    assert unexplained.grad is None
    expected = PRICE - unexplained.detach() - PRICE * losses.RESTING_MASK / 0.25
    assert mask.grad is not None and torch.allclose(mask.grad, expected / 2)


def test_features_are_bilinear_and_each_images_own():
    """Against bilinear lookups in the image alone, at its borders and inside, of many images."""
    generator = torch.Generator().manual_seed(0)
    masks = TransientMasks(300, generator)
    image = torch.randint(0, 300, (500,), generator=generator)
    place = torch.rand(500, 2, generator=generator)
    place[:100, 1], place[100:200, 1], place[200:250, 0] = 0.0, 1.0, 1.0
    place[0], image[0], place[1], image[1] = 1.0, 299, 0.0, 0
    found = masks.features(image, place)
    expected = []
    for level in masks.levels:
        pictures = level[image].permute(0, 3, 1, 2)
        at = (2 * place - 1)[:, None, None]
        bilinear = torch.nn.functional.grid_sample(
            pictures, at, padding_mode="border", align_corners=False
        )
        expected.append(bilinear[:, :, 0, 0])
    assert torch.allclose(found, torch.cat(expected, dim=-1), atol=2e-4)
    image[1:] = 150
    (gradient,) = torch.autograd.grad(masks.features(image[1:], place[1:]).sum(), masks.levels[3])
    assert (gradient[150] != 0).any() and (gradient[torch.arange(300) != 150] == 0).all()
