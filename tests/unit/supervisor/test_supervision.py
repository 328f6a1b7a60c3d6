"""State machine of the supervisor: each row of its table, and invariants under random events."""

from __future__ import annotations

import dataclasses
import errno
import os
import re
import signal
from types import SimpleNamespace
from typing import get_args

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rosrm.core.supervisor import events, reducer
from rosrm.core.supervisor.commands import Leave, ReportStatus, Signal, Spawn, Unspawn
from rosrm.core.supervisor.events import (
    AmendOrdered,
    ClientLost,
    ContactReported,
    Exited,
    FailOrdered,
    FenceOrdered,
    RestartOrdered,
    SessionEnded,
    ShutdownOrdered,
    Slept,
    Spawned,
    SpawnFailed,
    StartOrdered,
    StatusStored,
    StopOrdered,
    TimePassed,
)
from rosrm.core.supervisor.instance import (
    BACKOFF,
    ENDED,
    EXITED,
    FAILED,
    FENCED,
    HELD,
    MOST_KILLS,
    REFUSED,
    RUNNING,
    STARTING,
    STOPPING,
    WITHDRAWN,
)
from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule
from rosrm.core.supervisor.transitions import TRANSITIONS, backoff
from rosrm.model import values
from rosrm.model.durations import LONGEST
from rosrm.supervisor import messages, server

TALKER = ("talker", 7)


def kinds(commands):
    """Return the types of the commands, because named tuples of different types may be equal."""
    return [type(command).__name__ for command in commands]


def ordered(restart=RestartRule(), stop=StopRule()):  # noqa: B008 - named tuples
    """Return a state machine with one start order at time 0, and its instance."""
    core = reducer.SupervisorState()
    core.handle(StartOrdered(TALKER, restart, stop), 0.0)
    return core, core.instances[TALKER]


def started(**policies):
    """Return a state machine with one running instance, and the instance."""
    core, instance = ordered(**policies)
    core.handle(Spawned(TALKER, 100), 0.0)
    return core, instance


def test_policies_are_those_of_the_model():
    """The supervisor's light policies have the fields and defaults of the model's."""
    for light, heavy in ((RestartRule, values.RestartPolicy), (StopRule, values.StopPolicy)):
        assert light._fields == tuple(field.name for field in dataclasses.fields(heavy))
        assert tuple(light()) == dataclasses.astuple(heavy())
    assert FenceRule._fields == tuple(field.name for field in dataclasses.fields(values.Fence))


def test_status_is_that_of_the_model():
    """Statuses have the fields and the state names of the model; the slave adds the devices."""
    assert (*messages.Status._fields, "devices") == tuple(
        field.name for field in dataclasses.fields(values.InstanceStatus)
    )
    ours = {HELD, STARTING, RUNNING, BACKOFF, STOPPING, *ENDED}
    theirs = {state.value for state in values.InstanceState} - {"ready"}  # the slave decides this
    assert ours == theirs
    assert {state.value for state in values.InstanceState if state.ended} == ENDED


def test_the_table_of_the_docstring_is_the_table_that_runs():
    """Each row of the docstring is a transition that runs, and the reverse; no event is left out.

    The phase "-" has the orders that may concern an unknown instance.
    """
    table = re.findall(r"^    (\w+|-|)  +(\w+)  +\S", reducer.__doc__, re.MULTILINE)
    documented, phase = [], ""
    for first, event in table[1:]:
        phase = first or phase
        documented.append((phase, event))
    runs = {(row, event.__name__) for row, event in TRANSITIONS}
    runs |= {("-", event.__name__) for event in get_args(reducer._OrderForUnknown)}
    runs |= {("ended", "StatusStored")}
    assert sorted(documented) == sorted(runs)
    assert all(event.__name__ in reducer.__doc__ for event in get_args(events.Event))


def test_start_is_recorded_before_it_is_tried():
    """The start is reported, and so recorded, before the spawn."""
    core = reducer.SupervisorState()
    commands = core.handle(StartOrdered(TALKER, RestartRule(), StopRule()), 0.0)
    assert kinds(commands) == ["ReportStatus", "Spawn"]


@pytest.mark.parametrize("order", [StopOrdered, FenceOrdered])
def test_a_late_start_of_a_stopped_unknown_instance_is_refused(order):
    """An order to stop or fence that overtakes its start wins."""
    core = reducer.SupervisorState()
    core.handle(order(TALKER), 0.0)
    core.handle(StartOrdered(TALKER, RestartRule(), StopRule()), 1.0)
    assert core.instances[TALKER].phase == REFUSED


@pytest.mark.parametrize(
    "order",
    [
        StartOrdered(TALKER, RestartRule(), StopRule()),
        AmendOrdered(TALKER, RestartRule()),
        StatusStored(TALKER),
        FailOrdered(TALKER, 99, "unhealthy"),
    ],
    ids=lambda order: type(order).__name__,
)
def test_an_order_without_effect_reports_the_status_again(order):
    """DDS and masters repeat orders; a status that is not final, or another run, is no target."""
    core, instance = started()
    assert kinds(core.handle(order, 1.0)) == ["ReportStatus"]
    assert (instance.phase, instance.restart) == (RUNNING, RestartRule())


@pytest.mark.parametrize(("number", "starts"), [(6, False), (7, False), (8, True)])
def test_forgotten_numbers_never_start(number, starts):
    """A forgotten instance and the older ones of its process are refused."""
    core, _ = started()
    core.handle(Exited(TALKER), 1.0)
    core.handle(StatusStored(TALKER), 2.0)
    order = StartOrdered(("talker", number), RestartRule(), StopRule())
    commands = core.handle(order, 3.0)
    assert ("Spawn" in kinds(commands)) is starts


@pytest.mark.parametrize(
    ("when", "code", "phase"),
    [
        ("never", 0, EXITED),
        ("never", 3, FAILED),
        ("on-failure", 0, EXITED),
        ("on-failure", 3, BACKOFF),
        ("always", 0, BACKOFF),
        ("always", 3, BACKOFF),
    ],
)
def test_restart_policy(when, code, phase):
    """The restart policy decides the phase after an exit."""
    core, instance = started(restart=RestartRule(when=when))
    core.handle(Exited(TALKER, code), 1.0)
    assert instance.phase == phase


def test_backoff_grows_to_its_bound_and_restarts_run_out():
    """Waits are 1, 2, 4 s and so on up to the bound; the status of the failure has its reason."""
    policy = RestartRule("on-failure", 1.0, 5.0, 2.0, attempts=5, window=300.0)
    core, instance = started(restart=policy)
    now, waits = 0.0, []
    for _ in range(6):
        core.handle(Exited(TALKER, 1), now)
        if instance.phase == FAILED:
            break
        waits.append(core.deadline() - now)
        now = core.deadline()
        assert kinds(core.handle(TimePassed(), now)) == ["ReportStatus", "Spawn"]
        core.handle(Spawned(TALKER, 100), now)
    assert [0.8 * most <= wait <= most for wait, most in zip(waits, (1, 2, 4, 5, 5), strict=True)]
    assert instance.message == "exit code 1; its restart policy allows 5 restarts within 300 s"
    assert instance.restarts == 5


def test_restarts_of_a_whole_run_are_worded_without_a_window():
    """So `retries` of a job allows them: its window is longer than any run."""
    core, instance = started(restart=RestartRule("on-failure", attempts=0, window=LONGEST))
    core.handle(Exited(TALKER, 1), 1.0)
    assert instance.message == "exit code 1; its restart policy allows no restarts"


def test_a_long_run_starts_the_backoff_afresh():
    """Restarts older than the window do not count."""
    core, instance = started(restart=RestartRule("always", 1.0, 30.0, 2.0, 1, window=10.0))
    core.handle(Exited(TALKER, 1), 0.0)
    core.handle(TimePassed(), 1.0)
    core.handle(Spawned(TALKER, 101), 1.0)
    core.handle(Exited(TALKER, 1), 12.0)
    assert instance.phase == BACKOFF
    assert 12.8 <= core.deadline() <= 13.0


@given(st.integers(0, 2000), st.floats(0, 1e6), st.floats(0, 1e6), st.floats(0.5, 1e3))
def test_backoff_is_bounded(done, delay, most, factor):
    """No policy and no number of restarts gives a wait beyond its bound, or an overflow."""
    assert 0.0 <= backoff(RestartRule("always", delay, most, factor), done) <= most


def crashed(count, rule):
    """Return this many instances that ended at once."""
    core = reducer.SupervisorState()
    keys = [(f"p{number}", number) for number in range(count)]
    for key in keys:
        core.handle(StartOrdered(key, rule, StopRule()), 0.0)
        core.handle(Spawned(key, 100), 0.0)
    for key in keys:
        core.handle(Exited(key, 1), 10.0)
    return core


def test_processes_that_crashed_together_restart_apart():
    """The waits differ, by a fifth at most."""
    core = crashed(20, RestartRule("on-failure", delay=10.0))
    waits = {one.deadline - 10.0 for one in core.instances.values()}
    assert len(waits) == 20
    assert 8.0 <= min(waits) < 8.5
    assert 9.5 < max(waits) <= 10.0


def test_at_most_eight_restarts_begin_within_a_second():
    """All restarts begin, eight per second."""
    core = crashed(30, RestartRule("on-failure", delay=0.0))
    begun = []
    while core.deadline() is not None:
        now = core.deadline()
        spawned = [one for one in core.handle(TimePassed(), now) if kinds([one]) == ["Spawn"]]
        begun += [now] * len(spawned)
    assert len(begun) == 30
    assert all(later - earlier >= 1.0 for earlier, later in zip(begun, begun[8:], strict=False))


@pytest.mark.parametrize(
    ("order", "phase", "message"),
    [
        (StopOrdered(TALKER), EXITED, "stopped by {}"),
        (FailOrdered(TALKER, 100, "unhealthy"), FAILED, "unhealthy"),
    ],
)
def test_a_stop_escalates_and_reports_each_step(order, phase, message):
    """SIGTERM and SIGKILL follow SIGINT after their graces; the last message has all three."""
    core, instance = started(stop=StopRule(2.0, 3.0))
    commands, sent = core.handle(order, 10.0), []
    for _ in range(3):
        sent += [(command.number, core.deadline()) for command in commands[1:]]
        commands = core.handle(TimePassed(), core.deadline())
    assert sent == [(signal.SIGINT, 12.0), (signal.SIGTERM, 15.0), (signal.SIGKILL, 16.0)]
    core.handle(Exited(TALKER, signal=signal.SIGKILL), 16.1)
    steps = "SIGINT, SIGTERM after 2.0 s, SIGKILL after 5.0 s"
    assert (instance.phase, instance.message) == (phase, message.format(steps))


@pytest.mark.parametrize(
    "before", [None, RestartOrdered(TALKER), FailOrdered(TALKER, 100, "unhealthy: silent")]
)
@pytest.mark.parametrize("shutdown", [False, True])
def test_a_users_stop_wins(before, shutdown):
    """Policy, restart order and health failure start nothing; a shutdown withdraws nothing."""
    core, instance = started(restart=RestartRule("always"))
    if before is not None:
        core.handle(before, 1.0)
    core.handle(StopOrdered(TALKER), 1.5)
    if shutdown:
        core.handle(ShutdownOrdered(), 1.6)
    core.handle(Exited(TALKER, signal=signal.SIGINT), 2.0)
    assert instance.phase == EXITED


def test_forced_restart_stops_then_starts():
    """A forced restart spawns when nothing is left, and the policy does not count it."""
    core, instance = started()
    assert kinds(core.handle(RestartOrdered(TALKER), 1.0)) == ["ReportStatus", "Signal"]
    assert kinds(core.handle(Exited(TALKER, signal=2), 2.0)) == ["ReportStatus", "Spawn"]
    assert instance.restarts == 0


@pytest.mark.parametrize("run", [(99, 0), (100, 1), (0, 0)])
def test_a_restart_of_another_run_changes_nothing(run):
    """A late copy of an order, after the restart that it ordered: the status is reported again."""
    core, instance = started()
    assert kinds(core.handle(RestartOrdered(TALKER, run), 1.0)) == ["ReportStatus"]
    assert instance.phase == RUNNING
    assert kinds(core.handle(RestartOrdered(TALKER, (100, 0)), 1.0)) == ["ReportStatus", "Signal"]


def test_a_restart_while_its_own_end_is_in_hand_is_carried_out():
    """The leader has ended, and leftovers are being stopped: then the instance restarts."""
    core, instance = started()
    core.handle(Exited(TALKER, 3, leftovers=True), 1.0)
    assert kinds(core.handle(RestartOrdered(TALKER), 1.1)) == ["ReportStatus"]
    assert instance.message.startswith("to restart it: SIGINT")
    assert kinds(core.handle(SessionEnded(TALKER), 2.0)) == ["ReportStatus", "Spawn"]
    assert instance.restarts == 0


NEVER = RestartRule("never")
ON_FAILURE = RestartRule("on-failure")


@pytest.mark.parametrize(
    ("when", "phase"), [("never", FAILED), ("on-failure", BACKOFF), ("always", BACKOFF)]
)
def test_an_unhealthy_run_has_failed_however_it_ends(when, phase):
    """The instance exits with 0 on the stop signal, but its policy uses the health failure."""
    core, instance = started(restart=RestartRule(when))
    commands = core.handle(FailOrdered(TALKER, 100, "unhealthy: silent"), 1.0)
    assert commands[-1] == Signal(TALKER, signal.SIGINT)
    assert instance.message == "unhealthy: silent; stopping it: SIGINT"
    core.handle(Exited(TALKER, 0), 2.0)
    assert instance.phase == phase
    assert instance.message.startswith("unhealthy: silent")


@pytest.mark.parametrize(
    ("end", "text"),
    [
        (Exited(TALKER, signal=9, out_of_memory=(5e8, 5e8)), "killed: used 500 MB of 500 MB"),
        (Exited(TALKER, -1, out_of_memory=(5e8, 5e8)), "killed: used 500 MB of 500 MB"),
        (Exited(TALKER, 1, out_of_memory=(5e8, 5e8)),
         "exit code 1, after a process of it was killed: used 500 MB of 500 MB"),
        (Exited(TALKER, signal=9, out_of_memory=(2e8, 0.0)),
         "killed: its host ran out of memory; it used 200 MB"),
        (Exited(TALKER, signal=9), "killed by SIGKILL"),
    ],
)  # fmt: skip
def test_an_end_by_the_oom_killer_is_reported_as_what_it_is(end, text):
    """The restart policy applies as to any other failure."""
    core, instance = started(restart=RestartRule("on-failure"))
    core.handle(end, 1.0)
    assert instance.phase == BACKOFF
    assert instance.message.startswith(f"{text}; restart 1 of 5")
    core.handle(TimePassed(), 60.0)
    core.handle(Spawned(TALKER, 101, ("limits.memory",), "limits.cpu: no group"), 60.0)
    assert (instance.message, instance.enforced) == ("limits.cpu: no group", ("limits.memory",))


def test_a_run_that_ends_well_has_not_failed_though_a_child_was_killed():
    """The leader has handled the end of its child."""
    core, instance = started(restart=RestartRule("on-failure"))
    core.handle(Exited(TALKER, 0, out_of_memory=(5e8, 5e8)), 1.0)
    assert (instance.phase, instance.message) == (EXITED, "")


def test_a_process_stopped_by_a_signal_is_killed_at_once():
    """A stopped process does not handle SIGINT; after SIGKILL no milder signal follows."""
    core, instance = started()
    commands = core.handle(FailOrdered(TALKER, 100, "unhealthy: stopped", kill=True), 1.0)
    assert commands[-1] == Signal(TALKER, signal.SIGKILL)
    assert instance.message == "unhealthy: stopped; stopping it: SIGKILL"
    again = core.handle(TimePassed(), core.deadline())
    assert again[-1] == Signal(TALKER, signal.SIGKILL)


def test_a_run_is_not_failed_for_the_one_before():
    """A restart clears the failure: the next run ends by its own exit code."""
    core, instance = started(restart=ON_FAILURE)
    core.handle(FailOrdered(TALKER, 100, "unhealthy: silent"), 1.0)
    core.handle(Exited(TALKER, 0), 1.1)
    core.handle(TimePassed(), core.deadline())
    core.handle(Spawned(TALKER, 101), 3.0)
    core.handle(Exited(TALKER, 0), 4.0)
    assert (instance.phase, instance.message) == (EXITED, "")


def test_another_policy_counts_at_the_next_end():
    """A source with a suspended policy ends for good; a former shadow restarts."""
    core, instance = started(restart=ON_FAILURE)
    assert kinds(core.handle(AmendOrdered(TALKER, NEVER), 1.0)) == ["ReportStatus"]
    core.handle(Exited(TALKER, signal=9), 2.0)
    assert instance.phase == FAILED
    core, instance = started(restart=NEVER)
    core.handle(AmendOrdered(TALKER, ON_FAILURE), 1.0)
    core.handle(Exited(TALKER, signal=9), 2.0)
    assert instance.phase == BACKOFF


@pytest.mark.parametrize(
    ("restart", "phase"),
    [
        (NEVER, FAILED),
        (RestartRule("on-failure", attempts=1), FAILED),
        (RestartRule("on-failure", attempts=2), BACKOFF),
    ],
)
def test_a_policy_that_allows_no_restart_ends_the_wait_for_one(restart, phase):
    """One restart was made and another one is due: the new policy may cancel it."""
    core, instance = started(restart=ON_FAILURE)
    core.handle(Exited(TALKER, 1), 0.0)
    core.handle(TimePassed(), 1.0)
    core.handle(Spawned(TALKER, 101), 1.0)
    core.handle(Exited(TALKER, 1), 2.0)
    due = core.deadline()
    assert 3.0 < due <= 4.0
    assert kinds(core.handle(AmendOrdered(TALKER, restart), 3.0)) == ["ReportStatus"]
    assert instance.phase == phase
    assert core.deadline() == (due if phase == BACKOFF else None)
    if phase == FAILED:
        assert instance.message == "exit code 1; by its new policy it is not restarted"


def test_a_policy_for_an_instance_being_stopped_counts_afterwards():
    """The leader ended and left other processes: the policy decides once they have ended."""
    core, instance = started(restart=ON_FAILURE)
    core.handle(Exited(TALKER, 3, leftovers=True), 1.0)
    core.handle(AmendOrdered(TALKER, NEVER), 1.5)
    core.handle(SessionEnded(TALKER), 2.0)
    assert instance.phase == FAILED


def test_a_policy_for_an_ended_instance_reports_its_end():
    """The order starts nothing; for an unknown instance it has no effect either."""
    core, instance = started()
    core.handle(Exited(TALKER, 1), 1.0)
    assert kinds(core.handle(AmendOrdered(TALKER, ON_FAILURE), 2.0)) == ["ReportStatus"]
    assert (instance.phase, instance.restart) == (FAILED, RestartRule())
    core.handle(AmendOrdered(("stranger", 8), ON_FAILURE), 2.0)
    assert core.instances["stranger", 8].phase == REFUSED


def test_leftovers_are_stopped_before_it_counts_as_ended():
    """The leader exits and leaves other processes: they are stopped, then its exit code counts."""
    core, instance = started()
    commands = core.handle(Exited(TALKER, 3, leftovers=True), 1.0)
    assert kinds(commands) == ["ReportStatus", "Signal"]
    assert instance.phase == STOPPING
    core.handle(SessionEnded(TALKER), 2.0)
    assert (instance.phase, instance.exit_code) == (FAILED, 3)


def test_leftovers_of_a_killed_leader_are_killed_at_once():
    """The leftovers get SIGKILL as well, because it is the last step."""
    core, _ = started(stop=StopRule(0.0, 0.0))
    core.handle(StopOrdered(TALKER), 0.0)
    core.handle(TimePassed(), 0.0)
    core.handle(TimePassed(), 0.0)
    commands = core.handle(Exited(TALKER, signal=9, leftovers=True), 0.1)
    assert commands[-1] == Signal(TALKER, signal.SIGKILL)


@pytest.mark.parametrize(("transient", "phase"), [(False, REFUSED), (True, BACKOFF)])
def test_only_a_transient_spawn_failure_follows_the_policy(transient, phase):
    """A lack of memory may pass; a missing executable does not, but another host may have it."""
    core, instance = ordered(RestartRule("always"))
    core.handle(SpawnFailed(TALKER, "no memory", transient=transient), 0.0)
    assert instance.phase == phase


def test_stop_before_the_spawn_gives_it_up():
    """A pending start is cancelled."""
    core, instance = ordered()
    assert kinds(core.handle(StopOrdered(TALKER), 0.0)) == ["ReportStatus", "Unspawn"]
    core.handle(SpawnFailed(TALKER, ""), 0.0)
    assert instance.phase == EXITED


def test_shutdown_leaves_when_all_have_ended():
    """Everything is stopped, nothing is started any more, and then the supervisor exits."""
    core, _ = started()
    assert "Leave" not in kinds(core.handle(ShutdownOrdered(), 1.0))
    core.handle(StartOrdered(("late", 1), RestartRule(), StopRule()), 1.0)
    assert core.instances["late", 1].phase == REFUSED
    assert kinds(core.handle(Exited(TALKER, signal=2), 2.0)) == ["ReportStatus", "Leave"]


@pytest.mark.parametrize("before", [None, Exited(TALKER, 1), RestartOrdered(TALKER)])
def test_what_a_shutdown_ends_is_withdrawn(before):
    """The shutdown ended the instance, not the process or an order, whatever the exit code is."""
    core, instance = started(restart=RestartRule("on-failure"))
    if before is not None:
        core.handle(before, 0.5)
    core.handle(ShutdownOrdered(), 1.0)
    core.handle(ShutdownOrdered(), 1.5)  # the slave repeats it to the next supervisor
    core.handle(Exited(TALKER, 0), 2.0)
    assert instance.phase == WITHDRAWN


def test_a_lost_client_changes_nothing():
    """The processes of a slave that died keep running."""
    core, instance = started()
    assert core.handle(ClientLost(), 1.0) == []
    assert instance.phase == RUNNING


def test_dead_numbers_are_bounded():
    """Thousands of jobs with different names need bounded memory."""
    core = reducer.SupervisorState()
    for number in range(reducer.MOST_TOMBSTONES + 10):
        key = (f"job{number}", number)
        core.handle(StopOrdered(key), 0.0)
        core.handle(StatusStored(key), 0.0)
    assert len(core.dead) == reducer.MOST_TOMBSTONES


# --- invariants under random events -----------------------------------------------------------

POLICIES = st.builds(
    RestartRule,
    st.sampled_from(["never", "on-failure", "always"]),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.just(2.0),
    st.just(2.0),
    st.integers(0, 3),
    st.sampled_from([5.0, 50.0]),
)
FENCES = st.none() | st.builds(
    FenceRule, st.sampled_from([0.5, 1.0, 5.0]), st.sampled_from([0.0, 0.5, 2.0]), st.booleans()
)
GRACES = st.builds(StopRule, st.sampled_from([0.0, 1.0]), st.sampled_from([0.0, 1.0]))


class Host(RuleBasedStateMachine):
    """Host whose processes behave at random, with the state machine that supervises them.

    `leaders` and `strays` record which processes live; the state machine only receives events.
    """

    def __init__(self):
        super().__init__()
        self.core = reducer.SupervisorState()
        self.now = 0.0
        self.newest = 0
        self.queue: list[Key] = []
        self.in_hand: list[Key] = []
        self.leaders: set[Key] = set()
        self.strays: set[Key] = set()
        self.killed: set[Key] = set()
        self.final: dict[Key, messages.Status] = {}
        self.policy_restarts: dict[Key, list[float]] = {}
        self.stopped: set[Key] = set()
        self.fences: dict[Key, FenceRule] = {}
        self.contact: dict[Key, float] = {}
        self.dead_by: dict[Key, float] = {}
        self.left = False

    def happens(self, event):
        before = {key: instance.phase for key, instance in self.core.instances.items()}
        for command in self.core.handle(event, self.now):
            self.carry_out(command, event, before)

    def carry_out(self, command, event, before):
        if isinstance(command, Leave):
            for key in self.leaders | self.strays:
                kills = self.core.instances[key].kills
                assert kills > MOST_KILLS, f"it leaves while {key} is alive"
            self.left = True
            return
        key = command.instance
        if isinstance(command, Spawn):
            assert key not in self.leaders | self.strays, "started twice"
            assert key not in self.queue + self.in_hand, "ordered twice"
            assert key not in self.final, "started after its end"
            assert key not in self.stopped, "started after the user's stop"
            assert key not in self.dead_by, "started after its fence had passed"
            if before.get(key, HELD) == HELD and (slots := self.core.instances[key].slots):
                assert sum(self.takes_slot(i) for i in self.core.instances.values()) <= slots
            self.queue.append(key)
            if isinstance(event, TimePassed) and before[key] == BACKOFF:
                self.policy_restarts.setdefault(key, []).append(self.now)
        elif isinstance(command, Unspawn):
            if key in self.queue:
                self.queue.remove(key)
                self.happens(SpawnFailed(key, ""))
        elif isinstance(command, Signal):
            assert key in self.leaders | self.strays, "a signal after the end"
            if command.number == signal.SIGKILL:
                self.killed.add(key)
        elif isinstance(command, ReportStatus):
            self.check_status(key)
        else:
            assert key in self.final, "forgotten before its end"
            del self.final[key]

    @staticmethod
    def takes_slot(instance):
        return instance.phase != HELD and not instance.ended

    def check_status(self, key):
        status = messages.Status.of(self.core.instances[key], self.now)
        if key in self.final:
            assert status == self.final[key], "a second final status"
        elif status.state in ENDED:
            self.final[key] = status

    @precondition(lambda self: sum(not i.ended for i in self.core.instances.values()) < 3)
    @rule(
        restart=POLICIES, stop=GRACES, fence=FENCES, ago=st.sampled_from([0.0, 0.0, 0.5, 9.0]),
        slots=st.sampled_from([0, 0, 1, 2]),
    )  # fmt: skip
    def start(self, restart, stop, fence, ago, slots):
        self.newest += 1
        key = ("a", self.newest)
        if fence is not None:
            self.fences[key], self.contact[key] = fence, self.now - (0.0 if fence.alive else ago)
        self.happens(StartOrdered(key, restart, stop, fence, self.now - ago, slots))
        self.happens(TimePassed())
        self.look_at_fences()

    @rule(ago=st.sampled_from([-1.0, 0.0, 0.5, 4.0]))
    def contact_confirmed(self, ago):
        """Report a contact with the master from this long ago; fenced instances stay fenced."""
        self.happens(ContactReported(self.now - ago))
        self.renew(min(self.now, self.now - ago), alive=False)

    @rule()
    def slave_is_at_work(self):
        """Report that the slave runs, without a newer contact with the master."""
        self.happens(ContactReported(-99.0, self.now))
        self.renew(self.now, alive=True)

    def renew(self, at, *, alive):
        for key in self.fences.keys() - self.dead_by.keys():
            if self.fences[key].alive or not alive:
                self.contact[key] = max(self.contact[key], at)

    @precondition(lambda self: self.core.instances)
    @rule(data=st.data())
    def fence(self, data):
        key = data.draw(st.sampled_from(sorted(self.core.instances)))
        self.dead_by[key] = min(self.now, self.dead_by.get(key, self.now))
        self.happens(FenceOrdered(key))

    def look_at_fences(self):
        for key, (after, grace, _) in self.fences.items():
            if self.now >= self.contact[key] + after:
                self.dead_by.setdefault(key, self.contact[key] + after + grace)

    @precondition(lambda self: self.core.instances)
    @rule(
        data=st.data(), kind=st.sampled_from(["stop", "stop", "restart", "start", "fail", "forget"])
    )
    def order(self, data, kind):
        """Send an order for a known instance, or now and then for an unknown one."""
        known = [number for _, number in self.core.instances]
        key = ("a", data.draw(st.sampled_from([*known, *known, *known, 0, self.newest])))
        if kind == "stop":
            self.stopped.add(key)
            self.happens(StopOrdered(key))
        elif kind == "restart":
            self.policy_restarts.pop(key, None)
            self.happens(RestartOrdered(key))
        elif kind == "fail":
            self.happens(FailOrdered(key, 100, "unhealthy", data.draw(st.booleans())))
        elif kind == "forget":
            self.happens(StatusStored(key))
        else:
            self.happens(StartOrdered(key, RestartRule("always"), StopRule()))

    @precondition(lambda self: self.core.instances)
    @rule(data=st.data(), restart=POLICIES)
    def amend(self, data, restart):
        key = data.draw(st.sampled_from(sorted(self.core.instances)))
        before = self.core.instances[key].phase
        self.policy_restarts.pop(key, None)
        self.happens(AmendOrdered(key, restart))
        instance = self.core.instances[key]
        assert instance.ended or instance.restart == restart
        gives_up = before == BACKOFF and restart.when == "never"
        assert instance.phase == before or instance.phase == FAILED
        assert (instance.phase == FAILED) >= gives_up

    @precondition(lambda self: self.queue)
    @rule()
    def spawn_begins(self):
        self.in_hand.append(self.queue.pop(0))

    @precondition(lambda self: self.in_hand)
    @rule(fails=st.sampled_from([None, None, None, False, True]))
    def spawn_is_done(self, fails):
        key = self.in_hand.pop(0)
        if fails is None:
            self.leaders.add(key)
            self.killed.discard(key)
            self.happens(Spawned(key, 100))
        else:
            self.happens(SpawnFailed(key, "no memory", transient=fails))

    @precondition(lambda self: self.leaders)
    @rule(data=st.data(), code=st.sampled_from([0, 1]), leaves=st.booleans())
    def leader_exits(self, data, code, leaves):
        key = data.draw(st.sampled_from(sorted(self.leaders)))
        self.leaders.discard(key)
        if leaves:
            self.strays.add(key)
        self.happens(Exited(key, code, leftovers=leaves))

    @precondition(lambda self: self.strays)
    @rule(data=st.data())
    def strays_end(self, data):
        key = data.draw(st.sampled_from(sorted(self.strays)))
        self.strays.discard(key)
        self.happens(SessionEnded(key))

    @precondition(lambda self: self.core.deadline() is not None)
    @rule(seconds=st.sampled_from([0.0, 0.5, 1.0, 1.0, 6.0, 60.0]))
    def time_passes(self, seconds):
        self.now += seconds
        self.look_at_fences()
        self.happens(TimePassed())

    @invariant()
    def the_state_agrees_with_the_host(self):
        for key, instance in self.core.instances.items():
            alive = key in self.leaders or key in self.strays
            assert alive == (instance.phase in (RUNNING, STOPPING)), key
            assert (key in self.leaders) == (instance.pid > 0), key
            waits_for_spawn = key in self.queue or key in self.in_hand
            assert waits_for_spawn == (instance.phase == STARTING), key
            assert instance.ended == (key in self.final), key
            waits = instance.phase in (STOPPING, BACKOFF)
            assert (instance.deadline is not None) == waits, key
        unknown = {*self.leaders, *self.strays, *self.queue, *self.in_hand} - {*self.core.instances}
        assert not unknown

    @invariant()
    def what_was_stopped_is_on_its_way_out(self):
        for key in self.stopped & set(self.core.instances):
            assert self.core.instances[key].phase not in (HELD, RUNNING, BACKOFF), key

    @invariant()
    def what_is_held_waits_for_a_slot(self):
        """Check that every held instance has no free slot."""
        active = sum(self.takes_slot(instance) for instance in self.core.instances.values())
        for key, instance in self.core.instances.items():
            assert instance.phase != HELD or active >= instance.slots, key

    @invariant()
    def what_is_fenced_is_killed_in_time(self):
        """Check that fenced instances end in time, and that the state machine wakes up for it."""
        for key in self.leaders | self.strays:
            by = self.dead_by.get(key)
            if by is not None:
                assert self.core.instances[key].phase == STOPPING, key
                assert key in self.killed or (self.now < by and self.core.deadline() <= by), key
            elif key in self.fences:
                assert self.core.deadline() <= self.contact[key] + self.fences[key].after, key
        for key in self.dead_by.keys() & self.core.instances.keys():
            assert self.core.instances[key].phase not in (HELD, RUNNING, BACKOFF), key

    @invariant()
    def what_was_fenced_says_so(self):
        for key, status in self.final.items():
            fenced = status.message.startswith("fenced: ")
            assert fenced == (status.state == FENCED) <= (key in self.dead_by), key

    @invariant()
    def what_is_never_restarted_does_not_wait_for_it(self):
        for key, instance in self.core.instances.items():
            assert instance.phase != BACKOFF or instance.restart.when != "never", key

    @invariant()
    def restarts_stay_within_the_policy(self):
        for key, times in self.policy_restarts.items():
            rule_ = self.core.instances[key].restart if key in self.core.instances else None
            if rule_ is not None:
                recent = [at for at in times if times[-1] - at < rule_.window]
                assert len(recent) <= rule_.attempts

    def teardown(self):
        """Check that a shutdown ends in bounded time from any state, if SIGKILL works."""
        self.happens(ShutdownOrdered())
        for _ in range(100):
            if self.left:
                break
            for key in list(self.in_hand):
                self.in_hand.remove(key)
                self.happens(SpawnFailed(key, "no memory", transient=True))
            for key in sorted(self.leaders & self.killed):
                self.leaders.discard(key)
                self.happens(Exited(key, signal=signal.SIGKILL))
            for key in sorted(self.strays & self.killed):
                self.strays.discard(key)
                self.happens(SessionEnded(key))
            self.now = self.core.deadline() or self.now
            self.happens(TimePassed())
        assert self.left


Host.TestCase.settings = settings(max_examples=300, stateful_step_count=50, deadline=None)
TestHost = Host.TestCase


def test_a_suspend_prolongs_the_grace_of_a_stop():
    """A process that was frozen with its machine has its whole grace to end in order."""
    core, instance = started(stop=StopRule(interrupt_grace=10.0, terminate_grace=5.0))
    core.handle(StopOrdered(TALKER), 100.0)
    core.handle(Slept(3600.0), 3704.0)
    assert core.deadline() == 3710.0
    assert core.handle(TimePassed(), 3704.0) == []
    assert kinds(core.handle(TimePassed(), 3710.0)) == ["ReportStatus", "Signal"]
    assert "after 10.0 s" in instance.trail


def test_a_suspend_prolongs_no_fence():
    """Another instance may run by the time at which a fenced one must be gone."""
    core = reducer.SupervisorState()
    fence = FenceRule(after=20.0, grace=10.0)
    core.handle(StartOrdered(TALKER, RestartRule(), StopRule(), fence), 0.0)
    core.handle(Spawned(TALKER, 100), 0.0)
    core.handle(StopOrdered(TALKER), 1.0)
    core.handle(TimePassed(), 21.0)
    must_be_gone = core.instances[TALKER].kill_by
    core.handle(Slept(3600.0), 3622.0)
    assert core.deadline() <= must_be_gone


def test_a_suspend_delays_no_restart():
    """A back-off counts the suspend, because the process has nothing to do in that time."""
    core, _ = started(restart=RestartRule("always"))
    core.handle(Exited(TALKER, 1), 0.0)
    due = core.deadline()
    core.handle(Slept(3600.0), 3600.0)
    assert core.deadline() == due


def test_a_bug_in_a_part_of_the_loop_does_not_end_the_parent_of_all_processes(monkeypatch):
    """The other parts are called, and the supervisor's own log has the traceback."""
    notes = []
    monkeypatch.setattr(server.own_log, "write_fault", notes.append)
    monkeypatch.setattr(server, "PAUSE_AFTER_FAULT", 0.0)
    server._guarded(lambda: 1 / 0)
    assert notes == ["a part of the loop failed: division by zero"]


def test_a_failed_look_at_ended_children_loses_no_order_to_end(monkeypatch):
    """SIGCHLD and SIGTERM may arrive together, when the system has no room for a look."""
    monkeypatch.setattr(server, "PAUSE_AFTER_FAULT", 0.0)
    monkeypatch.setattr(server.own_log, "write_fault", lambda _: None)
    happened = []

    def reap():
        raise OSError(errno.ENFILE, "Too many open files in system")

    its = SimpleNamespace(_trees=SimpleNamespace(reap=reap), _happened=happened.append)
    ours, theirs = os.pipe()
    os.write(theirs, bytes([signal.SIGCHLD, signal.SIGTERM]))
    server.Server._signalled(its, ours)
    os.close(ours)
    os.close(theirs)
    assert happened == [ShutdownOrdered()]
