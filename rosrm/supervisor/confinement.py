"""Start of an instance within its limits: control group, CPUs, real-time scheduling, niceness."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Iterator
from typing import Final, NamedTuple, TypeVar

from rosrm.core.supervisor.rules import Key, LimitRule
from rosrm.supervisor import group_trees
from rosrm.supervisor.instance_groups import InstanceGroups, LimitRefused
from rosrm.supervisor.spawn import Attempt, Scheduler
from rosrm.supervisor.spawn_error import ScheduleRefused, SpawnError, is_transient
from rosrm.wording import by_reason, listed, reason_of

#: In place of the descriptor of a control group.
NO_GROUP: Final = -1
#: Attempts to start a process in its group: the first one may find a prepared group removed.
_ATTEMPTS: Final = 3
_POLICIES: Final = {"fifo": os.SCHED_FIFO, "rr": os.SCHED_RR}

#: Forks the process of an instance, given its group and its scheduling as in `spawn.begin`.
Spawn = Callable[[int, Scheduler | None], Attempt]


class Confined(NamedTuple):
    """A started process.

    Attributes:
        enforced: names of the limits and scheduling settings that hold.
        note: limits that do not hold, though this host can enforce them, with the reasons.
    """

    pid: int
    enforced: tuple[str, ...]
    note: str


T = TypeVar("T")
#: A start: yields each attempt, and is sent its pid once the process executes its program. What the
#: attempt raises is thrown into it.
Steps = Generator[Attempt, int, T]


class Confinement:
    """Limits and scheduling of the instances of one supervisor.

    Attributes:
        missing: name of a limit or scheduling setting to the reason why it cannot be enforced here.
        groups: the control groups.

    Args:
        state: the state directory.
    """

    def __init__(self, state: str) -> None:
        trees, self.missing = group_trees.find(state)
        self.groups = InstanceGroups(trees)
        self._cpus = os.sched_getaffinity(0)

    def start(self, key: Key, limits: LimitRule, spawn: Spawn) -> Steps[Confined]:
        """Start an instance within its limits; after an exception the caller kills its process.

        Raises:
            SpawnError: it cannot be started, or its limits are required and cannot be enforced.
            OSError: the system has no room for another process now.
        """
        self._check_cpus(limits)
        wanted = limits.wanted
        faults = {name: self.missing[name] for name in wanted if name in self.missing}
        if limits.nice > 0:  # this needs no rights
            faults.pop("nice", None)
        _check_required(limits, faults)
        own = self._make_group(key, limits)
        realtime = bool(limits.policy) and "realtime" not in faults
        pid, late = yield from self._spawn(key, limits, spawn, realtime)
        own.update(late)
        if limits.nice and "nice" not in faults:
            own.update(_nice_fault(pid, limits))
        enforced = tuple(name for name in wanted if name not in faults and name not in own)
        return Confined(pid, enforced, by_reason(own.items()))

    def prepare(self, key: Key, limits: LimitRule) -> None:
        """Make the group of an instance before its start."""
        self.groups.prepare(key, limits, realtime=bool(limits.policy))

    def change(self, key: Key, former: LimitRule, limits: LimitRule) -> tuple[str, ...]:
        """Change the limits of an instance that runs; return the names of those that hold.

        Raises:
            LimitRefused: one of them cannot be changed, or is required and cannot be enforced
                here; all are as before.
        """
        given = limits.given_limits
        self.groups.add(key, limits)
        lacking = self.groups.lacking(key, limits)
        lacking.update((name, why) for name, why in self.missing.items() if name in given)
        if limits.required and lacking:
            raise LimitRefused(_lacks(lacking))
        self.groups.change(key, former, limits)
        return tuple(name for name in given if name not in lacking)

    def _check_cpus(self, limits: LimitRule) -> None:
        lacking = sorted(set(limits.cpus) - self._cpus)
        if lacking:
            raise SpawnError(f"this host has no {cpus_in_words(lacking)} for its processes")

    def _make_group(self, key: Key, limits: LimitRule) -> dict[str, str]:
        """Make the group of an instance; return its limits that do not hold, with the reasons."""
        made = self.groups.make(key, limits, realtime=bool(limits.policy))
        wanted = limits.wanted
        faults = {name: fault for name, fault in made.items() if name in wanted}
        _check_required(limits, faults)
        return faults

    def _spawn(
        self, key: Key, limits: LimitRule, spawn: Spawn, realtime: bool
    ) -> Steps[tuple[int, dict[str, str]]]:
        """Spawn the process; return its pid, and what the kernel has refused."""
        if not realtime:
            return (yield from self._spawn_inside(key, limits, spawn, None))
        try:
            scheduler = (_POLICIES[limits.policy], os.sched_param(limits.priority))
            return (yield from self._spawn_inside(key, limits, spawn, scheduler))
        except ScheduleRefused as error:
            fault = {"realtime": str(error)}
            _check_required(limits, fault)
            pid, others = yield from self._spawn_inside(key, limits, spawn, None)
            return pid, {**fault, **others}

    def _spawn_inside(
        self, key: Key, limits: LimitRule, spawn: Spawn, scheduler: Scheduler | None
    ) -> Steps[tuple[int, dict[str, str]]]:
        """Spawn the process in its group, or without one if no process can enter it."""
        fault, faults = "", dict[str, str]()
        for _ in range(_ATTEMPTS):
            try:
                with self.groups.inside(key) as group, _on_cpus(limits.cpus, self._cpus):
                    attempt = spawn(group, scheduler)
                return (yield attempt), faults
            except OSError as error:
                if is_transient(error):
                    raise
                fault = f"its control group cannot be entered: {reason_of(error)}"
                # A supervisor beside this one may have removed the group, because it was empty.
                faults = self._make_group(key, limits)
        faults = {name: fault for name in limits.wanted if name.startswith("limits.")}
        _check_required(limits, faults)
        self.groups.remove(key, 0.0)
        with _on_cpus(limits.cpus, self._cpus):
            attempt = spawn(NO_GROUP, scheduler)
        return (yield attempt), faults


def cpus_in_words(numbers: list[int]) -> str:
    """Return "CPU 3", or "CPUs 3, 4 and 5"."""
    return f"CPU{'s' if len(numbers) > 1 else ''} {listed(map(str, numbers))}"


def _check_required(limits: LimitRule, faults: dict[str, str]) -> None:
    if limits.required and faults:
        raise SpawnError(_lacks(faults))


def _lacks(faults: dict[str, str]) -> str:
    return f"its limits are required, and this host cannot enforce {by_reason(faults.items())}"


@contextlib.contextmanager
def _on_cpus(cpus: tuple[int, ...], own: set[int]) -> Iterator[None]:
    """Give processes that are started in this context these CPUs; (): those of this process."""
    if not cpus:
        yield
        return
    try:
        os.sched_setaffinity(0, cpus)
    except OSError as error:
        fault = f"{cpus_in_words(list(cpus))} cannot be used: {reason_of(error)}"
        raise SpawnError.of(fault, error) from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # must not hide that the instance was started
            os.sched_setaffinity(0, own)


def _nice_fault(pid: int, limits: LimitRule) -> dict[str, str]:
    """Return why a process that was just started has another niceness, if it has.

    Raises:
        SpawnError: the niceness is required.
    """
    try:
        actual = os.getpriority(os.PRIO_PROCESS, pid)
    except ProcessLookupError:  # it has ended
        return {}
    if actual == limits.nice:
        return {}
    fault = {"nice": f"it is {actual}, because CAP_SYS_NICE is required for {limits.nice}"}
    _check_required(limits, fault)
    return fault
