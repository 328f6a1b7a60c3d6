"""Values of the core: processes, instances, hosts, resources.

Seconds, bytes and fractions 0..1 are the base units. All values are frozen; mutable state is in
`rosrm.core`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, Literal

#: Slots of a `resource_info` message: most resources of one host.
RESOURCE_SLOTS: Final = 16
#: A usage above this is an error, not a measurement (a CPU reading of 1.2 can be real).
ABSURD_USAGE: Final = 64.0
#: More than this of a resource (base units), used by one process, is an error, not a measurement.
MOST_USED: Final[Mapping[str, float]] = MappingProxyType({"cpu": 65_536.0, "memory": 2.0**53})
#: Seconds: no run, delay or deadline is longer (10 years).
LONGEST_TIME: Final = 3.2e8
#: Instance numbers and journal records grow one by one, and so never get as large as this.
LARGEST_NUMBER: Final = 2**53

EMPTY: Final[Mapping[str, Any]] = MappingProxyType({})

RestartCondition = Literal["never", "on-failure", "always"]
ReadinessKind = Literal["auto", "graph", "running"]
HostLossAction = Literal["wait", "elsewhere", "stop"]
IsolationAction = Literal["keep", "stop"]


class Kind(str, Enum):
    """Duration of a process: until it is stopped (service), or until its own end (job)."""

    SERVICE = "service"
    JOB = "job"


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """Restart of an ended process on its host, with a bounded back-off.

    Attributes:
        delay: seconds before the first restart.
        max_delay: bound of the back-off, seconds.
        factor: by which the delay grows with each restart.
        attempts: most restarts within `window`; one more and the process has failed.
        window: seconds; after as long without a restart, the count begins at 0 again.
    """

    when: RestartCondition = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


@dataclass(frozen=True, slots=True)
class Readiness:
    """Condition under which an instance counts as ready.

    Attributes:
        kind: "graph" (this instance is seen in the ROS graph), "running" (the process runs), or
            "auto": "graph" for a ROS node, "running" for everything else.
        timeout: seconds; not ready by then, the start has failed.
    """

    kind: ReadinessKind = "auto"
    timeout: float = 30.0


#: Seconds beyond a process's own grace, for the signal, the report and the message.
_STOP_MARGIN: Final = 5.0


@dataclass(frozen=True, slots=True)
class StopPolicy:
    """Stop of a process: SIGINT, then SIGTERM, then SIGKILL, to its whole process group.

    Attributes:
        interrupt_grace: seconds between SIGINT and SIGTERM.
        terminate_grace: seconds between SIGTERM and SIGKILL.
    """

    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0

    @property
    def timeout(self) -> float:
        """Return the seconds from the order to stop until the end must be reported."""
        return self.interrupt_grace + self.terminate_grace + _STOP_MARGIN


@dataclass(frozen=True, slots=True)
class MigrationPolicy:
    """Migration of a process to another host.

    Attributes:
        strategy: name of a migration strategy; None: it is never moved.
        overlap: a stateless relaunch may run both instances for a moment (start first).
        options: the strategy's own options for this process.
    """

    strategy: str | None = None
    overlap: bool = True
    options: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class HostLossPolicy:
    """Treatment of a process when its host is lost.

    Attributes:
        then: "wait" for the host, go "elsewhere" (as soon as a host has room; the host keeps it if
            it rejoins before), or "stop": it has failed.
        delay: seconds after the loss until that is done.
    """

    then: HostLossAction = "wait"
    delay: float = 0.0


@dataclass(frozen=True, slots=True)
class IsolationPolicy:
    """Treatment of a process while its host and the master have no contact.

    Attributes:
        then: "keep" it running, or "stop" it.
        after: seconds; 0: so soon that it has ended when a successor starts elsewhere.
    """

    then: IsolationAction = "keep"
    after: float = 0.0


@dataclass(frozen=True, slots=True)
class StandbyPolicy:
    """Standby of a process: a second instance on another host that follows the state.

    The standby takes over at once when the primary ends.

    Attributes:
        apart_by: host labels in which the host of the standby differs from that of the primary.
    """

    wanted: bool = False
    apart_by: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Health:
    """Health checks of a running process; one that fails them has failed.

    Attributes:
        topic: that must be published at `rate`; "": none.
        rate: Hz, at least.
        lifecycle: state in which its lifecycle node must be; "": not checked.
        timeout: seconds for which a check may fail; 0: health is not watched.
    """

    topic: str = ""
    rate: float = 0.0
    lifecycle: str = ""
    timeout: float = 0.0


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process to run, in the terms of ROS 2 launch.

    Exactly one of `package` with `executable`, `module` and `command` is given.

    Attributes:
        name: unique among live processes; the node's name where it is a ROS node.
        namespace: of the node; "" or absolute.
        parameters: ROS parameters, values as in JSON.
        remappings: ROS name to ROS name.
        ros: it is a ROS node and gets its name, namespace, parameters and remappings; None, which
            becomes a boolean: True for an executable of a ROS package.
        needs: declared amounts by resource name, in base units.
        required_labels: host labels without which a host may never take it.
        preferred_labels: among hosts that fit, those with more of these go first.
        avoided_labels: hosts with any of these are taken only when no other fits.
        priority: higher goes first.
    """

    name: str
    namespace: str = ""
    package: str | None = None
    executable: str | None = None
    module: str | None = None
    command: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=lambda: EMPTY)
    remappings: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    environment: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    working_directory: str | None = None
    ros: bool | None = None
    kind: Kind = Kind.SERVICE
    restart: RestartPolicy = RestartPolicy()
    needs: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    required_labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    preferred_labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    avoided_labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    priority: int = 0
    migration: MigrationPolicy = MigrationPolicy()
    readiness: Readiness = Readiness()
    stop: StopPolicy = StopPolicy()
    host_loss: HostLossPolicy = HostLossPolicy()
    isolation: IsolationPolicy = IsolationPolicy()
    standby: StandbyPolicy = StandbyPolicy()
    health: Health = Health()

    def __post_init__(self) -> None:
        """Set the default of `ros`, which depends on `package`."""
        if self.ros is None:
            object.__setattr__(self, "ros", self.package is not None)

    @property
    def program(self) -> str:
        """Return the program as one text: the key under which its needs are learned."""
        if self.package is not None:
            return f"{self.package}/{self.executable}"
        if self.module is not None:
            return f"python -m {self.module}"
        return " ".join(self.command)


@dataclass(frozen=True, slots=True, order=True)
class InstanceId:
    """One run of a process on one host.

    Attributes:
        process: name of the process.
        number: grows with each assignment in the whole cluster and is never used again.
    """

    process: str
    number: int

    def __str__(self) -> str:
        return f"{self.process}#{self.number}"


@dataclass(frozen=True, slots=True)
class Fence:
    """Deadline at which a host without contact stops an instance, by its own clock.

    Attributes:
        after: seconds since the last contact: the newest time at which the master received from it.
        grace: seconds from there until SIGKILL at the latest.
        alive: a running slave counts as contact, even without beats.
    """

    after: float
    grace: float
    alive: bool = False


@dataclass(frozen=True, slots=True)
class Assignment:
    """An order to run an instance of a process.

    Attributes:
        epoch: of the master that gave it.
        node_name: name of its node; differs from the process's name in a handoff.
        shadow: it starts as the destination of a handoff: silent, and not restarted until an order
            to its slave allows it.
        fence: deadline at which its host stops it without contact to the master; None: never.
        kept_on: hosts with a snapshot of the process, the newest first.
        kept_from: snapshots of instances with a lower number belong to an earlier process of the
            name; 0: its node publishes no state, and there are none.
        restored: it starts from the image of a former instance on the host, and is not restarted
            until an order to its slave allows it.
    """

    instance: InstanceId
    spec: ProcessSpec
    epoch: int
    node_name: str
    shadow: bool = False
    fence: Fence | None = None
    kept_on: tuple[str, ...] = ()
    kept_from: int = 0
    restored: bool = False

    @property
    def has_snapshots(self) -> bool:
        """Return True if its node publishes a state of which snapshots are kept."""
        return self.kept_from > 0

    @property
    def on_trial(self) -> bool:
        """Return True for the destination of a migration that may still fail."""
        return self.shadow or self.restored


class InstanceState(str, Enum):
    """State of an instance as its slave reports it."""

    HELD = "held"
    STARTING = "starting"
    RUNNING = "running"
    READY = "ready"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    EXITED = "exited"
    FAILED = "failed"
    REFUSED = "refused"
    FENCED = "fenced"
    WITHDRAWN = "withdrawn"

    @property
    def ended(self) -> bool:
        """Return True if the slave holds no process for it and will start none."""
        return self in _ENDED


_ENDED: Final = frozenset(
    {
        InstanceState.EXITED, InstanceState.FAILED, InstanceState.REFUSED, InstanceState.FENCED,
        InstanceState.WITHDRAWN,
    }
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class InstanceStatus:
    """Status of one instance on its slave.

    Attributes:
        pid: of the session leader; 0: none.
        exit_code: of the last run, where no signal ended it; -1: its end was not seen.
        exit_signal: that ended the last run; 0: none.
        restarts: by the restart policy on this host.
        peak_memory: bytes, of the last run; 0: not known.
        cpu_time: seconds of CPU of the last run.
        run_time: seconds from start to end of the last run.
        message: why it failed or was refused, as text.
    """

    instance: InstanceId
    state: InstanceState
    pid: int = 0
    exit_code: int = 0
    exit_signal: int = 0
    restarts: int = 0
    peak_memory: float = 0.0
    cpu_time: float = 0.0
    run_time: float = 0.0
    message: str = ""

    @property
    def known_exit(self) -> int | None:
        """Return the exit code of the last run, or its signal as a negative number.

        None: the end was not seen, or the instance never ran.
        """
        if self.exit_signal:
            return -self.exit_signal
        ran = self.exit_code > 0 or (self.exit_code == 0 and self.run_time > 0.0)
        return self.exit_code if ran else None

    @property
    def succeeded(self) -> bool:
        """Return True if it has exited with code 0 and without a signal."""
        return self.state is InstanceState.EXITED and not (self.exit_code or self.exit_signal)


@dataclass(frozen=True, slots=True)
class SnapshotReport:
    """A snapshot of a process on a host.

    Attributes:
        instance: whose snapshot it is.
        sequence: cycles that it covers.
        size: bytes.
    """

    instance: InstanceId
    sequence: int
    size: int


@dataclass(frozen=True, slots=True)
class ResourceDescription:
    """One resource of a host.

    Attributes:
        name: "memory", "cpu", "disk", ...
        unit: base unit of `capacity`: "B", "core", "B/s", "1".
        capacity: what usage 1.0 stands for, > 0.
        scope: of the measurement: "machine", "cgroup", "slice" or a name that the probe defines.
    """

    name: str
    unit: str
    capacity: float
    scope: str = "machine"


@dataclass(frozen=True, slots=True)
class Reading:
    """The utilisation of one resource at one time.

    Attributes:
        resource: name of the resource.
        usage: fraction of its capacity, 0..1 (above 1 where a budget is exceeded).
    """

    resource: str
    usage: float


@dataclass(frozen=True, slots=True)
class HostDescription:
    """Facts about a host that do not change while its slave runs.

    Attributes:
        name: unique among live slaves.
        incarnation: random number of this run of the slave.
        resources: at most RESOURCE_SLOTS; the position is the slot in `resource_info`.
        max_processes: most processes held at a time; 0: no bound.
        period: of `resource_info`, seconds.
        executors: that plugins offer for the open step of a plan.
        absent: probe name to the reason why it is absent here.
    """

    name: str
    incarnation: int
    hostname: str = ""
    pid: int = 0
    software_version: str = ""
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    resources: tuple[ResourceDescription, ...] = ()
    max_processes: int = 0
    period: float = 0.1
    executors: tuple[str, ...] = ()
    absent: Mapping[str, str] = field(default_factory=lambda: EMPTY)
