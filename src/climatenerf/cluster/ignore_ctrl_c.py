"""Preloaded by workers of this machine: the process that started them ends them after Ctrl-C.

A terminal sends Ctrl-C to all processes, and each worker would print a traceback.
"""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C; the engine calls this in the main thread of the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
