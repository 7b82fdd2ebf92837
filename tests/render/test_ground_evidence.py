"""The terrain that rays of photos find in a field, and the file of it in a run folder."""

import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.holed_ground import GREY, LabelledField, slabs
from support.scene_builders import look_at

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, PERSON, ROAD, TERRAIN, UNKNOWN, VEHICLE
from climatenerf.core.errors import UserError
from climatenerf.field.capabilities import CLASSES, DENSITY, NORMALS
from climatenerf.render import ground_evidence, photo_rays, run_terrain
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.ground_evidence import find_terrain, heights_below_cameras
from climatenerf.render.integrator import trace
from climatenerf.render.run_terrain import terrain_of_run
from climatenerf.scene.scene import Scene, View
from climatenerf.scene.terrain import FILE_NAME, load_terrain
from climatenerf.weather.world import World

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
BOX = ((-8.0, -8.0, -6.0), (8.0, 8.0, 6.0))
HOUSE = Box((-3.0, 4.0, -1.0), (3.0, 9.0, 4.0), (0.5, 0.2, 0.1))
CAR = Box((1.2, 2.0, 0.0), (2.6, 4.0, 1.3), (0.1, 0.1, 0.6))


@pytest.fixture(autouse=True, scope="module")
def few_nodes():
    """Keep rasters and rays small."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("MAX_NODES", 72), ("MARGIN", 2.0)):
            patch.setattr(ground_evidence, name, value)
        patch.setattr(photo_rays, "MAX_RAYS", 6000)
        yield


@pytest.fixture(scope="module")
def found(few_nodes):
    """Terrain of level ground with a house and a car, and the reported fractions."""
    reports = []
    terrain = find_terrain(field(), scene(), reports.append)
    assert terrain is not None
    return terrain, reports


def scene(eyes=None, ahead=(0.0, 4.0, -1.0), camera=CAMERA):
    """Photos from positions, each looking ahead and down."""
    if eyes is None:
        eyes = [(x, y, 1.6) for y in (-5.0, -3.0) for x in (-0.5, 0.5)]
    views = [
        View(f"{i}.png", f"{i}.png", 0, look_at(eye, np.add(eye, ahead)))
        for i, eye in enumerate(eyes)
    ]
    return Scene("/none", "test", (camera,), tuple(views))


def field(ground=None, classes=(ROAD, BUILDING, VEHICLE), **changes):
    solids = [ground or HalfSpace(colour=GREY), HOUSE, CAR]
    return LabelledField(solids, classes=classes, box=BOX, **changes)


def at(terrain, values, x, y):
    return terrain.sample(np.asarray(values, float), np.array([[x, y]], float))[0]


def error_of(terrain, ground, where):
    """Height above the true ground at nodes that meet a condition."""
    nodes = terrain.nodes()
    return (terrain.height - ground(nodes[..., 0], nodes[..., 1]))[where]


def same(first, second):
    names = ("height", "error", "label", "seen", "open")
    return all(np.array_equal(getattr(first, n), getattr(second, n)) for n in names)


def level(x, y):
    return 0 * x


# --- what is found ------------------------------------------------------------------------------


def test_level_ground_with_a_house_and_a_car_is_found(found):
    terrain, reports = found
    assert (np.diff(reports) >= 0).all() and reports[0] == 0 and reports[-1] <= 1
    assert terrain.seen.mean() > 0.5
    assert np.abs(error_of(terrain, level, terrain.seen)).max() < 0.03
    assert np.abs(error_of(terrain, level, slice(None))).max() < 0.1, "also below house and car"
    off = np.abs(error_of(terrain, level, slice(None)))
    assert (off <= 2 * terrain.error).mean() > 0.95
    assert set(np.unique(terrain.label[terrain.seen])) == {ROAD}
    assert (terrain.label[~terrain.seen] == UNKNOWN).all()
    # The raster covers the cameras and what lies under them.
    assert terrain.contains(np.array([[0.5, -5.0], [-0.5, -3.0]])).all()


@pytest.mark.parametrize("capabilities", [{NORMALS}, {CLASSES}], ids=str)
def test_either_normals_or_classes_are_enough(capabilities):
    terrain = find_terrain(field(capabilities=frozenset({DENSITY, *capabilities})), scene())
    assert terrain is not None
    off = np.abs(error_of(terrain, level, terrain.seen))
    # Without normals the foot of a wall counts as ground, and lifts it beside the wall.
    assert np.quantile(off, 0.8) < 0.03 and off.max() < 0.3


def test_a_field_that_knows_neither_has_no_terrain():
    assert find_terrain(field(capabilities=frozenset({DENSITY})), scene()) is None
    assert find_terrain(AnalyticField([HalfSpace()]), scene()) is None


def test_without_ground_in_sight_there_is_no_terrain():
    """Cameras that look up, at a wall, at nothing, or at people alone."""
    assert find_terrain(field(), scene(ahead=(0.0, 1.0, 1.0))) is None
    wall = LabelledField([Box((-9, 1, -9), (9, 2, 9))], classes=(BUILDING,), box=BOX)
    assert find_terrain(wall, scene(ahead=(0.0, 1.0, 0.0))) is None
    assert find_terrain(LabelledField([], box=BOX), scene()) is None
    crowd = LabelledField([HalfSpace()], classes=(PERSON,), box=BOX)
    assert find_terrain(crowd, scene()) is None


def test_a_table_is_no_ground():
    """A figure on a table: its top is level, but no larger than the cameras are high."""

    def top(half):
        return LabelledField([Box((-half, -1.0 - half, -9), (half, -1.0 + half, 0))], box=BOX)

    assert find_terrain(top(0.7), scene()) is None
    assert find_terrain(top(2.5), scene()) is not None


@pytest.mark.filterwarnings("error")
def test_rays_along_an_axis_warn_of_nothing():
    """A level camera has rays with a component of 0, and some of them end in the sky."""
    odd = Camera(63, 47, 40.0, 40.0, 31.5, 23.5)
    assert find_terrain(field(), scene(ahead=(0.0, 1.0, 0.0), camera=odd)) is not None


@pytest.mark.parametrize(("degrees", "heading"), [(10.0, 0.0), (30.0, 90.0)])
def test_a_slope_is_kept(degrees, heading):
    angle, turn = np.radians(degrees), np.radians(heading)
    normal = (-np.sin(angle) * np.cos(turn), -np.sin(angle) * np.sin(turn), np.cos(angle))

    def slope(x, y):
        return np.tan(angle) * (np.cos(turn) * x + np.sin(turn) * y)

    hill = LabelledField([HalfSpace(normal)], classes=(TERRAIN,), box=BOX)
    eyes = [(x, y, slope(x, y) + 1.6) for y in (-5.0, -3.0) for x in (-1.0, 1.0)]
    terrain = find_terrain(hill, scene(eyes, ahead=(0.0, 4.0, -1.0 + slope(0, 4.0))))
    assert terrain is not None
    near = terrain.error < 0.1
    assert near.mean() > 0.3
    assert np.quantile(np.abs(error_of(terrain, slope, near)), 0.9) < 0.1
    off = np.abs(error_of(terrain, slope, slice(None)))
    assert (off <= 2 * terrain.error).mean() > 0.9
    assert set(np.unique(terrain.label[terrain.seen])) == {TERRAIN}


def test_a_kerb_is_kept(monkeypatch):
    monkeypatch.setattr(ground_evidence, "MAX_NODES", 128)
    monkeypatch.setattr(photo_rays, "MAX_RAYS", 12_000)
    kerb = Box((0.8, -9.0, -1.0), (9.0, 9.0, 0.12), GREY)
    street = LabelledField([HalfSpace(colour=GREY), kerb], classes=(ROAD, ROAD), box=BOX)
    terrain = find_terrain(street, scene())
    assert terrain is not None
    nodes = terrain.nodes()
    shown = terrain.seen & (np.abs(nodes[..., 1]) < 3) & (np.abs(nodes[..., 0]) < 2.5)
    shown &= np.abs(nodes[..., 0] - 0.8) > 0.35
    off = error_of(terrain, lambda x, y: np.where(x > 0.8, 0.12, 0.0), shown)
    assert len(off) > 100 and np.abs(off).max() < 0.04


class Mislabelled(LabelledField):
    """Every second patch of a metre has the other class: road is house, and house is road."""

    def surface_heads(self, rays_o, rays_d, samples, selected):
        normal, logits = super().surface_heads(rays_o, rays_d, samples, selected)
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        wrong = torch.floor(x).sum(-1).remainder(2) == 1
        swapped = logits[:, [1, 0, 2, 3, 4, 5]]  # the order of SOLID
        return normal, torch.where(wrong[:, None], swapped, logits)


@pytest.mark.parametrize("known", [{NORMALS, CLASSES}, {CLASSES}], ids=["both", "classes"])
def test_labels_that_are_wrong_by_half_do_not_tilt_the_ground(known):
    right = field(capabilities=frozenset({DENSITY, *known}))
    wrong = Mislabelled(
        right.solids, classes=right.classes, box=BOX, capabilities=right.capabilities
    )
    terrain = find_terrain(wrong, scene())
    assert terrain is not None
    off = np.abs(error_of(terrain, level, terrain.seen))
    # Without normals the foot of a wall counts as ground, and lifts it beside the wall.
    assert np.quantile(off, 0.95 if NORMALS in known else 0.8) < 0.05 and off.max() < 0.3
    assert np.median(np.abs(error_of(terrain, level, slice(None)))) < 0.05


def test_litter_on_the_ground_does_not_lift_it():
    """Boxes of 0.25 m and half a metre high, labelled road."""
    random = np.random.default_rng(0)
    boxes = [Box((x, y, 0), (x + 0.25, y + 0.25, 0.5)) for x, y in random.uniform(-4, 4, (20, 2))]
    littered = LabelledField([HalfSpace(), *boxes], classes=(ROAD,), box=BOX)
    terrain = find_terrain(littered, scene())
    assert terrain is not None
    assert np.quantile(np.abs(error_of(terrain, level, terrain.seen)), 0.9) < 0.08


# --- holes --------------------------------------------------------------------------------------


def below_cameras(half=1.0):
    """Ground with a hole below cameras that stand in a ring around its centre, facing outwards."""
    ground = LabelledField(slabs(half), classes=(ROAD,) * 4, box=BOX)
    views = []
    for turn in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        heading = np.array([np.cos(turn), np.sin(turn), 0.0])
        eye = 0.2 * heading + (0, 0, 1.6)
        pose = look_at(eye, eye + heading - (0, 0, 0.35))
        views.append(View(f"{len(views)}.png", f"{len(views)}.png", 0, pose))
    return ground, Scene("/none", "test", (CAMERA,), tuple(views))


def test_the_hole_below_the_cameras_is_completed():
    ground, photos = below_cameras()
    terrain = find_terrain(ground, photos)
    assert terrain is not None
    nodes = terrain.nodes()
    hole = (np.abs(nodes[..., :2]) < 0.75).all(-1)
    assert terrain.completed[hole].all()
    assert np.abs(terrain.height[hole]).max() < 0.03
    assert not terrain.completed[(np.abs(nodes[..., :2]) > 1.3).any(-1) & terrain.seen].any()
    completed = CompletedField(ground, terrain)
    o = torch.tensor([[0.0, 0.0, 1.6], [0.4, -0.3, 1.6]])
    d = torch.tensor([0.0, 0.0, -1.0]).repeat(2, 1)
    seen = trace(World(completed), o, d, torch.full((2,), 1e-3))
    assert torch.allclose(seen.depth, torch.tensor(1.6), atol=0.03)
    assert (seen.rgb - torch.tensor(GREY)).abs().max() < 1e-3
    assert (seen.layers["seen"] < 1e-3).all()


def walk(carried, rise=0.05):
    """Cameras every metre along a rising path, and ends on the ground below the first ten."""
    along = np.arange(len(carried), dtype=float)
    eyes = np.stack([along, 0 * along, rise * along + carried], axis=-1)
    x, y = np.meshgrid(np.linspace(-1.0, 9.1, 60), np.linspace(-0.5, 0.5, 7))
    return eyes, np.stack([x.ravel(), y.ravel(), rise * x.ravel()], axis=-1)


def test_cameras_carried_at_one_height_give_the_ground_below_them():
    random = np.random.default_rng(0)
    eyes, ground = walk(1.6 + random.normal(0.0, 0.03, 20))
    found = heights_below_cameras(eyes, ground)
    assert np.array_equal(found.x[:, 0], np.arange(10.0, 20.0)), "those without ground"
    off = np.abs(found.x[:, 2] - 0.05 * found.x[:, 0])
    assert off.max() < 0.1 and (off < found.error).mean() > 0.6
    assert (found.error > 0.1).all() and (found.error < 0.12).all()


def test_no_height_comes_from_differing_cameras_or_few_or_if_all_have_ground():
    random = np.random.default_rng(0)
    eyes, ground = walk(random.uniform(1.0, 3.0, 20))
    assert not len(heights_below_cameras(eyes, ground).x)
    eyes, ground = walk(np.full(20, 1.6))
    assert not len(heights_below_cameras(eyes[6:], ground).x), "four cameras"
    assert len(heights_below_cameras(eyes[5:], ground).x) == 10, "five"
    assert not len(heights_below_cameras(eyes[:10], ground).x), "all have ground"
    assert not len(heights_below_cameras(eyes, ground[:4]).x), "four ends"


def test_a_camera_that_leaves_the_ground_is_not_carried():
    """A drone climbs straight up from the end of the path."""
    eyes, ground = walk(np.full(12, 1.6))
    climb = np.stack([np.full(6, 10.5), np.zeros(6), 4.0 + 3.0 * np.arange(6)], axis=-1)
    found = heights_below_cameras(np.concatenate([eyes, climb]), ground)
    assert np.allclose(found.x, [(10.0, 0.0, 0.5), (11.0, 0.0, 0.55)], atol=1e-2)


def test_the_error_grows_into_the_hole():
    terrain = find_terrain(*below_cameras(1.4))
    assert terrain is not None
    at_rim, within = (at(terrain, terrain.error, x, 0.0) for x in (1.8, 0.0))
    assert within > at_rim + 0.03


def test_a_lens_that_distorts_strongly_does_not_open_the_hole():
    """The polynomial folds back: points far beside the frame are projected into it."""
    ground, photos = below_cameras()
    bent = replace(CAMERA, k1=-0.3)
    local = np.array([[0.0, 1.75, 1.0]])
    inside = (bent.project(local) >= 0) & (bent.project(local) < (64, 48))
    assert inside.all(), "the test has such points"
    terrain = find_terrain(ground, replace(photos, cameras=(bent,)))
    assert terrain is not None
    hole = (np.abs(terrain.nodes()[..., :2]) < 0.6).all(-1)
    assert terrain.completed[hole].mean() > 0.95


def test_no_floor_is_invented_across_a_valley():
    """Photos from one side look over a ravine of 6 m at the other side, and into it."""
    sides = [Box((-9, -9, -6), (9, -2, 0), GREY), Box((-9, 4, -6), (9, 9, 0), GREY)]
    floor = Box((-9, -9, -6), (9, 9, -5), GREY)
    ravine = LabelledField([*sides, floor], classes=(TERRAIN,) * 3, box=BOX)
    eyes = [(x, -4.0, 1.6) for x in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    terrain = find_terrain(ravine, scene(eyes, ahead=(0.0, 2.0, -1.0)))
    assert terrain is not None
    x, y = terrain.nodes()[..., 0], terrain.nodes()[..., 1]
    middle = (np.abs(x) < 2.5) & (y > -1.2) & (y < 3.2) & (terrain.height > -3)
    assert not terrain.completed[middle].any()


def test_ground_that_is_known_too_badly_is_not_completed(monkeypatch):
    monkeypatch.setattr(ground_evidence, "MAX_ERROR", 0.03)
    terrain = find_terrain(*below_cameras(1.4))
    assert terrain is not None
    badly = ~terrain.seen & (terrain.error > 0.03)
    assert badly.sum() > 10 and terrain.open[badly].all()


def test_the_terrain_is_deterministic(found):
    again = find_terrain(field(), scene())
    assert again is not None and same(found[0], again)


# --- the run folder -----------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch, found):
    """Calls of `find_terrain`, which is replaced by its result."""
    calls, (made, _) = [], found

    def find(field, scene, progress=None):
        calls.append(1)
        if progress is not None:
            progress(0.5)
        return made

    monkeypatch.setattr(run_terrain, "find_terrain", find)
    return calls


def test_the_terrain_of_a_run_is_made_once_and_then_read(tmp_path, counted):
    reports = []
    given = tmp_path, field(), scene(), "one"
    first = terrain_of_run(*given, lambda *step: reports.append(step))
    assert reports == [("ground", 0.0), ("ground", 0.5), ("ground", 1.0)]
    assert same(first, load_terrain(tmp_path / FILE_NAME)[0])
    reports.clear()
    second = terrain_of_run(*given, lambda *step: reports.append(step))
    assert same(first, second) and len(counted) == 1 and not reports


def test_another_checkpoint_makes_it_again(tmp_path, counted):
    for checkpoint in ("one", "two", "two", "one"):
        assert terrain_of_run(tmp_path, field(), scene(), checkpoint) is not None
        assert load_terrain(tmp_path / FILE_NAME)[1] == checkpoint
    assert len(counted) == 3


def test_the_absence_of_ground_is_found_once(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(run_terrain, "find_terrain", lambda *_: calls.append(1))
    assert [terrain_of_run(tmp_path, field(), scene(), "one") for _ in range(2)] == [None, None]
    assert len(calls) == 1


def test_a_folder_that_cannot_be_written_has_a_terrain(tmp_path, counted, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    for _ in range(2):
        assert terrain_of_run(tmp_path, field(), scene(), "one") is not None
    assert len(counted) == 2 and not list(tmp_path.iterdir())


def test_a_damaged_terrain_is_refused_in_one_sentence(tmp_path, counted):
    (tmp_path / FILE_NAME).write_bytes(b"PK")
    with pytest.raises(UserError, match="delete it, and the next render makes it again"):
        terrain_of_run(tmp_path, field(), scene(), "one")
    (tmp_path / FILE_NAME).unlink()
    assert terrain_of_run(tmp_path, field(), scene(), "one") is not None


def test_the_raster_reaches_far_ground_but_no_stray_end():
    rng = np.random.default_rng(0)
    near = rng.uniform(-10, 10, (9900, 3))
    far = rng.uniform((-5, 38, 0), (5, 42, 0.1), (95, 3))  # one in a hundred
    stray = np.array([[0.0, 900.0, 0.0], [-700.0, 0.0, 0.0]])
    origin, cell, (rows, columns) = ground_evidence._raster(
        np.concatenate([near, far, stray]), np.array([[0.0, 0.0, 1.6]])
    )
    assert 40 < origin[1] + cell * (rows - 1) < 60
    assert origin[0] > -20 and origin[0] + cell * (columns - 1) < 20
    assert max(rows, columns) <= ground_evidence.MAX_NODES + 1
