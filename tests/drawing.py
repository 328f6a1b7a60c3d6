"""Strategies of hypothesis for dataclasses: every field is drawn, by its type."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

from hypothesis import strategies as st

from rosrm.model.adoption import NO_ADOPTION
from rosrm.model.arrays import NO_ARRAY
from rosrm.model.artifacts import Artifact
from rosrm.model.component_rules import components_fault
from rosrm.model.devices import Device, DeviceNeed, HeldDevice
from rosrm.model.durations import LONGEST, LONGEST_STOP
from rosrm.model.lifecycle_rules import lifecycle_fault
from rosrm.model.limits import LARGEST_CPU_NUMBER, LEAST_CPU, LEAST_MEMORY
from rosrm.model.schedules import NO_SCHEDULE, WEEKDAYS, Schedule
from rosrm.model.values import (
    Container,
    DependencyRestartAction,
    Enforcement,
    Kind,
    LifecyclePolicy,
    Limits,
    NeighbourRule,
    ProcessSpec,
    Realtime,
    StartCondition,
    StartOrder,
)

Drawn = st.SearchStrategy[Any]

_LETTERS: Final = st.characters(codec="utf-8", exclude_characters="\0")
WORDS: Final = st.text(_LETTERS, max_size=12)
NAMES: Final = st.text(_LETTERS, min_size=1, max_size=12)
#: Names that a host, a process and a resource may have.
PROPER_NAMES: Final = st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,11}", fullmatch=True)
#: Texts that a terminal shows as they are.
PRINTABLE: Final = st.text(
    st.characters(codec="utf-8", categories=("L", "N", "P", "S")), max_size=12
)
_NAMESPACES: Final = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,5}){0,3}", fullmatch=True)
_PLAIN: Final = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=6,
)
_INT32: Final = st.integers(-(2**31), 2**31 - 1)
_UNITS: Final = st.lists(PROPER_NAMES, max_size=3, unique=True).map(tuple)
_SHARES: Final = st.floats(0.0, 1.0, exclude_min=True)
_ASKED: Final = st.one_of(
    st.builds(DeviceNeed, PROPER_NAMES, st.floats(0.001, 1.0) | st.integers(1, 256).map(float)),
    st.builds(
        lambda kind, units: DeviceNeed(kind, float(len(units) or 1), units), PROPER_NAMES, _UNITS
    ),
)
_DEVICES: Final = st.builds(
    Device, PROPER_NAMES, PROPER_NAMES, PRINTABLE.map(lambda text: f"/{text}"),
    st.integers(1, 1000), PRINTABLE, PRINTABLE,
)  # fmt: skip
_TIMES: Final = st.lists(st.sampled_from(["02:00", "2:00 UTC", "23:59 Etc/UTC"]), min_size=1)
_SCHEDULES: Final = st.one_of(
    st.just(NO_SCHEDULE),
    st.builds(Schedule, every=st.floats(1.0, LONGEST)),
    st.builds(
        Schedule, at=_TIMES.map(tuple),
        on=st.lists(st.sampled_from(WEEKDAYS), max_size=7, unique=True).map(tuple),
    ),
)  # fmt: skip
_BY_TYPE: Final[Mapping[Any, Drawn]] = {
    str: WORDS,
    int: st.integers(0, 2**31 - 1),
    float: st.floats(0.0, 3e8),
    str | None: st.none() | NAMES,
    Any: _PLAIN,
    Schedule: _SCHEDULES,
    Limits: st.builds(
        Limits,
        memory=st.just(0.0) | st.floats(1e9, 2.0**53),
        memory_high=st.just(0.0) | st.floats(LEAST_MEMORY, 1e9),
        cpu=st.just(0.0) | st.floats(LEAST_CPU, 1e4),
        enforce=st.sampled_from(get_args(Enforcement)),
    ),
    HeldDevice: st.builds(HeldDevice, PROPER_NAMES, PROPER_NAMES, _SHARES),
    tuple[DeviceNeed, ...]: st.lists(_ASKED, max_size=3, unique_by=lambda one: one.kind).map(tuple),
    tuple[Device, ...]: st.lists(
        _DEVICES, max_size=3, unique_by=lambda one: (one.kind, one.unit)
    ).map(tuple),
}  # fmt: skip
#: Fields with another range than other fields of their type.
_BY_NAME: Final[Mapping[str, Drawn]] = {
    "name": PROPER_NAMES,
    "process": PROPER_NAMES,
    "together": st.just("") | PROPER_NAMES,
    "namespace": _NAMESPACES,
    "node_name": st.sampled_from(["", "keep", "talker"]),
    "nodes": st.sampled_from(["/**", "/*", "/robot/talker"]),
    "talks_to": st.dictionaries(PROPER_NAMES.map("to-{}".format), st.floats(0.0, 1e15), max_size=3),
    "start_order": st.builds(
        StartOrder,
        st.dictionaries(
            PROPER_NAMES.map("to-{}".format), st.sampled_from(get_args(StartCondition)), max_size=3
        ),
        st.floats(0.0, LONGEST), st.sampled_from(get_args(DependencyRestartAction)),
    ),
    "needs": st.dictionaries(PROPER_NAMES, st.floats(0.0, 1e18), max_size=3),
    # No variable has a name of this length, because none may be a secret, too.
    "secrets": st.dictionaries(
        PROPER_NAMES.map("secret-of-a-{}".format), PRINTABLE.map("/{}".format), max_size=3
    ),
    "adoption": st.just(NO_ADOPTION),  # with which few other fields go
    "container": st.just(Container()) | st.builds(Container, PROPER_NAMES, PROPER_NAMES),
    "launchers": st.lists(PROPER_NAMES, max_size=3).map(tuple),
    "message": PRINTABLE,
    "priority": _INT32,
    "exit_code": _INT32,
    "number": st.integers(0, 2**64 - 1),
    "incarnation": st.integers(1, 2**64 - 1),
    "factor": st.floats(1.0, 100.0),
    "capacity": st.floats(1e-3, 1e18),
    "period": st.floats(1e-3, 10.0),
    "cpus": st.lists(st.integers(0, LARGEST_CPU_NUMBER), max_size=3, unique=True).map(tuple),
    "nice": st.integers(-20, 19),
    "rate": st.floats(0.0, 1e6),
    **{
        name: st.floats(0.0, LONGEST)
        for name in ("delay", "max_delay", "window", "timeout", "after", "grace")
    },
    **{
        name: st.floats(0.0, LONGEST_STOP / 2) for name in ("interrupt_grace", "terminate_grace")
    },
}  # fmt: skip


def drawn(kind: Any, **others: Drawn) -> Drawn:
    """Return a strategy for a dataclass; `others` are the strategies of fields by name."""
    hints, known = get_type_hints(kind), {**_BY_NAME, **others}
    names = [f.name for f in fields(kind)]
    return st.builds(kind, **{n: known[n] if n in known else _of(hints[n]) for n in names})


def _of(hint: Any) -> Drawn:
    origin, inner = get_origin(hint), get_args(hint)
    if hint in _BY_TYPE:
        return _BY_TYPE[hint]
    if is_dataclass(hint):
        return drawn(hint)
    if origin in (Union, types.UnionType):
        return st.one_of(*map(_of, inner))
    if origin is tuple and inner[-1] is Ellipsis:
        return st.lists(_of(inner[0]), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*map(_of, inner))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return st.dictionaries(NAMES, _of(inner[1]), max_size=3)
    return st.from_type(hint)


_NO_PROGRAM: Final = {"package": None, "executable": None, "module": None, "command": ()}
_PROGRAMS: Final = st.one_of(
    st.fixed_dictionaries({"package": NAMES, "executable": NAMES}),
    st.fixed_dictionaries({"module": NAMES}),
    st.fixed_dictionaries({"command": st.lists(WORDS, min_size=1, max_size=3).map(tuple)}),
)
_NEIGHBOURS: Final = st.one_of(
    drawn(
        NeighbourRule, group=st.just(""),
        processes=st.lists(PROPER_NAMES, min_size=1, max_size=3).map(tuple),
    ),
    drawn(NeighbourRule, group=NAMES, processes=st.just(())),
)  # fmt: skip

_ARTIFACTS: Final = drawn(
    Artifact, name=PROPER_NAMES, digest=st.text("0123456789abcdef", min_size=64, max_size=64),
    size=st.integers(1, 10**13), source=st.just(""),
)  # fmt: skip


def _scheduling(spec: ProcessSpec) -> dict[str, Any]:
    """Return the real-time scheduling of a spec without the settings that contradict it."""
    if not spec.realtime.policy:
        return {"realtime": Realtime()}
    priority = spec.realtime.priority % 99 + 1
    limits = replace(spec.limits, cpu=0.0)
    return {"realtime": replace(spec.realtime, priority=priority), "limits": limits, "nice": 0}


def _for_jobs(spec: ProcessSpec) -> dict[str, Any]:
    """Return the fields that only jobs have."""
    is_job = spec.kind is Kind.JOB
    return {} if is_job else {"array": NO_ARRAY, "schedule": NO_SCHEDULE}


def _accepted(spec: ProcessSpec, program: dict[str, Any]) -> ProcessSpec:
    """Return a spec with one program, and without contradictions."""
    fields_ = {**_NO_PROGRAM, **program, **_scheduling(spec), **_for_jobs(spec)}
    spec = replace(spec, **fields_)
    if lifecycle_fault(spec):
        spec = replace(spec, lifecycle=LifecyclePolicy())
    return replace(spec, components=()) if components_fault(spec) else spec


#: Specs with one program, as a master accepts them.
SPECS: Final = st.builds(
    _accepted,
    drawn(
        ProcessSpec,
        application=st.one_of(st.just(""), PROPER_NAMES),
        neighbours=st.lists(_NEIGHBOURS, max_size=3).map(tuple),
        artifacts=st.lists(_ARTIFACTS, max_size=3, unique_by=lambda one: one.name).map(tuple),
    ),
    _PROGRAMS,
)
