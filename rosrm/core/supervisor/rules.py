"""Policies for the restart, stop and fence of an instance."""

from __future__ import annotations

from typing import Literal, NamedTuple

#: Process name and number, as in `InstanceId`.
Key = tuple[str, int]


class RestartRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.RestartPolicy`."""

    when: Literal["never", "on-failure", "always"] = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


class StopRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.StopPolicy`."""

    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0


class RunLimits(NamedTuple):
    """Limits that can be changed while an instance runs; the fields are those of `LimitRule`."""

    memory: float
    memory_high: float
    cpu: float
    required: bool


class LimitRule(NamedTuple):
    """Limits and scheduling of an instance; 0, (), "": none.

    Attributes:
        memory: bytes; above them the kernel kills the instance.
        memory_high: bytes; above them the kernel slows it.
        cpu: cores.
        cpus: numbers of the CPUs that it may use.
        policy: real-time policy, "fifo" or "rr", with `priority`.
        nice: niceness.
        required: True: it is refused if any of these cannot be enforced.
    """

    memory: float = 0.0
    memory_high: float = 0.0
    cpu: float = 0.0
    cpus: tuple[int, ...] = ()
    policy: str = ""
    priority: int = 0
    nice: int = 0
    required: bool = False

    @property
    def given_limits(self) -> tuple[str, ...]:
        """Return the names of the limits that are given."""
        given = {
            "limits.memory": self.memory, "limits.memory_high": self.memory_high,
            "limits.cpu": self.cpu,
        }  # fmt: skip
        return tuple(name for name, value in given.items() if value)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Return the names of the limits and of the scheduling settings that are given."""
        given = {"cpus": self.cpus, "realtime": self.policy, "nice": self.nice}
        return (*self.given_limits, *(name for name, value in given.items() if value))

    def with_limits(self, limits: RunLimits | None) -> LimitRule:
        """Return this rule with other limits; None: the same."""
        return self if limits is None else self._replace(**limits._asdict())


class AdoptionRule(NamedTuple):
    """Lightweight copy of `rosrm.model.adoption.Adoption`, without the host."""

    pid: int
    birth: int
    boot: str


class FenceRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.Fence`."""

    after: float
    grace: float
    alive: bool = False
