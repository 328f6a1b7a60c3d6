"""Retries: each remembers what failed and has a back-off, which a change of the facts ends."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign, Redeliver, Withdraw
from rosrm.core.master.state.backoff import Backoff, Retries
from rosrm.core.slave import events
from rosrm.model.orders import AmendInstance
from rosrm.model.values import InstanceState, Limits, MigrationPolicy, NeighbourRule, ProcessSpec
from tests.unit.core.cluster import GIB, Cluster, Machine, movable, node, process


class Broken(Machine):
    """A host on which each program ends with exit code 1 soon after its start."""

    broken = True

    def tell(self, event: events.Event, now: float) -> None:
        super().tell(event, now)
        if self.broken:
            for one in list(self.programs):
                self._end(one, InstanceState.FAILED, now, code=1)


def moving(*, overlap: bool = True) -> ProcessSpec:
    return node("p", migration=MigrationPolicy("relaunch", overlap=overlap))


def broken_beside(*others: Machine, overlap: bool = True) -> Cluster:
    """Return a cluster with a process on host a, which cannot run on host b."""
    cluster = Cluster("a").with_processes(moving(overlap=overlap))
    cluster.discover("p")
    for machine in (Broken("b"), *others):
        cluster.add(machine)
    return cluster


def play(cluster: Cluster, seconds: float) -> int:
    """Let time pass, in which the node is discovered after each start; return its starts on a."""
    pids = set[int]()
    for _ in range(round(seconds / 0.5)):
        cluster.wait(0.5, tick=0.5)
        for machine in cluster.machines.values():
            for instance, program in list(machine.programs.items()):
                if machine.name == "a":
                    pids.add(program.pid)
                machine.seen_in_graph(instance.process, cluster.now)
        cluster.settle()
    return len(pids)


def test_the_wait_after_each_failure_in_a_row_doubles_up_to_the_longest() -> None:
    """No wait is shorter than the first."""
    backoff = Backoff()
    assert [backoff.note(0.0, 2.0, 10.0) for _ in range(5)] == [2.0, 4.0, 8.0, 10.0, 10.0]
    assert Backoff().note(0.0, 20.0, 10.0) == 20.0


def test_what_has_failed_waits_longer_than_everything_else() -> None:
    """A change of what has failed ends both waits."""
    retries = Retries()
    retries.note("b", "crashed", 0.0, 30.0)
    assert (retries.why_none(1.0), retries.waiting(1.0)) == ("crashed", {"b": "crashed"})
    assert (retries.why_none(3.0), retries.waiting(3.0)) == ("", {"b": "crashed"})
    assert retries.waiting(31.0) == {}
    retries.note("b", "crashed", 31.0, 30.0)
    assert retries.waiting(90.0) == {"b": "crashed"}
    retries.forget("b")
    assert (retries.why_none(31.5), retries.waiting(31.5)) == ("", {})


def test_a_drain_does_not_restart_a_process_again_and_again() -> None:
    """The process fails on the only other host, and each move stops it first."""
    cluster = broken_beside(overlap=False)
    cluster.set_host("a", "drain")
    assert play(cluster, 600.0) <= 7
    assert cluster.where("p") == ["a"]


def test_a_host_is_drained_although_moves_off_it_have_failed() -> None:
    """An event says once what is left and why; the master tries the moves again later."""
    cluster = broken_beside()
    cluster.set_host("a", "drain")
    play(cluster, 3.0)
    assert cluster.state.hosts.by_name["a"].drained
    (drained,) = cluster.recorded("host_drained")
    assert "p may run on no other host: b: its move to b has failed" in drained
    assert "the move is tried again later" in drained
    cluster.machines["b"].broken = False
    play(cluster, 60.0)
    assert cluster.where("p") == ["b"]
    assert cluster.recorded("host_drained")[-1] == "a is drained: no process is left"


def test_a_drain_tries_another_host_after_a_failed_one() -> None:
    """The memory is of the process and its destination."""
    cluster = broken_beside(Machine("c", busy={"memory": 0.6, "cpu": 0.1}))
    cluster.set_host("a", "drain")
    play(cluster, 10.0)
    assert cluster.where("p") == ["c"]
    assert len(cluster.recorded("stayed")) == 1


def test_an_eviction_does_not_repeat_a_failing_destination_at_each_cool_down() -> None:
    """The wait before the same destination doubles with each failure."""
    cluster = broken_beside(overlap=False)
    cluster.machines["a"].busy["memory"] = 0.85
    cluster.machines["a"].shown["p"] = {"memory": 2.0**30}
    assert play(cluster, 1800.0) <= 9


def test_a_new_run_of_the_slave_forgets_failed_moves_to_its_host() -> None:
    """Whatever the process lacked there may have been installed."""
    cluster = broken_beside()
    cluster.set_host("a", "drain")
    play(cluster, 3.0)
    cluster.machines["b"].broken = False
    cluster.cut("b", seconds=2.0)
    cluster.restart_slave("b")
    play(cluster, 5.0)
    assert cluster.where("p") == ["b"]


def test_a_user_may_repeat_a_failed_move_at_once() -> None:
    """Requests of users have no back-off."""
    cluster = broken_beside()
    assert cluster.migrate("p").accepted
    play(cluster, 1.0)
    cluster.machines["b"].broken = False
    assert cluster.migrate("p", "b").accepted
    play(cluster, 5.0)
    assert cluster.where("p") == ["b"]


def test_a_host_that_refused_a_process_is_tried_again_after_a_wait() -> None:
    """The disk of the host was full, and the process has waited for another host since."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.79, "cpu": 0.1}))
    cluster.machines["a"].refuses["p"] = "its artifact was not fetched: no space left on device"
    cluster.submit(process("p", memory=500))
    cluster.wait(30.0)
    assert cluster.phase("p") == "queued"
    assert len(cluster.assigned()) == 1
    del cluster.machines["a"].refuses["p"]
    cluster.wait(40.0)
    assert cluster.where("p") == ["a"]


def test_a_running_process_moves_to_a_host_that_has_refused_it_long_ago() -> None:
    """The master also tries moves to such a host again."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.3, "cpu": 0.1}))
    cluster.with_processes(movable("p"))
    cluster.machines["b"].refuses["p"] = "its artifact was not fetched: no space left on device"
    cluster.set_host("a", "drain")
    cluster.wait(5.0)
    assert list(cluster["p"].excluded) == ["b"]
    del cluster.machines["b"].refuses["p"]
    cluster.wait(120.0)
    assert cluster.where("p") == ["b"]


def test_a_host_that_refuses_a_process_for_ever_is_tried_less_and_less() -> None:
    """The wait doubles, also for a host that a former master has excluded."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.79, "cpu": 0.1}))
    cluster.machines["a"].refuses["p"] = "no such program"
    cluster.submit(process("p", memory=500))
    cluster.wait(600.0, tick=0.5)
    cluster.restart_master()
    cluster.wait(30.0)
    assert 3 <= len(cluster.assigned()) <= 6


class Unfetched(Cluster):
    """A cluster whose host a reports readings, and never fetches an assignment."""

    def assign(self, host: Machine, command: Assign) -> None:
        if host.name != "a":
            super().assign(host, command)

    def _redeliver(self, command: Redeliver) -> None:
        """Send nothing, because the assignment waits to be fetched."""

    def _withdraw(self, command: Withdraw) -> None:
        self.tell(happened.AssignmentWithdrawn(command.instance))


def test_a_host_that_fetches_no_assignment_gets_none_until_it_asks_again() -> None:
    """A process that fits on another host, too, does not wait for the best one for ever."""
    cluster = Unfetched("a", Machine("b", busy={"memory": 0.3, "cpu": 0.1}))
    cluster.with_processes(process("p"), process("q"))
    cluster.wait(2.0 * cluster.settings.delivery_timeout)
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])
    cluster.ask_for_work(cluster.machines["a"])
    cluster.submit(process("r"))
    assert cluster.state.instances[cluster["r"].owner].host.name == "a"


def test_an_order_of_which_nothing_is_reported_ends_without_an_answer() -> None:
    """A reload does not wait for ever for a slave."""
    cluster = Cluster("a", "b")
    request = cluster.request(happened.ReloadRequested(0))
    cluster.tell(happened.SettingsRead(request))
    cluster.machines["b"].ordered.clear()
    cluster.wait(120.0, tick=0.5)
    assert "b: not reloaded: no answer in time" in cluster.replies[request].message


def test_a_refused_change_of_a_running_process_is_repeated_with_back_off() -> None:
    """The slave refuses the change, because it cannot set the limit."""
    cluster = Cluster(Machine("a", uses=1e9))
    cluster.apply("nav", process("p", limits=Limits(memory=2e9)))
    cluster.apply("nav", process("p", limits=Limits(memory=5e8)))
    cluster.wait(300.0, tick=0.5)
    assert 5 <= len(cluster.orders(AmendInstance)) <= 12


# --- property ---------------------------------------------------------------------------------


def of_host_a(cluster: Cluster) -> int:
    """Return how often the process was started on its own host."""
    return sum(one.kind == "starting" and one.host == "a" for one in cluster.records)


@settings(max_examples=10)
@given(
    cause=st.sampled_from(["drain", "limit", "rebalance", "preemption", "reunion"]),
    overlap=st.booleans(),
    broken=st.sets(st.sampled_from("bcd"), min_size=1),
    need=st.sampled_from(["measured", "declared"]),
    lost=st.sets(st.integers(0, 60), max_size=20),
)
def test_no_cause_moves_a_process_again_and_again_to_where_it_fails(
    cause: str, overlap: bool, broken: set[str], need: str, lost: set[int]
) -> None:
    """In 200 s, with lost orders, each host is tried a few times; then a good one is used."""
    cluster = Cluster(
        Machine("a", memory=4 * GIB), need=need, settle=5.0, cooldown=10.0, hysteresis=1.0,
        rebalance=cause == "rebalance", rebalance_after=5.0, preemption="move",
    )  # fmt: skip
    near = (NeighbourRule("near", ("q",), by="rack"),) if cause == "reunion" else ()
    spec = node("p", neighbours=near, migration=MigrationPolicy("relaunch", overlap=overlap))
    cluster.submit(node("q"), spec)
    cluster.machines["a"].shown["p"] = {"memory": 2 * GIB}
    for name in "bcd":
        kind = Broken if name in broken else Machine
        cluster.add(kind(name, memory=4 * GIB))
    if cause == "drain":
        cluster.set_host("a", "drain")
    elif cause == "limit":
        cluster.machines["a"].busy["memory"] = 0.4
    elif cause == "preemption":
        cluster.submit(process("big", 3000, priority=1, required_labels={}))
    for at in range(400):
        if at in lost:
            for machine in cluster.machines.values():
                while machine.ordered:
                    cluster.tell(happened.OrderAnswered.missing(machine.ordered.popleft().order_id))
        play(cluster, 0.5)
    begun = sum(
        one.kind == "migration_begun" and one.process == "p" for one in cluster.records
    )  # fmt: skip
    assert begun <= 5 * 3
    assert of_host_a(cluster) <= 5 * 3
