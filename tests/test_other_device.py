"""Fits and frames on another device than the CPU: a toy one that computes as the CPU does.

A tensor that is created on the CPU by mistake raises an error where it meets one of the toy device.
"""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
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

WEATHER = {
    "smog": {"visibility": "20 m"},
    "flood": {"level": "0.2 m", "wind_speed": "3 m/s"},
    "snow": {"depth": "10 cm"},
    "sun": {"elevation": "40 deg"},
}


DEVICES = {"cpu": (CPU, contextlib.nullcontext), "toy": (TOY, kernels_for_toys)}


def nothing(*_):
    pass


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run of each device, both stopped and resumed."""
    folder = tmp_path_factory.mktemp("runs")
    scene = make_scene(folder)
    for name, (device, kernels) in DEVICES.items():
        with kernels():
            # Few: sooner or later a rounding decides whether a ray has one sample more, and
            # Adam, whose steps know no size of gradients, makes another fit of it.
            for steps in (12, 24):
                chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**12}
                settings = FitSettings(steps=steps, refine_poses=True, **chosen)
                fit_scene(
                    scene,
                    folder / name,
                    settings,
                    1,
                    steps > 12,
                    lambda _: None,
                    lambda *_: None,
                    device,
                )
    return scene, folder


def test_the_toy_device_refuses_to_meet_the_cpu():
    there = torch.arange(3, device=TOY)
    assert there.device == TOY and (there + 1).cpu().tolist() == [1, 2, 3]
    with pytest.raises(RuntimeError, match="of the CPU"):
        there + torch.ones(3)


@pytest.mark.slow
def test_a_fit_is_the_same_on_both(runs):
    _, folder = runs
    ours, theirs = load_field(folder / "cpu"), load_field(folder / "toy")
    for (name, a), b in zip(ours.state_dict().items(), theirs.state_dict().values(), strict=True):
        # Activations round otherwise there.
        alike = torch.isclose(a.float(), b.float(), rtol=1e-3, atol=1e-4).float().mean()
        assert alike > 0.99, (name, alike)
    found = [read_json(folder / name / "metrics.json")["psnr"] for name in ("cpu", "toy")]
    assert abs(found[0] - found[1]) < 0.005, found


@pytest.mark.slow
def test_a_step_with_every_loss_stays_on_its_device(runs):
    """Sky, ground, points, relative depth, moving cameras, normals that move matter."""
    scene, _ = runs
    place = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    points = np.concatenate([place, np.zeros((200, 1))], axis=1)
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
        trainer.run(nothing)
        assert trainer.field.embeddings.device == TOY and trainer.poses.shift.device == TOY


def test_photos_are_matched_alike_on_both():
    """And what is nearer to cameras than the points so found is the same."""
    grey, found, empty = pattern(), [], []
    for device, kernels in DEVICES.values():
        with kernels():
            pixels = photos(DISTORTED, lambda i, t, x: grey(x), device=device)
            matched = plane_sweep_depth(pixels, None, (1.5, 4.0), 0)
            assert matched is not None
            field = Field(TINY, 5, np.array([0.0, 3.0, 0.0]), 3.0, 0.1).to(device)
            carving = FreeSpace(field, pixels, matched, FitSettings())
            place = matched.rays_o + 0.3 * matched.depth[:, None] * matched.rays_d
            before = carving.too_near_camera(place, torch.full_like(matched.depth, 0.01))
            found.append(to_numpy(matched.depth))
            empty.append(to_numpy(before))
    assert len(found[0]) > 300 and np.array_equal(*found)
    assert empty[0].any() and np.array_equal(*empty)


@pytest.mark.slow
def test_a_frame_in_all_weathers_is_the_same_on_both(runs):
    scene, folder = runs
    pose = scene.c2w_world(scene.views[0])
    frames = []
    for device, kernels in DEVICES.values():
        with kernels(), torch.no_grad():
            field = load_field(folder / "cpu", device)
            field.occupancy.seen.fill_(1)
            weather = weather_from_table(WEATHER)
            session = RenderSession(field, scene, weather, pose[None, :3, 3])
            small = CAMERA.resized(16, 12)
            options = FrameOptions(2, normals=True, labels=True)
            frames.append(render_frame(session.world(0.0), small, pose, options))
    (ours, layers), (theirs, others) = frames
    assert ours.std() > 5 and np.array_equal(ours, theirs)
    assert {"mask_water", "mask_snow", "mask_smog", "normal"} <= set(layers)
    for name, values in layers.items():
        assert np.array_equal(values, others[name], equal_nan=True), name


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused(tmp_path, capsys):
    for words in (["fit", "capture", "-o", "run"], ["render", "run", "-o", "out"]):
        assert cli.main([*words, "--device", "cuda"]) == 2
        said = capsys.readouterr().err
        assert "NVIDIA GPU" in said and "Traceback" not in said
    with pytest.raises(UserError, match="NVIDIA GPU"):
        load_run(tmp_path, device="cuda")


def test_what_a_gpu_needs_beside_it_is_asked_for(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "3.4.0+git")
    monkeypatch.delenv("CC", raising=False)
    there = {"clang": "/usr/bin/clang", "/usr/bin/clang": "/usr/bin/clang"}
    monkeypatch.setattr("shutil.which", there.get)
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    with pytest.raises(UserError, match="Python's headers"):
        check_triton()
    (tmp_path / "Python.h").touch()
    check_triton()
    monkeypatch.setenv("CC", "not-there")
    with pytest.raises(UserError, match="C compiler"):
        check_triton()
    for version in ("3.3.1", "2.9", "0"):
        monkeypatch.setattr("importlib.metadata.version", lambda name, own=version: own)
        with pytest.raises(UserError, match=r"needs Triton 3\.4"):
            resolve_device("cuda")
