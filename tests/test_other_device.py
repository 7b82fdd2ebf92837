"""Fits and renders on a device other than the CPU, simulated by `support.toy_device`.

It computes as the CPU does, and raises an error if an operation mixes its tensors with CPU tensors.
"""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.command_line import run_cli
from support.random_run import random_run, small
from support.toy_device import TOY, kernels_for_toys
from support.toy_photos import DISTORTED, pattern, photos
from support.toy_scene import CAMERA, TINY, make_scene

from climatenerf import cli
from climatenerf.api import load_run
from climatenerf.core.device import CPU, check_triton, resolve_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json
from climatenerf.field.checkpoint import load_field
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import find_extent
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_image
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.multiview_stereo import plane_sweep_depth
from climatenerf.training.evidence.sparse_depth import read_sparse_depth
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings, Losses
from climatenerf.training.setup import make_trainer
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.weather import Weather

WEATHER = {
    "smog": {"visibility": "20 m"},
    "flood": {"level": "0.2 m", "wind_speed": "3 m/s"},
    "snow": {"depth": "10 cm"},
    "sun": {"elevation": "40 deg"},
}
DEVICES = {"cpu": (CPU, contextlib.nullcontext), "toy": (TOY, kernels_for_toys)}


def ignore(*_):
    """A progress callback that does nothing."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A scene and a folder with one run per device, each interrupted and resumed."""
    folder = tmp_path_factory.mktemp("runs")
    scene = make_scene(folder)
    for name, (device, kernels) in DEVICES.items():
        with kernels():
            # Few steps: in a longer fit, rounding changes the sample count of some ray, and Adam,
            # whose step size is independent of the gradient's, amplifies the difference.
            for steps in (12, 24):
                settings = FitSettings(
                    size=TINY, minutes=None, steps=steps, samples_per_step=2**12, refine_poses=True
                )
                resume = steps > 12
                fit_scene(scene, folder / name, settings, 1, resume, ignore, ignore, device)
    return scene, folder


def test_mixing_toy_and_cpu_tensors_raises_an_error():
    tensor = torch.arange(3, device=TOY)
    assert tensor.device == TOY and (tensor + 1).cpu().tolist() == [1, 2, 3]
    with pytest.raises(RuntimeError, match="on the CPU"):
        tensor + torch.ones(3)


@pytest.mark.slow
def test_fits_on_both_devices_are_equal(runs):
    _, folder = runs
    on_cpu, on_toy = (load_field(folder / name).state_dict() for name in DEVICES)
    for (name, a), b in zip(on_cpu.items(), on_toy.values(), strict=True):
        # Activations round differently on the toy device.
        close = torch.isclose(a.float(), b.float(), rtol=1e-3, atol=1e-4).float().mean()
        assert close > 0.99, (name, close)
    psnr = [read_json(folder / name / "metrics.json")["psnr"] for name in DEVICES]
    assert abs(psnr[0] - psnr[1]) < 0.005, psnr


@pytest.mark.slow
def test_steps_with_every_loss_stay_on_the_device(runs):
    """Sky, ground, points, relative depth, pose refinement, and normals that shape the density."""
    scene, _ = runs
    positions = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    points = np.concatenate([positions, np.zeros((200, 1))], axis=1)
    views = [replace(view, seen=np.arange(200)) for view in scene.views]
    scene = replace(scene, views=tuple(views), points=points)
    with kernels_for_toys():
        train = scene.of_split("train")
        images = [load_image(view, scene) for view in train]
        labels = [np.where(np.arange(36)[:, None] < 12, 10, 9) for _ in train]  # sky over terrain
        labels = [np.broadcast_to(each, (36, 48)).astype(np.uint8) for each in labels]
        relative = [np.random.default_rng(i).random((36, 48)) for i in range(len(train))]
        poses = np.stack([scene.c2w_world(view) for view in train])
        pixels = TrainingPixels(
            scene.cameras, [0] * len(train), poses, images, labels, None, relative, TOY
        )
        settings = FitSettings(
            size=TINY,
            minutes=None,
            steps=8,
            samples_per_step=2**12,
            losses=Losses(normal_consistency=0.01),
            refine_poses=True,
        )
        extent = find_extent(poses, None)
        trainer = make_trainer(pixels, extent, settings, read_sparse_depth(scene, TOY))
        assert trainer.evidence.knows_sky and trainer.evidence.free_space.ground is not None
        trainer.run(ignore)
        assert trainer.field.embeddings.device == TOY and trainer.poses.translation.device == TOY


def test_stereo_depth_and_free_space_are_equal_on_both_devices():
    grey, depths, empty = pattern(), [], []
    for device, kernels in DEVICES.values():
        with kernels():
            pixels = photos(DISTORTED, lambda i, t, x: grey(x), device=device)
            matched = plane_sweep_depth(pixels, None, (1.5, 4.0), 0)
            assert matched is not None
            field = Field(TINY, 5, np.array([0.0, 3.0, 0.0]), 3.0, 0.1).to(device)
            free_space = FreeSpace(field, pixels, matched, FitSettings())
            positions = matched.rays_o + 0.3 * matched.depth[:, None] * matched.rays_d
            radius = torch.full_like(matched.depth, 0.01)
            depths.append(to_numpy(matched.depth))
            empty.append(to_numpy(free_space.too_near_camera(positions, radius)))
    assert len(depths[0]) > 300 and np.array_equal(*depths)
    assert empty[0].any() and np.array_equal(*empty)


@pytest.mark.slow
def test_frames_with_all_weather_are_equal_on_both_devices(runs):
    scene, folder = runs
    pose = scene.c2w_world(scene.views[0])
    frames = []
    for device, kernels in DEVICES.values():
        with kernels(), torch.no_grad():
            field = load_field(folder / "cpu", device)
            field.occupancy.seen.fill_(1)
            field.occupancy.occupied[..., field.occupancy.side // 2 :] = 0  # air above the middle
            field.geometry_net[-1].add_(5.0)  # after few steps: dense below, so that snow can lie
            weather = weather_from_table(WEATHER)
            session = RenderSession(field, scene, weather, pose[None, :3, 3])
            small = CAMERA.resized(16, 12)
            options = FrameOptions(2, normals=True, labels=True)
            frames.append(render_frame(session.world(0.0), small, pose, options))
    (on_cpu, cpu_layers), (on_toy, toy_layers) = frames
    assert on_cpu.std() > 5 and np.array_equal(on_cpu, on_toy)
    assert {"mask_water", "mask_snow", "mask_smog", "normal"} <= set(cpu_layers)
    for name, values in cpu_layers.items():
        assert np.array_equal(values, toy_layers[name], equal_nan=True), name


def test_styles_are_equal_on_both_devices(tmp_path, monkeypatch):
    """The operator, its colours in the field, and pictures as teachers; shapes stay to the bit."""
    run, red = random_run(tmp_path, small("cpu")), tmp_path / "red"
    red.mkdir()
    for view in load_run(run).scene.views:
        Image.new("RGB", (96, 72), (200, 30, 20)).save(red / view.name)
    monkeypatch.setattr("climatenerf.styling.paper.fine_tune.RAYS", 256)
    few = ("--steps", 6, "--views", 3, "--width", 24)
    styles = {
        "operator": ("--season", "winter"),
        "baked": ("--bake", "--season", "winter", *few),
        "pictures": ("--method", "paper", "--pictures", red, *few),
    }
    for name, flags in styles.items():
        pictures = []
        for kind, (device, kernels) in DEVICES.items():
            out = tmp_path / f"{name}-{kind}"
            with kernels(), monkeypatch.context() as patch:
                resolved = {"cpu": CPU, "cuda": device}
                patch.setattr("climatenerf.core.device.resolve_device", resolved.__getitem__)
                asked = "cpu" if kind == "cpu" else "cuda"
                loaded = []
                patch.setattr(
                    "climatenerf.api.load_run",
                    lambda *args, to=loaded, **given: to.append(load_run(*args, **given)) or to[-1],
                )
                assert run_cli("stylize", run, "-o", out, *flags, "--device", asked) == 0
                assert [each.field.embeddings.device.type for each in loaded] == [device.type]
                styled = load_run(out, device=asked)
                assert styled.field.embeddings.device.type == device.type
                pose = styled.scene.c2w_world(styled.scene.views[0])
                session = RenderSession(styled.field, styled.scene, Weather(), style=styled.style)
                pictures.append(session.frame(CAMERA.resized(16, 12), pose).picture)
        assert np.array_equal(*pictures), name
        plain, *both = (load_field(p).state_dict() for p in (run, out, tmp_path / f"{name}-cpu"))
        for key, values in plain.items():
            learned = key == "appearance_grid" and name != "operator"
            assert torch.equal(both[0][key], values) != learned, (name, key)
            torch.testing.assert_close(both[0][key], both[1][key], rtol=1e-3, atol=1e-4)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_device_cuda_without_a_gpu_is_an_error(tmp_path, capsys):
    fit, render = ["fit", "capture", "-o", "run"], ["render", "run", "-o", "out"]
    for args in (fit, render, ["stylize", "run", "-o", "out", "--season", "winter"]):
        assert cli.main([*args, "--device", "cuda"]) == 2
        message = capsys.readouterr().err
        assert "NVIDIA GPU" in message and "Traceback" not in message
    with pytest.raises(UserError, match="NVIDIA GPU"):
        load_run(tmp_path, device="cuda")


def test_errors_name_what_triton_lacks(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "3.4.0+git")
    monkeypatch.delenv("CC", raising=False)
    compilers = {"clang": "/usr/bin/clang", "/usr/bin/clang": "/usr/bin/clang"}
    monkeypatch.setattr("shutil.which", compilers.get)
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    with pytest.raises(UserError, match="Python's headers"):
        check_triton()
    (tmp_path / "Python.h").touch()
    check_triton()
    monkeypatch.setenv("CC", "missing-compiler")
    with pytest.raises(UserError, match="C compiler"):
        check_triton()
    for version in ("3.3.1", "2.9", "0"):
        monkeypatch.setattr("importlib.metadata.version", lambda name, version=version: version)
        with pytest.raises(UserError, match=r"needs Triton 3\.4"):
            resolve_device("cuda")
