from pathlib import Path

import numpy as np
import pytest

from climatenerf.core.storage import plain
from climatenerf.output.sidecar import FrameRecord, sidecar
from climatenerf.scene import Camera, Scene

H, W = 6, 8


def test_a_sidecar_describes_frames_weather_scale_and_versions():
    world_from_input = np.eye(4)
    world_from_input[:3, :3] = 2.0 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    world_from_input[:3, 3] = [5, 6, 7]
    camera = Camera(W, H, 9.0, 9.0, 4.0, 3.0)
    scene = Scene(
        Path("/none"),
        "colmap",
        (camera,),
        (),
        None,
        world_from_input,
        "camera-height-assumed",
        0.3,
        ground_z=-1.5,
    )
    c2w = np.eye(4)
    c2w[:3, 3] = [5, 8, 7]
    files = {"depth": ["depth/0000.npz"]}
    record = FrameRecord("0000.png", 0.0, camera, c2w, files, measured={"water": 0.25})
    weather = {"flood": {"level": "0.5 m"}}
    data = plain(sidecar(scene, [record], weather, seed=3, about={"fps": 24, "path": "orbit"}))
    assert data["simulated"] is True and "simulated" in data["note"]
    assert data["weather"]["flood"]["level"] == "0.5 m" and data["seed"] == 3
    assert data["scale"] == {
        "source": "camera-height-assumed",
        "relative_error": 0.3,
        "metres_per_input_unit": pytest.approx(2.0),
        "assumed": True,
    }
    assert set(data["versions"]) == {"climatenerf", "torch", "numpy", "numba"}
    assert data["versions"]["numpy"] == np.__version__
    assert data["layers"]["depth"]["unit"] == "m" and data["fps"] == 24
    frame = data["frames"][0]
    assert frame["camera"]["fx"] == 9.0 and frame["layers"]["depth"] == ["depth/0000.npz"]
    assert frame["c2w_world"] == c2w.tolist() and frame["measured"] == {"water": 0.25}
    pose = np.array(frame["c2w_input"])
    assert np.allclose(world_from_input @ pose[:, 3], c2w[:, 3])
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.allclose(pose[:3, 3], [1, 0, 0])
