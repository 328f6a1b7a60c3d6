"""The timeline of the page in a real browser, against a real cluster."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import pytest
from playwright.sync_api import TimeoutError as NotInTime

from rosrm.model.values import MigrationPolicy
from tests.ros.browser_kit import BROWSER_PATIENCE, serious_findings, tab
from tests.ros.clusters import STEADY, Cluster, host, job, service
from tests.ros.web_kit import Gateway, gateway

#: As in test_web_page.py.
pytestmark = pytest.mark.timeout(600)

MOVES = MigrationPolicy("relaunch")
#: HTML in the reason of a failure and of a move: the name of a program that does not exist.
HTML = "<img src=x onerror=alert(1)>"
#: A shape that only arrows have: the line between two lanes.
ARROW = 'path[stroke-width="1.5"]'
#: Most clicks on a bar: one is lost if the live picture is drawn again, elsewhere, in that moment.
_CLICKS = 5


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    """Return a cluster with a process that stays, and one that failed."""
    made = make_shared(host("robot-1"), host("robot-2"), liveness=STEADY)
    made.submit(service("stays"), job("loser", "sh", "-c", "exit 4"))
    made.wait("stays", "running")
    made.ended("loser")
    return made


@pytest.fixture(scope="module")
def web(cluster):
    with gateway(cluster.ros) as one:
        yield one


@pytest.fixture
def page(chromium, web: Gateway):
    with tab(chromium, web.url) as one:
        open_timeline(one)
        yield one


def open_timeline(page: Any) -> None:
    page.get_by_role("tab", name="Timeline").click()
    text(page, "robot-2").wait_for()


def narrow(page: Any, process: str) -> None:
    page.get_by_role("textbox", name="Process").fill(process)


def text(page: Any, content: str) -> Any:
    """Return a text of the picture."""
    return page.locator("svg text", has_text=content).first


def mark(page: Any, content: str) -> Any:
    """Return a row of the table of moves and faults."""
    return page.locator(".rosrm-marks .ag-row", has_text=content).first


def test_a_move_appears_live_with_its_arrow(page, cluster):
    """The picture, the table and the summary show the move without a reload."""
    page.get_by_role("button", name="1 min").click()
    narrow(page, "mover")
    page.get_by_text("no processes, no moves").wait_for()
    cluster.submit(service("mover", migration=MOVES))
    source = cluster.wait("mover", "running").host
    text(page, "mover").wait_for()
    assert page.locator(ARROW).count() == 0

    cluster.client.migrate("mover")
    page.locator(ARROW).wait_for(state="attached")  # a vertical line has no area
    mark(page, "moved").filter(has_text=f"{source} to robot-").wait_for()
    page.get_by_text("1 move,").wait_for()


def test_a_bar_opens_its_process(page):
    """A click on the bar leads to the explanation."""
    page.get_by_role("button", name="1 min").click()
    heading = page.get_by_role("dialog").get_by_role("heading", name="stays")
    for _ in range(_CLICKS):
        text(page, "stays").click()
        with contextlib.suppress(NotInTime):
            heading.wait_for(timeout=BROWSER_PATIENCE * 1000 / _CLICKS)
            break
    assert heading.is_visible(), f"no dialog after {_CLICKS} clicks"


def test_earlier_looks_back_and_now_follows_again(page):
    """The look back shows no run that began later."""
    text(page, "stays").wait_for()
    page.get_by_role("button", name="Earlier").click()
    page.get_by_text("looking back").wait_for()
    for _ in range(4):  # the process has run for less than 10 min
        page.get_by_role("button", name="Earlier").click()
    text(page, "stays").wait_for(state="detached")

    page.get_by_role("button", name="Now").click()
    page.get_by_text("live", exact=True).wait_for()
    text(page, "stays").wait_for()


def test_the_wheel_zooms_and_the_picture_stops(page):
    """The picture stops following, so the zoomed part stays in view."""
    page.get_by_text("live", exact=True).wait_for()
    area = page.locator(".rosrm-timeline").bounding_box()
    page.mouse.move(area["x"] + area["width"] / 4, area["y"] + area["height"] / 3)
    page.mouse.wheel(0, -200)
    page.get_by_text("looking back").wait_for()


def test_keys_zoom_and_shift_the_picture(page):
    """Also where the pointer cannot: the length of the window is announced."""
    picture = page.get_by_role("application", name="The keys + and - zoom")
    picture.focus()
    length = page.get_by_role("status").filter(has_text="min")
    for key, shown in (("+", "2 min"), ("-", "5 min"), ("-", "10 min")):
        page.keyboard.press(key)
        length.filter(has_text=re.compile(f"^{shown}$")).wait_for()
    page.keyboard.press("ArrowLeft")
    page.get_by_text("looking back").wait_for()
    for _ in range(2):  # time has passed since the shift to the left
        page.keyboard.press("ArrowRight")
    page.get_by_text("live", exact=True).wait_for()
    page.get_by_role("button", name="Zoom in").click()
    length.filter(has_text=re.compile("^5 min$")).wait_for()


def test_a_name_narrows_the_picture(page):
    """The lane of a host without such processes goes away."""
    narrow(page, "no such process")
    text(page, "robot-1").wait_for(state="detached")
    narrow(page, "")
    text(page, "robot-1").wait_for()


def test_html_in_a_reason_stays_text(page, cluster):
    """Only the unit test of the options checks the text beside the pointer."""
    narrow(page, "no-program")
    cluster.submit(job("no-program", HTML))  # each host is tried
    mark(page, HTML).wait_for()
    assert page.locator("img").count() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_finding_of_an_accessibility_checker(chromium, web, scheme):
    """axe-core checks names, roles and contrasts of the timeline."""
    with tab(chromium, web.url, color_scheme=scheme) as page:
        open_timeline(page)
        mark(page, "loser").wait_for()
        assert serious_findings(page) == []


def test_the_timeline_fits_a_phone(chromium, web):
    """Only the table scrolls sideways."""
    with tab(chromium, web.url, viewport={"width": 390, "height": 844}) as page:
        open_timeline(page)
        page.wait_for_function("document.documentElement.scrollWidth <= 390")
