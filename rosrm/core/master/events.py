"""Events of the master, in the past tense. Readings arrive as one batch.

`by` of a request is its sender.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from rosrm.core.master.commands import OrderId
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.placement import PolicySettings
from rosrm.extensions.plugin_calls import Plugin
from rosrm.model.applications import Target
from rosrm.model.devices import Device
from rosrm.model.modes import Mode
from rosrm.model.plan import ReportPhase
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.rows import PluginKind
from rosrm.model.values import (
    EMPTY,
    HostDescription,
    InstanceId,
    InstanceStatus,
    ProcessSpec,
    SnapshotReport,
)


class OrderOutcome(Enum):
    """Outcome of an order, by the answer of its slave."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    BAD_RESULT = "bad_result"
    TIMEOUT = "timeout"


#: Answer code of an executor that ran to its end, but returned no JSON object.
BAD_RESULT: Final = OrderOutcome.BAD_RESULT.value

#: Outcomes by answer code; every other code is a refusal.
_BY_CODE: Final = {one.value: one for one in (OrderOutcome.BAD_RESULT, OrderOutcome.TIMEOUT)}


@dataclass(frozen=True, slots=True)
class HostRegistered:
    """A slave registered its host.

    Attributes:
        instances: all instances on the host.
        journal_seen: sequence of the newest record that a former run of this master has reported
            to the slave; 0: none.
        snapshots: all snapshots and replicas on the host.
    """

    request: int
    description: HostDescription
    instances: tuple[InstanceStatus, ...] = ()
    journal_seen: int = 0
    snapshots: tuple[SnapshotReport, ...] = ()


@dataclass(frozen=True, slots=True)
class HostLeft:
    """A slave is being stopped.

    Attributes:
        left_running: instances that the slave leaves running; (): the slave stops all of its
            instances and reports their ends.
    """

    request: int
    host_id: int
    incarnation: int
    left_running: tuple[InstanceStatus, ...] = ()


@dataclass(frozen=True, slots=True)
class ProcessRequested:
    """A slave is under all its limits and requests work."""

    request: int
    host_id: int
    incarnation: int


@dataclass(frozen=True, slots=True)
class ReadingsReceived:
    """N readings, at most one of each host (the newest), in parallel arrays.

    Attributes:
        host_id, incarnation, sequence, status_sequence: (N,) as in `ResourceInfo`.
        accepting: (N,) bool: the slave is under all its limits.
        stale: (N,) bit i: slot i is stale.
        usage, limit: (N, RESOURCE_SLOTS) fractions.
    """

    host_id: npt.NDArray[np.int64]
    incarnation: npt.NDArray[np.uint64]
    sequence: npt.NDArray[np.uint64]
    status_sequence: npt.NDArray[np.uint64]
    accepting: npt.NDArray[np.bool_]
    stale: npt.NDArray[np.uint32]
    usage: npt.NDArray[np.float64]
    limit: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StatusesReceived:
    """A slave reported statuses of its instances, failing plugins and devices of its host.

    Attributes:
        complete: True if `statuses` has all instances on the host, not only the changed ones.
        failing: resource to the reason why its probe gives no readings.
        failing_strategies: migration strategy to the reason why its executors fail.
        failing_launchers: launcher to the reason why it could not be created.
        devices: all devices of the host.
    """

    host_id: int
    incarnation: int
    sequence: int
    complete: bool
    statuses: tuple[InstanceStatus, ...]
    failing: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    failing_strategies: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    failing_launchers: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    devices: tuple[Device, ...] = ()

    def failing_plugins(self) -> dict[Plugin, str]:
        """Return the kind and name of each failing plugin with the reason."""
        by_kind: tuple[tuple[PluginKind, Mapping[str, str]], ...] = (
            ("probe", self.failing),
            ("migration", self.failing_strategies),
            ("launcher", self.failing_launchers),
        )
        return {(kind, name): why for kind, found in by_kind for name, why in found.items()}


@dataclass(frozen=True, slots=True)
class UsagesReceived:
    """Resource usage of each instance of a host: parallel arrays (cores, bytes).

    Attributes:
        others: slot of another resource to its amounts, in its base unit.
    """

    host_id: int
    incarnation: int
    numbers: npt.NDArray[np.uint64]
    cpu: npt.NDArray[np.float64]
    memory: npt.NDArray[np.float64]
    others: Mapping[int, npt.NDArray[np.float64]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SnapshotsReported:
    """A host reported all its snapshots and replicas, the newest of each process."""

    host_id: int
    incarnation: int
    snapshots: tuple[SnapshotReport, ...]


@dataclass(frozen=True, slots=True)
class SubmissionReceived:
    """A user submits processes, and becomes their owner: all are accepted, or none."""

    request: int
    specs: tuple[ProcessSpec, ...]
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class ApplicationsRequested:
    """A client requests versions of applications, or cancels applications: all, or none.

    Attributes:
        plan_only: True: the reply has the actions that would follow, and none begins.
    """

    request: int
    targets: tuple[Target, ...]
    plan_only: bool = False
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class ModesLoaded:
    """An operator replaces the modes."""

    request: int
    modes: tuple[Mode, ...]
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class ModeRequested:
    """An operator requests a mode.

    Attributes:
        plan_only: True: the reply has the actions that would follow, and none begins.
    """

    request: int
    mode: str
    plan_only: bool = False
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class CancelRequested:
    """A client cancels processes.

    Attributes:
        at_once: kill them (SIGKILL), without the graces of their `stop`.
    """

    request: int
    names: tuple[str, ...]
    by: Requester = OPERATOR
    at_once: bool = False


@dataclass(frozen=True, slots=True)
class RestartRequested:
    """A client restarts running processes in place, or queues ended ones again."""

    request: int
    names: tuple[str, ...]
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class MigrationRequested:
    """A client requests the migration of a process; `host` None: the core chooses the host."""

    request: int
    name: str
    host: str | None = None
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class CheckpointRequested:
    """A client requests to dump a process into a checkpoint image, and to stop it."""

    request: int
    name: str
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class RestoreRequested:
    """A client requests to restore a process from its checkpoint image."""

    request: int
    name: str
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class HostStateRequested:
    """A client cordons, uncordons or drains a host."""

    request: int
    host: str
    action: Literal["cordon", "uncordon", "drain"]
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class RebalanceRequested:
    """An operator evens out the load of the hosts.

    Attributes:
        plan_only: True: the reply has the moves, and none begins.
    """

    request: int
    plan_only: bool = False
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class ReloadRequested:
    """An operator reloads the settings of the master and of all slaves from their files."""

    request: int
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class SettingsRead:
    """The file of the master was read again, as a whole.

    Attributes:
        request: number of the `ReloadRequested`; 0: the master received a signal.
        fault: why the file cannot be used; "": it can.
        settings: settings of the core from now on.
        scoring: settings of the scoring policies from now on.
        changed: paths of the changed settings.
        kept: paths of settings that differ in the file, and need a restart.
    """

    request: int
    fault: str = ""
    settings: CoreSettings | None = None
    scoring: tuple[PolicySettings, ...] = ()
    changed: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PruneRequested:
    """A client removes ended processes and departed hosts from the listings.

    Attributes:
        names: processes to remove.
        hosts: hosts to remove. Both empty: all ended processes and all departed hosts.
    """

    request: int
    names: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    by: Requester = OPERATOR


@dataclass(frozen=True, slots=True)
class OrderAnswered:
    """A slave answered a `SendOrder`, or did not in time.

    Attributes:
        code: the slave's code of a refusal, or the value of an `OrderOutcome`.
    """

    order: OrderId
    accepted: bool
    code: str = ""
    message: str = ""
    result: Mapping[str, Any] | None = None

    @classmethod
    def missing(cls, order: OrderId, why: str = "no answer in time") -> OrderAnswered:
        """Return the event for an order without an answer."""
        return cls(order, False, OrderOutcome.TIMEOUT.value, why)

    @property
    def outcome(self) -> OrderOutcome:
        """Return the outcome of the order."""
        if self.accepted:
            return OrderOutcome.ACCEPTED
        return _BY_CODE.get(self.code, OrderOutcome.REFUSED)

    @property
    def is_measurement(self) -> bool:
        """Return True if the order was a measurement of links; its answer causes no decision."""
        return isinstance(self.order, tuple) and self.order[0] == "links"

    @property
    def reason(self) -> str:
        """Return the slave's message on an order that was not accepted, or else the code."""
        return self.message or self.code


@dataclass(frozen=True, slots=True)
class AssignmentWithdrawn:
    """An assignment was withdrawn before its slave had fetched it."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class HandoffReported:
    """The source or the destination of a handoff reported its phase.

    Attributes:
        destination: instance number of the destination; it identifies the handoff.
        instance: number of the reporting instance.
        sequence: number of cycles that the instance's newest snapshot covers.
        message: a sentence for listings and logs.
    """

    process: str
    destination: int
    instance: int
    phase: ReportPhase
    sequence: int = 0
    message: str = ""


@dataclass(frozen=True, slots=True)
class SourceStranded:
    """The source of a handoff is silent, and asks if it may resume.

    Attributes:
        source, destination: instance numbers.
    """

    source: int
    destination: int


@dataclass(frozen=True, slots=True)
class PeerRefused:
    """The network layer refused a message: another protocol version, or malformed."""

    who: str
    reason: str


@dataclass(frozen=True, slots=True)
class KeyRevoked:
    """The key of a slave was revoked: the network layer drops all further messages of it."""

    host_id: int
    incarnation: int


@dataclass(frozen=True, slots=True)
class TimePassed:
    """Time passed without another event; deadlines are checked."""


ClientRequest = (
    SubmissionReceived
    | ApplicationsRequested
    | ModesLoaded
    | ModeRequested
    | CancelRequested
    | RestartRequested
    | MigrationRequested
    | CheckpointRequested
    | RestoreRequested
    | HostStateRequested
    | RebalanceRequested
    | ReloadRequested
    | PruneRequested
)
#: Events that are answered by a `Reply`.
Request = HostRegistered | HostLeft | ProcessRequested | ClientRequest
Event = (
    Request
    | ReadingsReceived
    | StatusesReceived
    | UsagesReceived
    | SnapshotsReported
    | OrderAnswered
    | AssignmentWithdrawn
    | HandoffReported
    | SourceStranded
    | PeerRefused
    | KeyRevoked
    | SettingsRead
    | TimePassed
)
