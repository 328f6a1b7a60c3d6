"""The master's reducer under hostile events: no exception, sound state, bounded memory, a restart.

The events are those that pass the checks at the edge, and also numbers that the edge refuses: a bug
there must not end the master.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.invariants import check
from rosrm.model.requester import Requester
from rosrm.model.values import (
    RESOURCE_SLOTS,
    GroupEnd,
    GroupMembership,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    IsolationPolicy,
    MigrationPolicy,
    ProcessSpec,
    ResourceDescription,
)
from tests.fuzz.hostile import floats, fuzzed, texts, uint64s, values_of
from tests.unit.core.cluster import Cluster, Machine, job, movable, node, process

NAMES = ["job", "service", "node", "moves", "queued"]
HOSTS = ["a", "b", "c"]

names = st.sampled_from([*NAMES * 3, "unknown"]) | texts
hosts = st.sampled_from([*HOSTS * 3, "d"]) | texts
numbers = st.integers(0, 8) | uint64s
host_ids = st.sampled_from([1, 2, 3] * 3 + [0, 4, (1 << 31), (1 << 32) - 1])
#: `Cluster.add` gives them these.
incarnations = st.sampled_from([2, 3, 4] * 3 + [0, 1, (1 << 64) - 1])
#: `Besieged` gives them these numbers.
instances = st.sampled_from([InstanceId(name, at) for at, name in enumerate(NAMES[:4], 1)] * 2)
instances |= st.builds(InstanceId, names, numbers)
KNOWN: Mapping[Any, Any] = {
    int: uint64s | st.integers(-2, 3), float: floats, InstanceId: instances,
    "request": st.just(0), "host_id": host_ids, "incarnation": incarnations, "process": names,
    "host": hosts, "hosts": st.lists(hosts, max_size=2).map(tuple),
    Requester: st.builds(Requester, st.sampled_from(["user:ada", "user:bob"] * 3 + [""]) | texts,
                         st.booleans()),
    "names": st.lists(names, max_size=3).map(tuple), "destination": numbers, "instance": instances,
    "order": st.integers(0, 6) | st.tuples(st.sampled_from(["replication", "capability", "periodic",
                                                            "images", "x"]), st.integers(0, 4)),
}  # fmt: skip
RESOURCES = st.sampled_from(["memory", "cpu", "disk", "gpu", ""]) | texts
DESCRIPTIONS = values_of(
    HostDescription,
    {**KNOWN, "name": hosts, "max_processes": st.integers(0, (1 << 32) - 1), "resources": st.lists(
        values_of(ResourceDescription, {**KNOWN, "name": RESOURCES}), max_size=4
    ).map(tuple)},
)  # fmt: skip
#: None as long as a pause of `PAUSES`: messages of a `Cluster` take no time, so a process whose
#: fence has passed would be assigned and refused without end.
FENCES = st.sampled_from([0.0, 1e308, math.inf, math.nan, -1.0, -math.inf])
SPECS = values_of(
    ProcessSpec,
    {**KNOWN, "name": names, "needs": st.dictionaries(RESOURCES, floats, max_size=2),
     "isolation": values_of(IsolationPolicy, {**KNOWN, "after": FENCES}),
     "together": st.sampled_from(["", "", "g"]),
     "group": st.builds(
         GroupMembership, st.sampled_from(["", "d"]), st.sampled_from(get_args(GroupEnd))
     ),
     "migration": values_of(MigrationPolicy, {
         **KNOWN, "strategy": st.sampled_from([None, "relaunch", "handoff", "criu", "none"]),
         "options": st.dictionaries(st.sampled_from(["ready_timeout", "x"]), texts | floats,
                                    max_size=1)})},
)  # fmt: skip


@st.composite
def readings(draw: Any) -> happened.ReadingsReceived:
    runs = st.sampled_from([(1, 2), (2, 3), (3, 4)]) | st.tuples(host_ids, incarnations)
    ids = draw(st.lists(runs, unique=True, max_size=4))
    count = len(ids)

    def column(values: Any, kind: Any) -> Any:
        return np.array(draw(st.lists(values, min_size=count, max_size=count)), kind)

    def table() -> Any:
        values = st.floats(0, 1, width=32) | floats
        row = st.lists(values, min_size=RESOURCE_SLOTS, max_size=RESOURCE_SLOTS)
        some = draw(st.lists(row, min_size=count, max_size=count))
        return np.array(some, np.float64).reshape(count, RESOURCE_SLOTS)

    return happened.ReadingsReceived(
        np.array([one for one, _ in ids], np.int64), np.array([one for _, one in ids], np.uint64),
        column(uint64s, np.uint64), column(uint64s, np.uint64), column(st.booleans(), np.bool_),
        column(st.integers(0, (1 << 32) - 1), np.uint32), table(), table(),
    )  # fmt: skip


@st.composite
def usages(draw: Any) -> happened.UsagesReceived:
    rows = draw(st.lists(st.tuples(numbers, floats, floats, floats), max_size=3))
    columns = [list(column) for column in zip(*rows, strict=True)] or [[], [], [], []]
    slots = draw(st.sets(st.integers(0, 20), max_size=2))
    return happened.UsagesReceived(
        draw(host_ids), draw(incarnations), np.array(columns[0], np.uint64),
        np.array(columns[1], np.float64), np.array(columns[2], np.float64),
        {slot: np.array(columns[3], np.float64) for slot in slots},
    )  # fmt: skip


GENERAL = [
    happened.HostLeft, happened.ProcessRequested, happened.StatusesReceived,
    happened.SnapshotsReported, happened.CancelRequested, happened.RestartRequested,
    happened.CheckpointRequested, happened.RestoreRequested, happened.HostStateRequested,
    happened.PruneRequested, happened.OrderAnswered, happened.AssignmentWithdrawn,
    happened.HandoffReported, happened.PeerRefused, happened.KeyRevoked, happened.TimePassed,
]  # fmt: skip
EVENTS = st.one_of(
    *(values_of(kind, {**KNOWN, "name": names}) for kind in GENERAL),
    values_of(happened.MigrationRequested, {**KNOWN, "name": names, "host": st.none() | hosts}),
    values_of(happened.HostRegistered, {**KNOWN, "description": DESCRIPTIONS}),
    values_of(
        happened.SubmissionReceived, {**KNOWN, "specs": st.lists(SPECS, max_size=2).map(tuple)}
    ),
    readings(), usages(),
)  # fmt: skip


@st.composite
def hostile_events(draw: Any) -> happened.Event:
    """Draw an event, which mostly names the present run of its host."""
    event = draw(EVENTS)
    present = draw(st.sampled_from([True, True, False]))
    if present and isinstance(getattr(event, "host_id", None), int):
        return replace(event, incarnation=event.host_id + 1)
    return event


#: Seconds until an event; None in place of an event: the honest hosts work for a while.
PAUSES = st.sampled_from([0.0, 0.0, 0.1, 1.0, 6.0, 1e6])
STREAMS = st.lists(
    st.tuples(PAUSES, hostile_events() | hostile_events() | st.none()), min_size=1, max_size=10
)


QUOTAS = {"default": {"processes": 3, "memory": 1e9}, "user:ada": {"cpu": 1.0}}


class Besieged(Cluster):
    """A cluster with three honest hosts, and with strangers that the master may have let in."""

    def __init__(self) -> None:
        super().__init__(*HOSTS, settle=3.0, suspect=1.0, lease=5.0, order_retry=1.0, quotas=QUOTAS)
        self.strangers: dict[str, Machine] = {}
        self.with_processes(
            job("job", memory=100), process("service", memory=100), node("node", memory=100),
            movable("moves", memory=100), process("queued", memory=1 << 40),
        )  # fmt: skip

    def by_id(self, host_id: int) -> Machine:
        name = self.state.hosts.hosts[host_id - 1].name
        found = self.machines.get(name)
        return self.strangers.setdefault(name, Machine(name)) if found is None else found

    def suffer(self, stream: Any) -> None:
        """Let hostile events arrive, and check the state after each."""
        for pause, event in stream:
            self.now += pause
            if event is None:
                self.wait(0.5)
            else:
                self.tell(event)
            check(self.state)
            for name in self.state.processes:
                self.explain(name)


@fuzzed(150)
@given(stream=STREAMS)
def test_hostile_events_leave_a_sound_state(stream):
    """A job that its user submits afterwards runs, and the journal restores the master."""
    cluster = Besieged()
    cluster.suffer(stream)
    cluster.kill_master()
    check(cluster.state)


def weight_of(thing: Any, seen: set[int]) -> int:
    """Return the number of items in all containers that are reachable from a value."""
    if id(thing) in seen:
        return 0
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        return thing.size
    if isinstance(thing, Mapping):
        return sum(1 + weight_of(one, seen) for one in thing.values())
    if isinstance(thing, (list, tuple, set, frozenset, deque)):
        return sum(1 + weight_of(one, seen) for one in thing)
    if not type(thing).__module__.startswith("rosrm.core"):
        return 0
    slots = (name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ()))
    names = {*slots, *getattr(thing, "__dict__", ())}
    return sum(weight_of(getattr(thing, name, None), seen) for name in names)


#: Times that the same events arrive until nothing more is remembered of them.
REPEATS = 12


@fuzzed(12)
@given(stream=st.lists(st.tuples(st.just(0.1), hostile_events()), min_size=1, max_size=5))
def test_repeated_events_are_not_remembered_again(stream):
    """A sender that repeats itself does not fill the memory of the master."""
    cluster = Besieged()
    for _ in range(REPEATS):
        cluster.suffer(stream)
    before = weight_of(cluster.state, set())
    for _ in range(REPEATS):
        cluster.suffer(stream)
    assert weight_of(cluster.state, set()) <= 1.1 * before + 100


# --- found by the test above --------------------------------------------------------------------


def test_an_instance_gets_no_number_that_a_host_has_claimed():
    """Two instances of one number would overwrite each other."""
    cluster = Besieged()
    claims = [
        InstanceStatus(InstanceId("job", number), InstanceState.HELD) for number in (6, 1 << 53)
    ]
    for host_id, kept in ((1, []), (2, claims)):
        event = happened.HostLeft(0, host_id, host_id + 1, tuple(kept))
        cluster.suffer([(0.0, event), (0.0, None)])
    for number in range(3):
        cluster.submit(process(f"more{number}"))
        check(cluster.state)


@pytest.mark.parametrize("after", [-1.0, -math.inf, math.nan])
def test_a_process_whose_fence_has_always_passed_is_not_assigned_without_end(after):
    """Each assignment is a line of the journal."""
    cluster = Besieged()
    spec = process("p", isolation=IsolationPolicy("stop", after))
    cluster.submit(spec)
    cluster.wait(1.0)
    assert cluster.state.next_instance < 100
