"""Render jobs: keys of finished frames, parts, restarts, and two processes at once."""

import contextlib
import dataclasses
import json
import multiprocessing
import os
import random
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image
from support.render_jobs import SCENE, files_of, join_parts, make_job, noise_of, render_part

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.output import job as jobs
from climatenerf.output import render_folder
from climatenerf.output.frame_source import measured
from climatenerf.output.job import frames_of_part, join, render_frames, render_movie
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather


def render(job, out, **options):
    return render_movie(job, SCENE, out, lambda: noise_of(job), **options)


def never():
    raise AssertionError("nothing is to be rendered")


# --- keys -------------------------------------------------------------------------------------


def other_path(job, **changes):
    return dataclasses.replace(job, path=dataclasses.replace(job.path, **changes))


def test_a_frame_key_depends_on_everything_that_a_frame_depends_on(monkeypatch):
    job = make_job(3)
    moved, zoomed = job.path.c2w.copy(), dataclasses.replace(job.path.cameras[0], fx=21.0)
    moved[2, 1, 3] = 0.5  # the lattice of snow depends on all cameras
    later = KeyframedWeather(Weather(snow=Snow(depth=0.1)), {"snow.depth": ((0, 0.1), (9, 0.2))})
    others = [
        dataclasses.replace(job, run="another run"),
        dataclasses.replace(job, fps=24.0),
        dataclasses.replace(job, weather=KeyframedWeather(Weather(seed=1), {})),
        dataclasses.replace(job, weather=later),
        dataclasses.replace(job, supersample=2),
        dataclasses.replace(job, layers=("depth", "normal")),
        dataclasses.replace(job, formats=("png",)),
        dataclasses.replace(job, appearance=0),
        dataclasses.replace(job, complete_ground=False),
        other_path(job, c2w=moved),
        other_path(job, cameras=(zoomed, *job.path.cameras[1:])),
        make_job(4),
    ]
    keys = [each.frame_key(0) for each in (job, *others)] + [job.frame_key(1)]
    monkeypatch.setattr(climatenerf, "__version__", "99")
    keys.append(make_job(3).frame_key(0))
    assert len(set(keys)) == len(keys)


def test_a_frame_key_is_the_same_in_another_process_and_after_roundings():
    job = make_job(3)
    rounded = other_path(job, c2w=job.path.c2w + 1e-12)
    code = "from support.render_jobs import make_job; print(make_job(3).key)"
    paths = {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "5"}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **paths}, capture_output=True, text=True
    )
    assert job.key == rounded.key == done.stdout.strip(), done.stderr


def test_the_hash_of_a_run_depends_on_its_field_and_scene(tmp_path):
    (tmp_path / "field.safetensors").write_bytes(b"a")
    with pytest.raises(UserError, match="scene.json"):
        jobs.hash_of_run(tmp_path)
    hashes = set()
    for field, scene in ((b"a", "{}"), (b"b", "{}"), (b"b", "{ }")):
        (tmp_path / "field.safetensors").write_bytes(field)
        (tmp_path / "scene.json").write_text(scene)
        (tmp_path / "metrics.json").write_text(scene)
        hashes.add(jobs.hash_of_run(tmp_path))
    assert len(hashes) == 3


# --- parts and restarts -----------------------------------------------------------------------


def test_parts_hold_every_nth_frame():
    job = make_job(40)
    assert list(frames_of_part(job, (3, 16))) == [2, 18, 34]
    assert list(frames_of_part(job)) == list(range(40))
    parts = [index for number in range(1, 8) for index in frames_of_part(job, (number, 7))]
    assert sorted(parts) == list(range(40))
    assert not list(frames_of_part(job, (41, 41)))


def test_a_render_writes_frames_layers_movie_and_sidecar(tmp_path):
    job, reports = make_job(3), []
    movie = render(job, tmp_path, progress=lambda *step: reports.append(step))
    assert movie == tmp_path / "movie.mp4"
    sidecar = json.loads((tmp_path / "movie.json").read_text())
    assert [frame["file"] for frame in sidecar["frames"]] == [
        f"frames/000{i}.png" for i in range(3)
    ]
    assert sidecar["frames"][2]["time"] == 2 / 12 and sidecar["fact"] == 1.5
    assert sidecar["frames"][1]["layers"] == {"depth": ["depth/0001.npz"]}
    assert sidecar["render"] == job.key and sidecar["frames_wanted"] == 3
    expected = noise_of(job)(1, None)
    with Image.open(tmp_path / "frames" / "0001.png") as picture:
        assert picture.info["key"] == job.frame_key(1) and "simulated" in picture.info
        assert np.array_equal(np.asarray(picture), expected.picture)
    depth = np.load(tmp_path / "depth" / "0001.npz")["depth"]
    assert np.array_equal(depth, expected.layers["depth"])
    assert sidecar["frames"][1]["measured"] == measured(expected.layers)
    fractions = [fraction for what, fraction in reports if what == "frames"]
    assert fractions == [0, 1 / 3, 2 / 3, 1] and reports[-1] == ("movie", 1.0)


def test_the_same_call_on_a_finished_render_writes_nothing(tmp_path):
    render(make_job(), tmp_path)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    render_movie(make_job(), SCENE, tmp_path, never)
    after = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    before.pop(lock := tmp_path / ".frames" / "lock", None)
    after.pop(lock, None)
    assert after == before


@pytest.mark.parametrize("name", ["frames/0002.png", "depth/0002.npz", ".frames/0002.json"])
@pytest.mark.parametrize("spoil", ["remove", "cut"])
def test_a_frame_with_a_missing_or_damaged_file_is_rendered_again(tmp_path, name, spoil):
    job = make_job(4)
    render(job, tmp_path)
    whole = files_of(tmp_path)
    path = tmp_path / name
    path.unlink() if spoil == "remove" else path.write_bytes(path.read_bytes()[:40])
    assert jobs.missing_frames(job, tmp_path) == [2]
    render(job, tmp_path)
    assert files_of(tmp_path) == whole


def test_a_picture_of_another_render_does_not_count(tmp_path):
    job, other = make_job(2), make_job(2, visibility=9.0)
    render(job, tmp_path / "a")
    render(other, tmp_path / "b")
    for name in ("frames/0001.png", "depth/0001.npz"):
        os.replace(tmp_path / "b" / name, tmp_path / "a" / name)
    sizes = [(tmp_path / "a" / name).stat().st_size for name in job.files(1)]
    record = tmp_path / "a" / ".frames" / "0001.json"
    written = json.loads(record.read_text())
    written["files"] = dict(zip(job.files(1), sizes, strict=True))
    record.write_text(json.dumps(written))
    assert jobs.missing_frames(job, tmp_path / "a") == [1]


def test_joining_with_frames_missing_names_them_and_changes_nothing(tmp_path):
    job = make_job(20)
    with pytest.raises(UserError, match="20 of 20 frames"):
        join(job, SCENE, tmp_path / "absent")
    assert not (tmp_path / "absent").exists()
    render_frames(job, tmp_path, lambda: noise_of(job), frames_of_part(job, (1, 2)))
    before = files_of(tmp_path)
    with pytest.raises(UserError, match=r"10 of 20 frames.*\(0001, 0003, 0005, 0007, 0009, \.\.\."):
        join(job, SCENE, tmp_path)
    assert files_of(tmp_path) == before


def test_a_stopped_render_leaves_a_sidecar_of_its_frames_and_resumes(tmp_path):
    job = make_job(4)

    def stopping():
        source = noise_of(job)

        def frame(index, preview):
            if index == 2:
                raise KeyboardInterrupt
            return source(index, preview)

        return frame

    with pytest.raises(KeyboardInterrupt):
        render_movie(job, SCENE, tmp_path / "a", stopping)
    sidecar = json.loads((tmp_path / "a" / "movie.json").read_text())
    assert len(sidecar["frames"]) == 2 and sidecar["frames_wanted"] == 4
    render(job, tmp_path / "a")
    render(job, tmp_path / "b")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_a_preview_shows_the_current_frame_and_is_removed(tmp_path):
    job, seen = make_job(2), []

    def source():
        def frame(index, preview):
            made = noise_of(job)(index, preview)
            with Image.open(tmp_path / "preview.png") as picture:
                seen.append(np.array_equal(np.asarray(picture), made.picture))
            return made

        return frame

    render_movie(job, SCENE, tmp_path, source, preview=True)
    assert seen == [True, True] and not (tmp_path / "preview.png").exists()


# --- another render in the folder -------------------------------------------------------------


def test_a_complete_render_stays_until_the_next_one_is_complete(tmp_path):
    first, second = make_job(6), make_job(3, visibility=9.0, layers=("transmittance",))
    render(first, tmp_path / "a")
    before = files_of(tmp_path / "a")
    (tmp_path / "a" / "frames" / "mine.png").write_bytes(b"mine")
    render_frames(second, tmp_path / "a", lambda: noise_of(second), [0, 2])
    during = files_of(tmp_path / "a")
    assert {name: during[name] for name in before} == before
    with pytest.raises(UserError, match="1 of 3 frames"):
        join(second, SCENE, tmp_path / "a")
    third = make_job(3, visibility=5.0)
    with pytest.raises(UserError, match="unfinished render with other settings"):
        render_movie(third, SCENE, tmp_path / "a", never)
    assert files_of(tmp_path / "a") == during
    render(second, tmp_path / "a")
    render(second, tmp_path / "b")
    assert (tmp_path / "a" / "frames" / "mine.png").read_bytes() == b"mine"
    (tmp_path / "a" / "frames" / "mine.png").unlink()
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_an_unfinished_render_is_never_touched_by_another(tmp_path):
    first, second = make_job(), make_job(visibility=9.0)
    render_frames(first, tmp_path, lambda: noise_of(first), [0, 1])
    before = files_of(tmp_path)
    for indices in ([0], range(8)):
        with pytest.raises(UserError, match="unfinished render with other settings"):
            render_frames(second, tmp_path, never, indices)
    assert files_of(tmp_path) == before


def test_a_slow_process_does_not_write_into_the_render_that_followed(tmp_path):
    slow, following = make_job(2), make_job(2, visibility=9.0)

    def source():
        def frame(index, preview):
            if index == 1:  # other processes finish this render and the next one meanwhile
                render(slow, tmp_path)
                render(following, tmp_path)
            return noise_of(slow)(index, preview)

        return frame

    with pytest.raises(UserError, match="has replaced this one"):
        render_frames(slow, tmp_path, source, range(2))
    after = files_of(tmp_path)
    render(following, tmp_path / "expected")
    expected = files_of(tmp_path / "expected")
    assert after == expected


def test_a_render_of_an_earlier_version_without_records_is_replaced(tmp_path):
    job = make_job(2)
    (tmp_path / "frames").mkdir()
    names = [f"frames/{index:04d}.png" for index in range(3)]
    for name in names:
        (tmp_path / name).write_bytes(b"an older version's")
    frames = [{"file": name, "layers": {}} for name in names]
    (tmp_path / "movie.json").write_text(json.dumps({"frames": frames}))
    (tmp_path / "movie.mp4").write_bytes(b"an older version's")
    render(job, tmp_path)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["0000.png", "0001.png"]
    assert len((tmp_path / "movie.mp4").read_bytes()) > 500


def test_foreign_files_are_refused_before_anything_is_written(tmp_path):
    job = make_job(2)
    for name in ("frames/0001.png", "movie.json", "movie.mp4", "depth/0001.npz", "normal/0007.exr"):
        out = tmp_path / name.replace("/", "-")
        (out / name).parent.mkdir(parents=True)
        (out / name).write_bytes(b"mine")
        with pytest.raises(UserError, match="would be overwritten, and .* does not list it"):
            render_movie(job, SCENE, out, never)
        assert files_of(out) == {name: b"mine"}


# --- crashes and processes --------------------------------------------------------------------


class Crash(BaseException):
    """Simulates a kill; not an Exception, so that the code under test does not catch it."""


def crash_at(monkeypatch, step):
    """Raise before the `step`-th change of the folder's state; return how many there were."""
    count = [0]

    def counted(function):
        def call(*args, **options):
            count[0] += 1
            if count[0] == step:
                raise Crash
            return function(*args, **options)

        return call

    monkeypatch.setattr(render_folder, "move", counted(render_folder.move))
    monkeypatch.setattr(render_folder, "write_json", counted(render_folder.write_json))
    monkeypatch.setattr(jobs, "write_json", counted(jobs.write_json))
    return count


@pytest.mark.parametrize("replacing", [False, True])
def test_a_crash_at_any_point_loses_nothing(tmp_path, replacing):
    job, earlier = make_job(2), make_job(3, visibility=9.0)
    render(job, tmp_path / "expected")
    expected = files_of(tmp_path / "expected")
    for step in range(1, 100):
        out = tmp_path / str(step)
        if replacing:
            render(earlier, out)
            before = files_of(out)
        with pytest.MonkeyPatch.context() as patch:
            count = crash_at(patch, step)
            with contextlib.suppress(Crash):
                render_frames(job, out, lambda: noise_of(job), range(2))
                join(job, SCENE, out)
        if replacing:  # the earlier render is whole, or this one is
            whole = files_of(out).items() >= before.items()
            promoting = render_folder.current_render(out)["render"] == job.key
            assert whole or promoting, step
            third = make_job(2, visibility=5.0)  # any call finishes a promotion that has begun
            with contextlib.suppress(UserError):
                join(third, SCENE, out)
            assert files_of(out).items() >= (expected if promoting else before).items(), step
        render(job, out)
        assert files_of(out) == expected, step
        if count[0] < step:
            break
    assert step > (12 if replacing else 8)


def test_several_processes_write_the_same_files_as_one(tmp_path):
    """Two concurrent parts, one killed at random and restarted, then two concurrent joins."""
    frames, spawn = 20, multiprocessing.get_context("spawn")
    render(make_job(frames), tmp_path / "expected")
    expected = files_of(tmp_path / "expected")
    rng = random.Random(0)

    def start(target, *args):
        process = spawn.Process(target=target, args=args)
        process.start()
        return process

    for attempt in range(2):
        out = tmp_path / f"parts-{attempt}"
        killed = start(render_part, out, (1, 2), frames)
        other = start(render_part, out, (2, 2), frames)
        begun = out / "frames"
        while killed.is_alive() and not list(begun.glob("*.png")):
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.15))
        killed.kill()
        killed.join()
        again = start(render_part, out, (1, 2), frames)
        twin = start(render_part, out, (1, 2), frames) if attempt == 0 else again
        for process in (other, again, twin):
            process.join()
            assert process.exitcode == 0
        joins = [start(join_parts, out, frames) for _ in range(2)]
        for process in joins:
            process.join()
            assert process.exitcode == 0
        assert files_of(out) == expected


def test_a_file_system_without_locks_is_used_without_them(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise NotImplementedError

    monkeypatch.setattr("filelock.FileLock.acquire", refuse)
    render(make_job(2), tmp_path)
    assert (tmp_path / "movie.mp4").exists()
