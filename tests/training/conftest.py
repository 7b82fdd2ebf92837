"""The toy scene, for all tests of fits that do not build their own."""

import pytest
from support.toy_scene import make_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("toy"))
