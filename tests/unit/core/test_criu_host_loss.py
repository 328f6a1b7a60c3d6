"""Loss or departure of hosts during a move by `criu`: `host_loss` applies, one node is active.

The source is frozen from its dump on; the restored node is silent until the order to join. So the
master follows an unreachable instance's policy or waits; it never re-adopts it as it is.
"""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.model.plan import Commit, Execute, Move, Plan, Start, Stop
from rosrm.model.values import HostLossPolicy, MigrationPolicy
from rosrm_criu.plans import (
    AWAIT_RESTORED,
    COPY_MEMORY,
    END,
    FETCH,
    GO_ON,
    JOIN,
    REMOVE_COPY,
)
from tests.unit.core.cluster import Cluster, Machine, node, process
from tests.unit.core.portable import Portable, by_criu

#: Seconds after which a host counts as lost, and the longest wait for an order's answer then.
LEASE, LATEST = 10.0, 30.0
POLICIES = ["wait", "elsewhere", "stop"]
#: Ways in which a host gets lost, and times after which the master is killed then; 0: it lives.
WAYS = ["cut", "without power"]
KILLS = [("cut", 0.0), ("without power", 0.0), ("cut", LEASE + 0.5), ("cut", 1.0)]
KILL_NAMES = ["cut", "without power", "master killed after the lease", "master killed before"]


def story(
    then: Any = "elsewhere", *others: str, delay: float = 0.0, seconds: float = 2.0
) -> Cluster:
    """Return a cluster where p runs on a, moves by criu, and may go to the other hosts (b and c).

    Args:
        then: host-loss policy of p, applied after `delay` seconds.
        others: names of the other hosts.
        seconds: time-out of each part of a move.
    """
    cluster = Cluster(Portable("a"), strategies={"criu": by_criu(seconds)}, lease=LEASE)
    policy = HostLossPolicy(then, delay)
    cluster.submit(node("p", migration=MigrationPolicy("criu"), host_loss=policy))
    for name in others or ("b", "c"):
        cluster.add(Portable(name))
    wait(cluster, LEASE + 1.0)  # the master has had contact with some host for a whole lease
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    return cluster


def host(cluster: Cluster, name: str) -> Portable:
    machine = cluster.machines[name]
    assert isinstance(machine, Portable)
    return machine


def wait(cluster: Cluster, seconds: float) -> None:
    """Let time pass, with nodes appearing in the graph."""
    for _ in range(round(seconds / 0.5)):
        for machine in cluster.machines.values():
            for instance in machine.programs:
                if machine.connected:
                    machine.seen_in_graph(instance.process, cluster.now)
        cluster.wait(0.5, tick=0.25)


def lose(cluster: Cluster, name: str, how: str = "cut") -> None:
    """Cut a host off, or switch it off."""
    if how == "cut":
        host(cluster, name).connected = False
    else:
        host(cluster, name).lose_power(cluster.now)


def back(cluster: Cluster, name: str, *, registers: bool = False) -> None:
    """Reconnect a host and let its slave report its instances."""
    cluster.reconnect(name)
    if registers:
        cluster.rejoin(name, 0.0)
    wait(cluster, 8.0)


def leave(cluster: Cluster, name: str) -> None:
    """Stop a slave, which ends its processes and answers no more."""
    cluster.leave(name)
    cluster.cut(name)


def move_and_lose(
    cluster: Cluster, executor: str, *, of: str, lost: str, how: str = "cut", answered: bool = False
) -> None:
    """Move p to b and lose a host just before an executor does its work.

    Args:
        of: host of the executor.
        answered: True if the executor's answer arrives.
    """
    if not answered:
        host(cluster, of).mute.add(executor)
    host(cluster, of).befalls[executor] = lambda: lose(cluster, lost, how)
    assert cluster.migrate("p", "b").accepted
    wait(cluster, 0.5)
    assert not host(cluster, lost).connected


def active_in_contact(cluster: Cluster) -> list[str]:
    """Return the hosts with an active node, among those that are connected."""
    return [name for name in cluster.active() if cluster.machines[name].connected]


def runs_alone(cluster: Cluster, *on: str) -> None:
    """Check that p runs on one of these hosts, reachable and without a plan in progress."""
    assert "p" not in cluster.state.migrations, cluster["p"].reason
    assert cluster.phase("p") == "running", cluster["p"].reason
    owner = cluster.state.instances[cluster["p"].owner]
    assert owner.host.name in on
    assert active_in_contact(cluster) == [owner.host.name]


def nothing_else(cluster: Cluster) -> None:
    """Check that only the owner of the name runs on reachable hosts, if it has one."""
    owner = cluster.state.instances.get(cluster["p"].owner)
    reachable = [one for one in cluster.where("p") if cluster.machines[one].connected]
    assert reachable == ([owner.host.name] if owner is not None else [])


# --- lost and silent hosts --------------------------------------------------------------------


@pytest.mark.parametrize("then", POLICIES)
@pytest.mark.parametrize(
    ("executor", "lost", "number"), [(FETCH, "a", 1), (AWAIT_RESTORED, "a", 1), (JOIN, "b", 2)]
)
@pytest.mark.parametrize(("how", "killed"), KILLS, ids=KILL_NAMES)
def test_the_policy_decides_for_a_lost_host_of_a_move(
    executor: str, lost: str, number: int, then: str, how: str, killed: float
) -> None:
    """Source or destination resumes on its host, p starts on another one, or p has failed.

    The next master comes to the same end. No plan waits for a lost host, except under `wait`, for
    any time. After a power loss p starts again.
    """
    cluster = story(then)
    move_and_lose(cluster, executor, of="b", lost=lost, how=how)
    if killed:
        wait(cluster, killed)
        host(cluster, "b").mute.add(executor)  # the answer to the repeated request is lost, too
        cluster.restart_master()
        wait(cluster, 2 * LEASE + LATEST)
    else:
        wait(cluster, 120.0 if then == "wait" else LEASE + 3.0)
    if then == "elsewhere":
        runs_alone(cluster, *({"a", "b", "c"} - {lost}))
        assert killed or cluster.recorded("given_up") == [f"p#{number} is given up: {lost} is lost"]
    else:
        phase = "stuck" if then == "wait" else "failed"
        assert (cluster.phase("p"), active_in_contact(cluster)) == (phase, [])
        assert then == "wait" or cluster["p"].reason == f"{lost} is lost"
    back(cluster, lost, registers=bool(killed) or how != "cut")
    if then == "stop":
        assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])
        return
    resumes = then == "wait" and how == "cut"
    runs_alone(cluster, *(lost if resumes else "abc"))
    assert (cluster["p"].owner == number) == resumes
    nothing_else(cluster)


def test_p_starts_from_the_image_if_its_source_ends() -> None:
    """The source was frozen since its dump, so the image holds all its memory."""
    cluster = story("elsewhere", seconds=10.0)
    machine = host(cluster, "b")
    machine.slow.add(AWAIT_RESTORED)
    cluster.migrate("p", "b")
    host(cluster, "a").finish("p", cluster.now, code=9)
    wait(cluster, 1.0)
    cluster.tell(machine.answers.pop())
    wait(cluster, 3.0)
    runs_alone(cluster, "b")
    assert cluster["p"].owner == 2


@pytest.mark.parametrize("then", ["elsewhere", "stop"])
def test_p_starts_from_the_image_if_its_source_is_given_up(then: str) -> None:
    """The source's memory has left the lost host: p continues from the image at the destination."""
    cluster = story(then, seconds=3 * LEASE)
    machine = host(cluster, "b")
    machine.befalls[AWAIT_RESTORED] = lambda: lose(cluster, "a")
    machine.slow.add(AWAIT_RESTORED)
    cluster.migrate("p", "b")
    wait(cluster, LEASE + 2.0)
    assert cluster.recorded("given_up") == ["p#1 is given up: a is lost"]
    assert not active_in_contact(cluster)
    cluster.tell(machine.answers.pop())
    wait(cluster, 3.0)
    runs_alone(cluster, "b")
    assert cluster["p"].owner == 2
    back(cluster, "a")
    runs_alone(cluster, "b")
    nothing_else(cluster)


@pytest.mark.parametrize("executor", [FETCH, JOIN])
def test_the_plan_waits_for_a_source_whose_host_is_silent_and_not_lost(executor: str) -> None:
    """Before the commit the source resumes then; after it, its end becomes known."""
    cluster = story("elsewhere")

    def fail(arguments: Any) -> None:
        raise OSError("the transfer was cut")

    host(cluster, "b").executors[FETCH] = fail if executor == FETCH else lambda _: {}
    move_and_lose(cluster, executor, of="b", lost="a", answered=True)
    wait(cluster, LEASE - 3.0)
    assert "p" in cluster.state.migrations
    assert active_in_contact(cluster) == ([] if executor == FETCH else ["b"])
    back(cluster, "a")
    assert not cluster.recorded("given_up")
    runs_alone(cluster, "a" if executor == FETCH else "b")
    assert cluster["p"].owner == (1 if executor == FETCH else 2)
    nothing_else(cluster)


def test_the_delay_of_the_policy_applies() -> None:
    """A host that rejoins within the delay resumes its process."""
    cluster = story("elsewhere", delay=60.0)
    first = cluster["p"].owner
    move_and_lose(cluster, FETCH, of="b", lost="a")
    wait(cluster, LEASE + 40.0)
    assert (cluster.phase("p"), active_in_contact(cluster)) == ("stuck", [])
    back(cluster, "a")
    runs_alone(cluster, "a")
    assert cluster["p"].owner == first


@pytest.mark.parametrize(("executor", "at_once"), [(AWAIT_RESTORED, True), (JOIN, False)])
def test_p_starts_on_a_third_host_if_both_hosts_of_the_move_are_lost(
    executor: str, at_once: bool
) -> None:
    """The destination is lost at once, or after the move was finished without the source."""
    cluster = story("elsewhere")
    move_and_lose(cluster, executor, of="b", lost="a", answered=not at_once)
    if not at_once:
        wait(cluster, LEASE + 3.0)
    lose(cluster, "b")
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "c")
    back(cluster, "a")
    back(cluster, "b")
    runs_alone(cluster, "c")
    nothing_else(cluster)


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_a_frozen_source_is_not_readopted(restarted: bool) -> None:
    """Without room elsewhere p starts again after the rejoin: no plan resumes the source."""
    cluster = story("elsewhere", "b")
    host(cluster, "b").befalls[FETCH] = lambda: cluster.set_host("b", "cordon")
    host(cluster, "b").mute.add(FETCH)
    cluster.migrate("p", "b")
    wait(cluster, 0.5)
    lose(cluster, "a")
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster.queue()) == ("queued", ["p"])
    if restarted:
        cluster.restart_master()
        host(cluster, "a").connected = True
        cluster.register(host(cluster, "a"))
    back(cluster, "a")
    runs_alone(cluster, "a")
    nothing_else(cluster)


def test_a_source_that_runs_during_the_copy_is_readopted() -> None:
    """Its host is only cut off, and there is no room elsewhere: the node keeps its memory."""
    cluster = story("elsewhere", "b")
    host(cluster, "a").befalls[COPY_MEMORY] = lambda: cluster.set_host("b", "cordon")
    host(cluster, "a").mute.add(COPY_MEMORY)
    cluster.migrate("p", "b")
    wait(cluster, 0.5)
    lose(cluster, "a")
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster.queue()) == ("queued", ["p"])
    back(cluster, "a")
    runs_alone(cluster, "a")
    assert cluster["p"].owner == 1


# --- graceful stop of a slave -----------------------------------------------------------------


@pytest.mark.parametrize("then", POLICIES)
@pytest.mark.parametrize(
    ("leaves", "mute", "on"),
    [
        ("a", {"a": {GO_ON}, "b": {FETCH}}, "bc"),
        ("b", {"b": {FETCH, REMOVE_COPY}}, "a"),
        ("a", {"a": {END}}, "b"),
        ("b", {"b": {JOIN}}, "ac"),
    ],
    ids=["source", "destination", "source, committed", "destination, committed"],
)
def test_the_plan_does_not_wait_for_a_slave_that_was_stopped(
    leaves: str, mute: dict[str, set[str]], on: str, then: str
) -> None:
    """The slave has ended its processes. Under each policy the other instance runs at once.

    If there is none, p starts again elsewhere. A fetch has a long time-out, and the source is
    frozen then.
    """
    cluster = story(then)
    for name, executors in mute.items():
        host(cluster, name).mute |= executors
    cluster.migrate("p", "b")
    leave(cluster, leaves)
    wait(cluster, 1.0 if on == "a" else 3.0)
    runs_alone(cluster, *on)
    assert cluster["p"].owner == {"a": 1, "b": 2}.get(on, cluster["p"].owner)


# --- after the commit -------------------------------------------------------------------------


@pytest.mark.parametrize(("how", "killed"), [*KILLS[:2], ("cut", 0.5)])
@pytest.mark.parametrize("then", POLICIES)
def test_a_source_that_is_lost_after_the_commit_changes_nothing(
    then: str, how: str, killed: float
) -> None:
    """The node runs at the destination; the rest of the source ends when its host rejoins."""
    cluster = story(then)
    move_and_lose(cluster, JOIN, of="b", lost="a", how=how, answered=True)
    if killed:
        cluster.restart_master()
        wait(cluster, LEASE + LATEST)
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "b")
    assert cluster.recorded("migrated") == ["p moved from a to b"]
    back(cluster, "a", registers=bool(killed) or how != "cut")
    runs_alone(cluster, "b")
    nothing_else(cluster)


def test_a_destination_that_never_joined_is_not_readopted() -> None:
    """With no room elsewhere, p starts again."""
    cluster = story("elsewhere", "b")
    cluster.set_host("a", "cordon")
    move_and_lose(cluster, JOIN, of="b", lost="b")
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("queued", ["b"])
    back(cluster, "b")
    runs_alone(cluster, "b")
    nothing_else(cluster)


# --- steps that still need their host ---------------------------------------------------------


class Tidy:
    """Third-party strategy that must remove its files from the source's host."""

    def propose(self, move: Move) -> Plan:
        here, there = move.source_host, move.destination_host
        away = Execute("put_away", here, {}, 2.0)
        return Plan(
            (
                Execute("lay_out", here, {}, 2.0, undo=away),
                Execute("fetch", there, {}, 2.0),
                Start(move.destination, there, 5.0, undo=Stop(move.destination, there, 5.0)),
                Commit(),
                Stop(move.source, here, 5.0),
            ),
            overlap=5.0,
        )


def test_an_undo_on_a_host_in_contact_is_ordered_until_it_succeeds() -> None:
    """The files must be removed even if the instance there has ended."""
    put_away: list[Any] = []

    def refuse(arguments: Any) -> None:
        raise OSError("the disk is full")

    def end(arguments: Any) -> None:
        cluster.machines["a"].finish("p", cluster.now)
        raise OSError("there is nothing")

    cluster = Cluster(
        Machine("a", executors={"lay_out": lambda _: {}, "put_away": refuse}),
        Machine("b", busy={"memory": 0.5}, executors={"fetch": end}), strategies={"tidy": Tidy()},
    )  # fmt: skip
    cluster.submit(process("p", migration=MigrationPolicy("tidy")))
    cluster.migrate("p")
    cluster.wait(30.0)
    assert cluster.phase("p") == "stuck"
    assert "put_away failed on a: the disk is full" in cluster["p"].reason
    cluster.machines["a"].executors["put_away"] = put_away.append
    cluster.wait(3.0)
    assert len(put_away) == 1
    assert cluster.phase("p") == "finished"


def test_a_process_that_is_frozen_by_a_lost_checkpoint_is_not_readopted() -> None:
    """The frozen process starts again after the rejoin, and its image is removed."""
    cluster = story("elsewhere", "b")
    cluster.set_host("b", "cordon")
    machine = host(cluster, "a")
    dumped: list[int] = []

    def keep(arguments: Any) -> Any:
        machine.programs[machine.find("p")].node.active = False
        dumped.append(arguments["source"])
        lose(cluster, "a")

    machine.executors |= {
        "criu_keep": keep, "criu_drop": lambda one: dumped.remove(one["numbers"][0]),
    }  # fmt: skip
    assert cluster.checkpoint("p").accepted
    wait(cluster, LEASE + LATEST + 90.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("queued", ["a"])
    back(cluster, "a")
    runs_alone(cluster, "a")
    nothing_else(cluster)
    assert not dumped
