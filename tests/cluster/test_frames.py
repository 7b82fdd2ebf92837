"""Frames on local workers: the bytes of one process, also when a worker is killed."""

import errno
import hashlib
import os
import random
import signal
import time
from pathlib import Path

import psutil
import pytest
from support.render_jobs import SCENE, files_of, is_left_over, make_job, noise_frame, noise_of

from climatenerf.cluster.frames import renderer
from climatenerf.cluster.workers import LOG
from climatenerf.core.errors import UserError
from climatenerf.output.job import missing_frames, render_movie

FRAMES = 16


class SlowNoise:
    """A frame source that takes a while, and notes which frames it renders."""

    def __init__(self, job, notes: Path, seconds: float = 0.25):
        self.job, self.notes, self.seconds = job, notes, seconds

    def __call__(self, index, preview):
        with self.notes.open("a") as file:
            file.write(f"{index}\n")
        time.sleep(self.seconds)
        return noise_frame(self.job, index, preview)


class KillsItsWorker(SlowNoise):
    def __call__(self, index, preview):
        if index == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(index, preview)


class FullDisk(SlowNoise):
    def __call__(self, index, preview):
        def full(descriptor):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        if index == 3:
            os.fsync = full
        return super().__call__(index, preview)


def workers_alive() -> list[psutil.Process]:
    """Worker processes below this one: those that run a spawned main function."""
    below = psutil.Process().children(recursive=True)
    found = []
    for process in below:
        try:
            if "spawn_main" in " ".join(process.cmdline()):
                found.append(process)
        except psutil.Error:
            continue
    return found


def without_log(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: data for name, data in files.items() if name != LOG}


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    out = tmp_path_factory.mktemp("serial")
    job = make_job(FRAMES)
    render_movie(job, SCENE, out, lambda: noise_of(job))
    return files_of(out)


def test_a_killed_worker_costs_one_frame_and_the_bytes_are_those_of_one_process(tmp_path, expected):
    job, out, notes = make_job(FRAMES), tmp_path / "out", tmp_path / "notes"
    kill_at, killed = random.uniform(0.05, 0.9), []

    def progress(what, fraction):
        if what == "frames" and fraction >= kill_at and not killed:
            alive = workers_alive()
            killed.append(random.choice(alive))
            killed[0].kill()

    given = job, SCENE, out, lambda: SlowNoise(job, notes)
    render_movie(*given, progress=progress, render=renderer(2))
    assert killed, kill_at
    assert without_log(files_of(out)) == expected
    rendered = [int(line) for line in notes.read_text().split()]
    assert set(rendered) == set(range(FRAMES))
    # What the killed worker had at hand, and what the engine had given it beforehand, at most.
    assert len(rendered) <= FRAMES + 1, kill_at
    assert not any(is_left_over(p.relative_to(out).as_posix()) for p in out.rglob("unfinished-*"))
    assert f"frame {0:04d} took" in (out / LOG).read_text()


def test_finished_frames_are_not_rendered_again_and_nothing_starts_for_none(tmp_path, expected):
    job, out, notes = make_job(FRAMES), tmp_path / "out", tmp_path / "notes"

    class Stopped(Exception):
        pass

    def stop(what, fraction):
        if what == "frames" and fraction > 0.3:
            raise Stopped

    given = job, SCENE, out, lambda: SlowNoise(job, notes, 0.05)
    with pytest.raises(Stopped):
        render_movie(*given, progress=stop, render=renderer(2))
    assert not workers_alive()
    left = missing_frames(job, out)
    assert 0 < len(left) < FRAMES
    assert (out / "movie.json").is_file()  # the frames that are there have a sidecar
    notes.unlink()
    render_movie(*given, render=renderer(2))
    assert sorted(int(line) for line in notes.read_text().split()) == left
    assert without_log(files_of(out)) == expected

    def never():
        raise AssertionError("nothing is missing")

    render_movie(job, SCENE, out, never, render=renderer("tcp://127.0.0.1:9"))


def test_a_frame_that_ends_every_worker_is_named(tmp_path):
    job, out = make_job(6), tmp_path / "out"
    given = job, SCENE, out, lambda: KillsItsWorker(job, tmp_path / "notes", 0.05)
    with pytest.raises(UserError, match="frame 0002 has ended one worker after another.*memory"):
        render_movie(*given, render=renderer(1))
    assert 2 in missing_frames(job, out)
    render_movie(job, SCENE, out, lambda: noise_of(job))  # what is left is sound
    assert not missing_frames(job, out)


def test_a_full_disk_of_a_worker_is_one_sentence(tmp_path):
    job, out = make_job(6), tmp_path / "out"
    given = job, SCENE, out, lambda: FullDisk(job, tmp_path / "notes", 0.05)
    with pytest.raises(UserError, match=r"frame 0003 has failed on a worker: the disk is full"):
        render_movie(*given, render=renderer(1))
    render_movie(job, SCENE, out, lambda: noise_of(job))
    assert not missing_frames(job, out)


def test_a_preview_is_refused(tmp_path):
    job = make_job(2)
    with pytest.raises(UserError, match="preview"):
        render_movie(job, SCENE, tmp_path, lambda: noise_of(job), preview=True, render=renderer(1))


def test_a_changed_pickle_is_not_unpickled(tmp_path):
    from climatenerf.cluster.on_worker import Saved, unpickled, versions

    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "exploded"),)

    import pickle

    path = tmp_path / "prepared"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(UserError, match="holds something else"):
        unpickled(Saved(path, "0" * 64, versions()))
    right = hashlib.sha256(path.read_bytes()).hexdigest()
    old = versions() | {"torch": "1.0"}
    with pytest.raises(UserError, match="and the program has 1.0; install the same versions"):
        unpickled(Saved(path, right, old))
    assert not (tmp_path / "exploded").exists()
