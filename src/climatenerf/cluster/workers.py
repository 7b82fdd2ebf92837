"""Workers: processes of this machine, or those of a Dask scheduler that the user has started.

Processes of this machine speak TLS with keys of their own on the loopback interface, so that no
other user of the machine can give them work. What protects a real cluster is its own matter.
"""

import contextlib
import logging
import os
import secrets
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING, Any

from climatenerf.cluster import on_worker
from climatenerf.core.errors import UserError, explain, one_line
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
LOG = "workers.log"
LINE = "%(asctime)s %(process)d %(name)s %(levelname)s: %(message)s"

logger = logging.getLogger("distributed.climatenerf")

Workers = int | str
"""How many processes of this machine, or the address of a scheduler."""


def parse_workers(text: str | None) -> Workers | None:
    """Return what a text such as "2" or "tcp://10.0.0.1:8786" means; None stays None.

    Raises:
        UserError: it is neither a number from 1 to 256 nor an address.
    """
    if text is None:
        return None
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

    created, passed = not folder.exists(), False
    log = folder.resolve() / LOG
    opened = _processes(workers, log) if isinstance(workers, int) else _scheduler(workers)
    try:
        with _logged(log), dask.config.set(SETTINGS), opened as client:
            check_workers(client, folder)
            passed = True
            yield client
    finally:
        if created and not passed:
            with contextlib.suppress(OSError):
                log.unlink()
                folder.rmdir()


@contextlib.contextmanager
def _processes(count: int, log: Path) -> Iterator["Client"]:
    import dask.config
    from distributed import Client, LocalCluster, Security

    threads = str(max(1, _cores() // count))
    names = on_worker.THREADS, "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"
    environment = dict.fromkeys(names, threads) | {"DASK_LOGGING": repr(_logging(log))}
    with (
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
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def _scheduler(address: str) -> Iterator["Client"]:
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECT)
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

    waiting, last_seen = set(titles), time.monotonic()
    try:
        while waiting:
            try:
                ended = wait(list(waiting), timeout=POLL, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                last_seen = _last_seen(client, last_seen)
                continue
            except CancelledError as error:
                raise _failure(error, "", folder / LOG) from error
            for future in ended:
                if future.status == "lost":  # with its worker; another repeats it
                    continue
                try:
                    result = future.result()
                except Exception as error:
                    if future.status in ("lost", "pending"):
                        continue
                    raise _failure(error, titles[future], folder / LOG) from error
                waiting.discard(future)
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
    if isinstance(error, CancelledError | OSError):
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
        for name, version in own.items():
            if theirs[name] != version:
                raise UserError(
                    f"the worker {worker} has {name} {theirs[name]} and this program has {version};"
                    " install the same versions on all machines"
                )
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
    """Log what the workers of other machines remember of their logs."""
    with contextlib.suppress(Exception):  # a log is no reason to fail
        logs: Any = client.get_worker_logs()
        for worker, lines in logs.items():
            for level, line in reversed(lines):
                logger.info("%s: %s: %s", worker, level, line)
