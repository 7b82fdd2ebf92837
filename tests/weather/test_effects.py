"""Effects as packages: one of the user, and effects that are incompatible."""

import dataclasses
import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.random_field import random_field

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.layer_table import FRAME_LAYERS, RESERVED_NAMES, Layer
from climatenerf.core.storage import write_json
from climatenerf.field.checkpoint import save_field
from climatenerf.output import render_folder
from climatenerf.render.session import RenderSession
from climatenerf.scene import save_scene
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.effect import Effect, Measure
from climatenerf.weather.registry import EFFECTS, check_effects, in_order, layer_table
from climatenerf.weather.smog.parameters import SMOG, Smog
from climatenerf.weather.units import number
from climatenerf.weather.weather import Weather

EXAMPLE = Path(__file__).parents[2] / "examples" / "03_new_effect.py"
CAMERA = Camera(48, 27, 30.0, 30.0, 24.0, 13.5)
C2W = np.eye(4)
C2W[:3, :3] = np.array([[1, 0, 0], [0, -0.35, 0.9367], [0, -0.9367, -0.35]])
C2W[:3, 3] = (0.0, -4.5, 1.8)


@pytest.fixture(scope="module")
def ash():
    """The module of the example, imported like a package."""
    spec = importlib.util.spec_from_file_location("volcanic_ash", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["volcanic_ash"] = module
    spec.loader.exec_module(module)
    return module


def scene_at(folder):
    views = tuple(View(f"{i}.png", folder / f"{i}.png", 0, C2W) for i in range(3))
    return Scene(folder, "test", (CAMERA,), views)


@pytest.mark.slow
def test_ash_of_an_external_package_is_rendered(ash, tmp_path):
    effects = (*EFFECTS, ash.ASH)
    box = ((-6.0, -6.0, -2.0), (6.0, 6.0, 4.0))
    field = AnalyticField([HalfSpace(), Box((-1.0, 0.0, 0.0), (0.5, 1.0, 0.8))], box=box)
    film = weather_from_table(
        {"ash": {"depth": {"0 s": "2 cm", "2 s": "10 cm"}, "albedo": 0.05}}, effects
    )
    session = RenderSession(
        field, scene_at(tmp_path), film, times=np.array([0.0, 2.0]), effects=effects
    )
    for time, depth in ((0.0, 0.02), (1.0, 0.06), (2.0, 0.1)):
        frame = session.frame(CAMERA, C2W, time)
        covered = frame.layers["mask_ash"] > 0.9
        assert covered.mean() > 0.3
        assert np.median(frame.layers["ash_thickness"][covered]) == pytest.approx(depth, rel=0.2)
        assert (frame.layers["mask_snow"] == 0).all()
    clean = RenderSession(field, scene_at(tmp_path), Weather()).frame(CAMERA, C2W)
    dark, bright = frame.linear.numpy()[covered].mean(), clean.linear.numpy()[covered].mean()
    assert dark < 0.5 * bright, "ash is darker than the ground"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder on the path that contains the example as an installed package, and a run."""
    site = tmp_path_factory.mktemp("site")
    shutil.copy(EXAMPLE, site / "volcanic_ash.py")
    about = site / "volcanic_ash-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: volcanic-ash\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[climatenerf.effects]\nash = volcanic_ash:ASH\n")
    run = site / "run"
    run.mkdir()
    field = random_field(images=3, full=True)
    field.occupancy.occupied[..., field.occupancy.side // 2 :] = 0  # air above the middle
    field.geometry_net[-1].add_(5.0)  # dense below
    save_field(field, run)
    save_scene(scene_at(run), run)
    write_json(run / "config.json", {"schema_version": 1, "settings": {}})
    return site


def climatenerf(site, *args):
    paths = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "climatenerf", *map(str, args)]
    environment = os.environ | {"PYTHONPATH": paths}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_an_installed_effect_has_flags_keyframes_and_layers(installed, tmp_path):
    (tmp_path / "film.toml").write_text('[ash]\ndepth = { "0 s" = "0 m", "1 s" = "4 cm" }\n')
    out = tmp_path / "out"
    args = ["--weather", tmp_path / "film.toml", "--ash.albedo", "0.3", "--layers", "mask_ash"]
    args += ["--path", "still", "--frames", "2", "--fps", "1", "--size", "32x18"]
    done = climatenerf(installed, "render", installed / "run", "-o", out, *args)
    assert done.returncode == 0, done.stderr
    sidecar = json.loads((out / "movie.json").read_text())
    assert sidecar["weather"]["ash"] == {"depth": {"0 s": "0 m", "1 s": "0.04 m"}, "albedo": 0.3}
    assert sidecar["layers"]["mask_ash"]["meaning"] == "fraction of the pixel that shows ash"
    first, last = (frame["measured"]["ash_share"] for frame in sidecar["frames"])
    assert first == 0 < last
    with np.load(out / "mask_ash" / "0001.npz") as arrays:
        assert arrays["mask_ash"].shape == (18, 32)


def test_an_installed_effect_has_help_and_a_range(installed, tmp_path):
    printed = " ".join(climatenerf(installed, "render", "--help").stdout.replace("│", " ").split())
    assert '--ash.depth LENGTH, e.g. "0.5 m"; 0 m to 1 m' in printed
    args = ["render", installed / "run", "-o", tmp_path / "out", "--ash.depth", "3 m"]
    done = climatenerf(installed, *args)
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert done.stderr.strip() == ("climatenerf: --ash.depth must lie between 0 m and 1 m; got 3 m")


# --- incompatible effects ---------------------------------------------------------------------


def effect(**changes) -> Effect:
    return dataclasses.replace(
        Effect("rain", Smog, enabled_by=("visibility",), prepare=None), **changes
    )


RAIN = Layer("mask_rain", "1", "fraction of the pixel that shows rain", 1 / 255, 8)


def writes(name: str) -> Effect:
    return effect(layers=(dataclasses.replace(RAIN, name=name),))


@pytest.mark.parametrize(
    ("added", "message"),
    [
        ([effect(name="flood")], "two weather effects are named 'flood'"),
        ([effect(name="seed")], "cannot be named 'seed'"),
        ([effect(name="path")], "cannot be named 'path'"),
        ([effect(name="acid rain")], "cannot be named 'acid rain'"),
        ([writes("depth")], "layer 'depth' is written"),
        (
            [effect(layers=(RAIN,)), effect(name="sleet", layers=(RAIN,))],
            "layer 'mask_rain' is written by the effect 'rain' and by the effect 'sleet'",
        ),
        ([writes("frames")], "cannot be named 'frames'"),
        ([writes("Movie")], "cannot be named 'Movie'"),
        ([writes("../evil")], "cannot be named '../evil'"),
        ([writes("a/b")], "cannot be named 'a/b'"),
        ([writes("")], "cannot be named ''"),
        ([writes("Depth")], "layer 'Depth' is written"),
        ([effect(after=("hail",))], "placed after hail, which is absent"),
        ([effect(after=("sleet",)), effect(name="sleet", after=("rain",))], "waits for it"),
    ],
)
def test_incompatible_effects_are_refused_in_one_sentence(added, message):
    with pytest.raises(UserError) as error:
        check_effects((*EFFECTS, *added), reserved=["path"])
    assert message in str(error.value) and "\n" not in str(error.value)


@dataclasses.dataclass(frozen=True)
class Unitless:
    depth: float | None = None


@dataclasses.dataclass(frozen=True)
class Required:
    depth: Annotated[float, number(0.0, 1.0)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"enabled_by": ("visibilty",)}, "no parameter 'visibilty', which its enabled_by names"),
        ({"alternatives": (("visibility", "sgima"),)}, "'sgima', which its alternatives names"),
        ({"prepared_from": ("rain.sgima",)}, "is prepared from 'rain.sgima'"),
        ({"prepared_from": ("wet.depth",)}, "is prepared from 'wet.depth'"),
        ({"prepare": "my_package.entity"}, "prepare function 'my_package.entity'"),
        ({"prepare": ":prepare"}, "prepare function ':prepare'"),
        ({"prepare": 5}, "prepare function 5"),
        ({"measures": (Measure("wet", "mask_rian"),)}, "reads the layer 'mask_rian'"),
        ({"measures": (Measure("wet", "depth", "mask_rian"),)}, "reads the layer 'mask_rian'"),
        ({"measures": (Measure("up", "normal"),)}, "reads the layer 'normal'"),
        ({"measures": (Measure("snow_share", "depth"),)}, "measure 'snow_share' is a number of"),
        ({"measures": (Measure("mean_transmittance", "depth"),)}, "is a number of every frame"),
        ({"parameters": Unitless}, "Unitless.depth states no unit and range"),
        ({"parameters": Required, "enabled_by": ()}, "its parameter 'depth' no default"),
        ({"parameters": dict}, "are no dataclass"),
    ],
)
def test_slips_of_an_author_are_refused_in_one_sentence(changes, message):
    with pytest.raises(UserError) as error:
        check_effects((*EFFECTS, effect(**changes)))
    assert message in str(error.value) and "\n" not in str(error.value)
    assert "'rain'" in str(error.value)


@pytest.mark.parametrize("name", ["absent_package:prepare", "math:prepare"])
def test_a_missing_prepare_function_is_named_with_its_effect(name):
    with pytest.raises(UserError, match=f"{name}' of the weather effect 'rain' does not load"):
        effect(prepare=name).load()


def test_layers_cannot_have_the_names_of_the_other_files_of_a_render():
    own = {"frames", render_folder.MOVIE, render_folder.SIDECAR, render_folder.PREVIEW}
    assert {Path(name).stem for name in own} == RESERVED_NAMES
    assert Path(render_folder.frame_files(0, (), ())[0]).parts[0] in RESERVED_NAMES


def test_incompatible_installed_effects_exit_with_status_2(installed, tmp_path):
    for name in ("volcanic_ash.py", "volcanic_ash-1.0.dist-info"):
        copy = shutil.copytree if (installed / name).is_dir() else shutil.copy
        copy(installed / name, tmp_path / name)
    text = (tmp_path / "volcanic_ash.py").read_text()
    (tmp_path / "volcanic_ash.py").write_text(text.replace('name="ash"', 'name="flood"'))
    done = climatenerf(tmp_path, "render", installed / "run", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.startswith("climatenerf: two weather effects are named 'flood'")
    assert done.stderr.count("\n") == 1


def test_built_in_effects_are_compatible_and_snow_follows_the_flood():
    assert check_effects(EFFECTS) == EFFECTS
    names = [each.name for each in in_order(EFFECTS[::-1])]
    assert names.index("flood") < names.index("snow")
    for each in EFFECTS:
        assert each.fields().keys() == {f.name for f in dataclasses.fields(each.parameters)}
    own = sum(len(each.layers) for each in EFFECTS)
    assert len(layer_table()) == len(FRAME_LAYERS) + own


def test_prepared_from_names_existing_parameters():
    weather = Weather()
    for each in EFFECTS:
        for name in each.prepared_from:
            weather.value(name)


def test_weather_is_immutable_and_comparable():
    one = Weather(smog=Smog(visibility=9.0), seed=3)
    assert one == Weather(smog=Smog(visibility=9.0), seed=3) and hash(one) == hash(one)
    assert one != one.with_value("smog.visibility", 8.0) and one.smog.visibility == 9.0
    assert one.present() == (SMOG,)
    with pytest.raises(AttributeError):
        one.seed = 4
    with pytest.raises(AttributeError, match="no weather effect is named 'hail'"):
        one.hail  # noqa: B018
    with pytest.raises(TypeError, match="no weather effect is named 'hail'"):
        Weather(hail=Smog())
    assert math.isclose(one.with_value("sun.elevation", 0.5).sun.elevation, 0.5)
