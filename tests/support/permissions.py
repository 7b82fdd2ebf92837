"""Files that may not be read, also where tests run as root."""

import contextlib
import os
import tempfile
from pathlib import Path

import pytest

NOBODY = 65534


@contextlib.contextmanager
def as_another_user():
    """Give up root's right to read everything."""
    if os.name != "posix":
        pytest.skip("needs POSIX permissions")
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@contextlib.contextmanager
def open_folder():
    """A folder that every user may read: those of pytest belong to one."""
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        yield Path(name)
