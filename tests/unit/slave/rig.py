"""The slave's reducer with a clock, as the tests of this folder drive it."""

from __future__ import annotations

from typing import Any

from rosrm.core.slave import commands, reducer
from rosrm.core.slave.events import AssignmentsReceived, Event, SupervisorReported
from rosrm.core.slave.state import HeldInstance, SlaveState
from rosrm.model.values import Assignment, InstanceId, InstanceState, InstanceStatus, ProcessSpec

PLAIN = ProcessSpec("p", command=("true",))


def assignment(spec=PLAIN, number=1, *, epoch=1, alias="", **more) -> Assignment:
    return Assignment(InstanceId(spec.name, number), spec, epoch, alias or spec.name, **more)


def states(given) -> list[InstanceState]:
    """Return the states that the commands report."""
    return [one.state for c in given if isinstance(c, commands.Report) for one in c.statuses]


def launched(given) -> list[InstanceId]:
    """Return the instances that the commands launch."""
    launches = [one for one in given if isinstance(one, commands.Launch)]
    return [one.instance for launch in launches for one in launch.assignments]


class Slave:
    """Reducer of a registered slave, with its clock."""

    def __init__(self, now: float = 100.0, **state: Any) -> None:
        self.state, self.now = SlaveState(registered=True, **state), now

    def step(self, event: Event, after: float = 0.0) -> list[commands.Command]:
        self.now += after
        return list(reducer.step(self.state, event, self.now))

    def assign(self, spec=PLAIN, number=1, *, after=0.0, **more) -> list[commands.Command]:
        return self.step(AssignmentsReceived((assignment(spec, number, **more),)), after)

    def status(self, state, name="p", number=1, *, pid=5, after=0.0) -> list[commands.Command]:
        """Let the supervisor report the state of an instance; only a live one has a pid."""
        lives = state in (InstanceState.RUNNING, InstanceState.STOPPING)
        status = InstanceStatus(InstanceId(name, number), state, pid if lives else 0)
        return self.step(SupervisorReported((status,)), after)

    def of(self, name: str = "p", number: int = 1) -> HeldInstance:
        return self.state.held[InstanceId(name, number)]
