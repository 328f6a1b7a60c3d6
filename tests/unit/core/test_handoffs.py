"""Handoffs: moved or stayed, one active node at a time, and no source left silent.

The nodes follow the protocol (`nodes.Node`) except for the quirks that a test gives them.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import PublishStateConfig, SendOrder
from rosrm.core.master.lifecycle import restarts_after
from rosrm.model.orders import AmendInstance, StopInstance
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.values import (
    InstanceId,
    InstanceState,
    InstanceStatus,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
)
from rosrm_migration.handoff import WATCH, Handoff, HandoffOptions
from tests.unit.core.cluster import Cluster, HandOver, Machine, process

ON_FAILURE = RestartPolicy("on-failure", delay=0.5)


def stateful(name: str = "p", **fields: Any) -> ProcessSpec:
    """Return the spec of a process that moves with its state."""
    fields.setdefault("restart", ON_FAILURE)
    return process(name, migration=MigrationPolicy("handoff"), **fields)


def two_hosts(*, spec: ProcessSpec | None = None, **settings: Any) -> Cluster:
    """Return a cluster where p runs on a, and b has room."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5, "cpu": 0.1}), **settings)
    cluster.submit(spec or stateful())
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    return cluster


def quirk(cluster: Cluster, host: str, *quirks: str) -> None:
    cluster.machines[host].quirks["p"].update(quirks)


def published(cluster: Cluster) -> list[str]:
    """Return the published phases in order, including retries of unanswered phases."""
    return [one.phase.name for one in cluster.carried if isinstance(one, PublishStateConfig)]


def restart_of(cluster: Cluster, host: str) -> RestartPolicy:
    machine = cluster.machines[host]
    return machine.programs[machine.find("p")].restart


def begin(cluster: Cluster, until: HandoffPhase) -> None:
    """Begin the move of p to b; deliver messages until this phase is published, and no further."""
    cluster.tell(happened.MigrationRequested(9, "p", "b"))
    for _ in range(100):
        if until.name in published(cluster):
            return
        for machine in cluster.machines.values():
            cluster.deliver(machine)
            if until.name in published(cluster):
                return
        cluster.nodes_talk()
    raise AssertionError(f"{until.name} was never published")


def has_stayed(cluster: Cluster) -> None:
    """Check that p stayed: one active instance at the source, restarted as its spec says."""
    assert (cluster.phase("p"), cluster.where("p"), cluster.active()) == ("running", ["a"], ["a"])
    assert restart_of(cluster, "a") == ON_FAILURE
    assert len(cluster.recorded("stayed")) == 1
    settled(cluster)


def has_moved(cluster: Cluster) -> None:
    """Check that p moved: one active instance at the destination, restarted as its spec says."""
    assert (cluster.phase("p"), cluster.where("p"), cluster.active()) == ("running", ["b"], ["b"])
    assert restart_of(cluster, "b") == ON_FAILURE
    assert len(cluster.recorded("migrated")) == 1
    settled(cluster)


def settled(cluster: Cluster) -> None:
    assert not cluster.state.migrations
    assert not cluster.intents["migration"]
    assert published(cluster)[-1] == "DONE"
    assert not cluster.air.channels


# --- forward ----------------------------------------------------------------------------------


def test_a_handoff_without_faults_publishes_each_phase_once() -> None:
    """A handoff without faults publishes each of its phases SHADOW, SWITCH and DONE once."""
    cluster = two_hosts()
    reply = cluster.migrate("p", "b")
    assert reply.accepted
    has_moved(cluster)
    assert published(cluster) == ["SHADOW", "SWITCH", "DONE"]
    assert cluster["p"].migrations == 1


def test_a_step_is_done_although_its_order_was_repeated_before_the_answer() -> None:
    """On a link whose answers take longer than `order_retry`, the newest order is unanswered."""
    cluster = two_hosts(order_retry=2.0)
    late: list[tuple[float, happened.OrderAnswered]] = []
    for machine in cluster.machines.values():
        machine.obey = lambda sent, now, obey=machine.obey: (  # type: ignore[method-assign]
            late.append((now + 3.0, obey(sent, now))) or happened.OrderAnswered(0, accepted=True)
        )
    cluster.migrate("p", "b")
    for _ in range(200):
        cluster.wait(0.1)
        while late and late[0][0] <= cluster.now:
            cluster.tell(late.pop(0)[1])
    has_moved(cluster)


def test_a_shadow_without_a_reply_is_repeated_until_the_next_step_is_done() -> None:
    """A node of the paper may join when newer messages about other handoffs replaced the first."""
    state = {"protocol": "paper", "state": "/state", "type": "std_msgs/msg/Int64"}
    policy = MigrationPolicy("handoff", options=state)
    spec = process("p", ros=True, readiness=Readiness("running"), migration=policy)
    cluster = two_hosts(spec=spec, strategies={"handoff": Handoff(HandoffOptions())})
    cluster.machines["b"].executors[WATCH] = lambda _: {}
    begin(cluster, HandoffPhase.SHADOW)
    cluster.cut("b", seconds=5.0)  # the watch does not begin
    assert published(cluster) == ["SHADOW"] * 3
    cluster.reconnect("b", seconds=5.0)
    assert published(cluster) == ["SHADOW"] * 3 + ["DONE"]
    assert cluster.where("p") == ["b"]


def test_a_report_names_its_phase_only() -> None:
    """The report names the phase only; a wait that exceeds its time-out is named by the plan."""
    cluster = two_hosts()
    assert cluster.migrate("p").accepted
    cluster.wait(3.0)
    assert "p#2 receives the state of the source" in cluster.recorded("handoff_reported")


def test_names_on_the_wire_are_fully_qualified() -> None:
    """Node names have their namespace; the destination has its alias."""
    cluster = two_hosts(spec=stateful(namespace="/robot"))
    cluster.migrate("p", "b")
    config = next(one for one in cluster.carried if isinstance(one, PublishStateConfig))
    assert (config.source, config.destination) == (1, 2)
    assert (config.source_node, config.destination_node) == ("/robot/p", "/robot/p_2")


@pytest.mark.parametrize("restarted", [False, True])
def test_a_second_handoff_uses_the_alias_of_the_source(restarted: bool) -> None:
    """A restarted master knows the alias, too."""
    moves = []

    class Watched(HandOver):
        def propose(self, move: Any) -> Any:
            moves.append(move)
            return super().propose(move)

    cluster = two_hosts(strategies={"handoff": Watched()}, cooldown=0.0)
    cluster.migrate("p", "b")
    if restarted:
        cluster.restart_master()
    assert cluster.migrate("p", "a").accepted
    assert [move.source_node for move in moves] == ["p", "p_2"]
    assert cluster.active() == ["a"]
    config = [one for one in cluster.carried if isinstance(one, PublishStateConfig)][-1]
    assert config.source_node == "/p_2"


def test_the_commit_is_durable_before_the_source_is_stopped() -> None:
    """The stop is the first step without an undo."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    while not cluster["p"].migrations:
        cluster.nodes_talk()
    assert cluster.intents["migration"]["p"]["committed"]
    assert not cluster.orders(StopInstance)


def test_a_source_that_does_not_report_its_release_does_not_block_the_move() -> None:
    """The destination is active already, so waiting would only delay the move."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    for _ in range(100):
        cluster.air.to_master = [
            one for one in cluster.air.to_master if one[1].phase is not ReportPhase.RELEASED
        ]
        if not cluster.nodes_talk():
            break
    assert cluster["p"].migrations == 1  # the destination may fail after this point
    assert not cluster.orders(StopInstance)
    cluster.wait(11.0)
    has_moved(cluster)


def test_a_second_move_is_refused_while_one_is_under_way() -> None:
    """The refusal names the move in progress."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SHADOW)
    assert "p is moving already, to b" in cluster.migrate("p").message
    has_moved(cluster)


# --- back -------------------------------------------------------------------------------------


NEVER_READY = (
    "copying the state to the destination took longer than 10 s: p#2 receives the state of the "
    "source: waits for input /scan; p#1 takes part in the handoff"
)


@pytest.mark.parametrize(
    ("quirks", "seconds", "reasons"),
    [
        ({"b": "never ready"}, 11.0, [NEVER_READY]),
        (
            {"a": "deaf", "b": "deaf"},
            10.3,
            ["neither node has reported. Do they use rosrm.node?", "`protocol: paper`"],
        ),
        ({"b": "unfit"}, 0.0, ["p#2 cannot continue the handoff: restore: KeyError: 'map'"]),
        ({"a": "unfit"}, 0.0, ["p#1 cannot continue the handoff: the state is too large"]),
    ],
    ids=["never ready", "no protocol", "destination fails", "source fails"],
)
def test_a_failed_handoff_is_undone_with_the_reason_of_the_nodes(
    quirks: dict[str, str], seconds: float, reasons: list[str]
) -> None:
    """The reason is the newest message of the destination, a failure, or what to check.

    The plan needs no confirmation that the source resumed, because it never ordered silence.
    """
    cluster = two_hosts()
    for host, name in quirks.items():
        quirk(cluster, host, name)
    cluster.migrate("p", "b")
    cluster.wait(seconds)
    has_stayed(cluster)
    (message,) = cluster.recorded("stayed")
    assert message.startswith("p stayed on a: ")
    assert all(reason in message for reason in reasons)
    assert len(reasons) > 1 or message == f"p stayed on a: {reasons[0]}"


def test_a_source_that_does_not_fall_silent_resumes() -> None:
    """The destination aborts before the source receives RESUME."""
    cluster = two_hosts()
    quirk(cluster, "a", "never silent")
    cluster.migrate("p", "b")
    cluster.wait(11.0)
    has_stayed(cluster)
    assert list(dict.fromkeys(published(cluster))) == [
        "SHADOW",
        "SWITCH",
        "ABORT",
        "RESUME",
        "DONE",
    ]


@pytest.mark.parametrize("phase", [HandoffPhase.SHADOW, HandoffPhase.SWITCH])
def test_a_destination_that_ends_leaves_the_source_as_it_was(phase: HandoffPhase) -> None:
    """The end of the destination is enough; the plan sends no ABORT to a dead node."""
    cluster = two_hosts()
    begin(cluster, phase)
    cluster.finish("p", "b", code=3)
    has_stayed(cluster)


def test_the_source_resumes_if_an_active_destination_ends_before_the_commit() -> None:
    """The source resumes from its own state."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    while not cluster.node("b").active:
        for arrive in cluster.air.waiting():
            arrive()
    cluster.machines["b"].finish("p", cluster.now, code=3)
    cluster.deliver(cluster.machines["b"])
    assert cluster.active() == []
    cluster.settle()
    has_stayed(cluster)


def test_a_process_that_the_destination_refuses_stays() -> None:
    """The source never received a message."""
    cluster = two_hosts()
    cluster.machines["b"].refuses["p"] = "no such executable"
    cluster.migrate("p", "b")
    assert (cluster.phase("p"), cluster.active()) == ("running", ["a"])
    assert published(cluster) == []


@pytest.mark.parametrize("phase", [HandoffPhase.SHADOW, HandoffPhase.SWITCH])
def test_a_cancelled_process_ends_wherever_it_is(phase: HandoffPhase) -> None:
    """The plan is undone, and both instances are stopped."""
    cluster = two_hosts()
    begin(cluster, phase)
    cluster.tell(happened.CancelRequested(99, ("p",)))
    cluster.wait(25.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])
    settled(cluster)


def test_a_destination_that_answers_abort_with_active_has_moved() -> None:
    """An active destination cannot be undone, so the handoff counts as moved."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    cluster.machines["b"].connected = False  # cut off from the master, not from the other node
    while any(node.reports or node.configs for _, node in cluster.air.nodes()):
        for _, node in cluster.air.nodes():
            if node.configs:
                node.take_config()
            if node.reports:
                node.take_report()
    assert cluster.active() == ["b"]
    cluster.air.to_master.clear()
    cluster.wait(10.5)
    assert published(cluster)[-1] == "ABORT"
    assert cluster.active() == ["b"]
    cluster.reconnect("b", seconds=1.0)
    has_moved(cluster)
    assert len(cluster.recorded("migration_redone")) == 1


@pytest.mark.parametrize("killed", [False, True], ids=["same master", "next master"])
def test_a_destination_that_does_not_answer_abort_has_ended_before_the_source_resumes(
    killed: bool,
) -> None:
    """Until its end is known, the destination could still become active.

    Its report ACTIVE changes nothing once it was ordered to stop, for the next master neither.
    """
    cluster = two_hosts()
    quirk(cluster, "a", "never silent")
    quirk(cluster, "b", "no abort")
    cluster.machines["b"].stubborn.add("p")
    cluster.migrate("p", "b")
    cluster.wait(25.0)
    assert len(cluster.orders(StopInstance)) > 1
    assert len(cluster.recorded("destination_unheard")) == 1
    if killed:
        cluster.restart_master()
    cluster.tell(happened.HandoffReported("p", 2, 2, ReportPhase.ACTIVE))
    cluster.wait(1.0)
    assert "RESUME" not in published(cluster)
    assert cluster["p"].migrations == 0
    cluster.let_go("p", "b")
    has_stayed(cluster)


def test_a_silent_source_that_does_not_report_its_resume_leaves_the_move_stuck() -> None:
    """The master repeats RESUME and records the stuck move; the process can be cancelled."""
    cluster = two_hosts()
    quirk(cluster, "a", "no resume")
    begin(cluster, HandoffPhase.SWITCH)
    cluster.machines["b"].finish("p", cluster.now, code=3)
    cluster.wait(11.0)
    assert cluster.phase("p") == "stuck"
    assert (
        "letting the source publish again took longer than 10 s"
        in cluster.recorded("migration_stuck")[0]
    )
    cluster.machines["a"].quirks["p"].clear()
    cluster.wait(3.0)
    has_stayed(cluster)


# --- end of the source ------------------------------------------------------------------------


@pytest.mark.parametrize("policy", [ON_FAILURE, RestartPolicy("never")], ids=lambda one: one.when)
def test_a_source_that_ends_before_the_switch_follows_its_restart_policy(
    policy: RestartPolicy,
) -> None:
    """Its slave may not restart it during a move, so the master queues it, or it has failed."""
    cluster = two_hosts(spec=stateful(restart=policy))
    quirk(cluster, "b", "never ready")
    cluster.migrate("p", "b")
    cluster.finish("p", code=3)
    if policy.when == "never":
        assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])
        return
    assert (cluster.phase("p"), len(cluster.active())) == ("running", 1)
    (message,) = cluster.recorded("queued")
    assert message == "p returns to the queue: restart by policy 'on-failure': exit code 3"


class Crashing(Machine):
    """A host on which a program ends before an order to change it; later statuses are lost."""

    lost = False

    def obey(self, sent: SendOrder, now: float) -> happened.OrderAnswered:
        if isinstance(sent.order, AmendInstance) and sent.order.instance in self.programs:
            self.lost = True
            self.finish("p", now, code=3)
        return super().obey(sent, now)

    def say(self, batch: happened.StatusesReceived) -> None:
        if not self.lost:
            super().say(batch)


@pytest.mark.parametrize("killed", [False, True], ids=["same master", "next master"])
def test_a_destination_that_ends_before_its_restarts_are_allowed_is_started_again(
    killed: bool,
) -> None:
    """The master learns the end late, and the slave has not applied the policy."""
    cluster = Cluster("a")
    cluster.submit(stateful())
    crashing = Crashing("b", busy={"memory": 0.5, "cpu": 0.1})
    cluster.add(crashing)
    cluster.migrate("p", "b")
    cluster.wait(3.0)
    assert (cluster.active("p"), cluster["p"].owner) == ([], 2)
    crashing.lost = False
    if killed:
        cluster.restart_master()
    cluster.wait(15.0)
    assert (cluster.phase("p"), len(cluster.active())) == ("running", 1)


@pytest.mark.parametrize(("when", "again"), [("never", False), ("on-failure", True)])
def test_a_source_that_was_unhealthy_has_failed_though_it_exits_with_0(when, again) -> None:
    """The process ended on a signal of its slave, which would have restarted it."""
    unhealthy = InstanceStatus(InstanceId("p", 1), InstanceState.FAILED, message="unhealthy: x")
    assert restarts_after(RestartPolicy(when), unhealthy) is again


def test_the_destination_takes_over_from_a_source_that_ends_during_the_switch() -> None:
    """The destination has the newest state that is left."""
    cluster = two_hosts()
    quirk(cluster, "a", "never silent")
    cluster.migrate("p", "b")
    cluster.finish("p", code=3)
    has_moved(cluster)
    assert published(cluster) == ["SHADOW", "SWITCH", "TAKE_OVER", "DONE"]


def test_take_over_is_published_again_until_the_destination_reports() -> None:
    """After its time-out both instances are gone, and the process is queued."""
    cluster = two_hosts(order_retry=2.0)
    quirk(cluster, "a", "never silent")
    cluster.migrate("p", "b")
    quirk(cluster, "b", "deaf")
    cluster.finish("p", code=3)
    cluster.wait(5.0)
    assert published(cluster).count("TAKE_OVER") == 3
    cluster.wait(25.0)
    assert (cluster.phase("p"), len(cluster.active())) == ("running", 1)
    assert len(cluster.recorded("queued")) == 1


def test_a_phase_is_published_again_until_the_nodes_report() -> None:
    """A node may have missed the first message."""
    cluster = two_hosts(order_retry=2.0)
    quirk(cluster, "b", "deaf")
    cluster.migrate("p", "b")
    cluster.wait(5.0)
    assert published(cluster) == ["SHADOW"] * 3
    cluster.machines["b"].quirks["p"].clear()
    cluster.wait(2.0)
    has_moved(cluster)
    assert published(cluster) == ["SHADOW"] * 4 + ["SWITCH", "DONE"]


def test_a_destination_that_ends_after_the_commit_is_queued_by_its_policy() -> None:
    """Its slave has no order yet to restart it."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    while not cluster["p"].migrations:
        cluster.nodes_talk()
    cluster.finish("p", "b", code=3)
    assert (cluster.phase("p"), len(cluster.active())) == ("running", 1)


# --- slaves and the master --------------------------------------------------------------------

PHASES = [HandoffPhase.SHADOW, HandoffPhase.SWITCH]


class Killed(Exception):
    """Signal that the master was killed."""


def moving(strategy: str, overlap: bool, stop_at: int) -> tuple[Cluster, int]:
    """Run a move to b until the master has handled this many events."""
    policy = MigrationPolicy(strategy, overlap=overlap)
    cluster = two_hosts(spec=process("p", migration=policy, restart=ON_FAILURE))
    events, tell = 0, cluster.tell

    def counting(event: happened.Event) -> Any:
        nonlocal events
        if events == stop_at:
            raise Killed
        events += 1
        return tell(event)

    cluster.tell = counting  # type: ignore[method-assign]
    with suppress(Killed):
        cluster.tell(happened.MigrationRequested(9, "p", "b"))
        cluster.settle()
    cluster.tell = tell  # type: ignore[method-assign]
    return cluster, events


@pytest.mark.parametrize("order", ["ab", "ba"])
@pytest.mark.parametrize(
    ("strategy", "overlap"), [("handoff", True), ("relaunch", True), ("relaunch", False)]
)
def test_a_master_may_be_killed_at_any_event_of_a_move(
    strategy: str, overlap: bool, order: str
) -> None:
    """The move ends as moved with one running instance; never are two nodes active.

    Either slave may register first; the nodes repeat their reports.
    """
    cluster, count = moving(strategy, overlap, stop_at=10_000)
    assert (cluster.where("p"), count > 4) == (["b"], True)
    for stop_at in range(1, count):
        cluster, _ = moving(strategy, overlap, stop_at)
        cluster.kill_master()
        for name in order:
            cluster.register(cluster.machines[name])
            cluster.wait(2.0, tick=0.5)
            assert strategy == "relaunch" or len(cluster.active()) <= 1
        cluster.wait(36.0, tick=0.5)
        assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"]), stop_at
        assert cluster.active() == ["b"]
        assert restart_of(cluster, "b") == ON_FAILURE
        assert not cluster.intents["migration"]
        assert len(cluster.recorded("migrated")) == 1, stop_at


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("host", ["a", "b"])
def test_a_killed_slave_does_not_end_the_move(phase: HandoffPhase, host: str) -> None:
    """The processes keep running; the plan continues with the next slave."""
    cluster = two_hosts()
    begin(cluster, phase)
    cluster.machines[host].restart_slave(cluster.now)
    cluster.now += 4.0
    cluster.tell(happened.TimePassed())
    assert cluster.register(cluster.machines[host]).accepted
    cluster.wait(15.0)
    has_moved(cluster)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("host", ["a", "b"])
def test_one_instance_is_active_after_the_rejoin_of_a_host(phase: HandoffPhase, host: str) -> None:
    """One instance is active, whatever the master decided during the cut."""
    cluster = two_hosts()
    begin(cluster, phase)
    cluster.cut(host)
    for _ in range(12):
        cluster.wait(5.0)
        assert len(cluster.active()) <= 1
    cluster.reconnect(host, seconds=30.0)
    assert cluster.phase("p") == "running"
    assert len(cluster.active()) == len(cluster.where("p")) == 1


def test_a_plan_whose_hosts_stay_away_from_the_next_master_is_stuck() -> None:
    """The plan gives up after the lease and its own time-outs, and records that."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SHADOW)
    cluster.cut("a", "b")
    cluster.kill_master()
    cluster.wait(60.0)
    assert cluster.phase("p") == "stuck"
    cluster.rejoin("a", 0.0)
    cluster.rejoin("b", 30.0)
    assert cluster.phase("p") == "running"
    assert len(cluster.active()) == len(cluster.where("p")) == 1


def test_an_unknown_move_in_the_journal_is_dropped() -> None:
    """A move of another version is dropped: the owner keeps running, the other instance stops."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SHADOW)
    cluster.intents["migration"]["p"]["plan"]["steps"][0]["kind"] = "teleport"
    cluster.restart_master()
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert not cluster.intents["migration"]
    assert (
        "cannot be continued: steps[0].kind 'teleport'; allowed: start, "
        in cluster.recorded("migration_forgotten")[0]
    )


def test_the_source_of_a_dropped_move_has_its_restart_policy_again() -> None:
    """The dropped move had ordered the slave not to restart the source."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SHADOW)
    (source,) = cluster.machines["a"].programs.values()
    assert source.restart.when == "never"
    cluster.intents["migration"]["p"]["plan"]["steps"][0]["kind"] = "teleport"
    cluster.restart_master()
    cluster.wait(5.0)
    assert source.restart == cluster["p"].spec.restart


def test_reports_of_another_handoff_are_ignored() -> None:
    """A report is ignored if its process, destination or handoff number does not match."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SHADOW)
    for report in (("p", 7, 2), ("q", 2, 2), ("p", 2, 9)):
        cluster.tell(happened.HandoffReported(*report, ReportPhase.ACTIVE))
    assert not cluster.state.migrations["p"].handoff_reports


# --- stranded sources -------------------------------------------------------------------------


def silence(cluster: Cluster, destination: int = 99) -> None:
    """Silence the node of p by forged messages about a handoff to this number."""
    (node,) = (node for _, node in cluster.air.nodes() if node.active)
    node.active, node.handoff = False, destination


def test_a_source_that_forged_messages_silenced_resumes() -> None:
    """The master answers with RESUME and DONE, and records the reason."""
    cluster = two_hosts()
    silence(cluster)
    cluster.tell(happened.SourceStranded(1, 99))
    cluster.wait(1.0)
    assert published(cluster) == ["RESUME", "DONE"]
    assert cluster.active() == ["a"]
    assert "p#1 is silent for a handoff to p#99" in cluster.recorded("source_stranded")[0]
    assert cluster.migrate("p", "b").accepted
    has_moved(cluster)


@pytest.mark.parametrize("until", [HandoffPhase.SHADOW, HandoffPhase.SWITCH])
@pytest.mark.parametrize("destination", [2, 99])
def test_a_source_is_not_resumed_while_its_process_moves(until, destination) -> None:
    """The destination may become active at any moment; the plan ends the silence."""
    cluster = two_hosts()
    begin(cluster, until)
    for _ in range(100):
        cluster.tell(happened.SourceStranded(1, destination))
        if not cluster.nodes_talk():
            break
    cluster.wait(5.0)
    has_moved(cluster)
    assert not cluster.recorded("source_stranded")


def test_a_source_that_has_a_successor_is_not_resumed() -> None:
    """The plan is about to stop the source."""
    cluster = two_hosts()
    begin(cluster, HandoffPhase.SWITCH)
    while not cluster["p"].migrations:
        cluster.nodes_talk()
    cluster.tell(happened.SourceStranded(1, 2))
    cluster.tell(happened.SourceStranded(1, 99))
    assert not cluster.recorded("source_stranded")


@pytest.mark.parametrize("number", [0, 7, 2**62, 2**64 - 1])
def test_questions_of_unknown_instances_have_no_effect(number) -> None:
    cluster = two_hosts()
    cluster.tell(happened.SourceStranded(number, number))
    assert published(cluster) == []


def test_a_source_is_not_resumed_before_all_hosts_have_reported() -> None:
    """A host that is still expected may run a destination that the journal lost."""
    cluster = two_hosts()
    silence(cluster)
    cluster.kill_master()
    cluster.rejoin("a", 0.0)
    cluster.tell(happened.SourceStranded(1, 99))
    assert cluster.active() == []
    cluster.rejoin("b", 1.0)
    cluster.tell(happened.SourceStranded(1, 99))
    cluster.wait(1.0)
    assert cluster.active() == ["a"]
