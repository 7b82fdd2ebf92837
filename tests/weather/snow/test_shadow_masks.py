"""Shadows of the photos, baked from masks: the mean over the rays that see a place."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.analytic_fields import AnalyticField, ground

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.render.session import RenderSession
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.description import weather_from_table, weather_to_table
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import SnowEntity, bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.shadow_masks import ShadowMasks
from climatenerf.weather.weather import Weather

SIDE = 40  # rays along a side of a photo of 8 m of level ground


def photo(name):
    """A photo from above, x to the right and y down; its last row sees the sky."""
    x, y = np.meshgrid(np.linspace(-4, 4, SIDE), np.linspace(-4, 4, SIDE))
    ends = np.stack([x, y, 0 * x], -1)
    t = np.full((SIDE, SIDE), 3.0)
    ends[-1], t[-1] = np.inf, np.inf
    empty = np.zeros((SIDE, SIDE, 3))
    view, camera = View(name, Path(name), 0, np.eye(4)), Camera(SIDE, SIDE, 1, 1, 0, 0)
    label = np.zeros((SIDE, SIDE), np.uint8)
    return PhotoRays(view, camera, np.eye(4), ends, t, empty, empty, label, t)


def write_mask(path, left, right, size=200):
    mask = np.full((size, size), left, np.uint8)
    mask[:, size // 2 :] = right
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


def test_a_mask_is_found_again_at_the_places_that_its_photo_shows(tmp_path):
    write_mask(tmp_path / "a.png", 255, 0)
    masks = ShadowMasks(tmp_path, [photo("a.jpg"), photo("without_mask.jpg")])
    x = np.array([[-2.0, 0.0, 0.0], [2.0, 1.0, 0.05], [0.0, 0.0, 3.0], [50.0, 0.0, 0.0]])
    found = masks.sunlight(x)
    assert found[:2] == pytest.approx([0, 1], abs=0.01)
    assert np.isnan(found[2:]).all(), "no photo shows these places"


def test_masks_that_disagree_are_averaged_as_least_squares_do(tmp_path):
    write_mask(tmp_path / "photos" / "a.png", 255, 0)
    write_mask(tmp_path / "photos" / "b.jpg", 0, 0)
    masks = ShadowMasks(tmp_path, [photo("photos/a.jpg"), photo("photos/b.jpg")])
    x = np.random.default_rng(0).uniform(-3.5, -0.5, (200, 3)) * [1, 1, 0]
    values = masks.sunlight(x)
    assert values.mean() == pytest.approx(0.5, abs=0.02)


def test_snow_is_darker_where_the_photos_have_shadow(tmp_path):
    write_mask(tmp_path / "a.png", 255, 0)
    masks = ShadowMasks(tmp_path, [photo("a.jpg")])
    field = AnalyticField([ground()], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    grid = SnowGrid((0.0, 0.0), (-1.0, 3.0), 0.06, 48)
    snow = Snow(depth=0.1, light="paper")
    cameras = np.array([[0.0, 0.0, 1.6]])
    baked = bake_snow(field, snow, cameras, np.ones(3), grid=grid, sunlit=masks.sunlight)
    assert baked is not None
    dark, bright = baked.colour(torch.tensor([[-1.5, 0.0, 0.1], [1.5, 0.0, 0.1]])).mean(-1)
    assert float(dark / bright) == pytest.approx(0.3, abs=0.03), "V_s0 / (beta_s + V_s0)"


@pytest.mark.parametrize("case", ["missing", "empty", "proportions", "damaged"])
def test_unusable_masks_are_refused_in_one_sentence(tmp_path, case):
    folder = tmp_path / "masks"
    messages = {
        "missing": "there is no folder",
        "empty": r"named? .*after the photos, such as a\.png",
        "proportions": "other proportions",
        "damaged": "cannot be read",
    }
    if case != "missing":
        folder.mkdir()
    if case == "proportions":
        Image.new("L", (200, 100)).save(folder / "a.png")
    if case == "damaged":
        (folder / "a.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=messages[case]) as error:
        ShadowMasks(folder, [photo("a.jpg")])
    assert "\n" not in str(error.value)


def test_masks_belong_to_the_papers_shading_and_survive_a_weather_file(tmp_path):
    table = {"snow": {"depth": "0.1 m", "light": "paper", "shadows": "some/masks"}}
    weather = weather_from_table(table)
    written = weather_to_table(weather)
    assert written["snow"]["shadows"] == "some/masks"
    assert weather_from_table(written) == weather
    with pytest.raises(UserError, match="must be a folder"):
        weather_from_table({"snow": {"shadows": 3}})
    field = AnalyticField([ground()], box=((-4.0, -4.0, -1.0), (4.0, 4.0, 3.0)))
    c2w = np.eye(4)
    c2w[:3, 3] = (0, 0, 1.6)
    views = (View("a.png", tmp_path / "a.png", 0, c2w),)
    scene = Scene(tmp_path, "test", (Camera(8, 8, 8, 8, 4, 4),), views)
    table["snow"]["light"] = "scene"
    with pytest.raises(UserError, match="add --snow.light paper"):
        RenderSession(field, scene, weather_from_table(table))


def test_a_missing_folder_is_refused_before_photos_are_traced():
    def trace():
        raise AssertionError("photos are traced")

    moment = Weather(snow=Snow(depth=0.1, light="paper", shadows="no/such/folder"))
    with pytest.raises(UserError, match="there is no folder"):
        SnowEntity(SimpleNamespace(moments=(moment,), photo_rays=trace))
