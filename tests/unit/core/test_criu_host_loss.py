"""Loss or departure of hosts during a move by `criu`: `host_loss` applies, one node is active.

The source is frozen from its dump on; the restored node is silent until the order to join. So the
master follows an unreachable instance's policy or waits; it never re-adopts it as it is.
"""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.model.plan import Commit, Execute, Move, Plan, Start, Stop
from rosrm.model.values import HostLossPolicy, MigrationPolicy
from rosrm_criu.plans import AWAIT_RESTORED, END, FETCH, GO_ON, JOIN
from tests.unit.core.cluster import Cluster, Machine, node, process
from tests.unit.core.portable import Portable, by_criu

#: Seconds after which a host counts as lost, and the longest wait for an order's answer then.
LEASE, LATEST = 10.0, 30.0
POLICIES = ["wait", "elsewhere", "stop"]
#: Ways in which a host gets lost.
WAYS = ["cut", "without power"]


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


def back(cluster: Cluster, name: str, how: str = "cut") -> None:
    """Reconnect a host and let its slave report its instances."""
    machine = host(cluster, name)
    machine.connected = True
    if how != "cut":
        assert cluster.register(machine).accepted
    wait(cluster, 8.0)


def move_and_lose(
    cluster: Cluster, executor: str, *, of: str, lost: str, how: str = "cut", heard: bool = False
) -> None:
    """Move p to b and lose a host just before an executor does its work.

    Args:
        of: host of the executor.
        heard: True if the executor's answer arrives.
    """
    if not heard:
        host(cluster, of).mute.add(executor)
    host(cluster, of).befalls[executor] = lambda: lose(cluster, lost, how)
    assert cluster.migrate("p", "b").accepted
    wait(cluster, 0.5)
    assert not host(cluster, lost).connected


def heard(cluster: Cluster) -> list[str]:
    """Return the hosts with an active node, among those that are connected."""
    return [name for name in cluster.active() if cluster.machines[name].connected]


def runs_alone(cluster: Cluster, *on: str) -> None:
    """Check that p runs on one of these hosts, reachable and without a plan in progress."""
    assert "p" not in cluster.state.migrations, cluster["p"].reason
    assert cluster.phase("p") == "running", cluster["p"].reason
    owner = cluster.state.instances[cluster["p"].owner]
    assert owner.host.name in on
    assert heard(cluster) == [owner.host.name]


def nothing_else(cluster: Cluster) -> None:
    """Check that only the owner of the name runs on reachable hosts, if it has one."""
    owner = cluster.state.instances.get(cluster["p"].owner)
    reachable = [one for one in cluster.where("p") if cluster.machines[one].connected]
    assert reachable == ([owner.host.name] if owner is not None else [])


# --- the source's host before the commit ------------------------------------------------------


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("executor", [FETCH, AWAIT_RESTORED])
def test_a_source_that_is_lost_goes_elsewhere(executor: str, how: str) -> None:
    """The policy moves p on; the plan does not wait to resume the lost source."""
    cluster = story("elsewhere")
    move_and_lose(cluster, executor, of="b", lost="a", how=how)
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "b", "c")
    assert cluster.recorded("given_up") == ["p#1 is given up: a is lost"]
    back(cluster, "a", how)
    runs_alone(cluster, "b", "c")
    nothing_else(cluster)


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("executor", [FETCH, AWAIT_RESTORED])
def test_a_source_that_is_lost_has_failed_where_it_says_so(executor: str, how: str) -> None:
    """No instance of p is left on any host."""
    cluster = story("stop")
    move_and_lose(cluster, executor, of="b", lost="a", how=how)
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("failed", "a is lost")
    assert not heard(cluster)
    back(cluster, "a", how)
    assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])


@pytest.mark.parametrize("executor", [FETCH, AWAIT_RESTORED])
def test_a_source_that_is_waited_for_goes_on_where_it_stands_still(executor: str) -> None:
    """The source resumes after any absence of its host, because its memory is there."""
    cluster = story("wait")
    first = cluster["p"].owner
    move_and_lose(cluster, executor, of="b", lost="a")
    wait(cluster, 120.0)
    assert (cluster.phase("p"), heard(cluster)) == ("stuck", [])
    back(cluster, "a")
    runs_alone(cluster, "a")
    assert cluster["p"].owner == first
    nothing_else(cluster)


def test_a_source_that_ends_is_followed_by_its_image_once_that_is_there() -> None:
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
def test_a_source_that_is_given_up_is_followed_by_its_image(then: str) -> None:
    """The source's memory has left the lost host: p continues from the image at the destination."""
    cluster = story(then, seconds=3 * LEASE)
    machine = host(cluster, "b")
    machine.befalls[AWAIT_RESTORED] = lambda: lose(cluster, "a")
    machine.slow.add(AWAIT_RESTORED)
    cluster.migrate("p", "b")
    wait(cluster, LEASE + 2.0)
    assert cluster.recorded("given_up") == ["p#1 is given up: a is lost"]
    assert not heard(cluster)
    cluster.tell(machine.answers.pop())
    wait(cluster, 3.0)
    runs_alone(cluster, "b")
    assert cluster["p"].owner == 2
    back(cluster, "a")
    runs_alone(cluster, "b")
    nothing_else(cluster)


def test_a_source_that_is_waited_for_and_has_ended_starts_anew() -> None:
    """The host lost its power, so the plan cannot resume the source and p starts again."""
    cluster = story("wait")
    move_and_lose(cluster, FETCH, of="b", lost="a", how="without power")
    wait(cluster, 60.0)
    assert not heard(cluster)
    back(cluster, "a", "without power")
    runs_alone(cluster, "a", "b", "c")
    nothing_else(cluster)


def test_a_source_s_host_that_is_silent_for_a_while_is_waited_for() -> None:
    """The source resumes then: an instance is given up only when its host counts as lost."""
    cluster = story("elsewhere")
    first = cluster["p"].owner

    def fail(arguments: Any) -> None:
        raise OSError("the transfer was cut")

    host(cluster, "b").executors[FETCH] = fail
    move_and_lose(cluster, FETCH, of="b", lost="a", heard=True)
    wait(cluster, LEASE - 3.0)
    back(cluster, "a")
    assert not cluster.recorded("given_up")
    runs_alone(cluster, "a")
    assert cluster["p"].owner == first


def test_the_end_of_a_source_whose_host_is_silent_for_a_while_is_waited_for() -> None:
    """The node runs at the destination until the source's end is known."""
    cluster = story("elsewhere")
    move_and_lose(cluster, JOIN, of="b", lost="a", heard=True)
    wait(cluster, LEASE - 3.0)
    assert ("p" in cluster.state.migrations, heard(cluster)) == (True, ["b"])
    back(cluster, "a")
    assert not cluster.recorded("given_up")
    runs_alone(cluster, "b")
    nothing_else(cluster)


def test_the_delay_of_its_policy_is_kept() -> None:
    """A host that rejoins within the delay resumes its process."""
    cluster = story("elsewhere", delay=60.0)
    first = cluster["p"].owner
    move_and_lose(cluster, FETCH, of="b", lost="a")
    wait(cluster, LEASE + 40.0)
    assert (cluster.phase("p"), heard(cluster)) == ("stuck", [])
    back(cluster, "a")
    runs_alone(cluster, "a")
    assert cluster["p"].owner == first


def test_both_hosts_are_lost() -> None:
    """The process starts on a third host."""
    cluster = story("elsewhere")
    move_and_lose(cluster, AWAIT_RESTORED, of="b", lost="a")
    lose(cluster, "b")
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "c")
    back(cluster, "a")
    back(cluster, "b")
    runs_alone(cluster, "c")
    nothing_else(cluster)


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_a_source_that_stands_still_is_not_taken_back(restarted: bool) -> None:
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


# --- graceful stop of a slave -----------------------------------------------------------------


@pytest.mark.parametrize("then", POLICIES)
def test_a_source_s_slave_that_stops_leaves_nobody_waiting(then: str) -> None:
    """The slave has ended its processes and answers no more: p starts again elsewhere."""
    cluster = story(then)
    host(cluster, "b").mute.add(FETCH)
    cluster.migrate("p", "b")
    host(cluster, "a").mute.add(GO_ON)
    cluster.leave("a")
    host(cluster, "a").connected = False
    wait(cluster, 3.0)
    runs_alone(cluster, "b", "c")


@pytest.mark.parametrize("then", POLICIES)
def test_a_destination_s_slave_that_stops_in_the_fetch_lets_the_source_go_on(then: str) -> None:
    """The source resumes at once: it is frozen, and the time-out of a fetch is long."""
    cluster = story(then)
    first = cluster["p"].owner
    host(cluster, "b").mute.add(FETCH)
    cluster.migrate("p", "b")
    cluster.leave("b")
    host(cluster, "b").connected = False
    wait(cluster, 1.0)
    runs_alone(cluster, "a")
    assert cluster["p"].owner == first


# --- after the commit -------------------------------------------------------------------------


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("then", POLICIES)
def test_a_source_that_is_lost_after_the_commit_has_no_say(then: str, how: str) -> None:
    """The node runs at the destination; the rest of the source ends when its host rejoins."""
    cluster = story(then)
    move_and_lose(cluster, JOIN, of="b", lost="a", how=how, heard=True)
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "b")
    assert cluster.recorded("migrated") == ["p moved from a to b"]
    back(cluster, "a", how)
    runs_alone(cluster, "b")
    nothing_else(cluster)


@pytest.mark.parametrize("then", POLICIES)
def test_a_source_s_slave_that_stops_after_the_commit_has_no_say(then: str) -> None:
    """The slave has ended its processes."""
    cluster = story(then)
    host(cluster, "a").mute.add(END)
    cluster.migrate("p", "b")
    cluster.leave("a")
    host(cluster, "a").connected = False
    wait(cluster, 3.0)
    runs_alone(cluster, "b")


def test_a_later_loss_of_the_destination_is_followed() -> None:
    """The move is finished by then, though the source's host is lost."""
    cluster = story("elsewhere")
    move_and_lose(cluster, JOIN, of="b", lost="a", heard=True)
    wait(cluster, LEASE + 3.0)
    lose(cluster, "b")
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "c")
    back(cluster, "a")
    back(cluster, "b")
    runs_alone(cluster, "c")
    nothing_else(cluster)


@pytest.mark.parametrize("how", WAYS)
def test_a_destination_that_is_lost_before_it_joins_goes_elsewhere(how: str) -> None:
    """The policy decides, because the destination may or may not have joined.

    The source is ended.
    """
    cluster = story("elsewhere")
    move_and_lose(cluster, JOIN, of="b", lost="b", how=how)
    wait(cluster, LEASE + 3.0)
    runs_alone(cluster, "a", "c")
    assert cluster["p"].owner > 2
    back(cluster, "b", how)
    runs_alone(cluster, "a", "c")
    nothing_else(cluster)


@pytest.mark.parametrize("how", WAYS)
def test_a_destination_that_is_lost_before_it_joins_has_failed_where_it_says_so(how: str) -> None:
    """The frozen source is ended, too."""
    cluster = story("stop")
    move_and_lose(cluster, JOIN, of="b", lost="b", how=how)
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("failed", "b is lost")
    assert cluster.where("p") in (["b"], [])
    back(cluster, "b", how)
    assert cluster.where("p") == []


def test_a_destination_that_is_waited_for_joins_when_it_is_back() -> None:
    """The restored node keeps its memory; it stays silent until its host rejoins."""
    cluster = story("wait")
    move_and_lose(cluster, JOIN, of="b", lost="b")
    wait(cluster, 120.0)
    assert (cluster.phase("p"), heard(cluster)) == ("stuck", [])
    back(cluster, "b")
    runs_alone(cluster, "b")
    assert cluster["p"].owner == 2
    nothing_else(cluster)


def test_a_destination_that_never_joined_is_not_taken_back() -> None:
    """With no room elsewhere, p starts again."""
    cluster = story("elsewhere", "b")
    cluster.set_host("a", "cordon")
    move_and_lose(cluster, JOIN, of="b", lost="b")
    wait(cluster, LEASE + 3.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("queued", ["b"])
    back(cluster, "b")
    runs_alone(cluster, "b")
    nothing_else(cluster)


@pytest.mark.parametrize("then", POLICIES)
def test_a_destination_s_slave_that_stops_before_it_joins_leaves_nobody_waiting(then: str) -> None:
    """The slave has ended the restored instance: p starts again elsewhere."""
    cluster = story(then)
    host(cluster, "b").mute.add(JOIN)
    cluster.migrate("p", "b")
    cluster.leave("b")
    host(cluster, "b").connected = False
    wait(cluster, 3.0)
    runs_alone(cluster, "a", "c")


# --- restart of the master --------------------------------------------------------------------


@pytest.mark.parametrize("then", POLICIES)
@pytest.mark.parametrize("known", [True, False], ids=["loss known", "loss unknown"])
@pytest.mark.parametrize(("executor", "of", "lost"), [(FETCH, "b", "a"), (JOIN, "b", "b")])
def test_a_master_that_was_killed_comes_to_the_same_end(
    executor: str, of: str, lost: str, known: bool, then: str
) -> None:
    """The next master restores lost instances from its journal, or loses the host itself."""
    cluster = story(then)
    move_and_lose(cluster, executor, of=of, lost=lost)
    wait(cluster, LEASE + 0.5 if known else 1.0)
    host(cluster, of).mute.add(executor)  # the answer to the repeated request is lost, too
    cluster.restart_master()
    wait(cluster, 2 * LEASE + LATEST)
    if then == "wait":
        assert (cluster.phase("p"), heard(cluster)) == ("stuck", [])
    elif then == "stop":
        assert (cluster.phase("p"), heard(cluster)) == ("failed", [])
    else:
        runs_alone(cluster, "a", "b", "c")
    machine = host(cluster, lost)
    machine.connected = True
    cluster.register(machine)
    wait(cluster, 8.0)
    if then == "stop":
        assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])
    else:
        runs_alone(cluster, *([lost] if then == "wait" else "abc"))
        nothing_else(cluster)


def test_the_end_of_a_source_that_is_lost_is_left_to_its_host_by_the_next_master() -> None:
    """The node keeps running at the destination."""
    cluster = story("wait")
    move_and_lose(cluster, JOIN, of="b", lost="a", heard=True)
    cluster.restart_master()
    wait(cluster, 2 * LEASE + LATEST)
    runs_alone(cluster, "b")
    host(cluster, "a").connected = True
    cluster.register(host(cluster, "a"))
    wait(cluster, 8.0)
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


def test_an_executor_whose_host_is_heard_is_asked_until_it_has_done_its_work() -> None:
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


def test_a_checkpoint_that_was_left_behind_is_not_taken_back() -> None:
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
