"""Plans of changes on the page of `rosrm web`, in a real browser against a real cluster."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.config.modes import load_modes
from rosrm.config.work import load_application
from tests.ros.browser_kit import open_tab, row, serious_findings, tab
from tests.ros.clusters import STEADY, Cluster, host
from tests.ros.web_kit import gateway
from tests.waiting import wait_until

#: As in test_web_page.py.
pytestmark = pytest.mark.timeout(600)

TOKEN = "0123456789abcdef01234567"
#: A name cannot have HTML, but a reason can.
HTML = "<img src=x onerror=alert(1)>"
STOP = "stop: {interrupt_grace: 0.5s, terminate_grace: 0.5s}"


def work(app: str, *names: str) -> str:
    lines = [f"app: {app}", "rollout: {healthy_for: 0.1s}", "processes:"]
    return "\n".join(
        [*lines, *(f"  - {{name: {one}, command: sleep 1000, {STOP}}}" for one in names)]
    )


def apply(cluster: Cluster, app: str, name: str) -> None:
    """Apply an application without the page, and wait for its process."""
    path = cluster.directory / f"{app}.yaml"
    path.write_text(work(app, name))
    cluster.client.apply([load_application(path)])
    cluster.wait(name, "running")


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    return make_shared(host("robot-1"), liveness=STEADY)


@pytest.fixture(scope="module")
def web(cluster, tmp_path_factory):
    """Return a gateway that acts."""
    tokens = tmp_path_factory.mktemp("web") / "tokens"
    tokens.touch(0o600)
    tokens.write_text(f"operator ada {TOKEN}\nviewer eve {TOKEN[::-1]}\n")
    with gateway(cluster.ros, "--tokens", str(tokens), "--allow-actions") as one:
        yield one


def log_in(page: Any, token: str = TOKEN) -> None:
    page.get_by_label("Token").fill(token)
    page.get_by_role("button", name="Log in").click()
    row(page, "robot-1").wait_for()
    open_tab(page, "Applications")


@pytest.fixture
def page(chromium, web):
    """Yield the page of an operator, with the applications."""
    with tab(chromium, web.url) as page:
        log_in(page)
        yield page


def plan(page: Any, text: str) -> Any:
    """Plan a work file, and return the dialog."""
    page.get_by_role("button", name="Plan a change").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Work file", exact=True).fill(text)
    dialog.get_by_role("button", name="Plan", exact=True).click()
    return dialog


def test_a_work_file_is_planned_and_applied(page, cluster, web):
    """The plan begins nothing; its button starts at once, and asks before it stops anything.

    The gateway logs who has applied it.
    """
    dialog = plan(page, work("nav", "planner", "mapper"))
    dialog.get_by_role("cell", name="planner").wait_for()
    assert not cluster.client.list(applications=True).applications
    dialog.get_by_role("button", name="Apply: start 2").click()
    dialog.get_by_text("Accepted: nav version 1: 2 processes to start").wait_for()
    cluster.wait("planner", "running", application="nav")
    cluster.wait("mapper", "running")
    dialog.get_by_role("button", name="Close").click()
    row(page, "nav").filter(has_text="2/2").wait_for()

    dialog = plan(page, work("nav", "planner", "camera"))
    dialog.get_by_role("button", name="Apply: start 1, stop 1").click()
    question = page.get_by_role("dialog").filter(has_text="mapper is stopped.")
    question.get_by_role("button", name="Do nothing").click()
    question.wait_for(state="hidden")
    assert cluster.process("mapper").state == "running"
    dialog.get_by_role("button", name="Apply: start 1, stop 1").click()
    question.get_by_role("button", name="Apply: start 1, stop 1").click()
    cluster.wait("camera", "running")
    cluster.ended("mapper")
    wait_until(
        lambda: any("ada: page: start 1, stop 1 of nav" in line for line in web.said),
        "the gateway logs the change",
        seen=lambda: web.said,
    )


def test_an_application_is_reverted_by_its_plan(page, cluster):
    """Enter opens the dialog with the versions; on close, the focus returns to the row."""
    for names in (("one",), ("one", "two")):
        dialog = plan(page, work("back", *names))
        dialog.get_by_role("button", name="Apply: start 1").click()
        cluster.wait(names[-1], "running")
        page.keyboard.press("Escape")
        dialog.wait_for(state="detached")

    row(page, "back").locator("[col-id=name]").click()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("button", name="Plan: Revert to version 1").click()
    dialog.get_by_role("button", name="Apply: stop 1").click()
    question = page.get_by_role("dialog").filter(has_text="two is stopped.")
    question.get_by_role("button", name="Apply: stop 1").click()
    question.wait_for(state="detached")
    cluster.ended("two")
    page.keyboard.press("Escape")
    dialog.wait_for(state="detached")
    page.wait_for_function("document.activeElement.innerText.includes('back')")


def test_a_mode_is_switched_by_its_plan(page, cluster):
    """A row of the modes opens the plan of the switch."""
    (cluster.directory / "patrol.yaml").write_text(work("patrol", "walker"))
    modes = cluster.directory / "modes.yaml"
    modes.write_text("modes:\n  patrolling: {applications: [patrol.yaml]}\n")
    cluster.client.load_modes(load_modes(modes))

    row(page, "patrolling").dblclick()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("heading", name="Switch to the mode patrolling").wait_for()
    dialog.get_by_role("button", name="Apply: start 1").click()
    cluster.wait("walker", "running")
    dialog.get_by_role("button", name="Close").click()
    row(page, "patrolling").filter(has_text="in force").wait_for()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("processes: [{name: a, command: sleep 1}]", "app: the name of the application is requ"),
        (f"app: nav\nprocesses: [{{name: '{HTML}', command: 'x'}}]", HTML),
        ("app: [", "work:"),
        ("x" * 64_001, "64001 characters; the page takes at most 64000"),
    ],
)  # fmt: skip
def test_a_wrong_work_file_is_refused_with_its_error(page, cluster, text, error):
    """The page shows the text of the error, and nothing changes."""
    before = desired(cluster)

    dialog = plan(page, text)

    dialog.get_by_role("alert").filter(has_text=error).wait_for()
    assert dialog.get_by_role("button", name="Apply").count() == 0
    assert desired(cluster) == before


def desired(cluster: Cluster) -> tuple[set[str], set[tuple[str, int]]]:
    """Return the names of all processes, and all applications with their versions."""
    there = cluster.client.list(processes=True, applications=True)
    names = {row.name for row in there.processes}
    return names, {(row.name, row.version) for row in there.applications}


def test_a_plan_that_no_longer_holds_is_refused(page, cluster):
    """After a change by another user, the operator must plan again."""
    dialog = plan(page, work("late", "sleeper"))
    begin = dialog.get_by_role("button", name="Apply: start 1")
    begin.wait_for()
    apply(cluster, "late", "sleeper")
    begin.click()
    dialog.get_by_role("alert").filter(has_text="Plan again. Nothing was changed").wait_for()


def test_a_viewer_sees_versions_but_cannot_plan(chromium, web, cluster):
    """Neither the button of a work file nor those of an application are there."""
    apply(cluster, "seen", "viewed")
    with tab(chromium, web.url) as page:
        log_in(page, TOKEN[::-1])
        row(page, "seen").dblclick()
        page.get_by_role("dialog").get_by_text("Versions").wait_for()
        assert page.get_by_role("button", name="Plan").count() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_finding_in_the_tab_and_a_dialog(chromium, web, scheme):
    """axe-core checks names, roles and contrasts."""
    with tab(chromium, web.url, color_scheme=scheme) as page:
        log_in(page)
        assert serious_findings(page) == []
        dialog = plan(page, work(f"axe-{scheme}", f"checked-{scheme}"))
        dialog.get_by_role("button", name="Apply: start 1").wait_for()
        assert serious_findings(page) == []
