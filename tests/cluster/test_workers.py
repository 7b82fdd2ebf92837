"""Workers that cannot do the work are refused, each in one sentence."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.render_jobs import SCENE, make_job, noise_of

from climatenerf.cluster import workers
from climatenerf.cluster.frames import renderer
from climatenerf.cluster.workers import connected, parse_workers, results
from climatenerf.core.errors import UserError
from climatenerf.output.job import missing_frames, render_movie


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("2", 2),
        (" 16 ", 16),
        ("tcp://10.0.0.1:8786", "tcp://10.0.0.1:8786"),
        ("tls://node-3:8786", "tls://node-3:8786"),
        ("login.cluster:8786", "tcp://login.cluster:8786"),
        ("[::1]:8786", "tcp://[::1]:8786"),
    ],
)
def test_numbers_and_addresses(text, meant):
    assert parse_workers(text) == meant


@pytest.mark.parametrize(
    "text", ["0", "-1", "257", "two", "", "tcp://", "host:", ":8786", "host:99999", "a b:1", "1.5"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(UserError, match="--workers must be a number of processes from 1 to 256"):
        parse_workers(text)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_nobody_listens(tmp_path):
    address = f"tcp://127.0.0.1:{free_port()}"
    out = tmp_path / "out"
    began = time.monotonic()
    with (
        pytest.raises(UserError, match=f"no Dask scheduler answers at {address}"),
        connected(address, out),
    ):
        pass
    assert time.monotonic() - began < 60
    assert not out.exists()


def test_a_program_that_is_no_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "CONNECT", 2.0)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        said = refusal(tmp_path, address)
    assert "no Dask scheduler answers at" in said
    assert time.monotonic() - began < 60  # it would wait for ever


def test_tls_without_certificates(tmp_path):
    said = refusal(tmp_path, f"tls://127.0.0.1:{free_port()}")
    assert "needs certificates" in said


def test_the_environment_stays(tmp_path):
    before = dict(os.environ)
    with connected(1, tmp_path) as client:
        assert client.submit(os.environ.get, "NUMBA_NUM_THREADS").result() is not None
    assert dict(os.environ) == before


@pytest.mark.parametrize("count", [0, -1, 257, "2x"])
def test_counts_out_of_range_are_refused(count):
    with pytest.raises(UserError, match="--workers must be a number"):
        renderer(count)


@contextlib.contextmanager
def scheduler(tmp_path, count=1, startup="", threads=1):
    """A scheduler with workers, each a program of its own as on a real cluster.

    Args:
        startup: code that each worker runs first.
    """
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(startup)
    port = free_port()
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    address = f"tcp://127.0.0.1:{port}"
    paths = site, Path(__file__).parents[1]
    own = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    started = [subprocess.Popen([*program, "--host", "127.0.0.1", "--port", str(port)], **quiet)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-dashboard"]
    worker += ["--nthreads", str(threads), "--nworkers", str(count), "--host", "127.0.0.1"]
    try:
        started.append(subprocess.Popen(worker, env=own, **quiet))
        wait_for_workers(address, count)
        yield address, started
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait(30)


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, timeout=60) as client:
        client.wait_for_workers(count, timeout=60)


def refusal(tmp_path, address: str) -> str:
    """The sentence by which a render on these workers is refused; it has written nothing."""
    job, out = make_job(4), tmp_path / "out"
    with pytest.raises(UserError) as caught:
        render_movie(job, SCENE, out, lambda: noise_of(job), render=renderer(address))
    assert not out.exists()
    return str(caught.value)


def test_a_worker_with_another_version(tmp_path):
    old = "import climatenerf; climatenerf.__version__ = '0.0.9'"
    with scheduler(tmp_path, startup=old) as (address, _):
        said = refusal(tmp_path, address)
    assert "has climatenerf 0.0.9 and the program has" in said and "same versions" in said


def test_a_worker_without_the_program(tmp_path):
    with scheduler(tmp_path, startup="import sys; sys.modules['climatenerf'] = None") as (at, _):
        said = refusal(tmp_path, at)
    assert "install climatenerf[cluster] on all machines" in said


def test_a_worker_with_several_task_threads(tmp_path):
    with scheduler(tmp_path, threads=2) as (address, _):
        said = refusal(tmp_path, address)
    assert "runs 2 tasks at once; start it with --nthreads 1" in said


def test_a_worker_that_does_not_see_the_folder(tmp_path):
    hidden = f"""
import pathlib
real = pathlib.Path.read_text
def read_text(self, *args, **named):
    if str(self).startswith({str(tmp_path / "out")!r}):
        raise FileNotFoundError(str(self))
    return real(self, *args, **named)
pathlib.Path.read_text = read_text
"""
    with scheduler(tmp_path, startup=hidden) as (address, _):
        said = refusal(tmp_path, address)
    assert f"does not see {tmp_path / 'out'}; give a folder that all machines share" in said


def test_a_scheduler_renders_and_its_end_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "ALONE", 2.0)
    monkeypatch.setitem(workers.SETTINGS, "distributed.comm.timeouts.connect", "2 s")
    with scheduler(tmp_path, count=2) as (address, started):
        whole = make_job(4)
        given = whole, SCENE, tmp_path / "whole", lambda: noise_of(whole)
        render_movie(*given, render=renderer(address))
        assert not missing_frames(whole, tmp_path / "whole")
        job = make_job(40)

        def stop(what, fraction):
            if what == "frames" and fraction > 0:
                for process in started:
                    process.kill()

        given = job, SCENE, tmp_path / "out", lambda: noise_of(job)
        said = "no worker is left|scheduler has ended or has dropped the work"
        with pytest.raises(UserError, match=said):
            render_movie(*given, progress=stop, render=renderer(address))


def test_a_scheduler_without_workers(tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as cluster:
        said = refusal(tmp_path, cluster.scheduler_address)
    assert "has no worker; start some with `dask worker ADDRESS --nthreads 1`" in said


def test_without_the_package_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r"pip install \"climatenerf\[cluster\]\""):
        workers.check_installed()


class Ending:
    """A piece of work whose worker dies with the result, before another repeats it."""

    status = "finished"

    def __init__(self, error=None):
        self.asked, self.error = 0, error

    def result(self, timeout):
        self.asked += 1
        if self.error is not None:
            self.status = "error"
            raise self.error
        if self.asked < 3:
            raise TimeoutError
        return "made"


def test_a_result_that_is_lost_with_its_worker_is_asked_for_again(tmp_path, monkeypatch):
    import distributed

    done = SimpleNamespace
    monkeypatch.setattr(distributed, "wait", lambda first, **_: done(done=set(first)))
    client = SimpleNamespace(
        status="running", nthreads=lambda: {"one": 1}, cancel=lambda *a, **k: 0
    )
    work = Ending()
    assert list(results(client, {work: "frame 1"}, tmp_path)) == [(work, "made")]
    assert work.asked == 3
    with pytest.raises(UserError, match="frame 1"):  # of the work itself, not of waiting for it
        list(results(client, {Ending(TimeoutError("slow disk")): "frame 1"}, tmp_path))
    monkeypatch.setattr("climatenerf.cluster.workers.ALONE", -1.0)
    client.nthreads = dict
    with pytest.raises(UserError, match="no worker is left"):
        list(results(client, {Ending(): "frame 1"}, tmp_path))
