"""What the master's core can ask its runtime for, in the imperative.

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
    """Take an assignment back.

    One that was not yet fetched yields `AssignmentWithdrawn`; for one that was, the slave is
    ordered to stop it, so that it never runs or ends.
    """

    order: int
    host_id: int
    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Redeliver:
    """Order the start of an assignment, as the answer that it was fetched with may have been lost.

    One that was not yet fetched is left where it is: it can be taken back without a word.
    """

    order: int
    host_id: int
    assignment: Assignment


@dataclass(frozen=True, slots=True)
class Order:
    """Ask one slave for something; `OrderAnswered` follows, also when no answer comes.

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
    """Tell the source and the destination of a handoff where it stands, on `state_config`.

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
