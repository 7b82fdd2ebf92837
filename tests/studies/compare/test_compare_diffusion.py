"""Inpainting by real classes of diffusers with tiny random weights, from a local folder."""

import importlib.util
import inspect
import json
import shutil
import socket

import numpy as np
import pytest
from support.compared_frames import make_material

from climatenerf.core.errors import UserError
from climatenerf.studies.compare import diffusion
from climatenerf.studies.compare.settings import DiffusionSettings

pytest.importorskip("diffusers", reason="pip install .[diffusion]")
pytest.importorskip("transformers", reason="pip install .[diffusion]")
from support.tiny_pipeline import save_flux_fill, save_pipeline


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_pipeline(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    return make_material(tmp_path_factory.mktemp("flood"), "flood", frames=2)


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a network connection was opened")

    for name in ("connect", "connect_ex"):
        monkeypatch.setattr(socket.socket, name, refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


def settings_for(*models, **changes):
    return DiffusionSettings(models=tuple(map(str, models)), steps=2, side=48, **changes)


def method_of(folder, **changes):
    (method,) = diffusion.diffusion_methods(settings_for(folder, **changes), "cpu")
    return method


def test_a_saved_pipeline_paints_the_water_and_nothing_else(folder, material, no_network, tmp_path):
    method = method_of(folder)
    assert method.kind == "model" and method.name == "pipeline" and method.shows(material)
    painted = list(method.pictures(material, [0, 1], tmp_path))
    for index, picture in enumerate(painted):
        clean, mask = material.clean.picture(index), material.mask(index)
        assert picture.shape == clean.shape and picture.dtype == np.uint8
        np.testing.assert_array_equal(picture[mask == 0], clean[mask == 0])
        assert np.abs(picture[mask == 1].astype(int) - clean[mask == 1]).mean() > 5


def test_one_seed_gives_one_picture_and_the_prompt_and_steps_matter(folder, material, tmp_path):
    def first(**changes):
        return next(method_of(folder, **changes).pictures(material, [0], tmp_path))

    same = first()
    np.testing.assert_array_equal(first(), same)
    assert not np.array_equal(first(prompt="a desert"), same)
    assert not np.array_equal(first(guidance=1.0), same)
    identities = {
        json.dumps(method_of(folder, **changes).identity(material))
        for changes in ({}, {"prompt": "a desert"}, {"guidance": 1.0})
    }
    assert len(identities) == 3


def test_the_seed_and_the_mask_reach_the_pipeline(folder, material):
    pipeline = diffusion.load_pipeline(folder)
    assert type(pipeline).__name__ == "StableDiffusionInpaintPipeline"
    picture, mask = material.clean.picture(0), material.mask(0)
    settings = settings_for(folder)
    one, other = (diffusion.inpainted(pipeline, picture, mask, settings, s) for s in (1, 2))
    assert not np.array_equal(one, other)
    nothing = diffusion.inpainted(pipeline, picture, 0 * mask, settings, 1)
    np.testing.assert_array_equal(nothing, picture)
    half = diffusion.inpainted(pipeline, picture, np.full_like(mask, 0.5), settings, 1)
    whole = diffusion.inpainted(pipeline, picture, np.ones_like(mask), settings, 1)
    # The pipeline rounds the mask to 0 or 1; half of what it paints is pasted in.
    assert np.abs(half - (picture.astype(float) + whole) / 2).max() <= 0.5


def test_sides_are_multiples_of_sixteen_and_at_least_the_least(folder, material, monkeypatch):
    pipeline = diffusion.load_pipeline(folder)
    seen = {}
    call = type(pipeline).__call__

    def watched(self, **given):
        seen.update(given)
        return call(self, **given)

    watched.__signature__ = inspect.signature(call)
    monkeypatch.setattr(type(pipeline), "__call__", watched)
    picture, mask = material.clean.picture(0), material.mask(0)
    settings = DiffusionSettings(steps=1, side=64)
    diffusion.inpainted(pipeline, picture, mask, settings, 0)
    assert (seen["width"], seen["height"]) == (80, 64) and seen["image"].size == (80, 64)
    assert seen["mask_image"].size == (80, 64) and seen["strength"] == 1.0
    assert seen["guidance_scale"] == 7.5 and seen["prompt"] == "flooding"


def test_loading_is_asked_for_local_safetensors_alone(folder, monkeypatch):
    from diffusers import DiffusionPipeline

    seen = {}
    load = DiffusionPipeline.from_pretrained.__func__

    def watched(cls, name, **given):
        seen.update(given, name=name)
        return load(cls, name, **given)

    monkeypatch.setattr(DiffusionPipeline, "from_pretrained", classmethod(watched))
    diffusion.load_pipeline(folder)
    assert seen["name"] == str(folder) and seen["local_files_only"] is True
    assert seen["use_safetensors"] is True and not seen.get("trust_remote_code")


def test_a_pipeline_from_text_alone_is_turned_into_an_inpainting_one(tmp_path, material):
    pipeline = diffusion.load_pipeline(save_pipeline(tmp_path, inpainting=False))
    assert type(pipeline).__name__ == "StableDiffusionInpaintPipeline"
    picture, mask = material.clean.picture(0), material.mask(0)
    painted = diffusion.inpainted(pipeline, picture, mask, settings_for(tmp_path), 0)
    assert not np.array_equal(painted, picture)


def test_a_pipeline_of_another_class_paints_with_its_own_guidance(tmp_path, material, no_network):
    """FluxFillPipeline has other text encoders, and a usual guidance of 30."""
    method = method_of(save_flux_fill(tmp_path))
    assert "non-commercial" in method.licence
    clean, mask = material.clean.picture(0), material.mask(0)
    first, again = (next(method.pictures(material, [0], tmp_path)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[mask == 0], clean[mask == 0])
    assert np.abs(first[mask == 1].astype(int) - clean[mask == 1]).mean() > 5
    pipeline = diffusion.load_pipeline(method.folder)
    usual, low = (
        diffusion.inpainted(pipeline, clean, mask, settings_for(method.folder, guidance=g), 0)
        for g in (30.0, 1.0)
    )
    np.testing.assert_array_equal(usual, first)
    assert not np.array_equal(low, first)


def test_licences_come_from_the_model_card_or_are_the_usual_ones(folder, tmp_path):
    assert diffusion.licence_of(folder).startswith("CreativeML OpenRAIL-M, usual for Stable")
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "model_index.json").write_text('{"_class_name": "FluxFillPipeline"}')
    assert "non-commercial" in diffusion.licence_of(copy)
    (copy / "README.md").write_text("---\ntags:\n- a\nlicense: apache-2.0\n---\nlicense: mit\n")
    assert diffusion.licence_of(copy) == "apache-2.0 (model card)"
    (copy / "README.md").write_text("# no front matter\nlicense: mit\n")
    assert "FLUX" in diffusion.licence_of(copy)
    (copy / "model_index.json").write_text("{}")
    assert diffusion.licence_of(copy) == diffusion.UNKNOWN


def test_damaged_or_absent_pipelines_are_refused_in_one_sentence(folder, tmp_path):
    with pytest.raises(UserError, match="nothing is downloaded"):
        diffusion.diffusion_methods(settings_for("owner/model"), "cpu")
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "model_index.json").write_text('{"_class_name": "StableDiffusionInpaintPipeline"}')
    with pytest.raises(UserError, match="cannot be loaded"):
        diffusion.load_pipeline(empty)
    with pytest.raises(UserError, match="at least 1"):
        diffusion.diffusion_methods(DiffusionSettings(steps=0), "cpu")
    with pytest.raises(UserError, match="cannot be named"):
        diffusion.diffusion_methods(settings_for(f"a/b={folder}"), "cpu")


def test_weights_that_may_execute_code_are_not_read(folder, tmp_path):
    copy = tmp_path / "pickled"
    shutil.copytree(folder, copy)
    for file in copy.rglob("*.safetensors"):
        file.rename(file.with_suffix(".bin"))
    with pytest.raises(UserError, match="safetensors"):
        diffusion.load_pipeline(copy)


def test_without_diffusers_the_remedy_is_named(monkeypatch, folder):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install .*\[diffusion\]"):
        diffusion.diffusion_methods(settings_for(folder), "cpu")
    assert diffusion.diffusion_methods(DiffusionSettings(), "cpu") == ()
