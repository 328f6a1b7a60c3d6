"""Base of simulated clusters: the master's core, and the way of its commands to the hosts.

The simulator and the unit tests share it. The subclasses decide when messages arrive, and record.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np

from rosrm.core.master.commands import (
    Assign,
    Command,
    PublishStateConfig,
    Redeliver,
    Reply,
    SendOrder,
    Withdraw,
)
from rosrm.core.master.events import AssignmentWithdrawn, Event, HostRegistered, ReadingsReceived
from rosrm.core.master.invariants import check
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.reducer import step
from rosrm.core.slave.events import ContactConfirmed, Registered
from rosrm_simulate.host import Host

HostT = TypeVar("HostT", bound=Host[Any])


class World(ABC, Generic[HostT]):
    """A master's core with simulated hosts around it.

    Attributes:
        machines: by name.
        replies: replies of the master, by request number.
        publish: publishes the phase of a handoff to the nodes.
        checks: the invariants of the core are checked after each step with commands, and after each
            of so many others; 0: never.
    """

    publish: Callable[[PublishStateConfig], None]
    checks: int = 0

    def __init__(self, state: MasterState) -> None:
        self.state = state
        self.machines: dict[str, HostT] = {}
        self.replies: dict[int, Reply] = {}
        self._requests = self._steps = 0

    # --- differences between the simulator and the unit tests ------------------------------

    @property
    @abstractmethod
    def now(self) -> float:
        """Return the virtual time, seconds."""

    @property
    def wall(self) -> float:
        """Return the unix time."""
        return self.now

    @abstractmethod
    def record(self, event: Event, commands: Sequence[Command]) -> None:
        """Process the records and intents of a step, before its other commands."""

    @abstractmethod
    def send(self, sent: SendOrder) -> None:
        """Send an order to a slave."""

    def assign(self, host: HostT, command: Assign) -> None:
        """Send an assignment to a host that has requested work."""
        host.polled.append(command.assignment)

    def after(self, _seconds: float, action: Callable[[], object]) -> None:
        """Carry out an action after some seconds: here at once."""
        action()

    # --- the master ------------------------------------------------------------------------

    def decide(self, event: Event) -> list[Command]:
        """Process an event in the master's core, and return its commands."""
        self.state.wall = self.wall
        commands = step(self.state, event, self.now)
        self._steps += 1
        if self.checks and (commands or self._steps % self.checks == 0):
            check(self.state)
        return commands

    def tell(self, event: Event) -> list[Command]:
        """Process an event in the master's core, and carry out its commands."""
        commands = self.decide(event)
        self.record(event, commands)
        self.carry_out(commands)
        return commands

    def request(self, event: Any) -> int:
        """Send a request to the master: an event with a request number. Return the number."""
        self._requests += 1
        number = self._requests
        self.tell(replace(event, request=number))
        return number

    def carry_out(self, commands: Iterable[Command]) -> None:
        """Carry out all commands except records and intents."""
        for command in commands:
            match command:
                case Reply():
                    self.replies[command.request] = command
                case Assign():
                    self.assign(self.by_id(command.host_id), command)
                case SendOrder():
                    self.send(command)
                case Withdraw():
                    self._withdraw(command)
                case Redeliver():
                    self._redeliver(command)
                case PublishStateConfig():
                    self.publish(command)

    def _withdraw(self, command: Withdraw) -> None:
        host = self.by_id(command.host_id)
        kept = [one for one in host.polled if one.instance != command.instance]
        if len(kept) < len(host.polled):
            host.polled = kept
            self.after(0.0, partial(self.tell, AssignmentWithdrawn(command.instance)))
        else:
            self.send(command.if_fetched)

    def _redeliver(self, command: Redeliver) -> None:
        instance = command.assignment.instance
        if all(one.instance != instance for one in self.by_id(command.host_id).polled):
            self.send(command.if_fetched)

    # --- hosts -----------------------------------------------------------------------------

    def by_id(self, host_id: int) -> HostT:
        """Return a registered host."""
        return self.machines[self.state.hosts.hosts[host_id - 1].name]

    def join(self, host: HostT, contact: float, *known: Any) -> Reply:
        """Register a slave with its description and what else it knows.

        Args:
            host: of the slave.
            contact: time up to which it then knows that the master receives its messages.
            known: further fields of the registration.
        """
        reply = self.replies[self.request(HostRegistered(0, host.description(), *known))]
        if reply.accepted:
            host.host_id = reply.host_id
            host.tell(Registered(self.state.epoch), self.now)
            host.tell(ContactConfirmed(contact), self.now)
        return reply

    def readings(self, hosts: Sequence[HostT], **columns: Any) -> ReadingsReceived:
        """Return the next readings of hosts as one event.

        Args:
            hosts: that send them.
            columns: `status_sequence`, and what replaces the reported values.
        """
        now = self.now
        readings = [host.reading(now) for host in hosts]
        for host in hosts:
            host.sequence += 1
        values: dict[str, Any] = {
            "host_id": np.array([one.host_id for one in hosts], np.int64),
            "incarnation": np.array([one.incarnation for one in hosts], np.uint64),
            "sequence": np.array([one.sequence for one in hosts], np.uint64),
            "accepting": np.array([one.accepts for one in readings], np.bool_),
            "stale": np.array([one.stale for one in readings], np.uint32),
            "usage": np.array([one.usage for one in readings]),
            "limit": np.array([one.limit for one in hosts]),
        }
        return ReadingsReceived(**{**values, **columns})
