"""Commands of the core to an instance whose start still waits for its files."""

from __future__ import annotations

from typing import get_args

import pytest

from rosrm.core.slave import commands, events
from rosrm.core.slave.watches import Memo
from rosrm.core.supervisor.rules import LimitRule
from rosrm.model.values import Amendment, Assignment, InstanceId, Limits, ProcessSpec, RestartPolicy
from rosrm.slave.launch.environment import SHADOW
from rosrm.slave.launch.starter import Starter
from rosrm.slave.supervisor_client import amended
from rosrm.supervisor.client_values import LaunchOrder

ONE = InstanceId("one", 1)
AMENDMENT = Amendment(RestartPolicy("always"), Limits(memory=1e9))
STOPPED = events.LaunchRefused(ONE, "it was stopped before it was started")
#: Each command of the supervisor, with the events that follow; None: the supervisor has to act.
FOLLOW = {
    commands.Stop(ONE): [STOPPED],
    commands.Fence(ONE): [STOPPED],
    commands.Restart(ONE): [],
    commands.Fail(ONE, 7, "unhealthy", kill=False): [],
    commands.Amend(ONE, AMENDMENT): [events.AmendmentRecorded(ONE, AMENDMENT)],
    commands.Remember(ONE, Memo()): [],
    commands.Renew(1.0, 2.0): None,
    commands.Forget((ONE,)): None,
}


class NoFiles:
    """Services that prepare nothing."""

    def is_preparing(self, _instance) -> bool:
        return False

    def forget(self, _instance) -> None:
        pass


def starter(*waiting: InstanceId) -> tuple[Starter, list[events.Event]]:
    """Return a starter with instances that wait, and the events for the core."""
    made, taken = object.__new__(Starter), []
    made.artifacts = made.replication = NoFiles()
    made.take = taken.append
    made._launching = {one: Assignment(one, ProcessSpec("one"), 1, "one") for one in waiting}
    return made, taken


@pytest.mark.parametrize("command", FOLLOW, ids=lambda one: type(one).__name__)
def test_each_command_to_an_instance_that_waits_is_decided(command) -> None:
    """No command reaches the supervisor, which would refuse an instance that it does not know."""
    made, taken = starter(ONE)
    acts = FOLLOW[command] is not None
    assert made.call_off(command) is acts
    assert taken == (FOLLOW[command] or [])


@pytest.mark.parametrize("command", FOLLOW, ids=lambda one: type(one).__name__)
def test_each_command_to_a_started_instance_is_the_supervisors(command) -> None:
    """The starter leaves commands to started instances to the supervisor."""
    made, taken = starter()
    assert not made.call_off(command)
    assert taken == []


def test_the_table_above_has_each_command_of_the_supervisor() -> None:
    """A new command is decided here too."""
    assert {type(one) for one in FOLLOW} == set(get_args(commands.SupervisorCommand))


def test_a_start_has_the_amendment_that_came_while_it_waited() -> None:
    """The new policy and limits hold, and the instance is no shadow."""
    order = LaunchOrder(ONE, ("true",), {SHADOW: "1", "A": "b"}, limits=LimitRule(cpu=2.0, nice=5))
    started = amended(order, AMENDMENT)
    assert (started.restart.when, started.environment) == ("always", {"A": "b"})
    assert (started.limits.memory, started.limits.cpu, started.limits.nice) == (1e9, 0.0, 5)
