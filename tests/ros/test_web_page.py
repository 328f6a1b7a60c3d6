"""The page of `rosrm web` in a real browser, against a real cluster."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rosrm.archive.layout import Source
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.config.settings import MigrationSettings
from rosrm.model.rows import LogPart
from rosrm.model.values import MigrationPolicy
from tests.ros.browser_kit import SLOW_LINK, open_tab, row, serious_findings, tab
from tests.ros.clusters import STEADY, Cluster, host, job, service
from tests.ros.web_kit import Gateway, gateway

#: A page takes seconds of CPU time, and a busy machine gives a tenth of them.
pytestmark = pytest.mark.timeout(600)

#: HTML in a log line and in a reason.
HTML = "<img src=x onerror=alert(1)>"
#: Numbered, because the page shows only the last lines.
BEATS = f'while sleep 1; do echo "{HTML} beat $((n = n + 1))."; done'
TOKEN = "0123456789abcdef01234567"


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    """Return a cluster with a process that writes, one that failed, and one that waits."""
    made = make_shared(host("robot-1"), host("robot-2"), liveness=STEADY)
    made.submit(
        service("talker", "sh", "-c", BEATS),
        job("loser", "sh", "-c", "exit 4"),
        service("giant", "sleep", "9", needs={"memory": 1e15}),
    )
    made.wait("talker", "running")
    made.ended("loser")
    made.wait("giant", "set_aside")
    return made


@pytest.fixture(scope="module")
def web(cluster):
    with gateway(cluster.ros) as one:
        yield one


@pytest.fixture
def page(chromium, web: Gateway):
    with tab(chromium, web.url) as one:
        row(one, "robot-1").wait_for()
        yield one


def test_hosts_and_processes_are_in_tables(page, cluster):
    """Hosts with their usage, processes with state and reason, and events."""
    row(page, "robot-2").filter(has_text="up").wait_for()

    open_tab(page, "Processes")
    row(page, "talker").wait_for()
    row(page, "loser").filter(has_text="failed").filter(has_text="exit code 4").wait_for()

    open_tab(page, "Events")
    cluster.run(job("newest", "true"))  # the browser has only rows near the visible ones
    row(page, "newest").wait_for()


def test_the_strip_shows_what_is_wrong_and_filters(page):
    """Its buttons lead to the processes in this state, and back to all."""
    page.get_by_role("button", name="1 process failed").click()
    row(page, "loser").wait_for()
    page.locator(".ag-row:visible", has_text="talker").wait_for(state="hidden")

    page.get_by_role("button", name="Show all").click()
    row(page, "talker").wait_for()


def test_a_process_opens_with_its_scores_and_its_log(page):
    """HTML in the log stays text, new lines appear, and a search leaves only some."""
    open_tab(page, "Processes")
    row(page, "talker").dblclick()
    dialog = page.get_by_role("dialog")
    dialog.get_by_text("Scores of the hosts").wait_for()
    dialog.get_by_role("cell", name="chosen").wait_for()

    open_tab(dialog, "Logs")
    lines = dialog.get_by_text("beat")
    lines.first.wait_for()
    newest = int(lines.last.inner_text().removeprefix(f"{HTML} beat ").rstrip("."))
    later = dialog.get_by_text(f"{HTML} beat {newest + 2}.")
    later.wait_for()
    dialog.get_by_label("Show only lines with").fill(f" {newest + 2}.")
    lines.nth(1).wait_for(state="detached")
    later.wait_for()


def test_a_collected_log_is_shown_where_its_host_is_gone(chromium, cluster, tmp_path):
    """The dialog says where the output is from; HTML in it stays text."""
    line = f"{HTML} motor stalled\n".encode()
    writer = ArchiveWriter(tmp_path / "archive", ArchiveLimits(1 << 30, 1 << 30))
    writer.add(Source("robot-9", "giant", 1), LogPart(1, (1,), line, 0, len(line), True, ()))
    with (
        gateway(cluster.ros, "--archive", str(tmp_path / "archive")) as web,
        tab(chromium, web.url) as page,
    ):
        open_tab(page, "Processes")
        row(page, "giant").dblclick()
        dialog = page.get_by_role("dialog")
        open_tab(dialog, "Logs")
        dialog.get_by_text("Its output there is read from").wait_for()
        dialog.get_by_text(f"{HTML} motor stalled").wait_for()
        assert page.locator("img").count() == 0


def test_a_change_appears_without_a_reload(page, cluster):
    """A new process is in the table, and a cancelled one changes its state."""
    open_tab(page, "Processes")
    cluster.submit(service("late", "sleep", "1000"))
    row(page, "late").wait_for()
    cluster.cancel("late")
    page.locator(".ag-row:visible", has_text="late").filter(has_text="cancelled").wait_for()


def test_a_change_is_in_a_tab_that_opens_later(page, cluster):
    """A browser makes the table of a tab only when it first shows the tab."""
    cluster.submit(service("vast", "sleep", "9", needs={"memory": 1e15}))
    page.get_by_role("button", name="2 processes set aside").wait_for()
    open_tab(page, "Processes")
    row(page, "vast").wait_for()
    cluster.cancel("vast")


def test_a_slow_link_loses_nothing(chromium, cluster, web):
    """The page loads, follows changes, and opens a process, only later."""
    with tab(chromium, web.url, SLOW_LINK) as page:
        timing = page.evaluate("performance.getEntriesByType('navigation')[0].toJSON()")
        assert timing["responseEnd"] - timing["requestStart"] >= SLOW_LINK["latency"]
        open_tab(page, "Processes")
        cluster.submit(service("slow", "sleep", "1000"))
        row(page, "slow").dblclick()
        dialog = page.get_by_role("dialog")
        dialog.get_by_role("cell", name="chosen").wait_for()
        dialog.get_by_role("button", name="Close").click()
        dialog.wait_for(state="detached")
        cluster.cancel("slow")
        row(page, "slow").filter(has_text="cancelled").wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_finding_of_an_accessibility_checker(chromium, web, scheme):
    """Names, roles and contrasts of the page, by axe-core."""
    with tab(chromium, web.url, color_scheme=scheme) as page:
        row(page, "robot-1").wait_for()
        assert serious_findings(page) == []


def test_the_page_fits_a_phone(chromium, web):
    """Only tables scroll sideways."""
    with tab(chromium, web.url, viewport={"width": 390, "height": 844}) as page:
        row(page, "robot-1").wait_for()
        wide = page.evaluate("document.documentElement.scrollWidth")

    assert wide <= 390


@pytest.fixture
def tokens(tmp_path) -> Path:
    """Return the file with the tokens of `operated`."""
    file = tmp_path / "tokens"
    file.touch(0o600)
    file.write_text(f"operator ada {TOKEN}\noperator eve {TOKEN[::-1]}\n")
    return file


@contextmanager
def operating(chromium: Any, cluster: Cluster, tokens: Path) -> Iterator[Any]:
    """Yield the page of an operator; without a token there is only the form."""
    with (
        gateway(cluster.ros, "--tokens", str(tokens), "--allow-actions") as web,
        tab(chromium, web.url) as page,
    ):
        page.get_by_label("Token").fill(TOKEN)
        page.get_by_role("button", name="Log in").click()
        row(page, "robot-").wait_for()
        yield page


@pytest.fixture
def operated(chromium, cluster, tokens):
    with operating(chromium, cluster, tokens) as page:
        yield page


def test_an_operator_acts(operated):
    """Each action asks once, and says what it will do."""
    row(operated, "robot-2").dblclick()
    cordoned = operated.locator(".ag-row", has_text="up, cordoned")
    act(operated, "Cordon", "robot-2 gets no new processes.")
    cordoned.wait_for()
    act(operated, "Uncordon", "robot-2 gets new processes again.")
    cordoned.wait_for(state="detached")


def test_a_move_has_a_choice_of_the_hosts_that_fit(operated, cluster):
    """Any host comes first; the explanation has decided which hosts fit.

    No strategy of this cluster writes images, so there is no button for a checkpoint.
    """
    cluster.submit(service("mover", migration=MigrationPolicy("relaunch")))
    source = cluster.wait("mover", "running").host
    (other,) = {"robot-1", "robot-2"} - {source}
    open_tab(operated, "Processes")
    row(operated, "mover").dblclick()
    operated.get_by_role("dialog").get_by_role("cell", name="chosen").wait_for()
    assert operated.get_by_role("button", name="Checkpoint").count() == 0
    operated.get_by_role("button", name="Move", exact=True).click()
    question = operated.get_by_role("dialog").filter(has_text="mover moves to another host.")
    question.get_by_label("To").click()
    options = operated.get_by_role("option")
    options.filter(has_text=other).wait_for()
    assert options.all_inner_texts() == ["any host", other]
    options.last.click()
    question.get_by_role("button", name="Move", exact=True).click()
    cluster.wait("mover", "running", host=other)
    cluster.cancel("mover")


def test_a_process_is_checkpointed_and_restored(criu, chromium, make_cluster, tokens):
    """The dialog has the button of what is possible, and each asks once."""
    strategies = MigrationSettings(strategies={"criu": {}}, automatic=False)
    cluster = make_cluster(host("robot-1"), liveness=STEADY, migration=strategies)
    cluster.submit(service("held", "sleep", "1000"))
    cluster.wait("held", "running")
    with operating(chromium, cluster, tokens) as page:
        open_tab(page, "Processes")
        row(page, "held").dblclick()
        act(page, "Checkpoint", "ends until it is restored")
        cluster.wait("held", "checkpointed")
        assert page.get_by_role("button", name="Restore").count() == 0
        page.keyboard.press("Escape")
        page.get_by_role("dialog").wait_for(state="hidden")
        row(page, "held").filter(has_text="checkpointed").dblclick()
        act(page, "Restore", "continues from its image")
        cluster.wait("held", "running")
    cluster.cancel("held")


def test_the_page_of_an_operator_who_becomes_a_viewer_is_replaced(operated, tokens):
    """The token stays valid, but the buttons of the open page must not act any more."""
    operated.get_by_text("operator", exact=True).wait_for()
    tokens.write_text(f"viewer ada {TOKEN}\noperator eve {TOKEN[::-1]}\n")
    operated.get_by_text("read-only", exact=True).wait_for()


def act(page: Any, action: str, warning: str) -> None:
    """Press the button of an action twice, and confirm the single question with this warning."""
    page.get_by_role("button", name=action, exact=True).evaluate("it => { it.click(); it.click() }")
    question = page.get_by_role("dialog").filter(has_text=warning)
    question.get_by_role("button", name=action, exact=True).click()
    question.wait_for(state="hidden")


def test_a_reader_has_no_buttons(page):
    """A gateway that only reads offers no action."""
    open_tab(page, "Processes")
    row(page, "talker").dblclick()
    page.get_by_role("dialog").get_by_role("button", name="Close").wait_for()
    assert page.get_by_role("button", name="Cancel").count() == 0


def test_a_lost_master_is_shown_and_comes_back(chromium, make_cluster):
    """The header shows that the master is lost; the page need not be loaded again."""
    cluster = make_cluster(host("a"), liveness=STEADY)
    with gateway(cluster.ros) as web, tab(chromium, web.url) as page:
        page.get_by_text("master: up").wait_for()
        cluster.end(cluster.master, signal.SIGKILL)
        page.get_by_text("has not answered").wait_for()
        cluster.reconnect()
        cluster.start_master()
        page.get_by_text("master: up").wait_for()
