"""Networks of the real architectures at tiny sizes, through the same code path."""

import numpy as np
import pytest

from climatenerf.core.errors import UserError
from climatenerf.perception import models
from climatenerf.perception.monocular import load_depth
from climatenerf.perception.segmentation import CITYSCAPES, load_segmentation, train_ids

pytest.importorskip("transformers", reason="pip install .[perception]")
from support import networks


def test_class_names_map_to_train_ids():
    named = train_ids({number: name for number, name in enumerate(CITYSCAPES)}, "m")
    assert named.tolist() == list(range(19))
    others = {
        0: "wall",
        1: "building;edifice",
        2: "Tree",
        3: "person, individual, someone",
        4: "ceiling",
        5: "earth, ground",
        6: "traffic_light",
    }
    assert train_ids(others, "m").tolist() == [3, 2, 8, 11, 255, 9, 6]
    with pytest.raises(UserError, match="LABEL_0, LABEL_1"):
        train_ids({0: "LABEL_0", 1: "LABEL_1"}, "m")
    with pytest.raises(UserError, match="does not name"):
        train_ids({}, "m")


@pytest.mark.parametrize("save", [networks.save_segformer, networks.save_oneformer])
def test_labels_have_the_photo_size_and_known_ids(tmp_path, save):
    network = load_segmentation(str(save(tmp_path / "net")))
    photo = networks.picture()
    labels = network.predict(photo)
    assert labels.shape == (30, 48) and labels.dtype == np.uint8
    assert set(np.unique(labels)) <= {0, 10, 8, 11, 18}
    np.testing.assert_array_equal(network.predict(photo), labels)
    assert network.revision is None


def test_unmapped_classes_are_unknown(tmp_path):
    network = load_segmentation(str(networks.save_segformer(tmp_path / "n", networks.ROOM_NAMES)))
    ids = np.unique([network.predict(networks.picture(seed=i)) for i in range(5)])
    assert set(ids.tolist()) <= {3, 10, 8, 2, 255, 9}


def test_memory_limit_on_scores_keeps_the_label_size(tmp_path, monkeypatch):
    network = load_segmentation(str(networks.save_segformer(tmp_path / "net")))
    whole = network.predict(networks.picture())
    monkeypatch.setattr("climatenerf.perception.segmentation._MAX_SCORES", 5 * 30 * 48 // 4)
    coarse = network.predict(networks.picture())
    assert coarse.shape == whole.shape and (coarse == whole).mean() > 0.7


def test_depth_has_the_photo_shape_and_is_inverse_depth(tmp_path):
    wide = networks.picture(90, 160)
    relative = load_depth(str(networks.save_depth_anything(tmp_path / "r"))).predict(wide)
    assert relative.shape == (90, 160) and relative.dtype == np.float32
    assert np.isfinite(relative).all() and np.ptp(relative) > 0
    large = networks.picture(600, 1000)
    assert load_depth(str(tmp_path / "r")).predict(large).shape == (311, 518)
    metric = load_depth(str(networks.save_depth_anything(tmp_path / "m", "metric"))).predict(wide)
    assert (metric >= 1 / 20 - 1e-4).all(), "the network's largest depth is 20 m"


def test_unusable_models_give_one_sentence_errors(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="give the folder of a model"):
        load_segmentation(str(tmp_path / "absent"))
    with pytest.raises(UserError, match="give the folder of a model"):
        load_segmentation("simpel")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="cannot be loaded"):
        load_segmentation(str(tmp_path / "empty"))
    networks.save_segformer(tmp_path / "net")
    networks.save_depth_anything(tmp_path / "depth")
    with pytest.raises(UserError, match="not a Depth Anything model"):
        load_depth(str(tmp_path / "net"))
    with pytest.raises(UserError, match="not a segmentation network"):
        load_segmentation(str(tmp_path / "depth"))
    (tmp_path / "net" / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="cannot be loaded"):
        load_segmentation(str(tmp_path / "net"))
    monkeypatch.setattr(models.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r'pip install "\.\[perception\]"'):
        load_depth(str(tmp_path / "depth"))


def test_cached_models_are_preferred_to_downloads():
    calls = []

    def load(name, local):
        calls.append(local)
        if local:
            raise OSError("not cached")
        raise OSError("We couldn't connect\nand more")

    with pytest.raises(UserError, match="couldn't connect.*local path") as error:
        models.load_parts("owner/net", load)
    assert calls == [True, False] and "\n" not in str(error.value)
    assert models.load_parts("owner/net", lambda name, local: local) is True


def test_licence_of_known_and_unknown_models():
    assert models.licence_of("depth-anything/Depth-Anything-V2-Small-hf") == "Apache-2.0"
    assert "non-commercial" in models.licence_of("depth-anything/Depth-Anything-V2-Large-hf")
    assert "non-commercial" in models.licence_of("/copies/segformer-b5-finetuned-cityscapes")
    assert models.licence_of("shi-labs/oneformer_cityscapes_swin_large") == "MIT"
    assert "unknown" in models.licence_of("me/mine")
