"""Rules for the limits and the scheduling of a process, checked at every boundary."""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter
from typing import Final, get_args

from rosrm.model.values import (
    MOST_USED,
    Enforcement,
    ProcessSpec,
    RealtimePolicy,
)
from rosrm.wording import amount

#: Bytes that each process needs for its start, even one without an interpreter.
LEAST_MEMORY: Final = 4e6
#: Cores: the kernel allows no less than 1 ms in 100 ms.
LEAST_CPU: Final = 0.01
LARGEST_CPU_NUMBER: Final = 65_535
_limits_of: Final = attrgetter("limits", "cpus", "realtime", "nice")
_NO_LIMITS: Final = _limits_of(ProcessSpec(""))
#: Unit of each limit.
_UNITS: Final = {"memory": "B", "memory_high": "B", "cpu": "core"}


def limits_fault(spec: ProcessSpec) -> str:
    """Return the first fault of limits, cpus, realtime and nice, with its key; "": none."""
    return "" if _limits_of(spec) == _NO_LIMITS else next(_faults(spec), "")


def _faults(spec: ProcessSpec) -> Iterator[str]:
    limits = spec.limits
    for name, unit in _UNITS.items():
        yield from _amount_faults(name, unit, spec)
    if 0.0 < limits.memory < limits.memory_high:
        yield "limits.memory_high must not be more than limits.memory, where the process is killed"
    if limits.enforce not in get_args(Enforcement):
        yield f"limits.enforce {limits.enforce!r:.100}; allowed: {', '.join(get_args(Enforcement))}"
    yield from _scheduling_faults(spec)


def _amount_faults(name: str, unit: str, spec: ProcessSpec) -> Iterator[str]:
    given, need = getattr(spec.limits, name), spec.needs.get(name, 0.0)
    least = LEAST_CPU if unit == "core" else LEAST_MEMORY
    most = MOST_USED[name.partition("_")[0]]
    if given != 0.0 and not least <= given <= most:  # true for NaN
        allowed = f"0 (no limit), or {amount(least, unit)} to {amount(most, unit)}"
        yield f"limits.{name} is {amount(given, unit)}; allowed: {allowed}"
    if 0.0 < given < need:
        yield (
            f"limits.{name} is {amount(given, unit)}, less than needs.{name}, "
            f"{amount(need, unit)}: the process could not use what it needs"
        )


def _scheduling_faults(spec: ProcessSpec) -> Iterator[str]:
    realtime = spec.realtime
    for number in spec.cpus:
        if not 0 <= number <= LARGEST_CPU_NUMBER:
            yield f"cpus: {number} is no number of a CPU; allowed: 0 to {LARGEST_CPU_NUMBER}"
    if len(set(spec.cpus)) < len(spec.cpus):
        yield "cpus: a CPU is given twice"
    if realtime.policy not in get_args(RealtimePolicy):
        yield f"realtime.policy {realtime.policy!r:.100}; allowed: fifo, rr"
    if not (1 <= realtime.priority <= 99 if realtime.policy else realtime.priority == 0):
        yield f"realtime.priority is {realtime.priority}; allowed with a policy: 1 to 99"
    if not -20 <= spec.nice <= 19:
        yield f"nice is {spec.nice}; allowed: -20 to 19"
    for name, value in (("limits.cpu", spec.limits.cpu), ("nice", spec.nice)):
        if value and realtime.policy:
            yield f"{name} has no effect on a process with `realtime`; leave one of them out"


def limits_in_words(spec: ProcessSpec) -> dict[str, str]:
    """Return the name of each limit and scheduling setting of a process to its value as text."""
    found = {
        f"limits.{name}": amount(getattr(spec.limits, name), unit)
        for name, unit in _UNITS.items()
        if getattr(spec.limits, name)
    }
    if spec.cpus:
        found["cpus"] = ", ".join(map(str, spec.cpus))
    if spec.realtime.policy:
        found["realtime"] = f"{spec.realtime.policy} {spec.realtime.priority}"
    if spec.nice:
        found["nice"] = str(spec.nice)
    return found
