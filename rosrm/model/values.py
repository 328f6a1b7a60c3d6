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

from rosrm.model.adoption import NO_ADOPTION, Adoption
from rosrm.model.arrays import NO_ARRAY, ArrayMembership
from rosrm.model.artifacts import Artifact, fetch_time
from rosrm.model.devices import Device, DeviceNeed, HeldDevice
from rosrm.model.schedules import NO_SCHEDULE, Schedule

#: Slots of a `resource_info` message: highest number of resources of one host.
RESOURCE_SLOTS: Final = 16
#: A usage above this is an error, not a measurement (a CPU reading of 1.2 can be real).
ABSURD_USAGE: Final = 64.0
#: More than this of a resource (base units), used by one process, is an error, not a measurement.
MOST_USED: Final[Mapping[str, float]] = MappingProxyType({"cpu": 65_536.0, "memory": 2.0**53})
#: The same of each other resource.
MOST_USED_OF_OTHERS: Final = 2.0**53
#: Instance numbers and journal records grow one by one, and so never get as large as this.
LARGEST_NUMBER: Final = 2**53
#: Greatest rate of a flow or a link, in B/s.
LARGEST_RATE: Final = 1e15

#: `node_name` of a program whose nodes keep the names that it gives them.
KEEP_NAME: Final = "keep"
#: Pattern of all nodes in a source of parameters.
ALL_NODES: Final = "/**"

EMPTY: Final[Mapping[str, Any]] = MappingProxyType({})

RestartCondition = Literal["never", "on-failure", "always"]
ReadinessKind = Literal["auto", "graph", "running"]
HostLossAction = Literal["wait", "elsewhere", "stop"]
IsolationAction = Literal["keep", "stop"]
#: How the reservation of a need for a resource ends; see the reference of plugins.
Accounting = Literal["attributed", "shared", "countable"]
Relation = Literal["near", "apart"]
Enforcement = Literal["preferred", "required"]
StartCondition = Literal["ready", "finished"]
DependencyRestartAction = Literal["ignore", "restart"]
#: Ends of a process after which the others of its group are cancelled: none, failures, or all.
GroupEnd = Literal["never", "on-failure", "always"]
#: "": the default scheduling of the operating system.
RealtimePolicy = Literal["", "fifo", "rr"]
#: State to which a slave brings a lifecycle node; "unmanaged": it does not.
Autostart = Literal["active", "inactive", "unmanaged"]
LifecycleGoal = Literal["active", "inactive"]


class Kind(str, Enum):
    """Kind of a process: it runs until it is stopped (service), or to completion (job)."""

    SERVICE = "service"
    JOB = "job"


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """Restart of an ended process on its host, with a bounded back-off.

    Attributes:
        delay: seconds before the first restart.
        max_delay: upper bound of the delay, seconds.
        factor: factor by which the delay grows with each restart.
        attempts: highest number of restarts within `window`; after them the process has failed.
        window: seconds for which a restart counts.
    """

    when: RestartCondition = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


@dataclass(frozen=True, slots=True)
class ReschedulePolicy:
    """Starts of a failed process on other hosts, once its restart policy has given up.

    Attributes:
        attempts: highest number of starts on other hosts; 0: the process has failed. A service
            counts from zero again after a run of `restart.window` or longer; a job never does.
        delay: seconds before each attempt.
    """

    attempts: int = 0
    delay: float = 0.0


@dataclass(frozen=True, slots=True)
class Readiness:
    """Condition under which an instance counts as ready.

    Attributes:
        kind: "graph" (its node is in the ROS graph), "running" (the process runs), or "auto":
            "graph" for a ROS node, "running" for other programs.
        timeout: seconds after which an instance that is not ready has failed.
    """

    kind: ReadinessKind = "auto"
    timeout: float = 30.0


#: Seconds beyond the graces of a process, for the order, the signals and the report.
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
        strategy: name of a migration strategy; None: the process never moves.
        overlap: True: a stateless relaunch may start the new instance before it stops the old one.
        options: options of the strategy for this process.
    """

    strategy: str | None = None
    overlap: bool = True
    options: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class HostLossPolicy:
    """Treatment of a process when its host is lost.

    Attributes:
        then: "wait" for the host; start "elsewhere" as soon as a host has room, unless the lost
            host rejoins before; or "stop": the process has failed.
        delay: seconds after the loss before `then` applies.
    """

    then: HostLossAction = "wait"
    delay: float = 0.0


@dataclass(frozen=True, slots=True)
class IsolationPolicy:
    """Treatment of a process while its host and the master have no contact.

    Attributes:
        then: "keep" the process running, or "stop" it.
        after: seconds without contact; 0: chosen so that the process has ended before a successor
            starts elsewhere.
    """

    then: IsolationAction = "keep"
    after: float = 0.0


@dataclass(frozen=True, slots=True)
class StandbyPolicy:
    """Standby of a process: a second instance on another host that follows the state.

    The standby takes over at once when the primary ends.

    Attributes:
        apart_by: host labels in which the hosts of primary and standby must differ.
    """

    wanted: bool = False
    apart_by: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class NeighbourRule:
    """Rule on the hosts of a process, relative to the hosts of other processes.

    Attributes:
        relation: "near": on the host of each of the others; "apart": on another host.
        processes: names of the others.
        group: name of a group; the others are all processes with a rule of this group; "": none.
        by: host label; hosts with the same value of it count as one place; "": each host is one.
        prefer: True: where the rule cannot be kept, the process runs elsewhere instead of waiting.
    """

    relation: Relation
    processes: tuple[str, ...] = ()
    group: str = ""
    by: str = ""
    prefer: bool = False

    @property
    def requires_near(self) -> bool:
        """True if the process must run near the others."""
        return self.relation == "near" and not self.prefer


@dataclass(frozen=True, slots=True)
class StartOrder:
    """Start of a process after other processes, its dependencies.

    Attributes:
        after: name of each dependency to its condition: "ready" (it is ready, or is a job that has
            finished) or "finished" (it ended with success).
        delay: seconds from the time since when all conditions hold to the start.
        on_restart: "restart": when a dependency was restarted, the process is restarted in place as
            soon as all conditions hold again; "ignore": it runs on.
    """

    after: Mapping[str, StartCondition] = field(default_factory=lambda: EMPTY)
    delay: float = 0.0
    on_restart: DependencyRestartAction = "ignore"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a process that its host enforces; 0: no limit.

    Attributes:
        memory: bytes above which the kernel kills the process.
        memory_high: bytes above which the kernel slows the process and reclaims its memory.
        cpu: cores; above them the process waits.
        enforce: "required": a host that cannot enforce limits and scheduling does not run the
            process; "preferred": such a host runs it without.
    """

    memory: float = 0.0
    memory_high: float = 0.0
    cpu: float = 0.0
    enforce: Enforcement = "preferred"


@dataclass(frozen=True, slots=True)
class Amendment:
    """Changes of an instance that runs on.

    Attributes:
        limits: None: they stay.
    """

    restart: RestartPolicy
    limits: Limits | None = None

    def after(self, former: Amendment | None) -> Amendment:
        """Return the amendment that has the effect of a former one and of this one."""
        kept = former.limits if former is not None and self.limits is None else self.limits
        return Amendment(self.restart, kept)


@dataclass(frozen=True, slots=True)
class Realtime:
    """Real-time scheduling of a process.

    Attributes:
        policy: "": none.
        priority: 1..99; 0: no policy is given.
    """

    policy: RealtimePolicy = ""
    priority: int = 0


@dataclass(frozen=True, slots=True)
class Health:
    """Health checks of a running process; an unhealthy process has failed.

    Attributes:
        topic: topic that the node must publish; "": no check.
        rate: lowest rate of the topic, in Hz.
        lifecycle: required state of the lifecycle node; "": no check.
        timeout: seconds for which a check may fail; 0: no checks.
    """

    topic: str = ""
    rate: float = 0.0
    lifecycle: str = ""
    timeout: float = 0.0


@dataclass(frozen=True, slots=True)
class LifecyclePolicy:
    """Transitions of a lifecycle node by its slave, after each start and each restart.

    Attributes:
        autostart: state to which the slave brings the node; "unmanaged": it does not.
        timeout: seconds for each transition.
    """

    autostart: Autostart = "unmanaged"
    timeout: float = 30.0

    @property
    def is_managed(self) -> bool:
        """Return True if the slave brings the node to a state."""
        return self.autostart != "unmanaged"

    @property
    def total_timeout(self) -> float:
        """Return the seconds for all transitions after a start."""
        transitions = {"unmanaged": 0, "inactive": 1, "active": 2}[self.autostart]
        return transitions * self.timeout


@dataclass(frozen=True, slots=True)
class GroupMembership:
    """Membership of a process in a group, whose processes end together.

    Attributes:
        name: name of the group among those of one user; "": the process is in no group.
        ends: ends of this process after which the others of the group are cancelled.
    """

    name: str = ""
    ends: GroupEnd = "never"


@dataclass(frozen=True, slots=True)
class Container:
    """Container in which a process runs.

    Attributes:
        image: image as its engine names it; "": the process runs in no container.
        engine: launcher that starts the container; "": no image is given.
    """

    image: str = ""
    engine: str = ""


@dataclass(frozen=True, slots=True)
class ParameterSource:
    """ROS parameters of some nodes, or a file with parameters on the host of the process.

    Attributes:
        file: path of a ROS parameters file on the host; "": `parameters` are given.
        nodes: pattern of the nodes that get `parameters`: "/robot/planner", "/robot/*", "/**".
        parameters: by dotted names, values as in JSON.
    """

    file: str = ""
    nodes: str = ALL_NODES
    parameters: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class Component:
    """A node that a component container loads into its process.

    Attributes:
        plugin: name of the component in its package.
        name: of its node.
        package: package that has the component; "": the plugin says it alone.
        namespace: namespace of the node; "" or absolute.
        parameters: ROS parameters by dotted names, values as in JSON.
        remappings: ROS name to ROS name.
        arguments: extra arguments for the container, values as in JSON.
    """

    plugin: str
    name: str
    package: str = ""
    namespace: str = ""
    parameters: Mapping[str, Any] = field(default_factory=lambda: EMPTY)
    remappings: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    arguments: Mapping[str, Any] = field(default_factory=lambda: EMPTY)

    @property
    def full_name(self) -> str:
        """Return the name of its node with the namespace."""
        return qualified_name(self.namespace, self.name)


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process to run, in the terms of ROS 2 launch.

    Exactly one of `package` with `executable`, `module` and `command` is given.

    Attributes:
        name: unique among live processes.
        node_name: name of its ROS node; "": the name of the process; "keep": the program's own.
        namespace: namespace of the node; "" or absolute.
        prefix: words before the program in its command line.
        parameters: ROS parameters, values as in JSON.
        parameter_sources: further parameters; a later source overrides earlier ones.
        remappings: ROS name to ROS name.
        ros: True for a ROS node, which gets its name, namespace, parameters and remappings; None
            becomes True for an executable of a ROS package, else False.
        needs: declared amounts by resource name, in base units.
        required_labels: labels that a host must have to run the process.
        preferred_labels: of the hosts that fit, those with more of these labels are preferred.
        avoided_labels: a host with any of these labels is chosen only if no other host fits.
        priority: processes with a higher number are placed first.
        neighbours: rules on its hosts, relative to other processes.
        talks_to: name of another process to the bytes a second that flow between both.
        protect: True: it is neither moved nor stopped to make room for others.
        time_limit: seconds from the first start of a job on a host until the job has failed, with
            restarts and moves; its return to the queue begins them again. 0: no limit.
        cpus: numbers of the CPUs that it may use; (): all.
        nice: its niceness, -20..19; 0: that of the slave.
        devices: devices that it holds while it runs, each kind once.
        array: the array of a job, and its index there.
        schedule: times at which a job starts again.
        application: name of the application of which it is a part; "": it is a single process.
        start_order: the processes after which it starts.
        group: the group whose processes end together.
        together: name of its gang; all processes of a gang are placed at once; "": none.
        secrets: variable to the absolute path of a file on its host; each start sets the variable
            to the content of the file.
        container: container in which it runs.
        adoption: the running process that becomes its first instance; later ones are started.
        artifacts: files and directories that it gets on its host, in the order of their names.
        given: paths of the fields that the submitter gave, such as "restart.when"; the cluster's
            default applies to the others. Empty: the fields that differ from their defaults here.
    """

    name: str
    node_name: str = ""
    namespace: str = ""
    package: str | None = None
    executable: str | None = None
    module: str | None = None
    command: tuple[str, ...] = ()
    prefix: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=lambda: EMPTY)
    parameter_sources: tuple[ParameterSource, ...] = ()
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
    lifecycle: LifecyclePolicy = LifecyclePolicy()
    components: tuple[Component, ...] = ()
    neighbours: tuple[NeighbourRule, ...] = ()
    talks_to: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    reschedule: ReschedulePolicy = ReschedulePolicy()
    protect: bool = False
    time_limit: float = 0.0
    limits: Limits = Limits()
    cpus: tuple[int, ...] = ()
    realtime: Realtime = Realtime()
    nice: int = 0
    devices: tuple[DeviceNeed, ...] = ()
    array: ArrayMembership = NO_ARRAY
    schedule: Schedule = NO_SCHEDULE
    application: str = ""
    start_order: StartOrder = StartOrder()
    group: GroupMembership = GroupMembership()
    together: str = ""
    secrets: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    container: Container = Container()
    adoption: Adoption = NO_ADOPTION
    artifacts: tuple[Artifact, ...] = ()
    given: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Set the default of `ros`, which depends on `package`."""
        if self.ros is None:
            object.__setattr__(self, "ros", self.package is not None)

    @property
    def node(self) -> str:
        """Return the name that its ROS node gets; "": its nodes keep their own names."""
        return "" if self.node_name == KEEP_NAME else self.node_name or self.name

    @property
    def enforcement(self) -> tuple[str, ...]:
        """Return the names of its limits and scheduling settings for which a host needs rights."""
        settings = {
            "limits.memory": self.limits.memory, "limits.memory_high": self.limits.memory_high,
            "limits.cpu": self.limits.cpu, "realtime": self.realtime.policy, "nice": self.nice < 0,
        }  # fmt: skip
        return tuple(name for name, value in settings.items() if value)

    @property
    def awaits_graph(self) -> bool:
        """True if an instance is ready when its node appears, False as soon as it runs."""
        kind = self.readiness.kind
        return kind == "graph" or (kind == "auto" and bool(self.ros))

    @property
    def ready_timeout(self) -> float:
        """Return the seconds after which a run that is not ready has failed."""
        return self.readiness.timeout + self.lifecycle.total_timeout

    @property
    def fetch_time(self) -> float:
        """Return the seconds that a move adds to the time-out of a start, for the artifacts."""
        return fetch_time(self.artifacts)

    @property
    def program(self) -> str:
        """Return the program as one text: the key under which its needs are learned."""
        inside = f" in {self.container.image}" if self.container.image else ""
        if self.package is not None:
            return f"{self.package}/{self.executable}{inside}"
        if self.module is not None:
            return f"python -m {self.module}{inside}"
        return " ".join(self.command) + inside


def qualified_name(namespace: str, node_name: str) -> str:
    """Return a node's name with its namespace: `/robot/camera`."""
    inside = namespace.strip("/")
    return f"/{inside}/{node_name}" if inside else f"/{node_name}"


@dataclass(frozen=True, slots=True, order=True)
class InstanceId:
    """Id of an instance: one start of a process on one host.

    Attributes:
        process: name of the process.
        number: number that grows with each assignment in the cluster and is never used again.
    """

    process: str
    number: int

    def __str__(self) -> str:
        return f"{self.process}#{self.number}"


@dataclass(frozen=True, slots=True)
class Fence:
    """Deadline at which a host without contact stops an instance, by its own clock.

    Attributes:
        after: seconds since the last contact, at which the master received a message of the host.
        grace: seconds after that deadline until SIGKILL at the latest.
        alive: True: a running slave counts as contact, even without beats.
    """

    after: float
    grace: float
    alive: bool = False


@dataclass(frozen=True, slots=True)
class Assignment:
    """An order to run an instance of a process.

    Attributes:
        epoch: epoch of the master.
        node_name: name of its node; in a handoff an alias.
        shadow: True for the destination of a handoff: it starts silent, and is not restarted until
            an order to its slave allows restarts.
        fence: deadline at which its host stops it without contact to the master; None: never.
        snapshot_hosts: hosts with a snapshot of the process, the newest first.
        snapshots_from: lowest number of an instance with a valid snapshot; 0: the node publishes no
            state, and there are no snapshots.
        restored: True: it starts from the image of a former instance on the host, and is not
            restarted until an order to its slave allows restarts.
        state_key: key by which slaves encrypt the replicas of the process's snapshots; b"": they
            are not encrypted.
        devices: units of its host that it holds while it runs.
        inactive: True for the destination of a move whose lifecycle node is configured, and not
            activated until an order to its slave.
    """

    instance: InstanceId
    spec: ProcessSpec
    epoch: int
    node_name: str
    shadow: bool = False
    fence: Fence | None = None
    snapshot_hosts: tuple[str, ...] = ()
    snapshots_from: int = 0
    restored: bool = False
    state_key: bytes = field(default=b"", repr=False)
    devices: tuple[HeldDevice, ...] = ()
    inactive: bool = False

    @property
    def has_snapshots(self) -> bool:
        """Return True if its node publishes state that is stored in snapshots."""
        return self.snapshots_from > 0

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
        """Return True if no process of the instance runs, and none will."""
        return self in _ENDED


_ENDED: Final = frozenset(
    {
        InstanceState.EXITED, InstanceState.FAILED, InstanceState.REFUSED, InstanceState.FENCED,
        InstanceState.WITHDRAWN,
    }
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Run:
    """One run of an instance, from a start of its program to the next one.

    Attributes:
        pid: pid of the session leader; 0: it had not started, or had ended.
        restarts: number of restarts by the restart policy before it.
    """

    pid: int
    restarts: int

    def is_that_of(self, pid: int, restarts: int) -> bool:
        """Return False if a status with these values shows another run."""
        return restarts == self.restarts and pid in (0, self.pid)


@dataclass(frozen=True, slots=True)
class InstanceStatus:
    """Status of one instance on its slave.

    Attributes:
        pid: pid of the session leader; 0: none.
        exit_code: exit code of the last run without a signal; -1: the end was not observed.
        exit_signal: signal that ended the last run; 0: none.
        restarts: number of restarts by the restart policy on this host.
        peak_memory: peak memory of the last run in bytes; 0: unknown.
        cpu_time: CPU time of the last run in seconds.
        run_time: with a pid the seconds since the first start of the instance, by the boot clock of
            its host; otherwise from start to end of the last run.
        message: text on why it failed or was refused, or runs without its limits.
        enforced: names of the limits and scheduling settings that hold in this run.
        devices: devices of its host that it holds.
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
    enforced: tuple[str, ...] = ()
    devices: tuple[HeldDevice, ...] = ()

    @property
    def known_exit(self) -> int | None:
        """Return the exit code of the last run, or its signal as a negative number.

        None: the end was not observed, or the instance never ran.
        """
        if self.exit_signal:
            return -self.exit_signal
        ran = self.exit_code > 0 or (self.exit_code == 0 and self.run_time > 0.0)
        return self.exit_code if ran else None

    @property
    def succeeded(self) -> bool:
        """Return True if the instance has exited with code 0 and without a signal."""
        return self.state is InstanceState.EXITED and not (self.exit_code or self.exit_signal)


@dataclass(frozen=True, slots=True)
class SnapshotReport:
    """A snapshot of a process on a host.

    Attributes:
        instance: instance that wrote it.
        sequence: number of cycles that it covers.
        size: size in bytes.
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
        capacity: amount at usage 1.0, > 0.
        scope: scope of the measurement: "machine", "cgroup", "slice" or a name that the probe
            defines.
        accounting: end of the reservation of a declared need. "attributed": the usage of each
            process is measured, and replaces its reservation. "shared": the readings include the
            usage once the process is ready for a while, and the reservation ends then. "countable":
            the readings do not include it, and the reservation lasts as long as the instance. cpu
            and memory are always attributed, because the slave measures them itself.
    """

    name: str
    unit: str
    capacity: float
    scope: str = "machine"
    accounting: Accounting = "countable"


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
    """Facts about a host that do not change while its slave runs, except its devices.

    Attributes:
        name: unique among live slaves.
        incarnation: random number of this run of the slave.
        resources: at most RESOURCE_SLOTS; the position is the slot in `resource_info`.
        max_processes: highest number of running processes; 0: no bound.
        period: seconds between two `resource_info` messages.
        executors: names of executors that plugins offer for `Execute` steps.
        absent: probe name to the reason why the probe is absent on this host.
        unenforced: name of a limit or scheduling setting (`ProcessSpec.enforcement`) to the reason
            why this host cannot enforce it.
        cpus: numbers of the CPUs that processes may use; (): unknown.
        devices: devices that the host gives to its processes.
        launchers: names of the launchers that work on this host.
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
    unenforced: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    cpus: tuple[int, ...] = ()
    devices: tuple[Device, ...] = ()
    launchers: tuple[str, ...] = ()

    def accounted(self, accounting: Accounting) -> frozenset[str]:
        """Return the names of the resources with this accounting."""
        found = {one.name for one in self.resources if one.accounting == accounting}
        measured = MOST_USED.keys()
        return frozenset(found | measured if accounting == "attributed" else found - measured)


def is_plausible(resource: str, amount: float) -> bool:
    """Return True if one process may use this amount of a resource; False also for NaN."""
    return 0.0 <= amount <= MOST_USED.get(resource, MOST_USED_OF_OTHERS)
