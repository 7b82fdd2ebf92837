import math

import numpy as np
import pytest
import torch
from toy_scene import CAMERA, TINY, make_scene

from climatenerf.evaluation.metrics import psnr
from climatenerf.field.extent import find_extent
from climatenerf.field.presets import PRESETS
from climatenerf.ops import dispatch
from climatenerf.render.view import render_view
from climatenerf.scene import load_image
from climatenerf.training import fit, losses
from climatenerf.training.fit import FitSettings, Fitting, scale_gradient
from climatenerf.training.run import load_pixels


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("toy"))


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)


def begin(scene, **settings):
    views = scene.of_split("train")
    chosen = {"preset": "tiny", "minutes": None, "samples_per_step": 2**15, **settings}
    extent = find_extent(np.stack([scene.c2w_world(v) for v in views]), None)
    return Fitting(load_pixels(scene, 1), len(views), extent, FitSettings(**chosen))


def heldout_psnr(scene, render):
    return np.mean(
        [
            psnr(render(scene.c2w_world(v)), load_image(v, scene).astype(np.float32) / 255)
            for v in scene.of_split("heldout")
        ]
    )


def test_a_fit_shows_views_it_has_not_seen(scene):
    """Against the best single colour: at least 4 dB better after 400 small steps."""
    fitting = begin(scene, steps=400)
    reports = []
    fitting.run(reports.append)
    colour = fitting.pixels.rgb.float().mean(0).numpy() / 255
    flat = np.broadcast_to(colour.astype(np.float32), (CAMERA.height, CAMERA.width, 3))
    baseline = heldout_psnr(scene, lambda pose: flat)
    fitted = heldout_psnr(scene, lambda pose: render_view(fitting.field, CAMERA, pose))
    assert fitted > baseline + 4, (fitted, baseline)
    assert reports[-1].psnr > reports[20].psnr + 4
    # The box is matter and the air around it is none.
    field = fitting.field
    solid = torch.rand(500, 3) * torch.tensor([1.1, 1.1, 0.1]) + torch.tensor([-0.55, -0.55, 1.1])
    air = torch.rand(500, 3) * torch.tensor([3.0, 3.0, 0.4]) + torch.tensor([-1.5, -1.5, 1.6])
    assert field.density(solid).mean() > 10 * field.density(air).mean()
    assert field.occupancy.occupied.float().mean() < 0.5


def test_reports_count_and_rise_to_the_end(scene):
    reports = []
    fitting = begin(scene, steps=25, samples_per_step=2**16)
    fitting.run(reports.append)
    assert [r.step for r in reports] == [*range(1, 26)]
    assert [r.progress for r in reports] == pytest.approx([i / 25 for i in range(1, 26)])
    samples = np.array([r.samples for r in reports])
    assert (np.diff(samples) > 0).all() and samples[-1] == fitting.samples
    for r in reports:
        assert math.isfinite(r.psnr) and r.rays_per_second > 0 and r.samples_per_ray > 0
    # The budget of samples is kept, whatever the rays meet (the first step goes in blind).
    assert np.diff(samples).max() < 2.5 * fitting.settings.samples_per_step


class Clock:
    """Half a second passes between two looks at it."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += 0.5
        return self.now


def test_the_time_bound_ends_the_fit_with_the_first_step_beyond_it(scene, monkeypatch):
    monkeypatch.setattr(fit, "time", Clock())
    reports = []
    fitting = begin(scene, minutes=0.1)
    fitting.run(reports.append)
    seconds = [r.seconds for r in reports]
    assert all(s < 6 for s in seconds[:-1]) and seconds[-1] >= 6
    assert len(seconds) > 2 and reports[-1].progress == 1
    monkeypatch.setattr(fit, "time", Clock())
    both = begin(scene, minutes=0.1, steps=3)
    both.run(lambda _: None)
    assert both.steps == 3, "whichever comes first"


def parameters_after(scene, seed, steps=40):
    fitting = begin(scene, steps=steps, seed=seed)
    fitting.run(lambda _: None)
    return fitting.field.state_dict()


def test_the_same_seed_gives_the_same_field_and_another_seed_another(scene):
    a, b, c = (parameters_after(scene, seed) for seed in (1, 1, 2))
    for name in a:
        assert torch.equal(a[name], b[name]), name
    assert not torch.equal(a["geometry_grid"], c["geometry_grid"])


def test_all_parameters_learn_and_stay_finite(scene):
    fitting = begin(scene, steps=20)
    before = {k: v.clone() for k, v in fitting.field.named_parameters()}
    fitting.run(lambda _: None)
    for name, parameter in fitting.field.named_parameters():
        assert torch.isfinite(parameter).all(), name
        assert not torch.equal(parameter, before[name]), name


def opacity(fitting):
    """Mean opacity of a thousand training rays."""
    batch = fitting.pixels.draw(1000, torch.Generator().manual_seed(0))
    samples = fitting.field.march(
        batch.rays_o,
        batch.rays_d,
        torch.full((1000,), fitting.field.near),
        torch.full((1000,), 1e9),
    )
    left = dispatch.render_weights(samples.sigma * samples.dt, samples.offsets)[1]
    return float((1 - left).mean())


def test_pixels_labelled_sky_lose_their_matter(scene):
    fitting = begin(scene, steps=100, sky_weight=10.0)
    fitting.pixels.sky = torch.ones(fitting.pixels.rgb.shape[0], dtype=torch.bool)
    fitting.run(lambda _: None)
    plain = begin(scene, steps=100)
    plain.run(lambda _: None)
    assert opacity(fitting) < 0.2 * opacity(plain), (opacity(fitting), opacity(plain))


# --- losses ---------------------------------------------------------------------------------


def test_colour_loss_is_the_error_of_display_values():
    linear = torch.tensor([[0.21404114, 0.0, 1.0]])
    assert losses.colour_loss(linear, torch.tensor([[0.5, 0.0, 1.0]])) < 1e-10
    assert losses.colour_loss(linear, torch.tensor([[0.2, 0.0, 1.0]])) == pytest.approx(0.03)


def test_distances_are_bounded_smooth_and_plain_when_near():
    t = torch.tensor([0.0, 0.5, 1.0, 2.0, 1e9])
    measure = losses.distance_measure(t)
    assert torch.allclose(measure, torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]))


def test_distortion_of_known_weights():
    offsets = torch.tensor([0, 1, 3])
    t = torch.tensor([0.5, 0.2, 0.6])
    dt = torch.tensor([0.1, 0.1, 0.1])
    weights = torch.tensor([1.0, 0.5, 0.5])
    one = 0.1 / 3
    two = 2 * 0.5 * 0.5 * 0.4 + 2 * 0.25 * 0.1 / 3
    found = losses.distortion_loss(weights, t, dt, offsets)
    assert found == pytest.approx((one + two) / 2, rel=1e-5)
    gathered = torch.tensor([1.0, 0.95, 0.05])
    assert losses.distortion_loss(gathered, t, dt, offsets) < found


def test_opacity_is_pushed_to_none_or_all():
    left = torch.tensor([0.0, 1.0], requires_grad=True)
    loss = losses.opacity_loss(left)
    assert abs(loss.item()) < 2e-5
    loss.backward()
    assert torch.isfinite(left.grad).all()
    half = losses.opacity_loss(torch.tensor([0.5]))
    assert half == pytest.approx(0.5 * math.log(2))


def test_sky_loss_is_the_opacity_of_sky_rays_alone():
    left, sky = torch.tensor([0.25, 0.5, 1.0]), torch.tensor([1.0, 0.0, 1.0])
    assert losses.sky_loss(left, sky) == pytest.approx(0.25)


def test_scaling_a_gradient_leaves_the_value():
    x = torch.tensor([2.0, -3.0], requires_grad=True)
    y = scale_gradient(x, torch.tensor([0.25, 1.0]))
    assert torch.equal(y.detach(), x.detach())
    y.sum().backward()
    assert x.grad.tolist() == [0.25, 1.0]
