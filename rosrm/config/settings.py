"""Settings of a master and of a slave: plain frozen values with their defaults.

`cluster.yaml` and `host.yaml` have the same structure and names (only `ros` is nested there). The
annotations define the allowed values. `rosrm.config` reads and checks the files. The runtimes
receive the checked settings as JSON, and import this module without pydantic.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from rosrm.config.device_forms import OfferedByKind, with_kinds
from rosrm.config.first_name import default_host, default_states
from rosrm.config.markers import (
    NullIsEmpty,
    OneOrMore,
    OptionsByName,
    PlainWord,
    ProcessSection,
    RosSection,
)
from rosrm.core.master.settings import DEFAULT_QUOTA, CoreSettings, Preemption
from rosrm.errors import ConfigError
from rosrm.extensions.units import (
    Amount,
    Count,
    Fraction,
    PositiveByteRate,
    PositiveCount,
    PositiveSeconds,
    Quantity,
    Seconds,
)
from rosrm.keys.roles import SecurityMode, default_security
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import weighted

#: Default launcher of containers.
DEFAULT_ENGINE: Final = "podman"
#: Default upper limits: memory as in the paper, CPU and disk with a reserve.
DEFAULT_LIMITS: Final[Mapping[str, float]] = {"memory": 0.8, "cpu": 0.9, "disk": 0.9}

_CORE: Final = CoreSettings()

Options = Annotated[Mapping[str, Any], NullIsEmpty()]
Ros = Annotated[RosSettings, RosSection()]
Scope = Literal["machine", "cgroup", "slice"]


def default_state(name: str, role: str) -> Path:
    """Return the default state directory of a master or slave of a name."""
    return default_states() / name / role


def place_of_name(settings: HostConfig) -> Path:
    """Return the directory that keeps the first name of a host."""
    by_default = settings.state == default_state(settings.host, "slave")
    return default_states() if by_default else settings.state


def default_scope() -> Scope:
    """Return the default scope of a slave's probes: ROSRM_SCOPE, or "machine".

    Raises:
        ConfigError: the variable has a value that is not allowed.
    """
    scopes: Mapping[str, Scope] = {"machine": "machine", "cgroup": "cgroup"}
    text = os.environ.get("ROSRM_SCOPE") or "machine"
    if text not in scopes:
        raise ConfigError(f"ROSRM_SCOPE={text!r}; allowed: {', '.join(scopes)}")
    return scopes[text]


# --- cluster.yaml -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ScoringChoice:
    """A scoring policy, alone or as a link of a chain.

    Attributes:
        policy: its name.
        weight: factor of its scores in the sum of the chain; 0: only its vetoes count.
        options: its options.
    """

    policy: str = "weighted"
    weight: Annotated[float, Quantity(high=1e6)] = 1.0
    options: Options = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class CheckpointPolicySettings:
    """Name and options of the policy for replicas on other hosts; None: no replication."""

    policy: str | None = "other-host"
    options: Options = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class MigrationSettings:
    """Migration strategies and the limits on migrations.

    Attributes:
        strategies: names that specs may use, with their options; the first is preferred.
        cooldown: seconds after a migration in which the master does not migrate the process again
            without a request.
        hysteresis: seconds for which a host must be over a limit before the master evicts a
            process.
        headroom: fraction by which a destination stays under each of its limits.
        need: need by which the master chooses a destination. "measured": the larger one of the
            process's need and its measured usage; "declared": its need as at its first placement.
        max_in_flight: highest number of migrations in flight.
        automatic: True: the master evicts processes from hosts that are over a limit.
    """

    strategies: Annotated[Mapping[str, Options], OptionsByName()] = field(
        default_factory=lambda: {"relaunch": {}, "handoff": {}, "lifecycle_node": {}}
    )
    cooldown: Seconds = _CORE.cooldown
    hysteresis: Seconds = _CORE.hysteresis
    headroom: Fraction = _CORE.headroom
    need: Literal["measured", "declared"] = _CORE.need
    max_in_flight: PositiveCount = _CORE.max_migrations
    automatic: bool = _CORE.automatic


@dataclass(frozen=True, slots=True)
class QueueSettings:
    """Order of the queue.

    Attributes:
        backfill: True: processes may be placed before an earlier one that waits for room.
        max_processes: most processes that have not ended; more are refused.
        preemption: "move": processes of lower priorities move to make room for a process that fits
            nowhere; "requeue": those that cannot move wait in the queue again; False: neither.
    """

    backfill: bool = _CORE.backfill
    preemption: Preemption = _CORE.preemption
    max_processes: PositiveCount = _CORE.max_processes


@dataclass(frozen=True, slots=True)
class RebalanceSettings:
    """Moves that even out the load of the hosts.

    Attributes:
        automatic: True: the master begins them itself; False: only `rosrm rebalance` does.
        spread: difference between the loads of two hosts, as fractions of their limits, from which
            on the master begins a round.
        after: seconds for which the difference must last, and between two rounds; a host that joins
            does not wait for it.
        max_moves: most processes that move in one round.
    """

    automatic: bool = _CORE.rebalance
    spread: Fraction = _CORE.rebalance_spread
    after: Seconds = _CORE.rebalance_after
    max_moves: PositiveCount = _CORE.rebalance_moves


@dataclass(frozen=True, slots=True)
class Quota:
    """Limits on the processes of one user that have not ended, all together.

    Attributes:
        processes: most processes.
        memory: largest sum of their memory needs, in bytes.
        cpu: largest sum of their CPU needs, in cores.
    """

    processes: Count | None = None
    memory: Annotated[float, Quantity("size")] | None = None
    cpu: Annotated[float, Quantity("cores")] | None = None

    def limits(self) -> Mapping[str, float]:
        """Return the given limits by name."""
        return {name: limit for name, limit in to_plain(self).items() if limit is not None}


@dataclass(frozen=True, slots=True)
class ProcessDefaults:
    """Default demand of processes.

    Attributes:
        needs: amounts by resource, for a process without declared or learned needs.
        settle: seconds after which an estimate no longer counts as load of its host.
        process: values of the fields that the submitter of a process leaves out; its name and
            program are of no meaning. None: there are none.
    """

    needs: Mapping[str, Amount] = field(default_factory=lambda: dict(_CORE.default_needs))
    settle: Seconds = _CORE.settle
    process: Annotated[ProcessSpec | None, ProcessSection()] = None


@dataclass(frozen=True, slots=True)
class LivenessSettings:
    """Time limits for silent hosts.

    Attributes:
        suspect: seconds without contact after which a host gets no new work.
        lease: seconds without contact after which a host is lost.
    """

    suspect: PositiveSeconds = _CORE.suspect
    lease: PositiveSeconds = _CORE.lease


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """Times of the messages between master and slaves.

    Attributes:
        max_age: seconds, by the receiver's clock, after which a request is refused as stale.
        beat_period: seconds between the master's beats.
        order_retry: seconds after which an unanswered order is sent again.
    """

    max_age: PositiveSeconds = 5.0
    beat_period: PositiveSeconds = 0.2
    order_retry: PositiveSeconds = _CORE.order_retry


@dataclass(frozen=True, slots=True)
class ApplicationSettings:
    """Treatment of applications.

    Attributes:
        progress_deadline: seconds for which a service may wait for a host before the version of its
            application fails; 0: no limit.
    """

    progress_deadline: Seconds = _CORE.progress_deadline


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Measurement of links between hosts, and of flows between processes.

    Attributes:
        period: seconds between two measurements of the links of a host; 0: no measurements.
        learn: True: slaves measure the flows that processes receive, each at most 1 % of a core.
    """

    period: Seconds = _CORE.link_period
    learn: bool = _CORE.learn_flows


@dataclass(frozen=True, slots=True)
class JournalSettings:
    """Durable journal of events and intents.

    Attributes:
        sync: "normal" survives a SIGKILL of the master, "full" also a power failure.
        keep_events: number of the newest events that are not deleted.
        keep_bytes: most bytes of the events; refusals get a tenth of both bounds at most.
        keep_ended: number of the newest terminal processes that are not garbage-collected.
        keep_versions: number of the newest versions of each application that are kept.
    """

    sync: Literal["normal", "full"] = "normal"
    keep_events: PositiveCount = 100_000
    keep_bytes: Annotated[int, Quantity("size", low=1_000_000, whole=True)] = 200_000_000
    keep_ended: PositiveCount = _CORE.keep_ended
    keep_versions: PositiveCount = _CORE.keep_versions


@dataclass(frozen=True, slots=True)
class ArtifactStoreSettings:
    """Contents of artifacts at the master, from which slaves fetch them.

    Attributes:
        max_size: most bytes of all contents together.
        max_rate: highest rate at which the master receives and sends contents, all together, in
            bytes a second.
    """

    max_size: Annotated[int, Quantity("size", low=1_000_000, whole=True)] = 10_000_000_000
    max_rate: Annotated[int, Quantity("size", low=1_000_000, whole=True)] = 25_000_000


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Recording of a master's run, for `rosrm simulate`.

    Attributes:
        directory: directory of the files, one for each run; empty: no recording.
        max_size: largest size of a file in bytes; then the recording ends, and the master runs on.
        keep: number of the newest files that are not deleted.
    """

    directory: Path = Path()
    max_size: Annotated[int, Quantity("size", low=65536, whole=True)] = 256_000_000
    keep: PositiveCount = 3


@dataclass(frozen=True, slots=True)
class ClusterConfig:
    """Settings of a master (`cluster.yaml`).

    Attributes:
        name: name of the cluster and its master.
        ros: domain, discovery and transports.
        security: "keys": accept only messages of principals with a key; "none": accept all.
        state: state directory of the master; by default under XDG_STATE_HOME.
        scoring: policies that order the hosts that fit by the weighted sum of their scores.
        filters: names of placement filters of plugins, with their options.
        migration: strategies and limits of migrations.
        queue: order of the queue.
        rebalance: moves that even out the load of the hosts.
        quotas: limits by name of a user; "default" applies to users without an entry, and to
            limits that an entry does not give.
        defaults: default needs of processes.
        liveness: time limits for silent hosts.
        control: times of messages.
        applications: treatment of applications.
        network: measurement of links and flows.
        journal: journal of events and intents.
        record: recording of all events that the master receives, for replay.
        diagnostics: publish the statuses of hosts and processes on `/diagnostics`.
        artifacts: contents of artifacts, which slaves fetch from the master.
        checkpoint: policy that places replicas of snapshots on other hosts, if any.
        delivery_timeout: seconds within which a slave must accept an assignment.
        max_hosts: most hosts, also of those that left or are lost; more are refused.
    """

    name: str = "rosrm"
    ros: Ros = field(default_factory=RosSettings)
    security: SecurityMode = field(default_factory=default_security)
    state: Path = Path()
    scoring: Annotated[tuple[ScoringChoice, ...], OneOrMore(ScoringChoice)] = field(
        default_factory=lambda: (ScoringChoice(),)
    )
    filters: Annotated[Mapping[str, Options], OptionsByName()] = field(
        default_factory=lambda: EMPTY
    )
    migration: MigrationSettings = field(default_factory=MigrationSettings)
    queue: QueueSettings = field(default_factory=QueueSettings)
    rebalance: RebalanceSettings = field(default_factory=RebalanceSettings)
    quotas: Mapping[str, Quota] = field(default_factory=lambda: EMPTY)
    defaults: ProcessDefaults = field(default_factory=ProcessDefaults)
    liveness: LivenessSettings = field(default_factory=LivenessSettings)
    control: ControlSettings = field(default_factory=ControlSettings)
    applications: ApplicationSettings = field(default_factory=ApplicationSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    journal: JournalSettings = field(default_factory=JournalSettings)
    record: RecordSettings = field(default_factory=RecordSettings)
    diagnostics: bool = True
    artifacts: ArtifactStoreSettings = field(default_factory=ArtifactStoreSettings)
    checkpoint: CheckpointPolicySettings = field(default_factory=CheckpointPolicySettings)
    delivery_timeout: PositiveSeconds = _CORE.delivery_timeout
    max_hosts: PositiveCount = _CORE.max_hosts

    def __post_init__(self) -> None:
        """Set the default of the state directory, which depends on the name."""
        if self.state == Path():
            object.__setattr__(self, "state", default_state(self.name, "master"))

    @property
    def chain(self) -> str:
        """Return the scoring policies as text: "weighted + 0.5 x network"."""
        return " + ".join(weighted(one.policy, one.weight) for one in self.scoring)

    def core(self) -> CoreSettings:
        """Return the part of the settings that the master's core uses."""
        return CoreSettings(
            backfill=self.queue.backfill,
            default_needs=self.defaults.needs,
            settle=self.defaults.settle,
            process_defaults=self.defaults.process,
            suspect=self.liveness.suspect,
            lease=self.liveness.lease,
            delivery_timeout=self.delivery_timeout,
            cooldown=self.migration.cooldown,
            hysteresis=self.migration.hysteresis,
            headroom=self.migration.headroom,
            need=self.migration.need,
            max_migrations=self.migration.max_in_flight,
            automatic=self.migration.automatic,
            link_period=self.network.period,
            learn_flows=self.network.learn,
            preemption=self.queue.preemption,
            rebalance=self.rebalance.automatic,
            rebalance_spread=self.rebalance.spread,
            rebalance_after=self.rebalance.after,
            rebalance_moves=self.rebalance.max_moves,
            order_retry=self.control.order_retry,
            progress_deadline=self.applications.progress_deadline,
            keep_ended=self.journal.keep_ended,
            keep_versions=self.journal.keep_versions,
            max_hosts=self.max_hosts,
            max_processes=self.queue.max_processes,
            quotas={
                name if name == DEFAULT_QUOTA else f"user:{name}": quota.limits()
                for name, quota in self.quotas.items()
            },
        )

    def to_json(self) -> str:
        """Return the settings as JSON for the master's runtime."""
        return json.dumps(to_plain(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> ClusterConfig:
        """Return the settings from the result of `to_json`; raises `ValueError`."""
        return from_plain(cls, json.loads(text))


# --- host.yaml --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LogSettings:
    """Logs of the processes.

    Attributes:
        max_bytes: size at which a log file is rotated.
        keep: number of rotated files beside the current one.
        keep_bytes: most bytes of all logs on this host; beyond, logs of the processes that were
            started longest ago are removed. Current files of running processes stay.
    """

    max_bytes: Annotated[int, Quantity("size", low=4096, whole=True)] = 10_000_000
    keep: Annotated[int, Quantity(high=1000, whole=True)] = 3
    keep_bytes: Annotated[int, Quantity("size", low=1_000_000, whole=True)] = 2_000_000_000


@dataclass(frozen=True, slots=True)
class KeepSettings:
    """Snapshots of stateful processes, and replicas for other hosts.

    Attributes:
        every: seconds by which a node's snapshot on this host may be older than its state.
        max_bytes: largest total size, in bytes, of replicas of other hosts' processes on this host.
        max_rate: highest total rate of transfers to other hosts, in bytes a second.
        wait: seconds for which a start waits for each host with a newer snapshot to answer.
    """

    every: Seconds = 1.0
    max_bytes: Annotated[int, Quantity("size", low=0, whole=True)] = 1_000_000_000
    max_rate: Annotated[int, Quantity("size", low=65536, whole=True)] = 10_000_000
    wait: Seconds = 10.0


@dataclass(frozen=True, slots=True)
class ArtifactCacheSettings:
    """Artifacts of processes on this host.

    Attributes:
        max_size: most bytes of all artifacts; beyond, those that were used longest ago are removed.
    """

    max_size: Annotated[int, Quantity("size", low=1_000_000, whole=True)] = 2_000_000_000


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Links of this host to other hosts.

    Attributes:
        rate: bytes a second that each link can carry; None: the speed of its network interface.
        rates: bytes a second by name of the other host, for links with another rate.
        limit: fraction of these rates that flows of processes may use.
        port: UDP port for the packets that measure round trips; 0: any free one.
    """

    rate: PositiveByteRate | None = None
    rates: Mapping[str, PositiveByteRate] = field(default_factory=lambda: EMPTY)
    limit: Fraction = 1.0
    port: Annotated[int, Quantity(high=65535, whole=True)] = 0


@dataclass(frozen=True, slots=True)
class HostControlSettings:
    """Times of the requests to a slave.

    Attributes:
        max_age: seconds, by the slave's clock, after which a request is refused as stale; at
            least three periods of readings.
    """

    max_age: PositiveSeconds = 5.0


@dataclass(frozen=True, slots=True)
class HostConfig:
    """Settings of a slave (`host.yaml`).

    Attributes:
        host: name of the host; each name has at most one live slave. The default is the first name
            of the machine.
        ros: domain, discovery and transports.
        security: "keys" or "none"; the same as that of the master.
        state: state directory of the slave; by default under XDG_STATE_HOME.
        labels: labels that processes may require, prefer or avoid.
        scope: scope of the probes: the machine, the cgroup of the slave, or the process trees of
            the slave's processes against `budget`.
        budget: amounts by resource that correspond to usage 1.0 in the scope "slice".
        limits: upper limits, fractions by resource; a resource without a limit has the default.
        rate: rate of `resource_info` in Hz.
        probes: names of the chosen probes, with their options; None: the default ones.
        strategies: this host's own options of migration strategies, by name.
        max_processes: highest number of running processes; 0: no limit.
        max_starting: highest number of processes that are starting and not ready; 0: no limit.
        logs: logs of the processes.
        devices: units of devices by kind, which the host gives to its processes; of a kind that is
            not here, those that the probes find.
        control: times of requests.
        keep: snapshots and replicas.
        links: links to other hosts.
        artifacts: cache of the artifacts of processes.
        on_stop: "stop": a slave that is stopped stops its processes; "keep": it leaves them running
            under the supervisor.
        textfile: directory in which the slave writes metrics of its host; empty: it writes none.
    """

    host: str = field(default_factory=default_host)
    ros: Ros = field(default_factory=RosSettings)
    security: SecurityMode = field(default_factory=default_security)
    state: Path = Path()
    labels: Mapping[str, Annotated[str, PlainWord()]] = field(default_factory=lambda: EMPTY)
    scope: Scope = field(default_factory=default_scope)
    budget: Mapping[str, Amount] = field(default_factory=lambda: EMPTY)
    limits: Mapping[str, Fraction] = field(default_factory=lambda: dict(DEFAULT_LIMITS))
    rate: Annotated[float, Quantity(low=0.1, high=1000.0, hint="Hz")] = 10.0
    probes: Annotated[Mapping[str, Options] | None, OptionsByName()] = None
    strategies: Annotated[Mapping[str, Options], OptionsByName()] = field(
        default_factory=lambda: EMPTY
    )
    max_processes: Count = 0
    max_starting: Count = 8
    logs: LogSettings = field(default_factory=LogSettings)
    control: HostControlSettings = field(default_factory=HostControlSettings)
    keep: KeepSettings = field(default_factory=KeepSettings)
    links: LinkSettings = field(default_factory=LinkSettings)
    artifacts: ArtifactCacheSettings = field(default_factory=ArtifactCacheSettings)
    on_stop: Literal["stop", "keep"] = "stop"
    devices: OfferedByKind = field(default_factory=lambda: EMPTY)
    textfile: Path = Path()

    def __post_init__(self) -> None:
        """Set the default of `state`, which depends on the name, limits, and kinds of devices."""
        object.__setattr__(self, "devices", with_kinds(self.devices))
        if self.state == Path():
            object.__setattr__(self, "state", default_state(self.host, "slave"))
        object.__setattr__(self, "limits", {**DEFAULT_LIMITS, **self.limits})

    @property
    def period(self) -> float:
        """Return the period of `resource_info` in seconds."""
        return 1.0 / self.rate

    def to_json(self) -> str:
        """Return the settings as JSON for the slave's runtime."""
        return json.dumps(to_plain(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> HostConfig:
        """Return the settings from the result of `to_json`; raises `ValueError`."""
        return from_plain(cls, json.loads(text))
