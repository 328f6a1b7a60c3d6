"""Migration plans: forward, undo of each step, and moves that are stuck."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.slave import events
from rosrm.extensions.declared_fields import Declared
from rosrm.model.orders import StartInstance
from rosrm.model.plan import AwaitReady, Commit, Execute, Move, Plan, SetRestart, Start, Stop
from rosrm.model.values import (
    InstanceId,
    InstanceState,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
)
from tests.unit.core.cluster import Cluster, Machine, StartFirstOrStopFirst, job, movable, process


def two_hosts(*, overlap: bool = True, **settings: Any) -> Cluster:
    """Return a cluster where p runs on a as a ROS node, and b has room."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5, "cpu": 0.1}), **settings)
    cluster.submit(movable("p", overlap=overlap, ros=True))
    cluster.discover("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    return cluster


def ready_on(cluster: Cluster, host: str, name: str = "p") -> None:
    cluster.machines[host].seen_in_graph(name, cluster.now)
    cluster.settle()


# --- forward ----------------------------------------------------------------------------------


def test_start_first_runs_both_until_the_new_one_is_ready() -> None:
    """The steps are start there, ready there, commit, stop here."""
    cluster = two_hosts()
    reply = cluster.migrate("p")
    assert (reply.accepted, reply.host, reply.message) == (True, "b", "p moves to b")
    assert (cluster.phase("p"), cluster.where("p")) == ("migrating", ["a", "b"])
    ready_on(cluster, "b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    assert (cluster["p"].migrations, cluster["p"].owner) == (1, 2)
    assert cluster.recorded("migrated") == ["p moved from a to b"]


def test_stop_first_never_runs_two() -> None:
    """The steps are stop here, start there, ready there, commit."""
    cluster = two_hosts(overlap=False)
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    assert cluster.where("p") == ["a"]
    cluster.let_go("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("migrating", ["b"])
    ready_on(cluster, "b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    assert not cluster.intents["migration"]


def test_the_destination_is_counted_from_the_beginning_and_the_source_to_its_end() -> None:
    """Both hosts have the room that the move needs."""
    cluster = two_hosts()
    cluster.migrate("p")
    assert cluster.state.hosts.processes.tolist() == [1, 1]
    ready_on(cluster, "b")
    assert cluster.state.hosts.processes.tolist() == [0, 1]


def test_what_was_seen_of_the_source_is_counted_at_the_destination() -> None:
    """The measured usage counts at the destination if it exceeds the declared needs."""
    cluster = two_hosts()
    cluster.machines["a"].shown["p"] = {"memory": 6 * 2.0**30}
    cluster.wait(0.2)
    reply = cluster.migrate("p")
    assert reply.message == "no host has room for p"
    reply = cluster.migrate("p", "b")
    assert "p does not fit on b: memory: needs 6.4 GB; at most 13.7 GB" in reply.message


def test_a_move_is_refused_with_its_reason() -> None:
    """A refused move changes nothing."""
    cluster = two_hosts()
    cluster.submit(process("fixed"), process("waits", memory=1e6))
    cases = [
        (("x",), "no such process: 'x'; there are: waits, fixed, p "),
        (("p", "z"), "no such host: 'z'; there are: a, b"),
        (("p", "a"), "p runs on a already"),
        (("fixed",), "has no migration strategy"),
        (("waits",), "only a running process can be moved"),
    ]
    for asked, said in cases:
        reply = cluster.migrate(*asked)
        assert not reply.accepted
        assert said in reply.message
    cluster.set_host("b", "cordon")
    assert "p does not fit on b: it is cordoned" in cluster.migrate("p", "b").message
    cluster.set_host("b", "uncordon")
    cluster.migrate("p")
    assert "p is moving already, to b" in cluster.migrate("p").message


# --- undo -------------------------------------------------------------------------------------


def test_a_destination_that_never_becomes_ready_is_stopped_and_the_source_goes_on() -> None:
    """A failure before the commit is undone."""
    cluster = two_hosts()
    cluster.migrate("p")
    cluster.wait(11.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    (said,) = cluster.recorded("stayed")
    assert said == "p stayed on a: waiting until p#2 is ready on b took longer than 10 s"
    assert cluster.state.hosts.processes.tolist() == [1, 0]


def test_a_destination_that_refuses_or_ends_is_undone() -> None:
    """The source never stopped."""
    cluster = two_hosts()
    cluster.machines["b"].refuses["p"] = "no such executable"
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert "no such executable" in cluster.recorded("stayed")[0]
    assert cluster.explain("p")["decision"]["kind"] == "stayed"


def test_stop_first_starts_again_at_the_source_when_the_destination_fails() -> None:
    """The fallback is a new instance, and owns the name."""
    cluster = two_hosts(overlap=False)
    cluster.machines["b"].refuses["p"] = "no such executable"
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("starting", ["a"])
    ready_on(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 3)


def test_a_fallback_is_not_started_beside_a_source_that_has_not_ended() -> None:
    """After a time-out of the stop, the undo waits for the source's end."""
    cluster = two_hosts(overlap=False)
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    cluster.wait(25.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("stuck", ["a"])
    assert not cluster.orders(StartInstance)
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.wait(3.0)
    ready_on(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster["p"].owner == 3


def test_a_fallback_starts_as_soon_as_the_source_has_ended() -> None:
    """After a time-out of the stop, the undo does not wait for `order_retry`."""
    cluster = two_hosts(overlap=False)
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    cluster.wait(10.5)
    assert cluster.phase("p") == "migrating"
    assert cluster.recorded("migration_undone")
    cluster.let_go("p")
    assert [order.instance.number for order in cluster.orders(StartInstance)] == [3]
    ready_on(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 3)


def test_when_neither_side_can_run_it_the_process_returns_to_the_queue() -> None:
    """Destination and fallback refused the process, so the scheduler places it on a third host."""
    cluster = two_hosts(overlap=False)
    cluster.add(Machine("c", busy={"memory": 0.6}))
    for name in "ab":
        cluster.machines[name].refuses["p"] = "no such executable"
    cluster.migrate("p")
    assert not cluster.state.migrations
    assert cluster.where("p") == ["c"]
    assert sorted(cluster["p"].excluded) == ["a", "b"]


def test_a_source_that_ends_by_itself_ends_the_move() -> None:
    """The source's own end counts, and the destination is stopped."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(job("p", migration=MigrationPolicy("relaunch"), ros=True))
    cluster.discover("p")
    cluster.migrate("p")
    cluster.finish("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("finished", [])
    assert cluster.recorded("stayed") == ["p stayed on a: p#1 ended during the move"]


def test_a_job_that_completes_while_it_is_told_to_stop_has_finished() -> None:
    """A stop-first move does not run the job a second time."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(job("p", migration=MigrationPolicy("relaunch", overlap=False)))
    machine = cluster.machines["a"]
    cluster.carry_out(cluster.decide(happened.MigrationRequested(9, "p")))
    machine.finish("p", cluster.now)
    cluster.settle()
    assert (cluster.phase("p"), cluster.where("p")) == ("finished", [])


def test_a_source_whose_host_forgot_it_returns_to_the_queue() -> None:
    """An instance that is missing without a status is no failure of the process."""
    cluster = two_hosts()
    cluster.migrate("p")
    machine = cluster.machines["a"]
    machine.programs.clear()
    machine.slave.held.clear()
    machine.tell(events.ReportRequested(), cluster.now)
    cluster.settle()
    assert cluster.phase("p") in {"starting", "running"}
    assert len(cluster.where("p")) == 1


def test_a_fallback_whose_slot_was_given_away_returns_to_the_queue() -> None:
    """Another process took the slot during the move, so the scheduler places the process again."""
    cluster = Cluster(
        Machine("a", max_processes=1, labels={"x": "y"}), Machine("b", busy={"memory": 0.5})
    )
    cluster.submit(movable("p", overlap=False), process("q", required_labels={"x": "y"}))
    assert (cluster.where("p"), cluster.queue()) == (["a"], ["q"])
    cluster.machines["b"].refuses["p"] = "no such executable"
    cluster.add(Machine("c", busy={"memory": 0.6}))
    cluster.migrate("p")
    assert cluster.where("q") == ["a"]
    cluster.wait(12.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["c"])


# --- stuck ------------------------------------------------------------------------------------


def test_after_the_commit_a_source_that_does_not_stop_leaves_the_move_stuck() -> None:
    """The stuck move is recorded once, retried, and finished once the source has ended."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    ready_on(cluster, "b")
    cluster.wait(11.0)
    assert cluster.phase("p") == "stuck"
    (said,) = cluster.recorded("migration_stuck")
    assert said.startswith("p is stuck: its move cannot be finished yet: stopping p#1 on a took")
    cluster.wait(60.0)
    assert len(cluster.recorded("migration_stuck")) == 1
    assert len(cluster.recorded("migration_step_failed")) == 1
    cluster.let_go("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_one_that_is_stuck_can_be_cancelled() -> None:
    """Each reachable instance is stopped; stop orders to the other one repeat until its end."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    ready_on(cluster, "b")
    cluster.wait(11.0)
    cluster.cancel("p")
    assert cluster.phase("p") == "cancelled"
    assert cluster.where("p") == ["a"]
    assert not cluster.submit(process("p")).accepted
    assert not cluster.restart("p").accepted
    cluster.let_go("p")
    assert cluster.submit(process("p")).accepted


def test_one_that_is_stuck_does_not_keep_others_from_moving() -> None:
    """A stuck move does not count against `max_migrations`."""
    cluster = two_hosts(max_migrations=1)
    cluster.machines["a"].stubborn.add("p")
    cluster.submit(movable("q"))
    cluster.migrate("p")
    ready_on(cluster, "b")
    cluster.wait(11.0)
    assert cluster.phase("p") == "stuck"
    cluster.set_host("a", "drain")
    cluster.wait(1.0)
    assert cluster.where("q") == ["b"]


def test_a_destination_host_that_is_lost_on_the_way_leaves_the_source_running() -> None:
    """The move is undone; the instance on the lost host is fenced after the rejoin."""
    cluster = two_hosts()
    cluster.migrate("p")
    cluster.cut("b", seconds=25.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a", "b"])
    cluster.reconnect("b", seconds=25.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_a_source_host_that_leaves_during_the_move() -> None:
    """The move is undone and the process queued: in the end it runs once."""
    cluster = two_hosts()
    cluster.migrate("p")
    cluster.leave("a")
    assert cluster.where("p") == ["b"]
    ready_on(cluster, "b")
    assert cluster.phase("p") == "running"


# --- unsound strategies -----------------------------------------------------------------------


class Strange:
    """Strategy that proposes the plan of a test."""

    def __init__(self, make: Any) -> None:
        self.make = make

    def propose(self, move: Move) -> Plan:
        return self.make(move)


def raises(move: Move) -> Plan:
    raise RuntimeError("no idea")


def exits(move: Move) -> Plan:
    sys.exit(3)


def no_commit(move: Move) -> Plan:
    return Plan((Start(move.destination, move.destination_host, 1.0),))


def two_commits(move: Move) -> Plan:
    return Plan((Commit(), Commit()))


def foreign_host(move: Move) -> Plan:
    return Plan((Start(move.destination, "elsewhere", 1.0), Commit()))


def no_timeout(move: Move) -> Plan:
    return Plan((Start(move.destination, move.destination_host, 0.0), Commit()))


def foreign_instance(move: Move) -> Plan:
    foreign = type(move.source)("other", 1)
    return Plan((Stop(foreign, move.source_host, 1.0), Commit()))


def never_starts(move: Move) -> Plan:
    return Plan((Stop(move.source, move.source_host, 1.0), Commit()))


DELAY: Any = {"delay": "1s"}


def with_step(kind: Any, **fields: Any) -> Any:
    """Return a strategy that adds one step before the commit to a sound plan."""

    def propose(move: Move) -> Plan:
        start = Start(move.destination, move.destination_host, 1.0)
        instance = {} if kind is Execute else {"instance": move.destination}
        step = kind(host=move.destination_host, timeout=1.0, **instance, **fields)
        return Plan((start, step, Commit()))

    return propose


def none_at_all(move: Move) -> Any:
    return None


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (raises, "gave no plan: RuntimeError: no idea"),
        (no_commit, "0 commit points"),
        (two_commits, "2 commit points"),
        (foreign_host, "'elsewhere'"),
        (no_timeout, "no time-out"),
        (foreign_instance, "other#1"),
        (never_starts, "never starts"),
        (none_at_all, "gave no plan: answered None; Plan is required"),
        (exits, "gave no plan: SystemExit: 3"),
        (with_step(AwaitReady, settle="1s"), "settle: float is required, not '1s'"),
        (with_step(Start, node_name=7), "node_name: str is required, not 7"),
        (with_step(Start, remappings={"/a": 7}), "remappings./a: str is required, not 7"),
        (with_step(SetRestart, restart=RestartPolicy(**DELAY)), "restart.delay: float is required"),
        (with_step(Execute, executor="x", arguments={"of": {1}}), "set is not JSON serializable"),
    ],
)
def test_a_strategy_that_raises_or_proposes_nonsense_moves_nothing(make: Any, said: str) -> None:
    """The reply names the strategy, and the process keeps running."""
    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(make)}
    )
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert "the migration strategy 'strange' gave" in reply.message
    assert said in reply.message
    (told,) = cluster.recorded("plugin_failed")
    assert told.startswith("the migration strategy 'strange' fails: propose: ")
    assert said.removeprefix("gave no plan: ") in told
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.state.hosts.processes.tolist() == [1, 0]


def test_a_strategy_that_cannot_move_a_process_does_not_fail() -> None:
    """By contract a `ValueError` is a refusal.

    The reply has its reason, and no failure is recorded.
    """

    def declines(move: Move) -> Plan:
        raise ValueError("not on a Sunday")

    cluster = Cluster("a", "b", strategies={"strange": Strange(declines)})
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    assert "ValueError: not on a Sunday" in cluster.migrate("p").message
    assert cluster.recorded("plugin_failed") == []


def waits_first(move: Move) -> Plan:
    """Propose a plan that runs an executor on both hosts and then stops first."""
    plan = StartFirstOrStopFirst().propose(replace(move, spec=movable("p", overlap=False)))
    wait = Execute("sleepy.wait", move.source_host, {}, 5.0)
    there = replace(wait, host=move.destination_host)
    return replace(plan, steps=(replace(wait, undo=there), *plan.steps))


def sleepy(*executors: str) -> Cluster:
    """Return a cluster whose strategy has an executor; of two hosts only `a` has it."""
    machines = [Machine("a"), Machine("b", busy={"memory": 0.5})]
    machines[0].executors["sleepy.wait"] = lambda arguments: {}
    cluster = Cluster(
        *machines, strategies={"sleepy": Strange(waits_first)},
        declared=Declared(
            executors={"sleepy": frozenset(executors)}, brought_by={"sleepy": "rosrm-sleepy 1.0"}
        ),
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("sleepy")))
    return cluster


def test_a_plan_is_refused_before_its_first_step_where_a_host_lacks_an_executor() -> None:
    """The check includes the undo steps.

    Nothing was stopped, and the reply names the package to install.
    """
    cluster = sleepy("sleepy.wait")
    orders = len(cluster.sent())
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert reply.message == (
        "b has no executor 'sleepy.wait', which sleepy needs there to move p: install "
        "rosrm-sleepy 1.0 on b and restart its slave"
    )
    assert len(cluster.sent()) == orders
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.state.hosts.processes.tolist() == [1, 0]


def test_a_move_goes_to_the_next_host_where_the_best_lacks_an_executor() -> None:
    """A host that was requested by name is not replaced by another one."""
    cluster = sleepy("sleepy.wait")
    assert not cluster.migrate("p", "b").accepted
    cluster.add(Machine("c", busy={"memory": 0.55}))
    cluster.add(Machine("d", busy={"memory": 0.6}, executors={"sleepy.wait": lambda arguments: {}}))
    assert cluster.migrate("p").host == "d"


def test_a_host_that_lacks_an_executor_as_its_plugin_is_broken_says_so() -> None:
    """To install it again would not help; `rosrm explain` shows the refusal, too."""
    cluster = sleepy("sleepy.wait")
    machine = cluster.machines["b"]
    machine.batches += 1
    reason = "plugin 'sleepy': its executor 'sleepy.wait' has the name of one of 'weary'"
    cluster.tell(
        happened.StatusesReceived(
            machine.host_id, machine.incarnation, machine.batches, False, (),
            failing_strategies={"sleepy": reason},
        )
    )  # fmt: skip
    said = f"which sleepy needs there to move p: on b {reason}; then restart its slave"
    for _ in range(2):
        assert cluster.migrate("p").message.endswith(said)
    (refused,) = cluster.recorded("migration_refused")
    assert refused.startswith("p is not moved: b has no executor 'sleepy.wait'")
    assert refused in [one["message"] for one in cluster.explain("p")["history"]]


def test_hosts_that_lack_an_executor_are_named_together() -> None:
    """Hosts with the same reason share one reason and one advice."""
    cluster = sleepy("sleepy.wait")
    cluster.add(Machine("c", busy={"memory": 0.55}))
    assert cluster.migrate("p").message == (
        "b and c have no executor 'sleepy.wait', which sleepy needs there to move p: install "
        "rosrm-sleepy 1.0 on them and restart their slaves"
    )


def test_a_plan_that_names_an_executor_that_its_offer_lacks_is_unsound() -> None:
    """The plan check finds a misspelt executor, whatever the hosts have."""
    reply = sleepy("sleepy.wiat").migrate("p")
    assert not reply.accepted
    assert (
        "an unsound plan: it names the executor 'sleepy.wait', which its offer lacks; "
        "its own: sleepy.wiat"
    ) in reply.message


def test_a_move_brings_the_options_of_its_process() -> None:
    """The plan gets the options declared by the offer; unknown ones are refused at submission."""
    moves = []

    def propose(move: Move) -> Plan:
        moves.append(move.options)
        return StartFirstOrStopFirst().propose(move)

    def options_of(strategy: str, spec: ProcessSpec) -> str:
        if "speed" in spec.migration.options:
            raise ValueError("unknown speed; allowed: pause")
        return f"{strategy} of {spec.name}"

    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(propose)},
        declared=Declared(options_of=options_of),
    )  # fmt: skip
    wrong = process("q", migration=MigrationPolicy("strange", options={"speed": 1}))
    assert cluster.submit(wrong).message == (
        "q: migration by 'strange': unknown speed; allowed: pause. Nothing was queued"
    )
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    assert cluster.migrate("p").accepted
    assert moves == ["strange of p"]


def test_options_that_raise_cost_one_submission() -> None:
    """An options class is third-party code: its exceptions are a failure of the plugin."""

    def options_of(strategy: str, spec: ProcessSpec) -> None:
        raise KeyError("speed")

    cluster = Cluster(
        "a", strategies={"strange": Strange(StartFirstOrStopFirst().propose)},
        declared=Declared(options_of=options_of),
    )  # fmt: skip
    said = cluster.submit(process("p", migration=MigrationPolicy("strange"))).message
    assert said.startswith("p: migration by 'strange': its check of this process failed: KeyError")
    assert len(cluster.recorded("plugin_failed")) == 1


def test_a_plan_without_undo_leaves_no_instance_behind() -> None:
    """Started instances that do not own the name are stopped before anything else is started."""

    def careless(move: Move) -> Plan:
        return Plan(
            (
                Start(move.destination, move.destination_host, 5.0),
                AwaitReady(move.destination, move.destination_host, 5.0),
                Commit(),
            ),
            overlap=5.0,
        )

    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(careless)}
    )
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_a_same_name_start_waits_where_no_overlap_is_declared() -> None:
    """A plan that would run two instances under one name waits, and is undone."""

    def overlapping(move: Move) -> Plan:
        stop = Stop(move.destination, move.destination_host, 5.0)
        start = Start(move.destination, move.destination_host, 5.0, undo=stop)
        return Plan((start, Commit(), Stop(move.source, move.source_host, 5.0)))

    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(overlapping)}
    )
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert cluster.where("p") == ["a"]
    cluster.wait(12.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def noted(calls: list[Any]) -> Any:
    """Return an executor that records its arguments."""

    def execute(arguments: Any) -> dict[str, Any]:
        calls.append(arguments)
        return {}

    return execute


def executing(move: Move) -> Plan:
    undo = Execute("sweep", move.source_host, {"what": "image"}, 5.0)
    stop_there = Stop(move.destination, move.destination_host, 5.0)
    return Plan(
        (
            Execute("dump", move.source_host, {"what": "image"}, 5.0, undo=undo),
            Start(move.destination, move.destination_host, 5.0, "alias", undo=stop_there),
            AwaitReady(move.destination, move.destination_host, 5.0),
            Commit(),
            Stop(move.source, move.source_host, 5.0),
        )
    )


def test_an_executor_does_the_open_step_on_its_host() -> None:
    """The executor gets the plan's arguments; a shadow under an alias may run beside the source."""
    done: list[Any] = []
    cluster = Cluster(
        Machine("a", executors={"dump": noted(done), "sweep": noted(done)}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(executing)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert done == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_an_executor_is_asked_again_when_its_slave_was_started_again() -> None:
    """The former run's answer cannot arrive, so the master sends the order to the new run."""
    done: list[Any] = []
    cluster = Cluster(
        Machine("a", executors={"dump": noted(done), "sweep": noted(done)}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(executing)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    machine = cluster.machines["a"]
    machine.connected = False
    cluster.migrate("p")
    assert (done, cluster.phase("p")) == ([], "migrating")
    cluster.wait(2.0)  # until its former run counts as silent
    machine.connected = True
    machine.restart_slave(cluster.now)
    assert cluster.register(machine).accepted
    cluster.wait(0.2)
    assert done == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_an_executor_on_a_lost_host_is_not_waited_for() -> None:
    """The plan is undone when the host is lost. The source may be frozen during a long time-out."""

    def fetching(move: Move) -> Plan:
        undo = Execute("go_on", move.source_host, {}, 5.0)
        return Plan(
            (
                Execute("dump", move.source_host, {}, 5.0, undo=undo),
                Execute("fetch", move.destination_host, {}, 600.0),
                Start(move.destination, move.destination_host, 5.0, restored=True),
                Commit(),
                Stop(move.source, move.source_host, 5.0),
            )
        )

    done: list[Any] = []
    cluster = Cluster(
        Machine("a", executors={"dump": lambda _: {}, "go_on": noted(done)}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(fetching)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.machines["b"].connected = False
    assert cluster.migrate("p").accepted
    cluster.wait(5.0)
    assert (done, cluster.phase("p")) == ([], "migrating")
    cluster.wait(10.0)
    assert len(done) == 1
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_a_new_instance_that_is_to_settle_runs_beside_the_old_one() -> None:
    """Its peers need the overlap to discover the new instance."""

    def settling(move: Move) -> Plan:
        return Plan(
            (
                Start(move.destination, move.destination_host, 5.0),
                AwaitReady(move.destination, move.destination_host, 5.0, settle=3.0),
                Commit(),
                Stop(move.source, move.source_host, 5.0),
            ),
            overlap=20.0,
        )

    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(settling)}
    )
    cluster.submit(process("p", migration=MigrationPolicy("strange", overlap=True)))
    cluster.migrate("p")
    cluster.wait(2.5)
    assert sorted(cluster.where("p")) == ["a", "b"]
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_an_executor_that_fails_is_undone() -> None:
    """The plan runs the undo of the executor's own step."""
    swept: list[Any] = []

    def fails(arguments: Any) -> None:
        raise OSError("disk full")

    cluster = Cluster(
        Machine("a", executors={"dump": fails, "sweep": noted(swept)}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(executing)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert swept == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.recorded("stayed") == ["p stayed on a: dump failed on a: disk full"]


def bad_executor(arguments: Any) -> None:
    """Return None, as an executor does that lacks `return {}`."""


def test_an_executor_that_answers_nothing_is_undone_also_by_one_that_answers_nothing() -> None:
    """The undo is not retried. The executor would return nothing each time and block the move."""
    cluster = Cluster(
        Machine("a", executors={"dump": bad_executor, "sweep": bad_executor}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(executing)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.recorded("stayed") == ["p stayed on a: dump failed on a: no object"]
    assert cluster.recorded("migration_stuck") == []


def test_a_journalled_step_that_answers_nothing_is_undone_by_the_next_master() -> None:
    """The step is ordered once more, fails, and the source remains."""
    cluster = Cluster(
        Machine("a", executors={"dump": bad_executor, "sweep": bad_executor}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(executing)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    commands = cluster.decide(happened.MigrationRequested(9, "p"))
    cluster.journal(commands)
    cluster.restart_master()
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert len(cluster.recorded("stayed")) == 1


def test_an_executor_that_answers_nothing_after_the_commit_does_not_hold_the_plan_up() -> None:
    """After the commit there is no undo: the plan is completed, and the failure is recorded."""

    def late(move: Move) -> Plan:
        return Plan(
            (
                Start(move.destination, move.destination_host, 5.0, "alias"),
                AwaitReady(move.destination, move.destination_host, 5.0),
                Commit(),
                Stop(move.source, move.source_host, 5.0),
                Execute("sweep", move.source_host, {}, 5.0),
            )
        )

    cluster = Cluster(
        Machine("a", executors={"sweep": bad_executor}),
        Machine("b", busy={"memory": 0.5}), strategies={"strange": Strange(late)},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    assert cluster.recorded("migration_step_failed") == ["p: sweep failed on a: no object"]


def test_a_lost_order_is_given_again() -> None:
    """A repeated start or stop order has no effect."""
    cluster = two_hosts(order_retry=2.0)
    cluster.carry_out(cluster.decide(happened.MigrationRequested(9, "p")))
    cluster.machines["b"].ordered.clear()
    cluster.wait(2.5)
    ready_on(cluster, "b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_the_shipped_shape_of_relaunch_keeps_to_its_declared_overlap() -> None:
    """A stop-first plan declares no overlap, a start-first plan a bounded one."""
    move = Move(movable("p"), _id(1), "a", _id(2), "b", _id(3), 0, "p")
    assert StartFirstOrStopFirst().propose(move).overlap > 0.0


def _id(number: int) -> Any:
    return InstanceId("p", number)


def test_how_the_destination_ended_is_known_after_a_restart_of_the_master() -> None:
    """The destination ended by a signal while the source did not stop: the process has failed."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    ready_on(cluster, "b")
    machine = cluster.machines["b"]
    machine._end(machine.find("p"), InstanceState.EXITED, cluster.now, signal=2)
    cluster.settle()
    cluster.restart_master()
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].exit_code) == ("failed", -2)
