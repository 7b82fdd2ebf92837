"""An image-to-image network of diffusers as teacher."""

import shutil

import numpy as np
import pytest

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.styling.paper.editor import diffusion_editor
from climatenerf.styling.paper.shots import Shot

pytest.importorskip("diffusers")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from support.tiny_diffusion import save_editor

    return save_editor(tmp_path_factory.mktemp("diffusion"))


def shot(name="a.jpg"):
    return Shot(name, Camera(40, 24, 30.0, 30.0, 20.0, 12.0), np.eye(4), np.arange(40 * 24))


@pytest.mark.slow  # importing diffusers and 125 passes through the network
def test_pictures_come_back_at_the_size_of_the_view_and_repeat(folder):
    picture = np.random.default_rng(0).random((24, 40, 3)).astype(np.float32)
    edit = diffusion_editor(folder, "late snow", 3)
    one = edit(shot(), picture)
    assert one.shape == (24, 40, 3) and 0 <= one.min() <= one.max() <= 1
    assert np.abs(one - picture).mean() > 0.02
    assert np.array_equal(edit(shot(), picture), one)
    assert not np.array_equal(edit(shot("b.jpg"), picture), one), "each view has its own noise"
    assert not np.array_equal(diffusion_editor(folder, "late snow", 4)(shot(), picture), one)


def test_a_folder_without_a_usable_network_is_refused(folder, tmp_path):
    with pytest.raises(UserError, match=r"no model_index\.json"):
        diffusion_editor(tmp_path, "snow", 0)
    broken = tmp_path / "broken"
    shutil.copytree(folder, broken)
    (broken / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"none")
    with pytest.raises(UserError, match="cannot be loaded"):
        diffusion_editor(broken, "snow", 0)
