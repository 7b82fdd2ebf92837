"""The terrain raster: interpolation between nodes, and its file."""

import dataclasses

import numpy as np
import pytest

from climatenerf.core.classes import ROAD, TERRAIN, UNKNOWN, VEHICLE
from climatenerf.core.errors import UserError
from climatenerf.scene.terrain import (
    FILE_NAME,
    MAX_NODES,
    Terrain,
    load_terrain,
    nearest_known,
    save_terrain,
)


def terrain(rows=6, columns=9, seed=0):
    random = np.random.default_rng(seed)
    seen = random.random((rows, columns)) < 0.6
    return Terrain(
        origin=(-3.25, 17.5),
        cell=0.4,
        height=random.normal(size=(rows, columns)).astype(np.float32),
        error=random.random((rows, columns)).astype(np.float32),
        label=np.where(seen, random.choice([ROAD, TERRAIN], (rows, columns)), UNKNOWN).astype(
            np.uint8
        ),
        seen=seen,
        open=~seen & (random.random((rows, columns)) < 0.5),
    )


def stored(folder, **changes):
    """A terrain file some of whose arrays are changed; None leaves one out."""
    path = save_terrain(terrain(), folder, "abc")
    with np.load(path) as file:
        values = {**file, **{name: np.asarray(v) for name, v in changes.items()}}
    for name, value in changes.items():
        if value is None:
            del values[name]
    np.savez_compressed(path, **values)
    return path


# --- interpolation ------------------------------------------------------------------------------


def test_interpolation_is_bilinear_and_the_border_continues():
    ground = terrain(40, 30)
    nodes = ground.nodes()
    ramp = 2.0 * nodes[..., 0] - 0.5 * nodes[..., 1] + 1.0
    twisted = nodes[..., 0] * nodes[..., 1]
    low, high = nodes[0, 0, :2], nodes[-1, -1, :2]
    xy = np.random.default_rng(1).uniform(low - 5, high + 5, (500, 2))
    inside = np.clip(xy, low, high)
    assert np.allclose(ground.sample(ramp, xy), 2 * inside[:, 0] - 0.5 * inside[:, 1] + 1)
    on_line = inside.copy()
    on_line[:, 0] = nodes[3, 7, 0]  # along a lattice line a product is linear
    assert np.allclose(ground.sample(twisted, on_line), on_line[:, 0] * on_line[:, 1])
    assert np.allclose(ground.sample(ground.height, nodes[..., :2].reshape(-1, 2)),
                       ground.height.reshape(-1), atol=1e-6)  # fmt: skip
    assert np.array_equal(ground.contains(xy), ((xy >= low) & (xy <= high)).all(-1))


def test_rows_run_along_y_and_columns_along_x():
    nodes = terrain().nodes()
    assert nodes.shape == (6, 9, 3)
    assert np.allclose(nodes[0, 0, :2], (-3.25, 17.5))
    assert np.allclose(
        nodes[2, 5] - nodes[0, 0], (5 * 0.4, 2 * 0.4, nodes[2, 5, 2] - nodes[0, 0, 2])
    )


def test_every_node_is_seen_open_or_completed():
    ground = terrain(50, 50)
    parts = ground.seen.astype(int) + ground.open + ground.completed
    assert (parts == 1).all() and ground.completed.any()


def test_the_nearest_known_node_and_its_distance():
    known = np.zeros((5, 7), bool)
    known[1, 2] = known[4, 6] = True
    distance, (row, column) = nearest_known(known, 0.5)
    assert (row[0, 0], column[0, 0]) == (1, 2) and (row[3, 6], column[3, 6]) == (4, 6)
    assert distance[0, 0] == pytest.approx(0.5 * np.sqrt(5)) and distance[1, 2] == 0


# --- the file -----------------------------------------------------------------------------------


def test_a_saved_terrain_is_read_back_with_its_checkpoint(tmp_path):
    ground = terrain()
    path = save_terrain(ground, tmp_path, "of this field")
    assert path == tmp_path / FILE_NAME
    found, checkpoint = load_terrain(path)
    assert checkpoint == "of this field" and found is not None
    assert (found.origin, found.cell) == (ground.origin, ground.cell)
    for field in dataclasses.fields(Terrain)[2:]:
        before, after = getattr(ground, field.name), getattr(found, field.name)
        assert before.dtype == after.dtype and np.array_equal(before, after), field.name


def test_the_absence_of_ground_is_saved_too(tmp_path):
    path = save_terrain(terrain(), tmp_path, "first")
    save_terrain(None, tmp_path, "second")
    assert load_terrain(path) == (None, "second")
    assert [p.name for p in tmp_path.iterdir()] == [FILE_NAME]


def refusal(path):
    with pytest.raises(UserError) as error:
        load_terrain(path)
    message = str(error.value)
    assert message.count("\n") == 0 and len(message) < 600 and str(path) in message
    assert "delete it, and the next render makes it again" in message or "newer" in message
    return message


HOLE, HUGE = terrain().height.copy(), terrain().height.copy()
HOLE[2, 3], HUGE[2, 3] = np.nan, 1e30


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "changes",
    [
        {"height": HOLE},
        {"height": HUGE},
        {"height": HUGE.astype(np.float64) * 1e30},
        {"height": np.zeros((6, 8), np.float32)},
        {"height": np.zeros(9, np.float32)},
        {"height": np.zeros((0, 9), np.float32)},
        {"height": np.full((6, 9), "high")},
        {"height": np.ones((6, 9), np.complex64)},
        {"error": HOLE},
        {"error": -np.ones((6, 9), np.float32)},
        {"error": None},
        {"label": np.full((6, 9), VEHICLE, np.uint8)},
        {"label": np.full((6, 9), 256 + ROAD)},
        {"label": np.full((6, 9), np.nan)},
        {"seen": np.ones((1, 1), bool)},
        {"open": None},
        {"origin": [1.0]},
        {"origin": 1.0},
        {"origin": [0.0, np.inf]},
        {"origin": [0.0, 1e12]},
        {"cell": 0.0},
        {"cell": -1.0},
        {"cell": np.nan},
        {"cell": [0.1, 0.1]},
        {"cell": 1e9},
        {"schema_version": np.nan},
        {"schema_version": np.inf},
        {"schema_version": "one"},
        {"schema_version": None},
        {"checkpoint": None},
    ],
    ids=lambda changes: "-".join(f"{k}={v}"[:24].replace("\n", " ") for k, v in changes.items()),
)
def test_values_that_no_terrain_has_are_refused(tmp_path, changes):
    assert "damaged" in refusal(stored(tmp_path, **changes))


def test_a_huge_raster_is_refused(tmp_path):
    shape = (MAX_NODES + 1, 2)
    large = {name: np.zeros(shape, np.float32) for name in ("height", "error")}
    large |= {"label": np.zeros(shape, np.uint8)}
    large |= {name: np.zeros(shape, bool) for name in ("seen", "open")}
    assert str(shape) in refusal(stored(tmp_path, **large))


def test_a_newer_version_is_named(tmp_path):
    newer = refusal(stored(tmp_path, schema_version=3))
    assert "was written by a newer version of climatenerf; update" in newer


def test_a_raster_of_an_earlier_method_is_of_no_field(tmp_path):
    """So that it is made again."""
    found, checkpoint = load_terrain(stored(tmp_path, schema_version=1))
    assert found is not None and checkpoint == ""
    assert load_terrain(stored(tmp_path))[1] == "abc"


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / FILE_NAME
    refusal(path)
    for content in (b"", b"not a raster", b"PK\x03\x04" + bytes(100)):
        path.write_bytes(content)
        refusal(path)
    np.savez(path, depth=np.zeros(3))
    assert "schema_version" in refusal(path)
    np.savez(path, schema_version=np.array([{"a": 1}], dtype=object))
    refusal(path)
    path.unlink()
    path.mkdir()
    refusal(path)


def test_damaged_bytes_never_escape_as_another_error(tmp_path):
    """Whatever byte changes, the file is read or refused."""
    path = save_terrain(terrain(), tmp_path, "abc")
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for k in range(300):
        bytes_ = bytearray(whole)
        if k % 3 == 0:
            bytes_ = bytes_[: random.integers(len(whole))]
        else:
            bytes_[random.integers(len(whole))] ^= 1 << int(random.integers(8))
        path.write_bytes(bytes_)
        try:
            found, _ = load_terrain(path)
        except UserError:
            refused += 1
        else:
            assert found is None or np.isfinite(found.height).all()
    assert refused > 200
