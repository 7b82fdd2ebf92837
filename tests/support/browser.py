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


def opened_page(context: Any, address: str) -> Any:
    """Open an address in a new page; its problems and requests are collected as attributes."""
    page = context.new_page()
    page.set_default_timeout(20_000)
    page.problems, page.requests = [], []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on("console", lambda told: page.problems.append(told.text))
    page.on("request", lambda request: page.requests.append(request.url))
    page.goto(address)
    return page


def wait_until(page: Any, condition: str) -> None:
    """Wait for a condition; playwright's own way is by `eval`, which a page's policy may forbid."""
    for _ in range(2000):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(10)
    pytest.fail(f"in vain: {condition}")
