"""Renders that are killed, run out of disk, or share their folder with others."""

import contextlib
import errno
import json
import os
import random
import signal
import time

import pytest
from support.render_jobs import SCENE, files_of, make_job, noise_of, render_whole, start

from climatenerf.core import storage
from climatenerf.core.errors import UserError
from climatenerf.output import job as jobs
from climatenerf.output import render_folder
from climatenerf.output.job import frames_of_part, join, render_frames, render_movie

FRAMES = 12
EARLIER, LATER = 9.0, 50.0  # visibilities of two renders


def render(job, out, **options):
    return render_movie(job, SCENE, out, lambda: noise_of(job), **options)


def left_over(folder):
    """What killed processes leave."""
    scratch = list((folder / ".frames").glob("unfinished-*"))
    return scratch + [path for path in folder.rglob("*") if storage.is_temporary(path.name)]


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Files of both renders alone in a folder."""
    folder = tmp_path_factory.mktemp("expected")
    for visibility in (EARLIER, LATER):
        render(make_job(FRAMES, visibility), folder / str(visibility))
    return {v: files_of(folder / str(v)) for v in (EARLIER, LATER)}


def killed_somewhere(out, seconds):
    """Render the later job in a process that is killed within some seconds, if it still runs."""
    process = start(render_whole, out, FRAMES, LATER)
    process.join(seconds)
    process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def kill_at_random(tmp_path, expected, kills):
    """Kill renders that replace another one, at random times, until they have ended."""
    for out in (tmp_path / "first", tmp_path / "timed"):  # the first starts the server
        begun = time.monotonic()
        start(render_whole, out, FRAMES, LATER).join()
        duration = time.monotonic() - begun
    rng = random.Random(1)
    for number in range(kills):
        out = tmp_path / str(number)
        render(make_job(FRAMES, EARLIER), out)
        while killed_somewhere(out, rng.uniform(0.2, 1.1) * duration):
            found = files_of(out)
            current = json.loads(found[".frames/render.json"])["render"]
            if current == make_job(FRAMES, EARLIER).key:
                assert found.items() >= expected[EARLIER].items(), "the earlier render is whole"
            if rng.random() < 0.3:
                break
        render(make_job(FRAMES, LATER), out)
        assert files_of(out) == expected[LATER]
        join(make_job(FRAMES, LATER), SCENE, out)
        assert not left_over(out)


def test_a_render_that_is_killed_resumes_and_leaves_the_earlier_one_whole(tmp_path, expected):
    kill_at_random(tmp_path, expected, 2)


@pytest.mark.slow
def test_many_renders_are_killed_at_random(tmp_path, expected):
    kill_at_random(tmp_path, expected, 60)


def test_a_killed_first_render_resumes(tmp_path, expected):
    process = start(render_whole, tmp_path, FRAMES, LATER)
    while process.is_alive() and len(list((tmp_path / "frames").glob("*.png"))) < 2:
        time.sleep(0.001)
    process.kill()
    process.join()
    render(make_job(FRAMES, LATER), tmp_path)
    assert files_of(tmp_path) == expected[LATER] and not left_over(tmp_path)


@pytest.mark.parametrize("place", ["in files", "when they are flushed"])
def test_a_full_disk_leaves_the_earlier_render_whole(tmp_path, expected, monkeypatch, place):
    earlier, later = make_job(FRAMES, EARLIER), make_job(FRAMES, LATER)
    render(earlier, tmp_path)
    failures = 0
    for allowed in range(200):
        with monkeypatch.context() as patch:
            full_disk(patch, allowed, place)
            try:
                render(later, tmp_path)
                break
            except UserError as error:
                failures += 1
                assert "disk is full" in str(error) and "unharmed" not in str(error)
        if render_folder.current_render(tmp_path)["render"] == earlier.key:
            assert files_of(tmp_path).items() >= expected[EARLIER].items()
            assert not jobs.missing_frames(earlier, tmp_path)
        assert not left_over(tmp_path)
    assert failures > 4 and files_of(tmp_path) == expected[LATER]


def full_disk(patch, allowed, place):
    """Let the disk be full after some writes."""
    count = [0]
    name = "write_bytes" if place == "in files" else "fsync"
    owner = storage.Path if place == "in files" else os
    real = getattr(owner, name)

    def limited(*args):
        count[0] += 1
        if count[0] > allowed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*args)

    patch.setattr(owner, name, limited)


def test_without_ffmpeg_the_earlier_movie_stays(tmp_path, expected, monkeypatch):
    earlier, later = make_job(FRAMES, EARLIER), make_job(FRAMES, LATER)
    render(earlier, tmp_path)
    with monkeypatch.context() as patch:
        patch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "absent"))
        with pytest.raises(UserError, match="keeps its earlier movie until the same command"):
            render(later, tmp_path)
    assert files_of(tmp_path).items() >= expected[EARLIER].items()
    render(later, tmp_path)
    assert files_of(tmp_path) == expected[LATER]


def test_ctrl_c_while_the_movie_is_made_leaves_the_earlier_render(tmp_path, expected):
    earlier, later = make_job(FRAMES, EARLIER), make_job(FRAMES, LATER)
    render(earlier, tmp_path)

    def stop(what, fraction):
        if what == "movie":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(later, tmp_path, progress=stop)
    assert files_of(tmp_path).items() >= expected[EARLIER].items()
    render_movie(later, SCENE, tmp_path, lambda: pytest.fail("all frames are finished"))
    assert files_of(tmp_path) == expected[LATER]


def test_ctrl_c_during_the_promotion_takes_effect_after_it(tmp_path, expected, monkeypatch):
    earlier, later = make_job(FRAMES, EARLIER), make_job(FRAMES, LATER)
    render(earlier, tmp_path)
    render_frames(later, tmp_path, lambda: noise_of(later), range(FRAMES))
    real, moved = render_folder.move, []

    def interrupted(*args):
        moved.append(args)
        if len(moved) == 5:
            raise KeyboardInterrupt
        real(*args)

    monkeypatch.setattr(render_folder, "move", interrupted)
    with pytest.raises(KeyboardInterrupt):
        join(later, SCENE, tmp_path)
    assert files_of(tmp_path) == expected[LATER]


def test_an_unfinished_replacement_can_be_dropped_without_the_earlier_render(tmp_path, expected):
    earlier, later = make_job(FRAMES, EARLIER), make_job(FRAMES, LATER)
    render(earlier, tmp_path)
    render_frames(later, tmp_path, lambda: noise_of(later), [0])
    third = make_job(FRAMES, visibility=5.0)
    with pytest.raises(UserError, match="unfinished render") as caught:
        render(third, tmp_path)
    named = tmp_path / ".frames" / "next"
    assert str(caught.value).endswith(f"or remove {named}")
    storage.remove(named)
    assert files_of(tmp_path) == expected[EARLIER]
    render(third, tmp_path)
    assert not jobs.missing_frames(third, tmp_path)


def test_a_stopped_part_does_not_replace_the_sidecar_of_the_whole(tmp_path, expected):
    """Another process finishes and joins the render while one is stopped."""
    job = make_job(FRAMES, LATER)

    def source():
        def frame(index, preview):
            render(job, tmp_path)
            raise KeyboardInterrupt

        return frame

    with pytest.raises(KeyboardInterrupt):
        render_movie(job, SCENE, tmp_path, source)
    assert files_of(tmp_path) == expected[LATER]


def test_files_of_dead_processes_are_removed_and_files_of_live_ones_kept(tmp_path):
    job = make_job(4)
    with contextlib.ExitStack() as live:
        used = live.enter_context(storage.atomic_path(tmp_path / "preview.png"))
        used.write_bytes(b"at work")
        scratch = live.enter_context(render_folder.unfinished_files(tmp_path))
        (scratch / "frames").mkdir()
        (scratch / "frames" / "0000.png").write_bytes(b"at work")
        dead = start(leave_temporary_files, tmp_path)
        dead.join()
        assert len(left_over(tmp_path)) == 2 + 5
        render_frames(job, tmp_path, lambda: noise_of(job), frames_of_part(job, (1, 2)))
        assert sorted(left_over(tmp_path)) == sorted([used, scratch])
        render(job, tmp_path)
        assert sorted(left_over(tmp_path)) == sorted([used, scratch])
        assert (scratch / "frames" / "0000.png").read_bytes() == b"at work"


def leave_temporary_files(out):
    """Entry point of a process that ends at once while it writes."""
    names = ["movie.mp4", "frames/0001.png", ".frames/render.json", ".frames/next/depth/0001.npz"]
    with contextlib.ExitStack() as stack:
        for name in names:
            stack.enter_context(storage.atomic_path(out / name)).write_bytes(b"half")
        stack.enter_context(render_folder.unfinished_files(out))
        os._exit(9)
