"""Commands of the master's core to its runtime, in the imperative.

The runtime writes all `Record` and `Intent` of one batch to the journal before it carries out
anything else of that batch: intent is durable before it is acted on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rosrm.extensions.contracts import Intent, Record
from rosrm.model.plan import HandoffPhase
from rosrm.model.values import EMPTY, Assignment, InstanceId, RestartPolicy


@dataclass(frozen=True, slots=True)
class Assign:
    """Hand an assignment to a host with the answer to its open request."""

    host_id: int
    assignment: Assignment


@dataclass(frozen=True, slots=True)
class Withdraw:
    """Withdraw an assignment.

    An assignment that the slave has not fetched yields `AssignmentWithdrawn`. For a fetched one, an
    order to stop goes to the slave, so that it never runs or ends.
    """

    order: int
    host_id: int
    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Redeliver:
    """Order the start of a fetched assignment, because the answer that carried it may be lost.

    An assignment that the slave has not fetched stays open: it can be withdrawn without an order.
    """

    order: int
    host_id: int
    assignment: Assignment


@dataclass(frozen=True, slots=True)
class Order:
    """Send an order to one slave; `OrderAnswered` follows, also when no answer arrives.

    Attributes:
        action: "stop", "fence", "restart", "start", "execute", "report", "set_restart", "keep" or
            "drop_kept".
        assignment: for "start".
        restart: for "set_restart".
        executor, arguments, timeout: for "execute".
        keep_on, keep_every: for "keep": hosts, seconds.
    """

    order: int
    host_id: int
    action: str
    instance: InstanceId | None = None
    assignment: Assignment | None = None
    executor: str = ""
    arguments: Mapping[str, Any] = field(default_factory=lambda: EMPTY)
    timeout: float = 0.0
    restart: RestartPolicy | None = None
    keep_on: tuple[str, ...] = ()
    keep_every: float = 0.0


@dataclass(frozen=True, slots=True)
class PublishStateConfig:
    """Publish the phase of a handoff on `state_config`, for its source and destination.

    Attributes:
        source, destination: instance numbers.
        source_node, destination_node: fully qualified names of their nodes.
    """

    process: str
    phase: HandoffPhase
    source: int
    destination: int
    source_node: str
    destination_node: str


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer a request that came with an event."""

    request: int
    accepted: bool = True
    code: str = ""
    message: str = ""
    host_id: int = 0
    host: str = ""


Command = Assign | Withdraw | Redeliver | Order | PublishStateConfig | Reply | Record | Intent
