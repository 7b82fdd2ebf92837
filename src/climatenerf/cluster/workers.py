"""Workers: processes of this machine, or those of a Dask scheduler that the user has started.

Processes of this machine speak TLS with keys of their own on the loopback interface, so that no
other user of the machine can give them work. What protects a real cluster is its own matter.
"""

import asyncio
import contextlib
import itertools
import logging
import os
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING, Any

from climatenerf.cluster import on_worker
from climatenerf.core.errors import UserError, explain, one_line
from climatenerf.core.locks import LOCK
from climatenerf.core.storage import make_folder, owned_name, write_bytes

if TYPE_CHECKING:
    from distributed import Client, Future

MAX_LOCAL = 256
CONNECT = 10.0
"""Seconds within which a scheduler must answer."""
SETTINGS = {
    "distributed.scheduler.allowed-failures": 3,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.comm.timeouts.connect": f"{CONNECT} s",
}
ALONE = 60.0
"""Seconds without any worker after which the program gives up."""
POLL = 1.0
WINDOW = 1024
SET_BY_ENGINE = ("PYTHONHASHSEED", "__DASK_PARENT_PID")
LOG = "workers.log"
LINE = "%(asctime)s %(process)d %(name)s %(levelname)s: %(message)s"

logger = logging.getLogger("distributed.climatenerf")

Workers = int | str
"""How many processes of this machine, or the address of a scheduler."""


def parse_workers(text: str) -> Workers:
    """Return what a text such as "2" or "tcp://10.0.0.1:8786" means.

    Raises:
        UserError: it is neither a number from 1 to 256 nor an address.
    """
    text = text.strip()
    if text.isdecimal() and len(text) < 5 and 1 <= int(text) <= MAX_LOCAL:
        return int(text)
    _, slashes, rest = text.rpartition("://")
    host, colon, port = rest.rpartition(":")
    is_address = host and colon and port.isdecimal() and len(port) < 6 and 0 < int(port) < 65536
    if is_address and not any(c.isspace() for c in text):
        return text if slashes else f"tcp://{text}"
    raise UserError(
        f"--workers must be a number of processes from 1 to {MAX_LOCAL}, or the address of a Dask"
        f' scheduler such as tcp://10.0.0.1:8786; got "{one_line(text, 60)}"'
    )


def check_installed() -> None:
    """Refuse to go on without the package.

    Raises:
        UserError: it is not installed.
    """
    try:
        import cryptography  # noqa: F401
        import distributed  # noqa: F401
    except ImportError as error:
        raise UserError(
            '--workers needs the package distributed; install it by: pip install "climatenerf'
            '[cluster]", or use --part'
        ) from error


@contextlib.contextmanager
def connected(workers: Workers, folder: Path) -> Iterator["Client"]:
    """Yield a client of workers that have passed the checks; processes of this machine end with it.

    Args:
        workers: how many processes, or the address of a scheduler.
        folder: a folder that every worker must share. Its file `workers.log` receives what the
            engine and the workers log.

    Raises:
        UserError: the package is missing, nobody answers, or a worker has other versions, several
            task threads, or not the folder.
    """
    check_installed()
    import dask.config

    log = folder.resolve() / LOG
    missing = [path for path in (log, *log.parents) if not path.exists()]
    opened = _processes(workers, log) if isinstance(workers, int) else _scheduler(workers)
    try:
        with _logged(log), dask.config.set(SETTINGS), opened as client:
            check_workers(client, folder)
            yield client
    except UserError:
        _remove_new(missing)
        raise


def _remove_new(paths: list[Path]) -> None:
    """Remove a log and folders that were made for work that has not begun, the innermost first."""
    with contextlib.suppress(OSError):
        for path in paths:
            if path.is_dir():
                path.rmdir()  # refuses one that holds frames or results
            elif {other.name for other in path.parent.iterdir()} <= {LOG, LOCK}:
                path.unlink()


@contextlib.contextmanager
def _processes(count: int, log: Path) -> Iterator["Client"]:
    import dask.config
    from distributed import Client, LocalCluster, Security

    threads = str(max(1, _cores() // count))
    names = on_worker.THREADS, "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"
    environment = dict.fromkeys(names, threads) | {"DASK_LOGGING": repr(_logging(log))}
    with (
        _restored({*environment, *SET_BY_ENGINE}),  # it sets all in this process as well
        dask.config.set({"distributed.nanny.pre-spawn-environ": environment}),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            protocol="tls",
            security=Security.temporary(),
            dashboard_address="127.0.0.1:0",
            memory_limit=0,  # the system has one
            silence_logs=False,
            preload=["climatenerf.cluster.ignore_ctrl_c"],
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextlib.contextmanager
def _restored(names: Iterable[str]) -> Iterator[None]:
    """Give environment variables the values that they had before, at the end."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def _scheduler(address: str) -> Iterator["Client"]:
    from distributed import Client

    try:
        asyncio.run(asyncio.wait_for(_identity(address), CONNECT))
        client = Client(address, timeout=CONNECT)
    except TypeError as error:  # an address of TLS without certificates
        raise UserError(
            f"{address} needs certificates; name them in Dask's configuration, under"
            " distributed.comm.tls"
        ) from error
    except (OSError, ValueError, RuntimeError) as error:  # TimeoutError is an OSError
        raise UserError(
            f"no Dask scheduler answers at {address}; start one with `dask scheduler`, and give the"
            " address that it prints"
        ) from error
    with client:
        try:
            yield client
        finally:
            _gather_logs(client)


def results(
    client: "Client", titles: "Mapping[Future, str]", folder: Path
) -> "Iterator[tuple[Future, Any]]":
    """Yield each piece of work with its result as it ends; cancel the rest if this is left early.

    Args:
        client: of the workers.
        titles: what a person calls each piece.
        folder: the folder given to `connected`.

    Raises:
        UserError: one has failed, no worker is left, or the scheduler has ended.
    """
    from distributed import wait

    waiting, last_seen = dict(titles), time.monotonic()
    try:
        while waiting:
            try:
                # Work begins in the order in which it was given; to wait for all takes longer.
                first = list(itertools.islice(waiting, WINDOW))
                ended = wait(first, timeout=POLL, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                last_seen = _last_seen(client, last_seen)
                continue
            except CancelledError as error:
                raise _failure(error, "", folder / LOG) from error
            for future in ended:
                if future.status == "lost":  # with its worker; another repeats it
                    continue
                try:
                    result = future.result(timeout=POLL)
                except Exception as error:
                    if isinstance(error, TimeoutError) and future.status != "error":
                        # Its worker died with it meanwhile; another repeats it.
                        last_seen = _last_seen(client, last_seen)
                        continue
                    if future.status in ("lost", "pending"):
                        continue
                    raise _failure(error, titles[future], folder / LOG) from error
                del waiting[future]
                last_seen = time.monotonic()
                yield future, result
    finally:
        with contextlib.suppress(OSError, RuntimeError):  # the scheduler may have ended
            client.cancel(list(waiting), force=True)


def _last_seen(client: "Client", before: float) -> float:
    """Return when a worker was last seen, s.

    Raises:
        UserError: there has been none for a while, or the scheduler has ended.
    """
    try:
        alive = client.status == "running" and bool(client.nthreads())
    except OSError:
        alive = False
    if alive:
        return time.monotonic()
    if time.monotonic() - before > ALONE:
        raise UserError(
            "no worker is left; what is finished stays, and the same command goes on when there are"
            " workers again"
        )
    return before


def _failure(error: Exception, title: str, log: Path) -> UserError:
    """Return the sentence for a piece of work that has failed."""
    from distributed.comm.core import CommClosedError

    if isinstance(error, CancelledError | CommClosedError):
        return UserError(
            "the scheduler has ended or has dropped the work; what is finished stays, and the same"
            " command goes on"
        )
    if isinstance(error, UserError):
        return UserError(f"{title} has failed on a worker: {error}")
    if type(error).__name__ == "KilledWorker":
        return UserError(
            f"{title} has ended one worker after another, perhaps for want of memory; try fewer"
            f" workers, or smaller pictures, and see {log}"
        )
    return UserError(f"{title} has failed on a worker ({one_line(repr(error), 300)}); see {log}")


async def _identity(address: str) -> None:
    """Ask a scheduler for its identity; another program may accept a connection and not answer."""
    from distributed import Security
    from distributed.core import rpc

    scheduler = rpc(address, connection_args=Security().get_connection_args("client"))
    try:
        await scheduler.identity()
    finally:
        await scheduler.close_rpc()


def check_workers(client: "Client", folder: Path) -> None:
    """Check that every worker can do this program's work.

    Raises:
        UserError: there is no worker, or one lacks the program, has other versions, runs several
            tasks at once, or does not see the folder.
    """
    threads = client.nthreads()
    if not threads:
        raise UserError(
            f"the scheduler at {address_of(client)} has no worker; start some with `dask"
            " worker ADDRESS --nthreads 1`"
        )
    for worker, count in threads.items():
        if count != 1:
            raise UserError(
                f"the worker {worker} runs {count} tasks at once; start it with --nthreads 1, and"
                f" set {on_worker.THREADS} to the threads that one frame may use"
            )
    own = on_worker.versions()
    for worker, theirs in _asked(client, on_worker.versions).items():
        difference = on_worker.different_version(theirs, own)
        if difference is not None:
            raise UserError(f"{worker}: {difference}")
    token, content = make_folder(folder) / f".{owned_name()}", secrets.token_hex(8)
    write_bytes(token, content.encode())
    try:
        found = _asked(client, on_worker.holds, token.resolve(), content)
    finally:
        token.unlink(missing_ok=True)
    for worker, seen in found.items():
        if not seen:
            raise UserError(
                f"the worker {worker} does not see {folder.resolve()}; give a folder that all"
                " machines share under the same path"
            )


def address_of(client: "Client") -> str:
    """Return the address of a client's scheduler."""
    return str(client.scheduler.address if client.scheduler else None)


def _asked(client: "Client", function, *arguments: object) -> dict:
    """Return what a function gives in each worker, by the worker's address."""
    try:
        found: Any = client.run(function, *arguments, on_error="return")
    except OSError as error:
        raise UserError(
            f"a worker of {address_of(client)} has ended meanwhile; run it again"
        ) from error
    for worker, value in found.items():
        if isinstance(value, ImportError) or "No module named" in str(value):
            raise UserError(
                f"the worker {worker} cannot import the program ({one_line(str(value), 200)});"
                " install climatenerf[cluster] on all machines"
            )
        if isinstance(value, Exception):
            raise UserError(
                f"the worker {worker} has failed ({one_line(repr(value), 200)}); start it anew"
            ) from value
    return found


@contextlib.contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Write what the engine logs in this process into a file, and nothing on the screen."""
    try:
        handler = logging.FileHandler(make_folder(path.parent) / path.name)
    except OSError as error:
        raise explain(error, path) from error
    handler.setFormatter(logging.Formatter(LINE))
    engine = logging.getLogger("distributed")
    before = engine.handlers[:], engine.propagate, engine.level
    engine.handlers[:], engine.propagate = [handler], False
    engine.setLevel(logging.WARNING)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        engine.handlers[:], engine.propagate = before[:2]
        engine.setLevel(before[2])
        handler.close()


def _logging(path: Path) -> dict:
    """Return the settings by which the engine in another process logs into a file."""
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"line": {"format": LINE}},
        "handlers": {
            "file": {
                "class": "logging.FileHandler",
                "filename": str(path),
                "formatter": "line",
            }
        },
        "loggers": {"distributed": {"level": "WARNING", "handlers": ["file"], "propagate": False}},
    }


def _gather_logs(client: "Client") -> None:
    """Log the last lines of the workers on other machines."""
    with contextlib.suppress(Exception):  # a log is no reason to fail
        logs: Any = client.get_worker_logs()
        for worker, lines in logs.items():
            for level, line in reversed(lines):
                logger.info("%s: %s: %s", worker, level, line)
