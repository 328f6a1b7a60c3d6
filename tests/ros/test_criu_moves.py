"""Processes that move with their whole memory: dumped by CRIU, restored on another host."""

from __future__ import annotations

import pytest

from rosrm.model.values import Health
from tests.ros.portable_kit import NAME, ask, counter, nothing_left, two_hosts


@pytest.fixture(scope="module")
def cluster(make_shared):
    return two_hosts(make_shared)


def moved(cluster, times: int):
    """Return the process after so many migrations, none of which has failed."""

    def there(view) -> bool:
        stayed = [event.message for event in cluster.events("stayed")]
        assert not stayed, stayed
        return any(row.migrations == times and row.state == "running" for row in view.processes)

    view = cluster.wait_until(f"{times} migrations", there, 60.0)
    return next(row for row in view.processes if row.state == "running")


def test_a_node_counts_on_where_it_is_restored(criu, cluster, listener):
    """Over several migrations no count is repeated or missing, and the memory is the same."""
    cluster.submit(counter())
    cluster.wait(NAME, "running")
    listener.receive(50)
    for times in (1, 2, 3):
        before = cluster.process(NAME).host
        assert not ask(cluster)
        row = moved(cluster, times)
        assert row.host != before
        listener.receive(50)
    # A reader that discovers the writer late misses its first counts.
    steps = listener.steps()
    assert min(steps) == 1
    assert sum(step > 1 for step in steps) <= 3
    assert len(listener.checksums) == 1
    cluster.cancel(NAME)
    nothing_left(cluster)


def test_memory_that_is_written_during_its_copy_arrives_as_it_was_left(criu, cluster, listener):
    """Twice, most of the memory comes from the copy that was sent before the node was frozen."""
    cluster.submit(counter("--mb", "100", "--period", "0.02", "--write", "0.05"))
    cluster.wait(NAME, "running")
    listener.receive(50)
    for times in (1, 2):
        before = cluster.client.list().last_sequence
        assert not ask(cluster)
        moved(cluster, times)
        event = cluster.wait_for_event("migrated", process=NAME, after=before)
        assert "dump_compared" in event.facts["parts"]["criu_checkpoint"], "the whole dump was sent"
        listener.receive(100)  # all its memory is read again within 50 counts
    assert min(listener.steps()) == 1
    assert len(listener.checksums) == 1
    cluster.cancel(NAME)
    nothing_left(cluster)


def test_it_is_healthy_where_it_is_restored(criu, cluster, listener):
    """The health watch knows its topic, although the node has another pid in its namespace."""
    cluster.submit(counter(health=Health("count", rate=10.0, timeout=3.0)))
    cluster.wait(NAME, "running")
    listener.receive(50)
    assert not ask(cluster)
    moved(cluster, 1)
    listener.receive(300)  # twice the timeout of the health watch
    row = cluster.process(NAME)
    assert (row.state, row.restarts, row.migrations) == ("running", 0, 1)
    cluster.cancel(NAME)
