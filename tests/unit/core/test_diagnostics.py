"""Diagnostic statuses: levels of hosts and processes, and when they are published."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.diagnostics import MOST_PROCESSES, diagnostics, of_host, of_process
from rosrm.master.diagnostics import DiagnosticsFeed
from rosrm.model.diagnostics import Level
from rosrm.model.requester import OPERATOR
from rosrm.model.rows import HostRow, ProcessRow, ResourceRow
from rosrm.model.values import HostDescription, Limits
from tests.unit.core.cluster import MIB, Cluster, process

OK, WARN, ERROR, STALE = Level


def resource(usage=0.4, *, stale=False, name="memory"):
    return ResourceRow(name, "B", 2e9, "machine", usage, 0.0, 0.8, stale)


def host(state="up", *resources, **fields):
    row = HostRow(HostDescription("a", 7), 1, state, False, False, True, 0.1, resources, 2)
    return replace(row, **fields)


def row(state, **fields):
    shown = ProcessRow("p", "service", state, "a", 4, 9, 1, 0, None, 0, 0, 3.0, 0.5, 95, "")
    return replace(shown, **fields)


@pytest.mark.parametrize(
    ("shown", "level", "message"),
    [
        (host("up", resource()), OK, "up"),
        (host("up", resource(), draining=True), OK, "up, draining"),
        (host("up", resource(0.7)), OK, "up"),
        (host("up", resource(0.73)), WARN, "memory 73 % of at most 80 %"),
        (host("up", resource(float("nan"))), OK, "up"),
        (host("up", resource(stale=True), resource(name="cpu")), WARN, "old readings of memory"),
        (host("up", resource(0.9, stale=True)), STALE, "all its readings are old"),
        (host("suspect", resource(stale=True)), WARN, "suspect: its reports are late"),
        (host("detached"), WARN, "detached: its slave was stopped and left processes running"),
        (host("lost"), ERROR, "lost: it was silent for its whole lease"),
        (host("expected"), STALE, "silent since the master started"),
        (host("left"), OK, "left: its slave was stopped"),
    ],
)
def test_the_level_of_a_host(shown, level, message):
    """Each condition has its level; a limit counts from 90 % on."""
    found = of_host(shown)
    assert (found.level, found.message, found.host) == (level, message, "a")


@pytest.mark.parametrize(
    ("shown", "level", "message"),
    [
        (row("running"), OK, "is running"),
        (row("queued", reason="no room"), OK, "is queued: no room"),
        (row("running", memory_limit=106), OK, "is running"),
        (row("running", memory_limit=100), WARN, "uses 95 B of at most 100 B"),
        (row("set_aside", reason="no GPU"), WARN, "is set aside: no GPU"),
        (row("backoff"), WARN, "is in back-off"),
        (row("failed", reason="exit code 3\nPATH=/secret"), ERROR, "has failed: exit code 3"),
        (row("unreachable"), ERROR, "is unreachable"),
        (row("stuck"), ERROR, "is stuck"),
        (row("unknown"), STALE, "is unknown"),
    ],
)
def test_the_level_of_a_process(shown, level, message):
    """Each state has its level; details of a reason, such as a PATH, are left out."""
    found = of_process(shown)
    assert (found.level, found.message, found.host) == (level, message, "a")


@pytest.fixture
def cluster():
    """Return a host with a process that runs, and one that has failed."""
    cluster = Cluster("a").with_processes(process("well"), process("broken"))
    cluster.finish("broken", code=3)
    return cluster


def test_the_message_has_all_hosts_and_the_processes_that_are_not_well(cluster):
    """A process that runs has no status; the master's own counts the others."""
    own, *others = diagnostics(cluster.state, cluster.now, "lab", "")
    assert (own.subject, own.level) == (("master", "lab"), OK)
    assert own.message == "1 host; 2 processes, 1 not well"
    found = [(one.subject, one.level) for one in others]
    assert found == [(("host", "a"), OK), (("process", "broken"), ERROR)]


def test_a_master_that_accepts_no_work_is_an_error(cluster):
    """The reason is its message."""
    own, *_ = diagnostics(cluster.state, cluster.now, "lab", "the disk is full\ndetails")
    assert (own.level, own.message) == (ERROR, "the disk is full")


def test_processes_of_a_silent_host_are_stale(cluster):
    """The search includes processes whose phase is the last one that was reported."""
    cluster.cut("a", seconds=2.0)
    levels = {one.subject: one.level for one in diagnostics(cluster.state, cluster.now, "lab", "")}
    assert levels["host", "a"] is WARN
    assert levels["process", "well"] is STALE


def test_a_process_near_its_limit_of_memory_is_found(cluster):
    """The search includes processes whose limit of memory holds."""
    cluster.submit(process("big", limits=Limits(memory=100 * MIB)))
    instance = cluster.state.instances[cluster["big"].owner]
    instance.enforced, instance.seen = ("limits.memory",), {"memory": 95.0 * MIB}
    levels = {one.subject: one.level for one in diagnostics(cluster.state, cluster.now, "lab", "")}
    assert levels["process", "big"] is WARN


def test_a_message_is_bounded_and_errors_come_first():
    """Errors are shown first, because they need a person."""
    nowhere = [process(f"w{n}", needs={"memory": 1e15}) for n in range(MOST_PROCESSES)]
    cluster = Cluster("a").with_processes(*nowhere, process("broken"))
    cluster.finish("broken", code=3)
    _, _, first, *others = diagnostics(cluster.state, cluster.now, "lab", "")
    assert (first.subject, len(others)) == (("process", "broken"), MOST_PROCESSES - 1)


# --- when -------------------------------------------------------------------------------------


class Feed:
    """The statuses that a feed publishes of a cluster."""

    def __init__(self, cluster):
        self.cluster, self.sent, self.seen, self.is_read = cluster, [], 0, True
        self.feed = DiagnosticsFeed(cluster.state, "lab", self.sent.append, lambda: self.is_read)

    def advance(self, now):
        """Pass new events at a time; return what is published as level by kind and name."""
        self.feed.note(self.cluster.records[self.seen :])
        self.seen = len(self.cluster.records)
        self.sent.clear()
        self.feed.advance(now, self.cluster.now, "")
        assert len(self.sent) <= 1
        return {one.subject: one.level for sent in self.sent for one in sent}


def test_all_statuses_are_published_each_second_without_a_change(cluster):
    """A monitor takes a publisher that is silent for stale."""
    feed = Feed(cluster)
    shown = {("master", "lab"): OK, ("host", "a"): OK, ("process", "broken"): ERROR}
    assert [feed.advance(now) for now in (5.0, 5.5, 6.0)] == [shown, {}, shown]


def test_nothing_is_published_without_a_reader(cluster):
    """Statuses of a thousand hosts are costly; a new reader has all of them after a second."""
    feed = Feed(cluster)
    feed.is_read = False
    assert feed.advance(5.0) == {}
    cluster.finish("well", code=1)
    assert feed.advance(5.1) == {}
    feed.is_read = True
    assert feed.advance(6.0)["process", "well"] is ERROR


def test_a_change_of_a_level_is_published_at_once_and_alone(cluster):
    """A failure between two seconds arrives before the next one, and is not repeated."""
    feed = Feed(cluster)
    feed.advance(5.0)
    cluster.finish("well", code=1)
    assert feed.advance(5.1) == {("process", "well"): ERROR}
    assert feed.advance(5.2) == {}


def test_events_that_change_no_level_are_not_published(cluster):
    """A burst of submissions of healthy processes costs no message."""
    feed = Feed(cluster)
    feed.advance(5.0)
    cluster.submit(process("more"))
    assert feed.advance(5.1) == {}


@pytest.mark.parametrize("now", [5.1, 6.0], ids=["at once", "with all others"])
def test_a_process_that_is_well_again_is_published_once_more(cluster, now):
    """Otherwise a monitor would show its last error for ever."""
    feed = Feed(cluster)
    feed.advance(5.0)
    cluster.restart("broken")
    assert feed.advance(now)["process", "broken"] is OK
    assert ("process", "broken") not in feed.advance(7.0)


def test_what_is_no_longer_listed_is_published_as_ok_once(cluster):
    """A lost host that was removed leaves no error behind."""
    cluster.add("b")
    feed = Feed(cluster)
    cluster.cut("b", seconds=20.0)
    assert feed.advance(5.0)["host", "b"] is ERROR
    cluster.ask(happened.PruneRequested, (), ("b",), OPERATOR)
    assert feed.advance(6.0)["host", "b"] is OK
    assert ("host", "b") not in feed.advance(7.0)
