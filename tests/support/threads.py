"""Numbers of threads, which results must not depend on."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import torch


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Run on `count` threads of torch and of Numba; None: all that Numba has."""
    before = torch.get_num_threads(), numba.get_num_threads()
    count = count or numba.config.NUMBA_NUM_THREADS
    torch.set_num_threads(count)
    numba.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])
