"""A real browser for tests of pages."""

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextlib.contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """Start the system's Chromium by playwright; skip the test where one of them is missing.

    Args:
        flags: of its command line.
    """
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright (make setup installs it)"
    )
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("needs Chromium, such as `apt-get install chromium`")
    with playwright.sync_playwright() as started:
        # Without the sandbox it starts as root and in containers; it opens our own page alone.
        browser = started.chromium.launch(executable_path=found, args=["--no-sandbox", *flags])
        yield browser
        browser.close()
