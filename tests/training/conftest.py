"""The toy scene and its small field, for all tests of fits that do not make their own."""

import pytest
from support.toy_scene import TINY, make_scene

from climatenerf.field.presets import PRESETS


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("toy"))


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
