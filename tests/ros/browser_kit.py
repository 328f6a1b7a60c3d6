"""Tabs and rows of the page in a real browser, which the fixture `chromium` starts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from axe_playwright_python.sync_playwright import Axe

from tests.waiting import PATIENCE

#: Seconds for one step of a page: on a busy machine a browser, a gateway and a cluster share a CPU.
BROWSER_PATIENCE = 3 * PATIENCE
#: Link of `tab` over a bad mobile network: milliseconds of delay, bytes per second.
SLOW_LINK = {"latency": 400, "downloadThroughput": 250_000, "uploadThroughput": 60_000}

#: Looks of axe-core, each of about half a second, at a page that is being drawn.
_LOOKS = 5
_ALL_ROWS_HAVE_CELLS = """
    [...document.querySelectorAll("[role=row]")].every(
        row => row.querySelector("[role=columnheader], [role=rowheader], [role=gridcell]"))
"""


@contextmanager
def tab(
    browser: Any, url: str, link: Mapping[str, int] | None = None, **options: Any
) -> Iterator[Any]:
    """Yield a tab with a page; fail if the page reports an error or asks another machine."""
    context = browser.new_context(**options)
    context.set_default_timeout(BROWSER_PATIENCE * 1000)
    page = context.new_page()
    errors: list[str] = []
    outside: list[str] = []
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda asked: outside.append(asked.url) if _is_outside(asked.url) else None)
    if link is not None:
        limits = {"offline": False, **link}
        context.new_cdp_session(page).send("Network.emulateNetworkConditions", limits)
    try:
        page.goto(url)
        yield page
    except Exception:  # of any test: it is raised again, after what explains it
        print(f"the page shows:\n{page.locator('body').inner_text()}\nits errors: {errors}")
        raise
    else:
        assert outside == []
        assert errors == []
    finally:
        context.close()


def _is_outside(url: str) -> bool:
    return not url.startswith(("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:"))


def row(page: Any, name: str) -> Any:
    """Return the row of a host or process in the visible table."""
    return page.locator(".ag-row:visible", has_text=name).first


def open_tab(page: Any, name: str) -> None:
    """Show the tab of this name."""
    page.get_by_role("tab", name=name).click()


def serious_findings(page: Any) -> list[tuple[str, str]]:
    """Return the serious and critical findings of axe-core: each rule, and its first element.

    The page draws a row before its cells, also of the header: what one of a few looks does not
    find was only being drawn.
    """
    for _ in range(_LOOKS):
        page.wait_for_function(_ALL_ROWS_HAVE_CELLS)
        found = Axe().run(page).response["violations"]
        serious = [one for one in found if one["impact"] in ("serious", "critical")]
        if not serious:
            return []
    return [(one["id"], one["nodes"][0]["html"][:200]) for one in serious]
