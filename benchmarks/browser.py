"""Chromium of the system, driven by Playwright: for benchmarks, tests, and pictures of the docs."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from rosrm.errors import RosrmError

if TYPE_CHECKING:
    from playwright.sync_api import Browser

#: Path of its program; None: it is not installed.
CHROMIUM: Final = shutil.which("chromium") or shutil.which("chromium-browser")
MISSING: Final = "this machine has no Chromium: apt-get install chromium"


@contextmanager
def browser(timeout: float = 30.0) -> Iterator[Browser]:
    """Yield a browser.

    Args:
        timeout: seconds for its start.

    Raises:
        RosrmError: Chromium is not installed.
    """
    if CHROMIUM is None:
        raise RosrmError(MISSING)
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - tests without it are skipped

    with sync_playwright() as driver:
        # Its sandbox needs a user that is not root.
        one = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox"], timeout=1e3 * timeout
        )
        try:
            yield one
        finally:
            one.close()
