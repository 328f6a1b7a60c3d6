"""The settings of a master and of a slave: plain frozen values with their defaults.

`cluster.yaml` and `host.yaml` have the same shape and the same names (`ros` alone is nested there),
and the annotations say what is allowed. `rosrm.config` reads and checks the files; the runtimes get
what was checked as JSON, and import this module without pydantic.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from rosrm.config.markers import NullIsEmpty, OptionsByName, PlainWord, RosSection
from rosrm.core.master.settings import CoreSettings
from rosrm.errors import ConfigError
from rosrm.extensions.units import (
    Amount,
    Count,
    Fraction,
    PositiveCount,
    PositiveSeconds,
    Quantity,
    Seconds,
)
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import EMPTY

#: Upper limits where the file sets none: memory as in the paper, CPU and disk with a reserve.
DEFAULT_LIMITS: Final[Mapping[str, float]] = {"memory": 0.8, "cpu": 0.9, "disk": 0.9}

_CORE: Final = CoreSettings()

Options = Annotated[Mapping[str, Any], NullIsEmpty()]
Ros = Annotated[RosSettings, RosSection()]
Scope = Literal["machine", "cgroup", "slice"]


def default_state(name: str, role: str) -> Path:
    """Where a master or slave of a name keeps its files when nothing else is said."""
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "rosrm" / name / role


def default_scope() -> Scope:
    """What a slave measures when its file does not say: ROSRM_SCOPE, or the machine.

    Raises:
        ConfigError: the variable has another word.
    """
    scopes: Mapping[str, Scope] = {"": "machine", "machine": "machine", "cgroup": "cgroup"}
    word = os.environ.get("ROSRM_SCOPE", "")
    if word not in scopes:
        raise ConfigError(f"ROSRM_SCOPE={word!r}; allowed: machine, cgroup")
    return scopes[word]


# --- cluster.yaml -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ScoringChoice:
    """The policy that orders the hosts that fit, by name, with its own options."""

    policy: str = "weighted"
    options: Options = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class CheckpointChoice:
    """The policy that keeps states on other hosts, with its own options; None: there is none."""

    policy: str | None = "other-host"
    options: Options = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class MigrationSettings:
    """What may move, and how calmly.

    Attributes:
        strategies: that specs may name, each with its options; the first is preferred.
        cooldown: seconds after a move in which a process is not moved again by itself.
        hysteresis: seconds that a host must be over a limit before anything moves.
        headroom: fraction by which a destination stays under each of its limits.
        max_in_flight: most moves at a time.
        automatic: the master moves processes from hosts that are over a limit.
    """

    strategies: Annotated[Mapping[str, Options], OptionsByName()] = field(
        default_factory=lambda: {"relaunch": {}, "handoff": {}}
    )
    cooldown: Seconds = _CORE.cooldown
    hysteresis: Seconds = _CORE.hysteresis
    headroom: Fraction = _CORE.headroom
    max_in_flight: PositiveCount = _CORE.max_migrations
    automatic: bool = _CORE.automatic


@dataclass(frozen=True, slots=True)
class QueueSettings:
    """The order of what waits.

    Attributes:
        backfill: those behind a process that waits for room may pass it.
    """

    backfill: bool = _CORE.backfill


@dataclass(frozen=True, slots=True)
class ProcessDefaults:
    """What is assumed of a process that says nothing.

    Attributes:
        needs: amounts by resource, of a process that declares none and of which none were learned.
        settle: seconds after which such an estimate no longer counts against its host.
    """

    needs: Mapping[str, Amount] = field(default_factory=lambda: dict(_CORE.default_needs))
    settle: Seconds = _CORE.settle


@dataclass(frozen=True, slots=True)
class LivenessSettings:
    """When a silent host is no longer trusted.

    Attributes:
        suspect: seconds of silence after which it gets no new work.
        lease: seconds of silence after which it is lost.
    """

    suspect: PositiveSeconds = _CORE.suspect
    lease: PositiveSeconds = _CORE.lease


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """The requests between the parts.

    Attributes:
        max_age: seconds, by the receiver's clock, after which a request is refused as stale.
        beat_period: seconds between the master's beats.
        order_retry: seconds after which an order that was not answered is given again.
    """

    max_age: PositiveSeconds = 5.0
    beat_period: PositiveSeconds = 0.2
    order_retry: PositiveSeconds = _CORE.order_retry


@dataclass(frozen=True, slots=True)
class JournalSettings:
    """The durable record.

    Attributes:
        sync: "normal" survives a SIGKILL of the master; "full" a power failure too.
        keep_events: newest events kept.
        keep_ended: processes that are over and still known, those that ended last.
    """

    sync: Literal["normal", "full"] = "normal"
    keep_events: PositiveCount = 100_000
    keep_ended: PositiveCount = _CORE.keep_ended


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """The record of a run, for `rosrm simulate`.

    Attributes:
        directory: for the files, one for each run; empty: nothing is recorded.
        max_size: bytes of one file; then the record ends, and the master goes on.
        keep: newest files kept.
    """

    directory: Path = Path()
    max_size: Annotated[int, Quantity("size", low=65536, whole=True)] = 256_000_000
    keep: PositiveCount = 3


@dataclass(frozen=True, slots=True)
class ClusterConfig:
    """A master's settings: `cluster.yaml`.

    Attributes:
        name: of the cluster and its master.
        ros: domain, discovery and transports.
        state: the master's directory; by default under XDG_STATE_HOME.
        scoring: the policy that orders the hosts that fit.
        migration: what moves.
        queue: what waits.
        defaults: of processes.
        liveness: of hosts.
        control: of requests.
        journal: of events and intent.
        record: of everything that the master is told, to be replayed.
        checkpoint: the policy that keeps states of processes on other hosts, if any.
        delivery_timeout: seconds within which a slave must take up an assignment.
    """

    name: str = "rosrm"
    ros: Ros = field(default_factory=RosSettings)
    state: Path = Path()
    scoring: ScoringChoice = field(default_factory=ScoringChoice)
    migration: MigrationSettings = field(default_factory=MigrationSettings)
    queue: QueueSettings = field(default_factory=QueueSettings)
    defaults: ProcessDefaults = field(default_factory=ProcessDefaults)
    liveness: LivenessSettings = field(default_factory=LivenessSettings)
    control: ControlSettings = field(default_factory=ControlSettings)
    journal: JournalSettings = field(default_factory=JournalSettings)
    record: RecordSettings = field(default_factory=RecordSettings)
    checkpoint: CheckpointChoice = field(default_factory=CheckpointChoice)
    delivery_timeout: PositiveSeconds = _CORE.delivery_timeout

    def __post_init__(self) -> None:
        """Fill in the state directory, which depends on the name."""
        if self.state == Path():
            object.__setattr__(self, "state", default_state(self.name, "master"))

    def core(self) -> CoreSettings:
        """The part that the master's core is told."""
        return CoreSettings(
            backfill=self.queue.backfill,
            default_needs=self.defaults.needs,
            settle=self.defaults.settle,
            suspect=self.liveness.suspect,
            lease=self.liveness.lease,
            delivery_timeout=self.delivery_timeout,
            cooldown=self.migration.cooldown,
            hysteresis=self.migration.hysteresis,
            headroom=self.migration.headroom,
            max_migrations=self.migration.max_in_flight,
            automatic=self.migration.automatic,
            order_retry=self.control.order_retry,
            keep_ended=self.journal.keep_ended,
        )

    def to_json(self) -> str:
        """As the master's runtime reads it."""
        return json.dumps(to_plain(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> ClusterConfig:
        """The inverse of `to_json`; raises `ValueError`."""
        return from_plain(cls, json.loads(text))


# --- host.yaml --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LogSettings:
    """The logs of the processes.

    Attributes:
        max_bytes: of one log file; then it is rotated.
        keep: rotated files kept beside the current one.
    """

    max_bytes: Annotated[int, Quantity("size", low=4096, whole=True)] = 10_000_000
    keep: Count = 3


@dataclass(frozen=True, slots=True)
class KeepSettings:
    """The kept states of stateful processes.

    Attributes:
        every: seconds by which the state that a node keeps here may be behind.
        max_bytes: of the states of other hosts' processes that are kept here, all together.
        max_rate: bytes a second that are sent to other hosts, all together.
    """

    every: Seconds = 1.0
    max_bytes: Annotated[int, Quantity("size", low=0, whole=True)] = 1_000_000_000
    max_rate: Annotated[int, Quantity("size", low=65536, whole=True)] = 10_000_000


@dataclass(frozen=True, slots=True)
class HostControlSettings:
    """The requests that a slave takes.

    Attributes:
        max_age: seconds, by the slave's clock, after which a request is refused as stale; never
            less than three readings take.
    """

    max_age: PositiveSeconds = 5.0


@dataclass(frozen=True, slots=True)
class HostConfig:
    """A slave's settings: `host.yaml`.

    Attributes:
        host: name of the host; one live slave for each name.
        ros: domain, discovery and transports.
        state: the slave's directory; by default under XDG_STATE_HOME.
        labels: what processes may require, prefer or avoid.
        scope: what the probes measure: the machine, the cgroup that the slave runs in, or the
            slave's own process tree against `budget`.
        budget: amounts by resource that the scope "slice" counts as 1.0.
        limits: upper limits, fractions by resource; those not named keep their default.
        rate: of `resource_info`, Hz.
        probes: chosen by name, each with its options; None: the default ones.
        max_processes: most processes held at a time; 0: no bound.
        max_starting: most processes started at a time, until they are ready; 0: no bound.
        logs: of the processes.
        control: of requests.
        keep: of states.
        on_stop: a slave that is stopped stops its processes, or keeps them with the supervisor.
    """

    host: str = field(default_factory=socket.gethostname)
    ros: Ros = field(default_factory=RosSettings)
    state: Path = Path()
    labels: Mapping[str, Annotated[str, PlainWord()]] = field(default_factory=lambda: EMPTY)
    scope: Scope = field(default_factory=default_scope)
    budget: Mapping[str, Amount] = field(default_factory=lambda: EMPTY)
    limits: Mapping[str, Fraction] = field(default_factory=lambda: dict(DEFAULT_LIMITS))
    rate: Annotated[float, Quantity(low=0.1, high=1000.0, hint="Hz")] = 10.0
    probes: Annotated[Mapping[str, Options] | None, OptionsByName()] = None
    max_processes: Count = 0
    max_starting: Count = 8
    logs: LogSettings = field(default_factory=LogSettings)
    control: HostControlSettings = field(default_factory=HostControlSettings)
    keep: KeepSettings = field(default_factory=KeepSettings)
    on_stop: Literal["stop", "keep"] = "stop"

    def __post_init__(self) -> None:
        """Fill in the state directory, which depends on the name, and the default limits."""
        if self.state == Path():
            object.__setattr__(self, "state", default_state(self.host, "slave"))
        object.__setattr__(self, "limits", {**DEFAULT_LIMITS, **self.limits})

    @property
    def period(self) -> float:
        """Of `resource_info`, seconds."""
        return 1.0 / self.rate

    def to_json(self) -> str:
        """As the slave's runtime reads it."""
        return json.dumps(to_plain(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> HostConfig:
        """The inverse of `to_json`; raises `ValueError`."""
        return from_plain(cls, json.loads(text))
