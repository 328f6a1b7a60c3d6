"""Events with values that no honest sender has: each is harmless, and hides no later event."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rosrm.core.master import events as happened
from rosrm.model.devices import Device
from rosrm.model.orders import ReportInstances
from rosrm.model.sizes import size_of
from rosrm.model.values import (
    InstanceId,
    InstanceState,
    InstanceStatus,
    ResourceDescription,
    SnapshotReport,
)
from tests.unit.core.cluster import Cluster, Machine, job, process

#: Sequences that no host reaches: the largest ones of the wire, and one of a signed number.
FAR_AHEAD = [2**64 - 1, 2**63 - 1, 10**6]


def forge_reading(cluster: Cluster, sequence: int, **columns: Any) -> None:
    """Send a reading in the name of host a."""
    machine = cluster.machines["a"]
    honest = machine.sequence
    cluster.read(machine, sequence=np.array([sequence], np.uint64), **columns)
    machine.sequence = honest


def forge_batch(cluster: Cluster, sequence: int, *statuses: InstanceStatus) -> None:
    """Send a status batch in the name of host a."""
    machine = cluster.machines["a"]
    cluster.tell(
        happened.StatusesReceived(
            machine.host_id, machine.incarnation, sequence, False, tuple(statuses)
        )
    )


def running(name: str, number: int) -> InstanceStatus:
    return InstanceStatus(InstanceId(name, number), InstanceState.RUNNING, pid=7)


# --- sequences --------------------------------------------------------------------------------


@pytest.mark.parametrize("sequence", FAR_AHEAD)
def test_a_reading_far_ahead_is_refused(sequence: int) -> None:
    """The host is never suspect, and its own next reading counts."""
    cluster = Cluster("a")
    forge_reading(cluster, sequence)
    (said,) = cluster.recorded("reading_refused")
    assert str(sequence) in said
    cluster.wait(2.0)
    assert not cluster.recorded("host_suspect")


@pytest.mark.parametrize("sequence", FAR_AHEAD)
def test_a_first_reading_far_ahead_silences_its_host_for_seconds_only(sequence: int) -> None:
    """No reading tells yet that it is forged; the host's own readings count after 3 s."""
    cluster = Cluster()
    machine = Machine("a")
    machine.connected = False  # registered, without a reading
    machine.incarnation = 5
    cluster.machines["a"] = machine
    assert cluster.enter(machine, 0, ()).accepted
    machine.connected = True
    forge_reading(cluster, sequence)
    cluster.wait(4.0)
    assert not cluster.recorded("host_lost")
    assert cluster.submit(process("p")).accepted
    assert cluster.where("p") == ["a"]


def test_a_reading_far_ahead_of_lost_ones_counts_after_seconds() -> None:
    """The readings of 1,000 cycles were lost on their way from the host to the master."""
    cluster = Cluster("a", lease=100.0)
    cluster.machines["a"].sequence += 5000
    cluster.wait(4.0)
    assert cluster.recorded("host_back") == ["a reports again"]


@pytest.mark.parametrize("sequence", FAR_AHEAD)
def test_a_status_batch_far_ahead_is_refused(sequence: int) -> None:
    """Its statuses change nothing, and the host's own next batch counts."""
    cluster = Cluster("a").with_processes(job("p"))
    failed = InstanceStatus(InstanceId("p", 1), InstanceState.FAILED, exit_code=1)
    forge_batch(cluster, sequence, failed)
    assert cluster.phase("p") == "running"
    (said,) = cluster.recorded("peer_refused")
    assert "far ahead" in said
    cluster.finish("p")
    assert cluster.phase("p") == "finished"


@pytest.mark.parametrize("reported", [False, True])
def test_a_forged_status_batch_hides_later_ones_for_seconds_only(reported: bool) -> None:
    """The readings of the host show that the host has not sent that batch.

    A forged reading beside it does not help the sender.
    """
    cluster = Cluster("a").with_processes(job("p"))
    cluster.wait(1.0)
    batch = cluster.machines["a"].batches + 900
    if reported:
        batch = 2**63
        forge_reading(
            cluster, cluster.machines["a"].sequence + 1,
            status_sequence=np.array([batch], np.uint64),
        )  # fmt: skip
    forge_batch(cluster, batch)
    cluster.finish("p")
    assert cluster.phase("p") == "running"
    cluster.wait(3.0)
    assert cluster.phase("p") == "finished"


def test_batches_that_overtake_readings_are_not_reported_again() -> None:
    """A batch arrives before the reading that mentions it."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    for _ in range(40):
        forge_batch(cluster, machine.batches + 1)
        cluster.wait(0.1)
        machine.batches += 1
    assert not cluster.orders(ReportInstances)


# --- numbers ----------------------------------------------------------------------------------


def test_a_claimed_instance_number_is_never_assigned() -> None:
    """A host claims to hold the next instance; its number is not given to another process."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.report("a", running("ghost", 2))
    cluster.submit(process("q"))
    assert cluster.phase("q") == "running"
    assert cluster.state.instances[cluster["q"].owner].id.process == "q"
    assert cluster["q"].owner > 2


@pytest.mark.parametrize("number", [2**53, 2**63, 2**64 - 1])
def test_an_impossible_instance_number_is_ignored(number: int) -> None:
    """The next instances get the numbers that they would have had."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.report("a", running("ghost", number))
    cluster.submit(process("q"))
    assert sorted(cluster.state.instances) == [1, 2]


@pytest.mark.parametrize("seen", [2**53, 2**64 - 1])
def test_an_impossible_number_of_journal_records_stops_no_work(seen: int) -> None:
    """A forged beat may have told the slave that number."""
    cluster = Cluster()
    cluster.state.journal_gap.newest, cluster.state.journal_gap.started = 10, 0.0
    machine = Machine("a", incarnation=5)
    cluster.machines["a"] = machine
    assert cluster.register(machine, journal_seen=seen).accepted
    assert not cluster.recorded("journal_behind")
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]


ABSURD = [float("nan"), float("inf"), -1.0, 1e300]


@pytest.mark.parametrize("absurd", ABSURD)
def test_absurd_peaks_are_not_learned(absurd: float) -> None:
    """The next process of the program has the default needs."""
    cluster = Cluster("a").with_processes(job("p"))
    status = InstanceStatus(
        InstanceId("p", 1), InstanceState.EXITED, peak_memory=absurd, cpu_time=absurd, run_time=9.0
    )
    cluster.report("a", status)
    assert cluster.phase("p") == "finished"
    assert not cluster.state.learned.estimate(job("q"), {}).amounts


@pytest.mark.parametrize("absurd", ABSURD)
def test_an_absurd_run_time_is_not_learned(absurd: float) -> None:
    cluster = Cluster("a").with_processes(job("p"))
    cluster.report(
        "a", InstanceStatus(InstanceId("p", 1), InstanceState.EXITED, run_time=absurd, cpu_time=1.0)
    )
    assert not cluster.state.run_times


@pytest.mark.parametrize("absurd", [1e300, 2.0**54])
def test_an_absurd_usage_is_refused(absurd: float) -> None:
    cluster = Cluster("a").with_processes(process("p"))
    cluster.machines["a"].shown["p"] = {"memory": absurd}
    cluster.tell(cluster.machines["a"].usages(cluster.now))
    assert cluster.state.instances[1].peak == {}
    assert cluster.recorded("reading_refused")


# --- bounds -----------------------------------------------------------------------------------


def test_hosts_are_bounded() -> None:
    """A new host is refused; a known one, and one in the place of a pruned one, are not."""
    cluster = Cluster("a", "b", max_hosts=2)
    for name in ("c", "d", "e"):
        reply = cluster.ask(happened.HostRegistered, Machine(name, incarnation=5).description(), ())
        assert (reply.accepted, reply.code) == (False, "invalid")
        assert "the master knows 2 hosts" in reply.message
    assert len(cluster.recorded("host_refused")) == 1  # the names are the senders' choice
    assert cluster.restart_slave("a").code in ("", "name_taken")
    cluster.leave("b")
    cluster.ask(happened.PruneRequested, (), ("b",))
    cluster.add("c")
    assert cluster.submit(process("p")).accepted


def test_resources_of_all_hosts_are_bounded() -> None:
    """Each host may have 16, and all hosts together 64 different ones."""
    cluster = Cluster()

    def register(host: int, *names: str) -> bool:
        resources = tuple(ResourceDescription(name, "1", 1.0) for name in names)
        machine = Machine(f"h{host}", resources=resources, incarnation=host + 1)
        return cluster.ask(happened.HostRegistered, machine.description(), ()).accepted

    for host in range(4):
        assert register(host, *(f"r{host}-{n}" for n in range(16)))
    assert not register(4, "one-more")
    assert register(5, "r0-0", "r3-15")


def test_processes_are_bounded() -> None:
    """Ended processes do not count, and a refused batch queues nothing."""
    cluster = Cluster("a", max_processes=2).with_processes(process("p"), job("q"))
    reply = cluster.submit(process("r"))
    assert not reply.accepted
    assert "`queue.max_processes` (2)" in reply.message
    cluster.finish("q")
    assert cluster.submit(process("r")).accepted


HUGE = "x" * 60_000


@pytest.mark.parametrize(
    "texts",
    [
        {"labels": {f"k{n}": HUGE for n in range(200)}},
        {"absent": {f"k{n}": HUGE for n in range(200)}},
        {"unenforced": {"nice": HUGE * 2}},
        {"executors": tuple(f"{HUGE}{n}" for n in range(200))},
        {"launchers": (HUGE * 2,)},
        {"hostname": HUGE * 2},
        {"software_version": HUGE * 2},
        {"resources": (ResourceDescription("r", "B" * 70_000, 1.0),)},
        {"resources": (ResourceDescription("r", "B", 1.0, HUGE * 2),)},
        {"cpus": tuple(range(70_000))},
        {"devices": (Device("gpu", HUGE * 2),)},
        {"devices": tuple(Device("gpu", f"u{n}", missing=HUGE) for n in range(20))},
    ],
    ids=lambda texts: next(iter(texts)),
)
def test_the_description_of_a_host_is_bounded(texts: dict[str, Any]) -> None:
    """A registration has at most 64 KiB of texts; listings have parts of these texts."""
    cluster = Cluster()
    description = replace(Machine("a", incarnation=5).description(), **texts)
    reply = cluster.ask(happened.HostRegistered, description, ())
    assert (reply.accepted, reply.code) == (False, "invalid")
    assert len(reply.message) < 1000


def test_reports_of_a_host_are_bounded() -> None:
    """Messages, plugins, devices and snapshots of one host use little of the master's memory."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    machine.batches += 1
    status = InstanceStatus(
        InstanceId("p", 1), InstanceState.READY, pid=1, message=HUGE, enforced=(HUGE,) * 16
    )
    cluster.tell(
        happened.StatusesReceived(
            machine.host_id, machine.incarnation, machine.batches, False, (status,),
            failing={f"{n}": HUGE for n in range(1000)}, failing_launchers={HUGE: HUGE},
            devices=tuple(Device("gpu", f"u{n}", missing=HUGE) for n in range(20)),
        )
    )  # fmt: skip
    names = ("s" * 60_000, *(f"s{n}" for n in range(20_000)))
    snapshots = tuple(SnapshotReport(InstanceId(name, 1), 1, 1) for name in names)
    cluster.tell(happened.SnapshotsReported(machine.host_id, machine.incarnation, snapshots))
    host, state = cluster.state.hosts.by_name["a"], cluster.state
    assert size_of(state.instances[1].message) + size_of(state.instances[1].enforced) < 20_000
    assert sum(size_of(name) + len(one.error) for (_, name), one in host.failing.items()) < 100_000
    assert size_of(host.description.devices) < 100_000
    assert sum(map(len, state.replication.replicas.processes())) < 100_000
    assert max(len(record.message) for record in cluster.records) < 11_000


# --- claims about others ----------------------------------------------------------------------


@pytest.mark.parametrize("detached", [False, True])
def test_the_departure_of_a_host_that_still_accepts_work_is_undone(detached: bool) -> None:
    """Another has sent its `leave`: its processes continue, and it gets work again."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    kept = machine.begun() if detached else ()
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation, kept)
    cluster.submit(process("q"))
    assert cluster.queue() == ["q"]
    cluster.wait(4.0)
    (said,) = cluster.recorded("host_back")
    assert said.startswith("a has not left")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.where("q") == ["a"]
    assert cluster.state.instances[1].id == InstanceId("p", 1)


def test_a_host_reports_only_about_its_own_instances() -> None:
    """A host claims that an instance of another host has failed, and that it runs it."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5})).with_processes(process("p"))
    assert cluster.where("p") == ["a"]
    for state in (InstanceState.FAILED, InstanceState.RUNNING, InstanceState.STOPPING):
        cluster.report("b", InstanceStatus(InstanceId("p", 1), state, exit_code=1))
        cluster.settle()
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
