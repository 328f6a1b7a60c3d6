"""Tests of alerts without a cluster: what happens, and which alerts begin and end. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Literal

from rosrm.model.values import EMPTY
from rosrm.wording import duration
from rosrm_alerts.conditions import Alert, SeenEvent, SeenHost, SeenProcess, SeenResource, Situation
from rosrm_alerts.watch import Change, Watch


@dataclass(frozen=True, slots=True)
class RehearsedHost:
    """A host from one step on; a part that is None stays as it was."""

    state: str | None = None
    usage: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    limits: Mapping[str, float] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class Step:
    """Changes of the cluster at one time.

    Attributes:
        at: seconds since the start of the test.
        master: True: the master answers from now on; False: it does not; None: unchanged.
    """

    at: float
    hosts: Mapping[str, RehearsedHost] = field(default_factory=lambda: EMPTY)
    processes: Mapping[str, SeenProcess] = field(default_factory=lambda: EMPTY)
    events: tuple[SeenEvent, ...] = ()
    master: bool | None = None


@dataclass(frozen=True, slots=True)
class Expected:
    """The beginning or end of an alert at one time.

    Attributes:
        about: host or process; "": the cluster.
    """

    at: float
    alert: str
    kind: Literal["begins", "ends"]
    about: str = ""

    def __str__(self) -> str:
        about = f" on {self.about}" if self.about else ""
        return f"{self.alert} {self.kind}{about} at {duration(self.at) if self.at else '0 s'}"


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """One test.

    Attributes:
        expected: all changes of alerts, in any order.
        until: time of the end; 0: the last step or expected change.
    """

    name: str
    steps: tuple[Step, ...]
    expected: tuple[Expected, ...] = ()
    until: float = 0.0


def differences(rehearsal: Rehearsal, alerts: Sequence[Alert]) -> list[str]:
    """Return the expected changes that do not happen, and the others that do."""
    times = [step.at for step in rehearsal.steps] + [one.at for one in rehearsal.expected]
    until = rehearsal.until or max(times, default=0.0)
    happened = {_expected(change) for change in changes(rehearsal, alerts, until)}
    wanted = set(rehearsal.expected)
    missing = sorted(wanted - happened, key=_order)
    surplus = sorted(happened - wanted, key=_order)
    return [f"expected, and did not happen: {one}" for one in missing] + [
        f"happened, and is not expected: {one}" for one in surplus
    ]


def changes(rehearsal: Rehearsal, alerts: Sequence[Alert], until: float) -> list[Change]:
    """Return the changes of alerts in the steps of a test."""
    watch, situation, answers = Watch(alerts), Situation(), True
    found: list[Change] = []
    steps = sorted(rehearsal.steps, key=lambda step: step.at)
    for step, end in zip(steps, [*(one.at for one in steps[1:]), inf], strict=True):
        situation = _after(situation, step)
        answers = answers if step.master is None else step.master
        seen = situation if answers else None
        found += watch.observe(step.at, seen, step.events)
        while (at := watch.next_change()) < end and at <= until:
            found += watch.observe(at, seen)
    return found


def _after(before: Situation, step: Step) -> Situation:
    """Return the situation after the changes of a step."""
    hosts = dict(before.hosts)
    for name, change in step.hosts.items():
        old = hosts.get(name, SeenHost())
        resources = dict(old.resources)
        for resource in {*change.usage, *change.limits}:
            was = resources.get(resource, SeenResource(0.0))
            usage = change.usage.get(resource, was.usage)
            resources[resource] = SeenResource(usage, change.limits.get(resource, was.limit))
        hosts[name] = SeenHost(old.state if change.state is None else change.state, resources)
    return Situation(hosts, {**before.processes, **step.processes})


def _expected(change: Change) -> Expected:
    about = change.subject.process or change.subject.host
    return Expected(change.time, change.alert.name, change.kind, about)


def _order(one: Expected) -> tuple[float, str, str]:
    return one.at, one.alert, one.about
