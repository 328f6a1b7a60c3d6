"""The tree of processes on the page of `rosrm web`, in a real browser against a real cluster."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.model.applications import Target
from tests.ros.browser_kit import open_tab, row, tab
from tests.ros.clusters import STEADY, Cluster, host, job, service
from tests.ros.web_kit import gateway

#: As in test_web_page.py.
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    """Return a cluster with a single process, and an application with a namespace and a failure."""
    made = make_shared(host("robot-1"), liveness=STEADY)
    made.submit(service("single"))
    specs = [service("left.camera"), job("left.lidar", "sh", "-c", "exit 4"), service("planner")]
    nav = tuple(replace(spec, application="nav") for spec in specs)
    made.client.apply([Target("nav", nav)])
    for name in ("single", "left.camera", "planner"):
        made.wait(name, "running")
    made.ended("left.lidar")
    return made


@pytest.fixture
def page(chromium, cluster):
    """Yield the page with the processes."""
    with gateway(cluster.ros) as web, tab(chromium, web.url) as page:
        open_tab(page, "Processes")
        row(page, "single").wait_for()
        yield page


def group(page: Any, title: str, *, is_open: bool) -> Any:
    """Return the row of an open or closed group, which screen readers know as such."""
    expanded = f"[aria-expanded={str(is_open).lower()}]"
    return page.get_by_role("treegrid").locator(f"[role=row]{expanded}", has_text=title).first


def cell(found: Any) -> Any:
    return found.locator("[col-id=process]")


def test_the_tree_opens_closes_and_finds(page):
    """Click, keys and search work; a group shows sums of its processes, also while closed."""
    nav = group(page, "nav", is_open=True)
    nav.filter(has_text="failed").wait_for()
    assert nav.get_attribute("aria-level") == "1"
    assert row(page, "left.camera").get_attribute("aria-level") == "3"

    cell(nav).click()
    row(page, "left.camera").wait_for(state="detached")
    group(page, "nav", is_open=False).wait_for()
    page.keyboard.press("ArrowRight")
    row(page, "left.camera").wait_for()

    cell(row(page, "left.camera")).click()
    page.keyboard.press("ArrowLeft")  # to its namespace
    page.locator(".ag-cell-focus", has_text="/left").wait_for()
    page.keyboard.press("ArrowLeft")
    row(page, "left.camera").wait_for(state="detached")

    page.get_by_label("Search processes").fill("CAMERA")
    row(page, "left.camera").wait_for()
    row(page, "single").wait_for(state="detached")
    page.get_by_text("1 of 4 processes").wait_for()
    page.get_by_label("Search processes").fill("")
    row(page, "single").wait_for()
    group(page, "/left", is_open=False).wait_for()

    page.get_by_role("button", name="1 process failed").click()
    row(page, "left.lidar").wait_for()
    row(page, "single").wait_for(state="detached")
    page.get_by_role("button", name="Show all").click()
    row(page, "single").wait_for()


def test_enter_opens_a_process_and_the_focus_returns(page):
    """The arrow keys lead from row to row, and Escape closes the dialog."""
    cell(group(page, "nav", is_open=True)).click()
    group(page, "nav", is_open=False).wait_for()
    page.keyboard.press("Enter")
    row(page, "planner").wait_for()
    page.get_by_role("button", name="Collapse all").click()
    row(page, "planner").wait_for(state="detached")

    cell(group(page, "nav", is_open=False)).focus()
    page.keyboard.press("ArrowDown")
    page.locator(".ag-cell-focus", has_text="single").wait_for()
    page.keyboard.press("Enter")
    page.get_by_role("dialog").get_by_role("heading", name="single").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("dialog").wait_for(state="detached")
    page.wait_for_function("document.activeElement.innerText.includes('single')")
