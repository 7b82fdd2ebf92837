import dataclasses
import errno
import json
import os

import numpy as np
import pytest
import torch
from support.random_field import directions, points, random_field

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.samples import MIN_TAU
from climatenerf.core.storage import digest, read_safetensors, write_safetensors
from climatenerf.field.checkpoint import FILE_NAME, SCHEMA_VERSION, load_field, save_field
from climatenerf.render.volume import render_view

CAMERA = Camera(32, 24, 25.0, 25.0, 16.0, 12.0)


def rewrite(run, change):
    """Change the metadata or arrays of a field file, with a right checksum."""
    arrays, metadata = read_safetensors(run / FILE_NAME)
    about = json.loads(metadata["climatenerf"])
    change(about, arrays)
    about["digest"] = digest(arrays)
    write_safetensors(run / FILE_NAME, arrays, {"climatenerf": json.dumps(about)})


@pytest.mark.parametrize("refined", [False, True])
def test_a_loaded_field_renders_bit_identically(tmp_path, refined):
    field = random_field()
    if refined:
        field.occupancy.update(field.grid_density, 1.0, 0.9, torch.Generator().manual_seed(0))
        field.occupancy.refine()
    field.occupancy.seen[0, 3:9, 2:8, 4:7] = 1
    field.pruning_threshold = 0.04
    save_field(field, tmp_path)
    loaded = load_field(tmp_path)
    assert (loaded.size, loaded.unit, loaded.near) == (field.size, field.unit, field.near)
    assert loaded.pruning_threshold == field.pruning_threshold
    assert loaded.state_dict().keys() == field.state_dict().keys()
    for name, tensor in field.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
    pose = np.eye(4)
    pose[:3, 3] = field.centre.numpy()
    picture = render_view(field, CAMERA, pose)
    assert picture.std() > 0.01
    assert np.array_equal(render_view(loaded, CAMERA, pose), picture)
    x, d = points(field, 200), directions(200)
    for one, other in ((field, loaded), (field.observed_only(), loaded.observed_only())):
        assert torch.equal(one.density(x), other.density(x))
        assert torch.equal(one.colour(x, d), other.colour(x, d))
        assert torch.equal(one.sky(d), other.sky(d))
    assert not any(p.requires_grad for p in loaded.parameters())


def test_a_field_of_the_first_version_loads_without_normals_and_classes(tmp_path):
    field = random_field()
    field.learned[:] = True
    save_field(field, tmp_path)

    def earlier(about, arrays):
        about["schema_version"] = 1
        about["size"] = {k: v for k, v in about["size"].items() if "surface" not in k}
        del about["pruning_threshold"]
        for name in [name for name in arrays if name.startswith(("surface_", "learned"))]:
            del arrays[name]

    rewrite(tmp_path, earlier)
    loaded = load_field(tmp_path)
    x, d = points(field, 50), directions(50)
    assert torch.equal(loaded.density(x), field.density(x))
    assert torch.equal(loaded.colour(x, d), field.colour(x, d))
    assert not loaded.knows_normals and not loaded.knows_classes
    assert loaded.pruning_threshold == MIN_TAU


def test_a_field_of_the_second_version_keeps_its_pruning_threshold(tmp_path):
    field = random_field()
    field.pruning_threshold = 0.04
    save_field(field, tmp_path)

    def earlier(about, _):
        about["schema_version"] = 2
        about["thin"] = about.pop("pruning_threshold")

    rewrite(tmp_path, earlier)
    assert load_field(tmp_path).pruning_threshold == 0.04


def test_a_folder_without_a_field_is_refused(tmp_path):
    with pytest.raises(UserError, match="climatenerf fit"):
        load_field(tmp_path)
    with pytest.raises(UserError, match="climatenerf fit"):
        load_field(tmp_path / "absent")


def test_a_newer_schema_is_refused(tmp_path):
    save_field(random_field(), tmp_path)
    rewrite(tmp_path, lambda about, _: about.update(schema_version=SCHEMA_VERSION + 1))
    with pytest.raises(UserError, match="newer") as caught:
        load_field(tmp_path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("fraction", [0.0, 0.0001, 0.3, 0.999])
def test_a_truncated_file_is_reported_as_damaged(tmp_path, fraction):
    save_field(random_field(), tmp_path)
    data = (tmp_path / FILE_NAME).read_bytes()
    (tmp_path / FILE_NAME).write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(UserError, match="damaged") as caught:
        load_field(tmp_path)
    assert FILE_NAME in str(caught.value)


def without(name):
    return lambda about, arrays: arrays.pop(name)


@pytest.mark.parametrize(
    "change",
    [
        without("embeddings"),
        without("geometry_grid"),
        without("occupancy.density"),
        lambda about, _: about.pop("unit"),
        lambda about, _: about["size"].update(geometry_levels=7),
        lambda about, _: about["size"].update(flavour="new"),
        lambda about, arrays: arrays.update(centre=np.zeros(4, np.float32)),
        lambda about, _: about.update(unit="wide"),
        lambda about, _: about.update(unit=0.0),
        lambda about, _: about.update(pruning_threshold="a hair"),
        lambda about, _: about.update(pruning_threshold=float("nan")),
        lambda about, arrays: arrays["centre"].fill(np.nan),
        lambda about, arrays: arrays["centre"].fill(1e38),
        lambda about, arrays: arrays["surface_net.0"].reshape(-1)[:1].fill(np.nan),
        lambda about, arrays: arrays["embeddings"].fill(-1e38),
        lambda about, _: about.update(unit=1e300),
        lambda about, _: about.update(unit=10**30),
        lambda about, _: about.update(near=-1.0),
        lambda about, _: about.update(size=5),
        lambda about, _: about["size"].update(geometry_log2_rows=26, geometry_levels=64),
        lambda about, _: about["size"].update(cascades=10**9),
        lambda about, _: about["size"].update(cascades=40),
        lambda about, _: about["size"].update(coarsest=0),
        lambda about, _: about["size"].update(colour_hidden=2**20),
        lambda about, arrays: arrays.update(surplus=np.zeros(3, np.float32)),
        lambda about, arrays: arrays.update(embeddings=np.zeros(3, np.float32)),
    ],
)
def test_damaged_content_is_a_user_error(tmp_path, change):
    save_field(random_field(), tmp_path)
    rewrite(tmp_path, change)
    with pytest.raises(UserError, match="damaged"):
        load_field(tmp_path)


def test_a_flipped_bit_is_found(tmp_path):
    save_field(random_field(), tmp_path)
    data = bytearray((tmp_path / FILE_NAME).read_bytes())
    data[-1000] ^= 1
    (tmp_path / FILE_NAME).write_bytes(data)
    with pytest.raises(UserError, match="damaged .its checksum"):
        load_field(tmp_path)


def test_a_file_of_another_format_is_refused(tmp_path):
    write_safetensors(tmp_path / FILE_NAME, {"a": np.zeros(3, np.float32)}, {})
    with pytest.raises(UserError, match="damaged"):
        load_field(tmp_path)
    (tmp_path / FILE_NAME).write_bytes(b"not a field at all")
    with pytest.raises(UserError, match="damaged"):
        load_field(tmp_path)


def test_a_full_disk_keeps_the_earlier_field(tmp_path, monkeypatch):
    save_field(random_field(0), tmp_path)
    before = (tmp_path / FILE_NAME).read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match="disk is full"):
        save_field(random_field(1), tmp_path)
    assert (tmp_path / FILE_NAME).read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [FILE_NAME]


def test_the_field_size_is_saved(tmp_path):
    save_field(random_field(), tmp_path)
    _, metadata = read_safetensors(tmp_path / FILE_NAME)
    about = json.loads(metadata["climatenerf"])
    assert about["size"] == dataclasses.asdict(random_field().size)
