"""Migration plans: forward, undo of each step, and moves that are stuck."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rosrm.core.master import events as happened
from rosrm.core.slave import events
from rosrm.extensions.contracts import Scores
from rosrm.extensions.declared_fields import Declared
from rosrm.extensions.placement import SelectedFilter
from rosrm.model.artifacts import Artifact
from rosrm.model.orders import StartInstance
from rosrm.model.plan import AwaitReady, Commit, Execute, Move, Plan, SetRestart, Start, Step, Stop
from rosrm.model.values import (
    EMPTY,
    InstanceId,
    InstanceState,
    InstanceStatus,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
)
from tests.unit.core.cluster import Cluster, Machine, StartFirstOrStopFirst, job, movable, process
from tests.unit.core.machine import GIB


def two_hosts(
    *, overlap: bool = True, artifacts: tuple[Artifact, ...] = (), **settings: Any
) -> Cluster:
    """Return a cluster where p runs on a as a ROS node, and b has room."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5, "cpu": 0.1}), **settings)
    cluster.submit(movable("p", overlap=overlap, ros=True, artifacts=artifacts))
    cluster.discover("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    return cluster


def stuck(**settings: Any) -> Cluster:
    """Return a cluster where p moved to b, and its source on a does not stop."""
    cluster = two_hosts(**settings)
    cluster.machines["a"].stubborn.add("p")
    cluster.submit(movable("q"))
    cluster.migrate("p")
    cluster.discover("p", "b")
    cluster.wait(11.0)
    assert cluster.phase("p") == "stuck"
    return cluster


def moving_by(propose: Callable[[Move], Any], *, here: Any = EMPTY, **fields: Any) -> Cluster:
    """Return a cluster where p runs on a, b has room, and a function plans the moves.

    Args:
        propose: function of the strategy.
        here: executors of a.
        fields: further arguments of `Cluster`.
    """
    strategies = {"strange": SimpleNamespace(propose=propose)}
    hosts = Machine("a", executors=dict(here)), Machine("b", busy={"memory": 0.5})
    cluster = Cluster(*hosts, strategies=strategies, **fields)
    cluster.submit(process("p", migration=MigrationPolicy("strange")))
    return cluster


# --- no destination ---------------------------------------------------------------------------


def unwilling(**options):
    """Return a cluster where p runs on a, and b and c may refuse it by these options."""
    cluster = Cluster("a", **options).with_processes(
        process("p", migration=MigrationPolicy("relaunch"))
    )
    for name in "bc":
        cluster.add(Machine(name))
    cluster.wait(1.0)
    return cluster


class OnlyA:
    """A filter that passes a, and a scoring policy that vetoes all other hosts."""

    def mask(self, hosts, process):
        return np.array([name == "a" for name in hosts.names], np.bool_)

    def reason(self, hosts, process, row):
        return "it is not a"

    def score(self, hosts, process):
        veto = ~self.mask(hosts, process)
        return Scores(np.zeros(len(veto)), veto, veto_reason=lambda row: "it is too far away")


class Broken(OnlyA):
    """A filter that fails for every host but a."""

    def mask(self, hosts, process):
        if tuple(hosts.names) == ("a",):
            return super().mask(hosts, process)
        raise RuntimeError("the map is not loaded")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"filters": (SelectedFilter("only", OnlyA()),)}, "is not a (filter only)"),
        ({"policy": OnlyA()}, "is too far away"),
    ],
)
def test_a_refusal_of_a_migration_names_the_plugin_that_refused(options, why) -> None:
    """A move without a given host is refused with the reason of each host, equal ones once."""
    message = unwilling(**options).migrate("p").message
    assert message == f"no host can take p: each of b and c {why}"


def test_a_refusal_of_a_migration_names_the_filter_that_failed() -> None:
    """The error of a failing filter is the reason against each host."""
    cluster = unwilling(filters=(SelectedFilter("broken", Broken()),))
    message = cluster.migrate("p").message
    assert "no host can take p: b and c: the filter broken failed: RuntimeError" in message


def test_a_refusal_of_a_migration_tells_full_hosts_from_cordoned_ones() -> None:
    """Each host has its own reason; a full one has no room."""
    cluster = unwilling()
    cluster.machines["b"].busy["memory"] = cluster.machines["c"].busy["memory"] = 0.9
    cluster.set_host("b", "cordon")
    cluster.wait(1.0)
    message = cluster.migrate("p").message
    assert message == "no host can take p: b is cordoned; c has no room"


def test_a_drain_names_the_filter_that_keeps_a_process() -> None:
    """The answer and the record of a drain have the same reason as a refused migration."""
    cluster = unwilling(filters=(SelectedFilter("only", OnlyA()),))
    message = cluster.set_host("a", "drain").message
    cluster.wait(2.0)
    for text in (message, *cluster.recorded("nothing_moves")):
        assert "no host can take p: each of b and c is not a (filter only)" in text


# --- forward ----------------------------------------------------------------------------------


def test_start_first_runs_both_until_the_new_one_is_ready() -> None:
    """The steps are start there, ready there, commit, stop here."""
    cluster = two_hosts()
    reply = cluster.migrate("p")
    assert (reply.accepted, reply.host, reply.message) == (True, "b", "p moves to b")
    assert (cluster.phase("p"), cluster.where("p")) == ("migrating", ["a", "b"])
    cluster.discover("p", "b")
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
    cluster.discover("p", "b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    assert not cluster.intents["migration"]


def test_a_move_reserves_the_destination_from_its_start_and_the_source_until_its_end() -> None:
    """Both hosts have the room that the move needs."""
    cluster = two_hosts()
    cluster.migrate("p")
    assert cluster.state.hosts.processes.tolist() == [1, 1]
    cluster.discover("p", "b")
    assert cluster.state.hosts.processes.tolist() == [0, 1]


def test_the_measured_usage_of_the_source_is_reserved_at_the_destination() -> None:
    """The measured usage counts at the destination if it exceeds the declared needs."""
    cluster = two_hosts()
    cluster.machines["a"].shown["p"] = {"memory": 6 * GIB}
    cluster.wait(0.2)
    assert cluster.migrate("p").message == "no host has room for p"
    reply = cluster.migrate("p", "b")
    assert "p does not fit on b: memory: needs 6.4 GB; at most 13.7 GB" in reply.message


def test_a_move_is_refused_with_its_reason() -> None:
    """A refused move changes nothing."""
    cluster = two_hosts()
    cluster.submit(process("fixed"), process("waits", memory=1e6))
    cases = [
        (("x",), "no such process: 'x'; there are: p, fixed, waits "),
        (("p", "z"), "no such host: 'z'; there are: a, b"),
        (("p", "a"), "p runs on a already"),
        (("fixed",), "has no migration strategy"),
        (("waits",), "only a running process can be moved"),
    ]
    for asked, said in cases:
        reply = cluster.migrate(*asked)
        assert not reply.accepted
        assert said in reply.message
    assert cluster.explain("p")["possible"]["move"] == ["b"]
    cluster.set_host("b", "cordon")
    assert cluster.explain("p")["possible"]["move"] == []
    assert "p does not fit on b: it is cordoned" in cluster.migrate("p", "b").message
    cluster.set_host("b", "uncordon")
    cluster.migrate("p")
    assert "p is moving already, to b" in cluster.migrate("p").message


# --- undo -------------------------------------------------------------------------------------


def test_a_destination_that_never_becomes_ready_is_stopped() -> None:
    """A failure before the commit is undone."""
    cluster = two_hosts()
    cluster.migrate("p")
    cluster.wait(11.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    (said,) = cluster.recorded("stayed")
    assert said == "p stayed on a: waiting until p#2 is ready on b took longer than 10 s"
    assert cluster.state.hosts.processes.tolist() == [1, 0]


@pytest.mark.parametrize("overlap", [True, False])
@pytest.mark.parametrize("reported", [InstanceState.BACKOFF, InstanceState.STARTING])
def test_a_destination_that_ends_at_its_start_is_not_awaited(reported, overlap) -> None:
    """The move is undone at the first end of its program, or at the report of a restart."""
    cluster = two_hosts(overlap=overlap)
    cluster.migrate("p")
    cluster.wait(1.0)
    message = "exit code 3; restart 1 of 5 in 1.0 s"
    destination = cluster.machines["b"].find("p")
    cluster.report("b", InstanceStatus(destination, reported, restarts=1, message=message))
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]
    assert cluster.recorded("stayed") == ["p stayed on a: p#2 ended on b: exit code 3"]


def test_a_start_has_more_time_if_it_fetches_artifacts(monkeypatch) -> None:
    """One second for each megabyte is added to the time-out of its step."""
    cluster = two_hosts(artifacts=(Artifact("x", "0" * 64, 20_000_000),))
    monkeypatch.setattr(cluster.machines["b"], "_launch", lambda *_: None)  # it still fetches
    cluster.migrate("p")
    cluster.wait(25.0)
    assert cluster.state.migrations["p"].undo is None
    cluster.wait(10.0)
    assert cluster.state.migrations["p"].undo is not None


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
    cluster.discover("p")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 3)


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
    cluster.discover("p")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 3)


def test_a_process_that_both_hosts_refuse_returns_to_the_queue() -> None:
    """Destination and fallback refused the process, so the scheduler places it on a third host."""
    cluster = two_hosts(overlap=False)
    cluster.add(Machine("c", busy={"memory": 0.6}))
    for name in "ab":
        cluster.machines[name].refuses["p"] = "no such executable"
    cluster.migrate("p")
    assert not cluster.state.migrations
    assert cluster.where("p") == ["c"]
    assert sorted(cluster["p"].excluded) == ["a", "b"]


def test_a_source_that_ends_during_the_move_ends_the_move() -> None:
    """The source's own end counts, and the destination is stopped."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(job("p", migration=MigrationPolicy("relaunch"), ros=True))
    cluster.discover("p")
    cluster.migrate("p")
    cluster.finish("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("finished", [])
    assert cluster.recorded("stayed") == ["p stayed on a: p#1 ran to completion during the move"]


def test_a_job_that_completes_before_its_stop_order_arrives_has_finished() -> None:
    """A stop-first move does not run the job a second time."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(job("p", migration=MigrationPolicy("relaunch", overlap=False)))
    machine = cluster.machines["a"]
    cluster.carry_out(cluster.decide(happened.MigrationRequested(9, "p")))
    machine.finish("p", cluster.now)
    cluster.settle()
    assert (cluster.phase("p"), cluster.where("p")) == ("finished", [])


def test_a_source_that_is_missing_on_its_host_returns_to_the_queue() -> None:
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


def test_a_fallback_without_a_free_slot_returns_to_the_queue() -> None:
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
    cluster = stuck()
    cluster.wait(60.0)
    (message,) = cluster.recorded("migration_stuck")
    assert message.startswith("p is stuck: its move cannot be finished yet: stopping p#1 on a took")
    assert len(cluster.recorded("migration_step_failed")) == 1
    cluster.let_go("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_a_stuck_process_can_be_cancelled() -> None:
    """Each reachable instance is stopped; stop orders to the other one repeat until its end."""
    cluster = stuck()
    cluster.cancel("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", ["a"])
    assert not cluster.submit(process("p")).accepted
    assert not cluster.restart("p").accepted
    cluster.let_go("p")
    assert cluster.submit(process("p")).accepted


def test_a_stuck_move_does_not_count_against_max_migrations() -> None:
    """Other processes still move."""
    cluster = stuck(max_migrations=1)
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
    cluster.discover("p", "b")
    assert cluster.phase("p") == "running"


# --- unsound strategies -----------------------------------------------------------------------


def steps_of(*kinds: type[Step], **fields: Any) -> Callable[[Move], Plan]:
    """Return a strategy whose steps are of these kinds; fields replace those of the first."""

    def propose(move: Move) -> Plan:
        known: dict[type[Step], Any] = {
            Start: Start(move.destination, move.destination_host, 1.0),
            Stop: Stop(move.source, move.source_host, 1.0),
            Commit: Commit(),
        }
        first, *others = (known[kind] for kind in kinds)
        return Plan((replace(first, **fields), *others), overlap=1.0)

    return propose


def raises(error: BaseException) -> Callable[[Move], Plan]:
    """Return a strategy that raises an exception."""

    def propose(move: Move) -> Plan:
        raise error

    return propose


DELAY: Any = {"delay": "1s"}


def with_step(kind: Any, **fields: Any) -> Any:
    """Return a strategy that adds one step before the commit to a sound plan."""

    def propose(move: Move) -> Plan:
        start = Start(move.destination, move.destination_host, 1.0)
        instance = {} if kind is Execute else {"instance": move.destination}
        step = kind(host=move.destination_host, timeout=1.0, **instance, **fields)
        return Plan((start, step, Commit()), overlap=1.0)

    return propose


@pytest.mark.parametrize(
    ("propose", "fault"),
    [
        (raises(RuntimeError("no idea")), "gave no plan: RuntimeError: no idea"),
        (raises(SystemExit(3)), "gave no plan: SystemExit: 3"),
        (lambda move: None, "gave no plan: answered None; Plan is required"),
        (steps_of(Start), "0 commit points"),
        (steps_of(Commit, Commit), "2 commit points"),
        (steps_of(Start, Commit, host="elsewhere"), "'elsewhere'"),
        (steps_of(Start, Commit, timeout=0.0), "no time-out"),
        (steps_of(Stop, Commit, instance=InstanceId("other", 1)), "other#1"),
        (steps_of(Stop, Commit), "never starts"),
        (with_step(AwaitReady, settle="1s"), "settle: float is required, not '1s'"),
        (with_step(Start, node_name=7), "node_name: str is required, not 7"),
        (with_step(Start, remappings={"/a": 7}), "remappings./a: str is required, not 7"),
        (with_step(SetRestart, restart=RestartPolicy(**DELAY)), "restart.delay: float is required"),
        (with_step(Execute, executor="x", arguments={"of": {1}}), "set is not JSON serializable"),
    ],
)
def test_a_strategy_that_raises_or_proposes_an_unsound_plan_moves_nothing(
    propose: Any, fault: str
) -> None:
    """The reply names the strategy, and the process keeps running."""
    cluster = moving_by(propose)
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert "the migration strategy 'strange' gave" in reply.message
    assert fault in reply.message
    (message,) = cluster.recorded("plugin_failed")
    assert message.startswith("the migration strategy 'strange' fails: propose: ")
    assert fault.removeprefix("gave no plan: ") in message
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.state.hosts.processes.tolist() == [1, 0]


def test_a_duration_as_text_in_a_plan_is_named_with_its_path() -> None:
    """The refusal names the field and the place of `propose`, and no comparison of types."""

    def propose(move: Move) -> Plan:
        plan = StartFirstOrStopFirst().propose(move)
        wait = Execute("sleepy.wait", move.source_host, {}, "5s")  # type: ignore[arg-type]
        return replace(plan, steps=(wait, *plan.steps))

    message = moving_by(propose).migrate("p").message
    assert "an unsound plan: steps[0].timeout" in message
    assert f"({__file__}:{propose.__code__.co_firstlineno})" in message


def test_a_strategy_that_cannot_move_a_process_does_not_fail() -> None:
    """By contract a `ValueError` refuses the move.

    The reply has its reason, and no failure is recorded.
    """
    cluster = moving_by(raises(ValueError("not on a Sunday")))
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
    declared = Declared(
        executors={"strange": frozenset(executors)}, brought_by={"strange": "rosrm-sleepy 1.0"}
    )
    return moving_by(waits_first, here={"sleepy.wait": lambda _: {}}, declared=declared)


def test_a_plan_is_refused_before_its_first_step_where_a_host_lacks_an_executor() -> None:
    """The check includes the undo steps.

    Nothing was stopped, and the reply names the package to install.
    """
    cluster = sleepy("sleepy.wait")
    orders = len(cluster.sent())
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert reply.message == (
        "b has no executor 'sleepy.wait', which strange needs there to move p: install "
        "rosrm-sleepy 1.0 on b and restart its slave"
    )
    assert len(cluster.sent()) == orders
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.state.hosts.processes.tolist() == [1, 0]


def test_a_plan_can_do_without_an_executor_that_a_host_lacks() -> None:
    """The strategy knows before it plans what an older version on one of the hosts lacks."""

    def propose(move: Move) -> Plan:
        plan = waits_first(move)
        return replace(plan, steps=plan.steps[1:]) if "sleepy.wait" in move.lacking else plan

    declared = Declared(executors={"strange": frozenset({"sleepy.wait"})})
    cluster = moving_by(propose, here={"sleepy.wait": lambda _: {}}, declared=declared)
    assert cluster.migrate("p").host == "b"


def test_a_move_goes_to_the_next_host_where_the_best_lacks_an_executor() -> None:
    """A host that was requested by name is not replaced by another one."""
    cluster = sleepy("sleepy.wait")
    assert not cluster.migrate("p", "b").accepted
    cluster.add(Machine("c", busy={"memory": 0.55}))
    cluster.add(Machine("d", busy={"memory": 0.6}, executors={"sleepy.wait": lambda arguments: {}}))
    assert cluster.migrate("p").host == "d"


def test_a_host_whose_plugin_is_broken_gives_the_reason_for_the_missing_executor() -> None:
    """To install it again would not help; `rosrm explain` shows the refusal, too."""
    cluster = sleepy("sleepy.wait")
    reason = "plugin 'strange': its executor 'sleepy.wait' has the name of one of 'weary'"
    cluster.report("b", failing_strategies={"strange": reason})
    advice = f"which strange needs there to move p: on b {reason}; then restart its slave"
    for _ in range(2):
        assert cluster.migrate("p").message.endswith(advice)
    (refused,) = cluster.recorded("migration_refused")
    assert refused.startswith("p is not moved: b has no executor 'sleepy.wait'")
    assert refused in [one["message"] for one in cluster.explain("p")["history"]]


def test_hosts_that_lack_an_executor_are_named_together() -> None:
    """Hosts with the same reason share one reason and one advice."""
    cluster = sleepy("sleepy.wait")
    cluster.add(Machine("c", busy={"memory": 0.55}))
    assert cluster.migrate("p").message == (
        "b and c have no executor 'sleepy.wait', which strange needs there to move p: install "
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


def test_a_move_has_the_options_of_its_process() -> None:
    """The plan gets the options that the offer declares.

    Unknown options refuse the submission. Any other exception is a failure of the plugin.
    """
    moves = []

    def propose(move: Move) -> Plan:
        moves.append(move.options)
        return StartFirstOrStopFirst().propose(move)

    def options_of(strategy: str, spec: ProcessSpec) -> str:
        for kind in (ValueError, KeyError):
            if kind.__name__ in spec.migration.options:
                raise kind("unknown speed; allowed: pause")
        return f"{strategy} of {spec.name}"

    cluster = moving_by(propose, declared=Declared(options_of=options_of))
    assert cluster.migrate("p").accepted
    assert moves == ["strange of p"]
    for fault, reason in (
        ("ValueError", "unknown speed; allowed: pause. Nothing was queued"),
        ("KeyError", "its check of this process failed: KeyError"),
    ):
        assert cluster.recorded("plugin_failed") == []
        wrong = process("q", migration=MigrationPolicy("strange", options={fault: 1}))
        assert cluster.submit(wrong).message.startswith(f"q: migration by 'strange': {reason}")
    assert len(cluster.recorded("plugin_failed")) == 1


def test_a_plan_with_a_text_that_no_message_can_hold_is_unsound() -> None:
    """An order with a lone surrogate could never be sent, even after a restart of the master."""

    def odd(move: Move) -> Plan:
        there = move.destination, move.destination_host, 5.0
        start = Start(*there, remappings={"a": "\ud800"})
        return Plan((start, AwaitReady(*there), Commit()), overlap=5.0)

    cluster = moving_by(odd)
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert "an unsound plan: it has a character that UTF-8 cannot hold" in reply.message


def test_a_plan_of_a_class_of_the_plugin_is_journalled_as_a_plan() -> None:
    """The next master could not read a field of the plugin, and would not start."""

    @dataclass(frozen=True)
    class Noted(Plan):
        note: str = "mine"

    class Named(Plan):
        """A plan without further fields."""

    def with_field(move: Move) -> Plan:
        return Noted(StartFirstOrStopFirst().propose(move).steps, overlap=20.0)

    def without_field(move: Move) -> Plan:
        return Named(StartFirstOrStopFirst().propose(move).steps, overlap=20.0)

    message = moving_by(with_field).migrate("p").message
    assert "an unsound plan: unknown note; allowed: steps, overlap, options" in message
    cluster = moving_by(without_field)
    cluster.cut("b")  # so the move is still under way
    assert cluster.migrate("p").accepted
    assert {type(one.plan) for one in cluster.state.migrations.values()} == {Plan}


def test_a_strategy_changes_its_own_copy_of_the_spec() -> None:
    """The master keeps and journals the spec, by which the process starts again."""

    def changing(move: Move) -> Plan:
        move.spec.environment["A"] = "2"  # type: ignore[index]
        move.spec.migration.options["odd"] = 1  # type: ignore[index]
        return StartFirstOrStopFirst().propose(move)

    cluster = moving_by(changing)
    policy = MigrationPolicy("strange", options={"mine": 1})
    cluster.submit(process("q", environment={"A": "1"}, migration=policy))
    cluster.wait(2.0)
    assert cluster.migrate("q").accepted
    known = cluster["q"].spec
    assert (known.environment, known.migration.options) == ({"A": "1"}, {"mine": 1})


def test_a_plan_without_undo_leaves_no_instance_behind() -> None:
    """Started instances that do not own the name are stopped before anything else is started."""

    def careless(move: Move) -> Plan:
        there = move.destination, move.destination_host, 5.0
        return Plan((Start(*there), AwaitReady(*there), Commit()), overlap=5.0)

    cluster = moving_by(careless)
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_a_start_under_the_same_name_needs_an_overlap() -> None:
    """The start would wait for the end of the source, which the plan stops only later."""

    def overlapping(move: Move) -> Plan:
        there = move.destination, move.destination_host, 5.0
        stop_source = Stop(move.source, move.source_host, 5.0)
        return Plan((Start(*there, undo=Stop(*there)), Commit(), stop_source))

    cluster = moving_by(overlapping)
    reply = cluster.migrate("p")
    assert not reply.accepted
    assert "before a Stop of the source, and its overlap is 0 s" in reply.message
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def noted(calls: list[Any]) -> Any:
    """Return an executor that records its arguments."""
    return lambda arguments: calls.append(arguments) or {}


def executing(move: Move) -> Plan:
    undo = Execute("sweep", move.source_host, {"what": "image"}, 5.0)
    there = move.destination, move.destination_host, 5.0
    return Plan(
        (
            Execute("dump", move.source_host, {"what": "image"}, 5.0, undo=undo),
            Start(*there, "alias", undo=Stop(*there)),
            AwaitReady(*there),
            Commit(),
            Stop(move.source, move.source_host, 5.0),
        )
    )


def test_an_executor_does_the_open_step_on_its_host() -> None:
    """The executor gets the plan's arguments; a shadow under an alias may run beside the source."""
    done: list[Any] = []
    cluster = moving_by(executing, here={"dump": noted(done), "sweep": noted(done)})
    cluster.migrate("p")
    assert done == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_an_executor_is_ordered_again_from_the_next_run_of_its_slave() -> None:
    """The former run's answer cannot arrive, so the master sends the order to the new run."""
    done: list[Any] = []
    cluster = moving_by(executing, here={"dump": noted(done), "sweep": noted(done)})
    cluster.cut("a")
    cluster.migrate("p")
    assert (done, cluster.phase("p")) == ([], "migrating")
    cluster.wait(2.0)  # until its former run counts as silent
    assert cluster.restart_slave("a").accepted
    cluster.wait(0.2)
    assert done == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_the_plan_does_not_wait_for_an_executor_on_a_lost_host() -> None:
    """The plan is undone when the host is lost. The source may be frozen during a long time-out."""

    def fetching(move: Move) -> Plan:
        undo = Execute("resume", move.source_host, {}, 5.0)
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
    cluster = moving_by(fetching, here={"dump": lambda _: {}, "resume": noted(done)})
    cluster.cut("b")
    assert cluster.migrate("p").accepted
    cluster.wait(5.0)
    assert (done, cluster.phase("p")) == ([], "migrating")
    cluster.wait(10.0)
    assert len(done) == 1
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def settling(move: Move) -> Plan:
    """Return a plan that stops the source 3 s after the destination is ready."""
    stop_there = Stop(move.destination, move.destination_host, 5.0)
    start = Start(move.destination, move.destination_host, 5.0, undo=stop_there)
    ready = AwaitReady(move.destination, move.destination_host, 5.0, settle=3.0)
    stop = Stop(move.source, move.source_host, 5.0)
    return Plan((start, ready, Commit(), stop), overlap=20.0)


def test_a_source_runs_on_if_the_host_of_a_ready_destination_falls_silent() -> None:
    """The destination may have ended since its report, so the move is undone."""
    cluster = moving_by(settling)
    cluster.migrate("p")
    cluster.wait(1.0)
    cluster.cut("b", seconds=8.0)
    assert cluster["p"].owner == 1
    assert "a" in cluster.where("p")
    cluster.reconnect("b", seconds=5.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_a_new_instance_settles_beside_the_old_one() -> None:
    """Its peers need the overlap to discover the new instance."""
    cluster = moving_by(settling)
    cluster.migrate("p")
    cluster.wait(2.5)
    assert sorted(cluster.where("p")) == ["a", "b"]
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def fails(arguments: Any) -> None:
    raise OSError("disk full")


def test_an_executor_that_fails_is_undone() -> None:
    """The plan runs the undo of the executor's own step."""
    swept: list[Any] = []
    cluster = moving_by(executing, here={"dump": fails, "sweep": noted(swept)})
    cluster.migrate("p")
    assert swept == [{"what": "image"}]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.recorded("stayed") == ["p stayed on a: dump failed on a: disk full"]


def returns_none(arguments: Any) -> None:
    """Return None, as an executor does that lacks `return {}`."""


@pytest.mark.parametrize("killed", [False, True], ids=["same master", "next master"])
def test_an_executor_that_returns_none_is_undone_though_its_undo_returns_none(killed: bool) -> None:
    """The undo is not retried. The executor would return None each time and block the move.

    A master that is killed after it journalled the step orders it once more.
    """
    cluster = moving_by(executing, here={"dump": returns_none, "sweep": returns_none})
    if killed:
        cluster.journal(cluster.decide(happened.MigrationRequested(9, "p")))
        cluster.restart_master()
        cluster.wait(5.0)
    else:
        cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert cluster.recorded("stayed") == ["p stayed on a: dump failed on a: no object"]
    assert cluster.recorded("migration_stuck") == []


def test_an_executor_that_returns_none_after_the_commit_does_not_block_the_plan() -> None:
    """After the commit there is no undo: the plan is completed, and the failure is recorded."""

    def late(move: Move) -> Plan:
        there = move.destination, move.destination_host, 5.0
        stop = Stop(move.source, move.source_host, 5.0)
        sweep = Execute("sweep", move.source_host, {}, 5.0)
        return Plan((Start(*there, "alias"), AwaitReady(*there), Commit(), stop, sweep))

    cluster = moving_by(late, here={"sweep": returns_none})
    cluster.migrate("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    assert cluster.recorded("migration_step_failed") == ["p: sweep failed on a: no object"]


def test_a_lost_order_is_sent_again() -> None:
    """A repeated start or stop order has no effect."""
    cluster = two_hosts(order_retry=2.0)
    cluster.carry_out(cluster.decide(happened.MigrationRequested(9, "p")))
    cluster.machines["b"].ordered.clear()
    cluster.wait(2.5)
    cluster.discover("p", "b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_a_restarted_master_knows_how_the_destination_ended() -> None:
    """The destination ended by a signal while the source did not stop: the process has failed."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    cluster.discover("p", "b")
    machine = cluster.machines["b"]
    machine._end(machine.find("p"), InstanceState.EXITED, cluster.now, signal=2)
    cluster.settle()
    cluster.restart_master()
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].exit_code) == ("failed", -2)
