"""The slave's and the supervisor's reducers under hostile orders and reports."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.slave import commands, events, reducer
from rosrm.core.slave.state import SlaveState
from rosrm.core.supervisor import events as told
from rosrm.core.supervisor import reducer as supervision
from rosrm.core.supervisor.commands import Spawn
from rosrm.core.supervisor.rules import FenceRule, RestartRule, StopRule
from rosrm.model.values import InstanceId, InstanceState, ProcessSpec
from rosrm.supervisor import messages
from rosrm.supervisor.json_lines import ProtocolError, line
from tests.fuzz.hostile import floats, fuzzed, texts, uint64s, values_of

NAMES = st.sampled_from(["p", "q"] * 3) | texts
NUMBERS = st.integers(0, 3) | uint64s
#: Seconds until an event.
PAUSES = st.sampled_from([0.0, 0.0, 0.1, 1.0, 30.0, 1e6])

# --- the slave ---------------------------------------------------------------------------------

INSTANCES = st.builds(InstanceId, NAMES, NUMBERS)
KNOWN = {
    int: NUMBERS, float: floats, InstanceId: INSTANCES, "name": NAMES,
    "given_at": st.none() | floats,
    ProcessSpec: values_of(ProcessSpec, {int: NUMBERS, float: floats, "name": NAMES}),
}  # fmt: skip
SLAVE_EVENTS = st.one_of(*(values_of(kind, KNOWN) for kind in events.Event.__args__))


@fuzzed(150)
@given(
    stream=st.lists(st.tuples(PAUSES, SLAVE_EVENTS), min_size=1, max_size=10),
    bounds=st.tuples(st.integers(0, 2), st.integers(0, 2)),
)
def test_hostile_events_leave_a_sound_slave(stream, bounds):
    """An instance is launched once at most, and none that was stopped before."""
    state, now = SlaveState(max_processes=bounds[0], max_starting=bounds[1], max_age=5.0), 0.0
    launched: list[InstanceId] = []
    for pause, event in stream:
        now += pause
        for command in reducer.step(state, event, now):
            if isinstance(command, commands.Launch):
                launched += [one.instance for one in command.assignments]
        assert len(launched) == len(set(launched))
        assert state.waiting.keys() <= state.held.keys()
        assert state.starting() <= len(state.held)
        assert not math.isnan(state.last_contact)
        assert state.last_contact <= now
        for instance, held in state.held.items():
            assert held.status.instance == instance
            if held.status.state is InstanceState.READY:
                assert held.ready_by is None


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -1.0, 1e301])
@pytest.mark.parametrize("place", range(4))
def test_times_of_an_order_are_refused_at_the_socket(seconds, place):
    """A deadline of NaN never passes, and epoll cannot wait for a far one."""
    given = [seconds if place == number else 1.0 for number in range(4)]
    launch = messages.Launch(
        ("p", 1), ("run",), "e", {}, None, RestartRule("always", delay=given[0]),
        StopRule(interrupt_grace=given[1]), fence=FenceRule(given[2], given[3]),
    )  # fmt: skip
    with pytest.raises(ProtocolError):
        messages.decode_order(messages.encode_order(launch))


# --- the supervisor ----------------------------------------------------------------------------

KEYS = st.tuples(NAMES, NUMBERS)
WHEN = st.sampled_from(["never", "on-failure", "always"])
#: Of a policy: the edge refuses others.
SECONDS = st.sampled_from([0.0, 5e-324, 0.5, 1.0, 1e9, 1e308])
RULES: dict[str, Any] = {
    "instance": KEYS, "at": floats, "alive": floats, "reason": texts, "message": texts,
    "pid": st.integers(-1, 3) | uint64s, "code": st.integers(-1, 300),
    "signal": st.integers(-1, 70), "peak_memory": floats, "cpu_time": floats,
    "heard": st.none() | SECONDS, "enforced": st.lists(texts, max_size=3).map(tuple), "note": texts,
    "unfound": texts,
    "out_of_memory": st.none() | st.tuples(floats, floats),
    "kill": st.booleans(), "transient": st.booleans(), "leftovers": st.booleans(),
    "adopted": st.booleans(), "slots": NUMBERS, "seconds": SECONDS,
    "run": st.none() | st.tuples(NUMBERS, NUMBERS),
    "restart": st.builds(RestartRule, WHEN, SECONDS, SECONDS, SECONDS, NUMBERS, SECONDS),
    "stop": st.builds(StopRule, SECONDS, SECONDS),
    "held": st.none() | st.lists(texts, max_size=3).map(tuple),
    "fence": st.none() | st.builds(FenceRule, SECONDS, SECONDS, st.booleans()),
}  # fmt: skip
SUPERVISOR_EVENTS = st.one_of(
    *(
        st.builds(kind, **{name: RULES[name] for name in kind._fields})
        for kind in told.Event.__args__
    )
)


@fuzzed(200)
@given(stream=st.lists(st.tuples(PAUSES, SUPERVISOR_EVENTS), min_size=1, max_size=12))
def test_hostile_events_leave_a_sound_supervisor(stream):
    """Each deadline can be waited for, each status be sent, and each state be recorded."""
    core, now = supervision.SupervisorState(), 0.0
    for pause, event in stream:
        now += pause
        spawned = [one for one in core.handle(event, now) if isinstance(one, Spawn)]
        assert len(spawned) == len({one.instance for one in spawned})
        deadline = core.deadline()
        assert deadline is None or not math.isnan(deadline)
        assert len(core.dead) <= supervision.MOST_TOMBSTONES
        for key, instance in core.instances.items():
            assert instance.key == key
            messages.encode_status(messages.Status.of(instance, now))
            line({name: getattr(instance, name) for name in type(instance).__slots__})
            assert instance.ended or instance.phase in (
                "held",
                "starting",
                "running",
                "backoff",
                "stopping",
            )
