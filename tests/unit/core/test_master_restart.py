"""Restore of the master from its journal: the same intent, and no process started twice."""

from __future__ import annotations

import json

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.state.intents import process_intent
from rosrm.model.lazy import mapping_to_json
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus, RestartPolicy
from tests.unit.core.cluster import MIB, Cluster, Machine, job, movable, process


def test_the_queue_keeps_its_order() -> None:
    """Priorities and places are kept, also of processes that were set aside."""
    cluster = Cluster(Machine("a", memory=1000 * MIB, busy={"memory": 0.79}))
    cluster.submit(process("aside", required_labels={"x": "y"}), process("p", memory=100))
    cluster.submit(process("urgent", memory=100, priority=3), process("q", memory=100))
    before = cluster.queue()
    cluster.kill_master()
    assert cluster.queue() == before == ["urgent", "p", "q"]
    assert cluster.phase("aside") == "set_aside"
    cluster.machines["a"].busy["memory"] = 0.1
    cluster.restart_master()
    assert cluster.assigned() == ["urgent", "p", "q"]
    cluster.add(Machine("b", labels={"x": "y"}))
    assert cluster.where("aside") == ["b"]


def test_a_process_stays_set_aside_while_the_hosts_register() -> None:
    """Reason and age are kept, because no host with known limits may take it."""
    cluster = Cluster(Machine("a", memory=1000 * MIB)).with_processes(process("p", memory=900))
    reason, since = cluster["p"].reason, cluster["p"].since
    cluster.wait(5.0)
    cluster.restart_master()
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("set_aside", reason)
    assert cluster["p"].since == pytest.approx(since, abs=0.01)
    assert len(cluster.recorded("set_aside")) == 1


def test_the_reason_of_a_process_that_is_set_aside_follows_the_hosts() -> None:
    """The reason includes hosts that register later."""
    cluster = Cluster("a").with_processes(process("p", required_labels={"x": "y"}))
    cluster.add("b")
    cluster.wait(0.2)
    assert cluster["p"].reason == "no host may take it: each of a and b lacks the label x=y"
    assert cluster.intents["process"]["p"]["reason"] == cluster["p"].reason


def test_running_processes_keep_running_and_are_not_started_twice() -> None:
    """The process is expected on its host, and its slave reports it."""
    cluster = Cluster("a", "b").with_processes(process("p"), process("q"))
    pids = {n: m.programs[next(iter(m.programs))].pid for n, m in cluster.machines.items()}
    cluster.kill_master()
    assert cluster.phase("p") == "unreachable"
    assert "has not reported since the master started" in cluster["p"].reason
    cluster.restart_master()
    assert (cluster.phase("p"), cluster.phase("q")) == ("running", "running")
    assert {n: m.programs[next(iter(m.programs))].pid for n, m in cluster.machines.items()} == pids
    assert len(cluster.assigned()) == 2


@pytest.mark.parametrize("seconds", [-3600.0, 3600.0])
def test_the_age_of_a_phase_is_not_that_of_a_clock_that_was_set(seconds: float) -> None:
    """The next master on the machine reads the boot clock."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.wait(60.0)
    since = cluster["p"].since
    cluster.clock_set_by = seconds
    cluster.restart_master()
    assert cluster["p"].since == since


@pytest.mark.parametrize("boot", ["another", ""])
def test_after_a_boot_the_age_of_a_phase_is_that_of_the_wall_clock(boot: str) -> None:
    """The boot clock began at zero again, or the boot of the journal is not known."""
    cluster = Cluster("a").with_processes(process("p"))
    since = cluster["p"].since
    cluster.clock_set_by = 3600.0
    cluster.boot = boot
    cluster.restart_master()
    assert cluster["p"].since == pytest.approx(since - 3600.0)


def test_the_age_of_a_move_is_not_that_of_a_clock_that_was_set() -> None:
    """The event of the move has its duration, measured without the unix time."""
    cluster = Cluster("a", "b").with_processes(movable("p"))
    cluster.wait(60.0)
    (source,) = cluster.where("p")
    cluster.machines[source].stubborn.add("p")
    assert cluster.migrate("p").accepted
    cluster.wait(1.0)
    started = cluster.state.migrations["p"].started
    cluster.clock_set_by = 3600.0
    cluster.restart_master()
    assert cluster.state.migrations["p"].started == started


def test_a_process_that_runs_as_before_is_not_written_again() -> None:
    """The journal already has the phase and its start, exactly as this master would write them."""
    cluster = Cluster("a").with_processes(process("p"))
    written = cluster.intents["process"]["p"]
    cluster.wait(5.0)
    cluster.restart_master()
    assert cluster.phase("p") == "running"
    assert cluster.intents["process"]["p"] is written
    intent = process_intent(cluster.state, cluster["p"])
    assert json.loads(mapping_to_json(intent.value)) == written


def test_ends_during_the_absence_of_the_master_are_known() -> None:
    """The slave reports ended instances when it registers."""
    cluster = Cluster("a").with_processes(job("good"), job("bad"))
    cluster.kill_master()
    cluster.machines["a"].finish("good", cluster.now)
    cluster.machines["a"].finish("bad", cluster.now, code=4)
    cluster.restart_master()
    assert (cluster.phase("good"), cluster.phase("bad")) == ("finished", "failed")


@pytest.mark.parametrize("spec", [process("p"), job("p"), movable("p")], ids=lambda one: one.kind)
def test_a_process_that_its_slave_ended_without_a_master_is_queued_again(spec) -> None:
    """Ctrl-C on the slave ended the processes without a failure, so they are queued again."""
    cluster = Cluster("a").with_processes(spec)
    machine = cluster.machines["a"]
    cluster.kill_master()
    machine.stop_unreachable(cluster.now)
    machine.restart_slave(cluster.now)
    cluster.register(machine)
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.recorded("queued") == ["p returns to the queue: its instance on a was stopped"]


def test_a_process_that_was_cancelled_before_its_slave_ended_it_stays_cancelled() -> None:
    """The cancel is in the journal, though it had not reached the slave."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.journal(cluster.decide(happened.CancelRequested(9, ("p",))))
    cluster.kill_master()
    machine = cluster.machines["a"]
    machine.stop_unreachable(cluster.now)
    machine.restart_slave(cluster.now)
    cluster.register(machine)
    assert cluster.phase("p") == "cancelled"


def test_the_next_master_knows_hosts_and_starts_of_phases() -> None:
    """Start of the phase and host are kept, for running, waiting and ended processes."""
    cluster = Cluster("a")
    cluster.submit(process("runs"), process("waits", memory=1e6), job("ends"))
    cluster.machines["a"].finish("ends", cluster.now, code=4)
    cluster.wait(60.0, tick=1.0)
    before = {row.name: row for row in listing.process_rows(cluster.state, cluster.now)}
    assert (before["ends"].host, before["ends"].exit_code) == ("a", 4)
    assert before["runs"].exit_code is None
    cluster.kill_master()
    unseen = listing.process_row(cluster.state, cluster["runs"], cluster.now)
    assert (unseen.state, unseen.since) == ("unreachable", 0.0)
    cluster.restart_master()  # killed again, before any slave registered
    after = {row.name: row for row in listing.process_rows(cluster.state, cluster.now)}
    for name, row in after.items():
        told = (row.state, row.host, row.exit_code)
        assert told == (before[name].state, before[name].host, before[name].exit_code)
        assert row.since == pytest.approx(before[name].since) == pytest.approx(60.0, abs=1.0)


def test_a_restart_without_a_master_begins_the_run_time_again() -> None:
    """Its slave restarted it while the master was away."""
    cluster = Cluster("a").with_processes(process("p", restart=RestartPolicy("always")))
    cluster.wait(60.0, tick=1.0)
    cluster.kill_master()
    cluster.machines["a"].finish("p", cluster.now)
    cluster.restart_master()
    assert cluster.phase("p") == "running"
    assert listing.process_row(cluster.state, cluster["p"], cluster.now).since < 1.0


def test_an_undelivered_assignment_is_repeated() -> None:
    """The assignment was durable but never sent, so its host does not report it."""
    cluster = Cluster("a")
    commands = cluster.decide(happened.SubmissionReceived(1, (process("p"),)))
    cluster.journal(commands)
    cluster.restart_master()
    assert cluster.phase("p") == "running"
    # numbers are reserved by the thousand, and none is used again
    assert cluster["p"].owner == 1001


def test_an_outcome_that_was_not_journalled_has_no_effect() -> None:
    """The master was killed before the write and had not replied to the request."""
    cluster = Cluster("a")
    cluster.decide(happened.SubmissionReceived(1, (process("p"),)))
    cluster.restart_master()
    assert not cluster.state.processes
    assert cluster.submit(process("p")).accepted


def test_hosts_keep_their_numbers_and_are_still_cordoned_or_draining() -> None:
    """Cordoned and drained hosts stay so."""
    cluster = Cluster("a", "b", "c")
    cluster.set_host("b", "cordon")
    cluster.set_host("c", "drain")
    ids = {name: machine.host_id for name, machine in cluster.machines.items()}
    cluster.restart_master()
    assert {name: machine.host_id for name, machine in cluster.machines.items()} == ids
    hosts = cluster.state.hosts.by_name
    assert [(h.cordoned, h.draining) for h in hosts.values()] == [
        (False, False), (True, False), (True, True),
    ]  # fmt: skip


def test_learned_needs_survive_the_master() -> None:
    """Learned needs of earlier runs outlive the master."""
    cluster = Cluster("a")
    cluster.machines["a"].shown["first"] = {"memory": 160 * MIB}
    cluster.submit(job("first"))
    cluster.finish("first")
    cluster.restart_master()
    cluster.submit(process("second"))
    assert cluster.explain("second")["decision"]["need"]["memory"] == 160 * MIB


def test_a_journalled_cancel_is_carried_out() -> None:
    """A running process and a queued one end as cancelled."""
    cluster = Cluster("a").with_processes(process("runs"), process("waits", memory=1e6))
    commands = cluster.decide(happened.CancelRequested(9, ("runs", "waits")))
    cluster.journal(commands)
    cluster.restart_master()
    cluster.wait(1.0)
    assert (cluster.phase("runs"), cluster.phase("waits")) == ("cancelled", "cancelled")
    assert cluster.where("runs") == []


def test_a_host_that_does_not_register_is_lost_after_its_lease() -> None:
    """Processes that fit only there do not block the queue forever."""
    cluster = Cluster("a", Machine("b", labels={"x": "y"}))
    cluster.submit(process("p", required_labels={"x": "y"}))
    cluster.machines["b"].connected = False
    cluster.restart_master()
    cluster.submit(process("special", required_labels={"x": "y"}), process("plain"))
    assert cluster.queue() == ["special", "plain"]
    cluster.wait(11.0)
    assert len(cluster.recorded("host_lost")) == 1
    assert (cluster.phase("p"), cluster["p"].reason) == ("unreachable", "b is lost")
    assert (cluster.phase("special"), cluster.where("plain")) == ("set_aside", ["a"])


@pytest.mark.parametrize("overlap", [True, False])
@pytest.mark.parametrize("first", ["a", "b"])
@pytest.mark.parametrize("ready", [True, False])
def test_a_move_in_progress_continues(overlap: bool, first: str, ready: bool) -> None:
    """Whichever slave registers first, before or after the commit, one owner runs in the end."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(movable("p", overlap=overlap, ros=True))
    cluster.discover("p")
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    if not overlap:
        cluster.let_go("p")
    if ready:
        cluster.discover("p", "b")
    cluster.machines["a"].stubborn.clear()
    cluster.kill_master()
    second = "b" if first == "a" else "a"
    for name in (first, second):
        cluster.register(cluster.machines[name])
        cluster.wait(3.0)
        assert len(cluster.where("p")) <= 1 + overlap
    cluster.wait(0.0 if ready else 15.0)
    (host,) = cluster.where("p")
    assert host == ("b" if ready else "a")
    cluster.machines[host].seen_in_graph("p", cluster.now)
    cluster.settle()
    assert cluster.phase("p") == "running"
    assert cluster.where("p") == [cluster.state.instances[cluster["p"].owner].host.name]
    assert not cluster.intents["migration"]


def test_the_duration_of_a_move_counts_from_its_start() -> None:
    """The duration includes the time in which the master was away."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(movable("p", ros=True))
    cluster.discover("p")
    cluster.migrate("p")
    cluster.wait(2.0)
    cluster.now += 3.0
    cluster.restart_master()
    cluster.machines["b"].seen_in_graph("p", cluster.now)
    cluster.wait(0.5)
    (moved,) = [record for record in cluster.records if record.kind == "migrated"]
    assert moved.facts["seconds"] == pytest.approx(5.0, abs=0.3)


def test_a_source_that_was_ordered_to_stop_has_not_finished() -> None:
    """The master died after the stop order, so the source's exit code 0 is not its own end."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(movable("p", overlap=False))
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    cluster.kill_master()
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.restart_master()
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    assert len(cluster.where("p")) == 1


def test_a_number_that_a_host_holds_is_not_used_again_after_a_lost_journal() -> None:
    """Otherwise statuses of the old instance would apply to the new one."""
    cluster = Cluster("a").with_processes(process("p"), process("q"))
    held = max(instance.number for instance in cluster.machines["a"].programs)
    cluster.intents.clear()
    cluster.restart_master()
    cluster.submit(process("new"))
    assert cluster["new"].owner > held
    assert (cluster.where("p"), cluster.where("new")) == ([], ["a"])


def test_the_status_of_another_process_with_the_same_number_changes_nothing() -> None:
    """An instance of another process with the same number is stopped, without effect on p."""
    cluster = Cluster("a").with_processes(process("p"))
    for state in (InstanceState.STOPPING, InstanceState.FAILED):
        cluster.report("a", InstanceStatus(InstanceId("former", cluster["p"].owner), state))
    cluster.settle()
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_a_host_is_expected_until_it_reports_to_a_restarted_master() -> None:
    """The listing does not call it lost before its lease has ended."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.kill_master()
    cluster.machines["a"].connected = False
    cluster.restart_master()
    (row,) = listing.host_rows(cluster.state, cluster.now)
    assert row.state == "expected"
    cluster.wait(60.0)
    (row,) = listing.host_rows(cluster.state, cluster.now)
    assert row.state == "lost"


def test_a_registered_host_has_the_reservations_of_its_processes_at_once() -> None:
    """Otherwise the first decisions of a new master would overload the hosts."""
    cluster = Cluster("a").with_processes(process("p", 6_000))
    cluster.kill_master()
    cluster.enter(cluster.machines["a"], 0, ())
    host = cluster.state.hosts.by_name["a"]
    (instance,) = cluster.state.instances_of(host)
    memory = cluster.state.hosts.resources.index("memory")
    assert instance.reserved[memory] > 0.3


@pytest.mark.parametrize(("ran", "is_placed"), [(11.0, True), (9.0, False)])
def test_readings_show_the_load_of_processes_from_before_the_restart(
    ran: float, is_placed: bool
) -> None:
    """Otherwise a host with many processes would get no work for `settle` after a restart."""
    cluster = Cluster(Machine("a", memory=1000 * MIB), settle=10.0)
    cluster.with_processes(*(process(f"p{number}") for number in range(9)))
    cluster.wait(ran)
    cluster.machines["a"].busy["memory"] = 0.2
    cluster.restart_master()
    cluster.wait(0.3)
    cluster.submit(process("new"))
    assert (cluster.phase("new") == "running") is is_placed
