"""Health checks: an instance is unhealthy only if every look fails for longer than its time."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.slave import events
from rosrm.core.slave.commands import Command, Fail, Remember
from rosrm.core.slave.health import LOOK_PERIOD, InstanceHealth, resolve, watch_of
from rosrm.core.slave.watches import Awaited, Memo, NoState, Observation, Watch
from rosrm.model.values import (
    Amendment,
    Assignment,
    Health,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    RestartPolicy,
)
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.slave import health
from rosrm.slave.health import HealthWatch
from rosrm.slave.memos import from_memo, to_memo
from tests.unit.slave.rig import Slave

SCAN = Health("~/scan", 5.0, "", 4.0)
SPEC = ProcessSpec("lidar", module="m", ros=True, namespace="/robot", health=SCAN)
LIDAR = InstanceId("lidar", 1)


def watched(health: Health = SCAN, **more) -> Watch:
    watch = watch_of(Assignment(LIDAR, replace(SPEC, health=health), 1, "lidar", **more))
    assert watch is not None
    return watch


class Node:
    """Node with simulated looks, and its health verdict.

    Args:
        health: health settings of the node.
    """

    def __init__(self, health: Health = SCAN) -> None:
        self.judgement = InstanceHealth(watched(health), 7, 0.0)
        self.now = 0.0

    def looks(self, seconds: float, rate: float | None = None, period: float = 0.2, **look):
        """Repeat a look for this long; return the first verdict of bad health, with its time."""
        begun, counted = self.now, 0
        while self.now - begun < seconds:
            self.now += period
            messages = None
            if rate is not None:
                published = int((self.now - begun) * rate + 1e-9)
                messages, counted = published - counted, published
            verdict = self.judgement.look(Observation(messages=messages, **look), self.now)
            if verdict:
                return verdict
        return ""


# --- a topic ----------------------------------------------------------------------------------


def test_a_topic_that_falls_silent_is_noticed_within_its_time_and_a_quarter() -> None:
    """The verdict comes after `timeout`, and has the finding, its duration and the requirement."""
    node = Node()
    assert node.looks(60.0, rate=20.0) == ""
    silent = node.now
    assert node.looks(20.0, rate=0.0).startswith("unhealthy: ~/scan: 0.0 Hz for 4.")
    assert 4.0 < node.now - silent < 6.0


def test_a_slow_topic_is_not_enough() -> None:
    """A steady rate of 0.4 Hz fails where 5 Hz are required."""
    node = Node()
    verdict = node.looks(20.0, rate=0.4)
    assert verdict.endswith("at least 5 Hz are required")
    assert "0.4 Hz" in verdict or "0.2 Hz" in verdict or "0.5 Hz" in verdict


def test_a_node_has_its_time_once_more_until_it_must_publish() -> None:
    """The time starts again once the node is ready, because it may load data first."""
    node = Node()
    assert node.looks(7.5, trouble="not published as /robot/lidar/scan") == ""
    verdict = node.looks(2.0, trouble="not published as /robot/lidar/scan")
    assert verdict.startswith("unhealthy: ~/scan: not published as /robot/lidar/scan for 4.")


class SimulatedNode(Node):
    """Node with `use_sim_time`, whose topic has a rate in simulated time."""

    clock = 1000.0

    def simulates(self, seconds: float, rate: float, factor: float) -> str:
        """Return looks as `looks` does, while simulated time passes by a factor of real time."""
        for _ in range(round(seconds / 0.2)):
            before, self.clock = self.clock, self.clock + 0.2 * factor
            self.now += 0.2
            published = int(self.clock * rate + 1e-6) - int(before * rate + 1e-6)
            seen = Observation(messages=published, clock=self.clock)
            verdict = self.judgement.look(seen, self.now)
            if verdict:
                return verdict
        return ""


@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_the_rate_of_a_simulated_node_counts_by_its_clock(factor) -> None:
    """A slow or fast simulator changes no verdict, which names the clock."""
    node = SimulatedNode()
    assert node.simulates(60.0 / factor, 6.0, factor) == ""
    verdict = node.simulates(20.0 / factor, 0.0, factor)
    assert re.search(r"0\.0 Hz for [45]\.\d s by /clock, at least 5 Hz", verdict)


def test_a_paused_simulator_fails_no_node() -> None:
    """No simulated time passes, so no message is due; the checks continue with the simulator."""
    node = SimulatedNode()
    assert node.simulates(20.0, 6.0, 1.0) == ""
    assert node.simulates(3600.0, 6.0, 0.0) == ""
    assert node.simulates(3.0, 0.0, 1.0) == ""
    assert node.simulates(20.0, 6.0, 1.0) == ""


def test_a_simulator_that_is_started_again_fails_no_node() -> None:
    """The time of a restarted simulator begins at zero again."""
    node = SimulatedNode()
    assert node.simulates(20.0, 6.0, 1.0) == ""
    node.clock = 0.0
    assert node.simulates(20.0, 6.0, 1.0) == ""


def test_a_pause_shorter_than_its_time_is_forgiven() -> None:
    """Repeated short pauses do not add up."""
    node = Node()
    for _ in range(10):
        assert node.looks(8.0, rate=5.0) == ""
        assert node.looks(2.9, rate=0.0) == ""


@given(st.floats(0.01, 2000.0), st.floats(0.3, 300.0), st.floats(1.0, 10.0))
def test_a_topic_at_its_required_rate_is_never_unhealthy(least, timeout, faster) -> None:
    """This holds for every rate, time and start of the windows."""
    node = Node(Health("scan", least, "", timeout))
    assert node.looks(max(10 * timeout, 10 / least), least * faster, timeout / 10) == ""


@given(st.floats(0.01, 2000.0), st.floats(0.3, 300.0))
def test_a_topic_at_half_its_rate_or_less_is_always_unhealthy(least, timeout) -> None:
    """The verdict comes within twice its time and two windows."""
    node = Node(Health("scan", least, "", timeout))
    window = max(timeout / 4, 3 / least)
    assert node.looks(3 * timeout + 2 * window, least / 3.1, min(0.2, timeout / 10)) != ""


def test_a_subscription_is_counted_from_its_matching_on() -> None:
    """Silence counts only from the first whole window after the match."""
    node = Node(Health("scan", 5.0, "", 1.0))
    assert node.looks(1.9, trouble="not found by discovery yet") == ""
    assert node.looks(30.0, rate=5.0) == ""


def test_a_slave_that_did_not_look_finds_no_instance_unhealthy() -> None:
    """Looks that failed because the slave itself was stopped for a minute do not count."""
    node = Node()
    assert node.looks(20.0, rate=5.0) == ""
    node.now += 60.0
    assert node.looks(20.0, rate=5.0) == ""


# --- stopped, lifecycle -----------------------------------------------------------------------

PLAIN = Health(timeout=4.0)


def test_what_is_stopped_for_too_long_is_unhealthy() -> None:
    """SIGSTOP counts; a process that resumes in time is healthy."""
    node = Node(PLAIN)
    assert node.looks(3.7, stopped=True) == ""
    assert node.looks(1.0) == ""
    assert node.looks(3.7, stopped=True) == ""
    assert node.looks(1.0, stopped=True).startswith("unhealthy: stopped by a signal (SIGSTOP) f")


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("inactive", "lifecycle state inactive for 4."),
        (NoState.NO_ANSWER, "no answer from /robot/lidar/get_state for 4."),
    ],
)
def test_another_lifecycle_state_or_no_answer(state, said) -> None:
    """Both fail the check; a state that is not known yet does not."""
    node = Node(Health(lifecycle="active", timeout=4.0))
    assert node.looks(10.0, state=NoState.NOT_YET) == ""
    assert node.looks(10.0, state="active") == ""
    assert node.looks(3.0, state=state) == ""
    assert node.looks(0.3, state="active") == ""
    verdict = node.looks(5.0, state=state)
    assert verdict.startswith(f"unhealthy: {said}")
    assert verdict.endswith("the state active is required")


def test_the_verdict_has_every_finding() -> None:
    """The message has all findings in one line."""
    node = Node(Health("~/scan", 5.0, "active", 4.0))
    while "~/scan" not in (verdict := node.looks(20.0, rate=0.0, state=NoState.NO_ANSWER)):
        assert node.now < 60.0, verdict
    assert "no answer" in verdict


# --- names ------------------------------------------------------------------------------------

RULES = {
    "scan": "front/scan", "~/raw": "/raw", "other:points": "/wrong", "lidar:points": "/points",
    "rosservice://image": "/wrong", "rostopic://image": "rostopic:///image", "__node": "x",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "absolute"),
    [
        ("/scan", "/scan"),
        ("scan", "/robot/front/scan"),
        ("/robot/scan", "/robot/front/scan"),
        ("~/scan", "/robot/lidar/scan"),
        ("~/raw", "/raw"),
        ("points", "/points"),
        ("image", "/image"),
        ("__node", "/robot/__node"),
    ],
)
def test_a_name_is_found_as_the_node_finds_it(name, absolute) -> None:
    """The first matching remapping rule applies, in the namespace or below the node's name."""
    assert resolve(name, "/robot", "lidar", RULES, "rostopic://") == absolute
    assert resolve("scan", "", "lidar", {}, "rostopic://") == "/scan"


def test_under_an_alias_names_are_those_that_others_see() -> None:
    """A node that does not know rosrm uses the alias, so names below the alias resolve, too."""
    spec = replace(SPEC, health=Health("~/scan", 5.0, "active", 4.0))
    watch = watch_of(Assignment(InstanceId("lidar", 2), spec, 1, "lidar_17", shadow=True))
    assert watch == Watch(
        spec.health,
        ("/robot/lidar/scan", "/robot/lidar_17/scan"),
        ("/robot/lidar/get_state", "/robot/lidar_17/get_state"),
        restarts=False,
        paused=True,
    )


def test_nothing_is_watched_without_a_time() -> None:
    """No health check is the default."""
    assert watch_of(Assignment(LIDAR, replace(SPEC, health=Health()), 1, "lidar")) is None


# --- reducer of the slave ---------------------------------------------------------------------

ALWAYS, NEVER = RestartPolicy("always"), RestartPolicy("never")
PROCESS = ProcessSpec("lidar", command=("true",), health=PLAIN, restart=ALWAYS)
RUNS = InstanceStatus(LIDAR, InstanceState.RUNNING, pid=5)


def running(**assigned) -> Slave:
    """Return a slave with one running plain process that has a health check."""
    one = Slave()
    one.assign(PROCESS, **assigned)
    one.status(InstanceState.RUNNING, "lidar")
    return one


def looks(one: Slave, seconds: float, pid: int = 5) -> list[Command]:
    """Look at a stopped process; return the first commands within this time."""
    until, commands = one.now + seconds, []
    while one.now < until and not commands:
        look = events.LookedAt(LIDAR, pid, Observation(stopped=True))
        commands = one.step(look, after=LOOK_PERIOD)
    return commands


def test_a_restart_starts_the_time_again() -> None:
    """Looks at the former run, or at a run that is not ready, do not count."""
    one = running()
    assert looks(one, 3.0) == []
    one.status(InstanceState.BACKOFF, "lidar")
    assert one.state.watched() == {}
    assert looks(one, 10.0) == []
    one.status(InstanceState.RUNNING, "lidar", pid=6)
    assert looks(one, 10.0) == []
    assert looks(one, 3.0, pid=6) == []
    assert len(looks(one, 3.0, pid=6)) == 1


def test_a_shadow_is_watched_when_it_is_none_any_more() -> None:
    """A later run of the slave resumes the checks, too."""
    one = running(shadow=True)
    assert one.state.watched() == {}
    assert looks(one, 10.0) == []
    commands = one.step(events.AmendmentOrdered(LIDAR, Amendment(ALWAYS)))
    (memo,) = [command.memo for command in commands if isinstance(command, Remember)]
    later = Slave()
    later.step(events.SupervisorReplaced((RUNS,), {LIDAR: memo}))
    assert list(one.state.watched()) == list(later.state.watched()) == [LIDAR]


def test_an_unhealthy_run_is_failed_unless_it_is_being_moved() -> None:
    """The fail order names this run, and kills it if it is stopped; a lost order is repeated.

    A move suspends restart policy and health checks; afterwards the time starts again.
    """
    one = running()
    looks(one, 3.0)
    one.step(events.AmendmentOrdered(LIDAR, Amendment(NEVER)))
    assert looks(one, 20.0) == []
    one.step(events.AmendmentOrdered(LIDAR, Amendment(ALWAYS)))
    assert looks(one, 3.0) == []
    for _ in range(2):
        (fail,) = looks(one, 10.0)
        assert isinstance(fail, Fail)
        assert (fail.instance, fail.pid, fail.kill) == (LIDAR, 5, True)


def test_a_shadow_that_waits_for_a_slot_is_watched_later() -> None:
    """The restart policy arrived before its start."""
    one = Slave(max_processes=1)
    one.assign(replace(PROCESS, name="other"))
    one.assign(PROCESS, alias="lidar_1", shadow=True)
    one.step(events.AmendmentOrdered(LIDAR, Amendment(ALWAYS)))
    watch = one.of("lidar").watch
    assert watch is not None
    assert not watch.paused


@given(
    st.builds(
        Memo,
        st.none() | st.builds(Awaited, st.text(), st.floats(0, 1e6), st.integers(0, 99)),
        st.none()
        | st.builds(
            Watch,
            st.builds(Health, st.text(), st.floats(0, 1e4), st.text(), st.floats(0.1, 1e6)),
            st.lists(st.text()).map(tuple), st.lists(st.text()).map(tuple), st.booleans(),
            st.booleans(),
        ),
    )
)  # fmt: skip
def test_a_memo_survives_the_way(memo) -> None:
    """A later run of the slave reads the same memo; an empty memo is not written."""
    text = to_memo(memo)
    assert (from_memo(text) or Memo()) == memo
    assert bool(text) == (memo != Memo())


def test_a_check_that_fails_has_no_result_and_the_others_go_on(monkeypatch, caplog) -> None:
    """For example because no descriptor is left: the slave and its processes run on."""

    def read_stat(pid: int):
        if pid == 1:
            raise OSError(24, "Too many open files")
        return SimpleNamespace(state="S")

    monkeypatch.setattr(health, "read_stat", read_stat)
    launchers = SimpleNamespace(has_departed=lambda _: False, root=lambda pid: pid)
    participant = SimpleNamespace(guard=CallbackGuard())
    checks = HealthWatch(participant, None, None, launchers)
    held = {
        InstanceId("p", pid): SimpleNamespace(status=SimpleNamespace(pid=pid), watched=Watch(SCAN))
        for pid in (1, os.getpid())
    }
    (result,) = checks.look(held, 1.0)
    assert (result.pid, result.look) == (os.getpid(), Observation(False))
    assert "Too many open files" in caplog.text


@pytest.mark.parametrize(("departed", "looks"), [(True, 0), (None, 0), (False, 1)])
def test_a_node_that_may_be_out_of_the_graph_is_not_observed(departed, looks) -> None:
    """None: its launcher is late or fails, perhaps while the node is dumped for a move."""
    launchers = SimpleNamespace(has_departed=lambda _: departed, root=lambda pid: pid)
    checks = HealthWatch(SimpleNamespace(guard=CallbackGuard()), None, None, launchers)
    one = SimpleNamespace(status=SimpleNamespace(pid=os.getpid()), watched=Watch(SCAN))
    assert len(checks.look({InstanceId("p", 1): one}, 1.0)) == looks
