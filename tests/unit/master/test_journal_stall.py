"""Journal stall: events that are noted, refused, queued or dropped until writes succeed."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Record
from rosrm.errors import JournalBlocked
from rosrm.master import journal_stall
from rosrm.master.journal_stall import JournalStall
from rosrm.master.journal_writer import JournalLate
from rosrm.model.values import InstanceId
from tests.unit.core.cluster import Cluster, process

REFUSED = {
    happened.HostRegistered, happened.SubmissionReceived, happened.ApplicationsRequested,
    happened.ModesLoaded, happened.ModeRequested,
    happened.CancelRequested,
    happened.RestartRequested, happened.MigrationRequested, happened.HostStateRequested,
    happened.CheckpointRequested, happened.RestoreRequested, happened.PruneRequested,
    happened.RebalanceRequested, happened.ReloadRequested,
}  # fmt: skip
KEPT = {
    happened.HostLeft, happened.StatusesReceived, happened.OrderAnswered,
    happened.HandoffReported, happened.AssignmentWithdrawn, happened.SettingsRead,
}  # fmt: skip
NEWEST = {happened.ProcessRequested, happened.SnapshotsReported, happened.KeyRevoked}
DROPPED = {
    happened.TimePassed, happened.UsagesReceived, happened.PeerRefused, happened.SourceStranded,
}  # fmt: skip


def still(now: float = 100.0) -> JournalStall:
    fault = JournalBlocked("the disk is full")
    return JournalStall([Record("n")], fault, since=5.0, core_now=now, tried=5.0)


def take(
    held: JournalStall, *events: happened.Event, cluster: Cluster | None = None, now: float = 5.0
) -> list:
    replies: list = []
    held.take((cluster or Cluster()).state, events, replies.append, now)
    return replies


def statuses(sequence: int) -> happened.StatusesReceived:
    return happened.StatusesReceived(1, 2, sequence, False, ())


def test_every_event_has_its_place() -> None:
    """A new kind of event needs an entry here."""
    known = REFUSED | KEPT | NEWEST | DROPPED | {happened.ReadingsReceived}
    assert known == set(get_args(happened.Event))


def test_requests_are_turned_away_with_the_reason() -> None:
    """The refusal has its own code, so that a slave knows that a retry may succeed."""
    held = still()
    (reply,) = take(held, happened.CancelRequested(7, ("p",)))
    assert (reply.request, reply.accepted, reply.code) == (7, False, "journal")
    assert "the disk is full" in reply.message
    assert held.waiting() == []


def test_requests_are_held_while_a_write_is_slow() -> None:
    """After 5 s all of them are refused; what happened stays in order."""
    held = still()
    held.fault = JournalLate("the disk has not answered")
    events = [statuses(1), happened.CancelRequested(7, ("p",)), statuses(2)]
    assert take(held, *events, now=9.9) == []
    assert held.waiting() == events
    assert not held.refuses
    replies = take(held, happened.CancelRequested(8, ("p",)), statuses(3), now=10.0)
    assert [reply.request for reply in replies] == [7, 8]
    assert held.waiting() == [statuses(1), statuses(2), statuses(3)]
    assert held.refuses


def test_held_requests_are_refused_once_the_write_has_failed() -> None:
    held = still()
    held.fault = JournalLate("the disk has not answered")
    take(held, happened.CancelRequested(7, ("p",)))
    held.fault = JournalBlocked("the disk is full")
    (reply,) = take(held)
    assert "the disk is full" in reply.message


def test_what_happened_is_kept_in_order_and_of_requests_for_work_the_newest() -> None:
    """A reported end is not lost; of a slave's repeated requests for work only one is kept."""
    held = still()
    left = happened.HostLeft(9, 3, 4)
    events = [
        statuses(1), happened.ProcessRequested(1, 5, 6), left, happened.TimePassed(),
        happened.AssignmentWithdrawn(InstanceId("p", 1)), happened.ProcessRequested(2, 5, 6),
    ]  # fmt: skip
    assert take(held, *events) == []
    assert held.waiting() == [events[0], left, events[4], events[5]]


def test_what_is_kept_is_bounded(monkeypatch) -> None:
    """The slaves send dropped statuses again on request."""
    monkeypatch.setattr(journal_stall, "_MOST_STATUSES", 3)
    held = still()
    take(held, *(statuses(n) for n in range(10)))
    assert held.waiting() == [statuses(n) for n in range(3)]


def test_no_host_falls_silent_by_it() -> None:
    """Readings are noted: no deadline passes within a minute, and lost statuses are requested."""
    cluster = Cluster("a", "b", lease=10.0, suspect=1.0)
    cluster.submit(process("p"), process("q"))
    held = still(cluster.now)
    machine = cluster.machines["a"]
    machine.batches += 1  # a status batch that was dropped
    machine.busy["memory"] = 0.7
    take(held, cluster.readings(list(cluster.machines.values())), cluster=cluster)
    column = cluster.state.hosts.by_name["a"].column
    assert cluster.state.hosts.usage[0, column] == pytest.approx(0.7)
    assert np.all(cluster.state.hosts.last_contact == cluster.now)
    cluster.tell(happened.TimePassed())
    cluster.wait(3.0)
    assert not [one for one in cluster.records if one.kind in ("host_suspect", "host_lost")]
    assert cluster.state.hosts.status_sequence[column] == machine.batches


def test_a_contact_ends_the_suspicion_of_a_host() -> None:
    """Beats must report the contact; otherwise the host's fenced processes would stop.

    A lost host stays lost.
    """
    cluster = Cluster("a", "b", "c", lease=10.0, suspect=1.0)
    cluster.machines["b"].connected = False
    cluster.wait(12.0)
    cluster.machines["a"].connected = False
    cluster.wait(2.0)
    a, b, _ = (cluster.state.hosts.by_name[name].host_id for name in "abc")
    assert cluster.state.hosts.silent_hosts() == [a, b]
    held = still(cluster.now)
    for machine in cluster.machines.values():
        machine.connected = True
    take(held, cluster.readings(list(cluster.machines.values())), cluster=cluster)
    assert cluster.state.hosts.silent_hosts() == [b]
    cluster.wait(1.0)
    assert cluster.state.hosts.silent_hosts() == []
