"""Plugin contracts: Protocols that plugins and adapters implement, and the values they exchange.

A plugin registers an *offer* for each of its objects (`ProbeOffer`, `ScoringOffer`, ...): a name, a
frozen dataclass of options, and a function that creates the object. The configuration chooses
offers by name. Their options are checked against the dataclass's annotations before the object is
created.

Slaves and commands import this module. So it imports numpy only where it makes an array.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from rosrm.extensions.link_views import FlowView, LinkView, no_flows, no_links
from rosrm.model.devices import Device
from rosrm.model.plan import Execute, Move, Plan
from rosrm.model.values import (
    EMPTY,
    Assignment,
    InstanceId,
    ProcessSpec,
    Reading,
    ResourceDescription,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rosrm.extensions.array_types import BoolArray, FloatArray


@dataclass(frozen=True)
class NoOptions:
    """Options of a plugin without settings."""


# --- probes (slave) ---------------------------------------------------------------------------


class Probe(Protocol):
    """Reads the utilisation of one or more resources of a host.

    `read` may block, because it runs in a separate thread with a deadline. If a probe is late or
    raises, its readings become stale, not zero.
    """

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return the resources that `read` reports; fixed, with names unique on a host."""

    def read(self) -> Iterable[Reading]:
        """Return the current utilisation: one reading per resource, fractions of the capacity."""

    def close(self) -> None:
        """Release the probe's files, threads and devices; called once, at the slave's end."""


class ProcessMeasuring(Protocol):
    """A probe that also measures how much of its resources single processes use."""

    def by_process(self) -> Mapping[str, Mapping[int, float]]:
        """Return resource name to pid to amount, in the unit of the resource; others use nothing.

        Called after each `read`, in the same thread. The answer has each attributed resource of the
        probe, and may have others: eviction then moves the process with the largest usage. Pids
        outside of the slave's sessions have no effect.
        """


class DeviceFinding(Protocol):
    """A probe that also finds devices of its host."""

    def devices(self) -> Iterable[Device]:
        """Return every device, also one that is `missing` now, with the reason; units are fixed.

        Called after each `read`, in the same thread, also if `read` raised. The settings of the
        host take precedence: they choose the units of a kind. The slave ends a process whose device
        is missing, so raise where the probe cannot tell; then all devices stay as they were.
        """


class HostLabelling(Protocol):
    """A probe that also labels its host."""

    @property
    def labels(self) -> Mapping[str, str]:
        """Return labels of the host, as `{"gpu.model": "A100"}`; read once, after `create`.

        A label of the same key in host.yaml replaces that of the probe.
        """


class Sessions(Protocol):
    """The sessions (process trees) that the slave runs, for probes whose scope is the slice."""

    def pids(self) -> Sequence[int]:
        """Return the pids of all processes in the slave's sessions; up to 1 s old."""

    def ended_cpu_time(self) -> float:
        """Return the CPU seconds that ended processes used; the value never decreases."""


@dataclass(frozen=True)
class ProbeContext:
    """Facts about the host, for the creation of a probe.

    Attributes:
        scope: "machine", "cgroup" or "slice", from the host's configuration; an option of the probe
            may override it.
        budget: for the scope "slice", base units by resource name ("memory": bytes, "cpu": cores).
        data_directory: directory of the slave's files, on the disk that a disk probe measures.
        sessions: the slave's process trees.
    """

    scope: str
    budget: Mapping[str, float]
    data_directory: Path
    sessions: Sessions


@dataclass(frozen=True)
class ProbeOffer:
    """Registers a probe.

    Attributes:
        name: name by which the configuration chooses it.
        create: creates it; raises `SkipPlugin` with the reason if its hardware or driver is absent.
        options: a frozen dataclass of its settings, each with a default.
        summary: one line for `rosrm plugins`.
        period: seconds between two reads.
        deadline: seconds after which a read counts as late.
        default: True: chosen if the configuration names no probes.
        resources: names of all resources that it may read; (): one with the name of the probe.
    """

    name: str
    create: Callable[[Any, ProbeContext], Probe]
    options: type[Any] = NoOptions
    summary: str = ""
    period: float = 0.1
    deadline: float = 1.0
    default: bool = False
    resources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Set the default of `resources`: one resource with the name of the probe."""
        object.__setattr__(self, "resources", tuple(self.resources) or (self.name,))


# --- scoring (master, pure) -------------------------------------------------------------------


@dataclass(frozen=True)
class HostView:
    """A read-only view of N hosts for a scoring policy. Arrays run in parallel.

    Attributes:
        names: N host names.
        resources: R resource names, the columns.
        usage: (N, R) reading + reservations, fractions of the capacity; NaN where a host does
            not measure such a resource. `column` has no NaN.
        limit: (N, R) upper limits, fractions; 1 where a host has none.
        capacity: (N, R) base units at usage 1.0; NaN as in `usage`.
        processes: (N,) number of processes on the host or reserved for it.
        labels: (N,) read-only mappings, the labels of each host, those of its probes included.
        links: links between the hosts and all hosts of the cluster.
        tenants: (N,) read-only mappings, for each host: name to spec of each process with an
            instance there, assigned ones included. A spec is as at the start of the instance.
        devices: (N,) mappings, the number of free units of each kind of devices; shares of units
            count. A kind that the host lacks is absent.

    Arrays are read-only, too. `labels` and `tenants` are made when they are read, host by host.
    """

    names: Sequence[str]
    resources: tuple[str, ...]
    usage: FloatArray
    limit: FloatArray
    capacity: FloatArray
    processes: npt.NDArray[np.int64]
    labels: Sequence[Mapping[str, str]] = ()
    links: LinkView = field(default_factory=no_links)
    tenants: Sequence[Mapping[str, ProcessSpec]] = ()
    devices: Sequence[Mapping[str, float]] = ()

    def labelled(self, key: str, value: str) -> BoolArray:
        """Return the mask, (N,), of the hosts with a label of this value, as a new array."""
        import numpy as np  # noqa: PLC0415 - see above

        return np.array([labels.get(key) == value for labels in self.labels], np.bool_)

    def column(self, resource: str, missing: float = 0.0) -> FloatArray:
        """Return the usage of one resource, (N,), as a new array without NaN.

        Args:
            resource: name of the resource.
            missing: value for a host that does not measure the resource.
        """
        if resource in self.resources:
            column = self.usage[:, self.resources.index(resource)]
            # One dot product finds any NaN, in a tenth of the time of a replacement.
            if not math.isnan(column.dot(column)):
                copied: FloatArray = column.copy()
                return copied
        import numpy as np  # noqa: PLC0415 - see above

        if resource not in self.resources:
            return np.full(len(self.usage), missing)
        return np.nan_to_num(column, nan=missing)


@dataclass(frozen=True)
class ProcessView:
    """The process to place, for a scoring policy or a filter.

    Attributes:
        spec: as submitted. A plugin gets the standard fields (program, `namespace`, `kind`,
            `priority`, `needs`, `devices` and labels) and those that its offer declares in
            `reads`; any other field raises `UndeclaredField`.
        need: (N, R) demand of the process on each host, fractions of that host's capacity; inf
            where a host lacks a needed resource, never NaN.
        flows: flows between the process and others, declared and learned ones; empty unless the
            offer declares `talks_to` in `reads`.
    """

    spec: ProcessSpec
    need: FloatArray
    flows: FlowView = field(default_factory=no_flows)


@dataclass(frozen=True)
class Scores:
    """A policy's scores of N hosts; the host with the lowest value is chosen.

    Attributes:
        value: (N,) scores, finite where not vetoed.
        veto: (N,) True: the host must not run the process; None: no vetoes.
        veto_reason: returns the reason for the veto on the host of a row.
        reason: returns the origin of the score of the host of a row.
    """

    value: FloatArray
    veto: BoolArray | None = None
    veto_reason: Callable[[int], str] = field(default=lambda _row: "vetoed by the scoring policy")
    reason: Callable[[int], str] = field(default=lambda _row: "")


class ScoringPolicy(Protocol):
    """Orders the hosts that fit. Pure: equal arguments give equal scores."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Score each row of `hosts` separately; no score may depend on another row.

        The core calls this once for all hosts, and again for single rows that have changed.
        """


@dataclass(frozen=True)
class ScoringOffer:
    """Registers a scoring policy; the fields are as in `ProbeOffer`.

    Attributes:
        reads: fields of the spec that it reads beyond the standard ones, as `("name",)`. Processes
            with equal fields are scored together.
    """

    name: str
    create: Callable[[Any], ScoringPolicy]
    options: type[Any] = NoOptions
    summary: str = ""
    reads: tuple[str, ...] = ()


# --- filters (master, pure) -------------------------------------------------------------------


class PlacementFilter(Protocol):
    """A placement rule of a plugin: which hosts may take a process. Pure, as a scoring policy."""

    def mask(self, hosts: HostView, process: ProcessView) -> BoolArray:
        """Return (N,) booleans, True: the host may take the process.

        No row may depend on another row. The core calls this once for all hosts, and again for
        single rows that have changed.
        """

    def reason(self, hosts: HostView, process: ProcessView, row: int) -> str:
        """Return why the host of a row fails, as a predicate: "it has no label floor"."""


@dataclass(frozen=True)
class FilterOffer:
    """Registers a placement filter; the fields are as in `ScoringOffer`.

    Attributes:
        permanent: True: a host that fails without any process on it fails until it registers again.
            A process that every host fails for good is set aside, and does not block the queue.
    """

    name: str
    create: Callable[[Any], PlacementFilter]
    options: type[Any] = NoOptions
    summary: str = ""
    reads: tuple[str, ...] = ()
    permanent: bool = False


# --- migration (master, pure; executors on the slaves) ----------------------------------------


class MigrationStrategy(Protocol):
    """Proposes the plan of a migration, as data. Pure; the core executes the plan."""

    def propose(self, move: Move) -> Plan:
        """Return the plan of a migration; raise `ValueError` with the reason if there is none."""


class SpecChecking(Protocol):
    """A migration strategy that checks, before a spec is queued, that it can move the process."""

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the fault of a spec, including its `migration.options`; "": none. Pure."""


class HostChecking(Protocol):
    """A migration strategy that works only on some hosts, or only between some hosts."""

    @property
    def host_check(self) -> str:
        """Return the name of the executor that checks whether the strategy works on a host.

        The core runs the executor once after each registration of a host, without arguments. The
        executor returns the properties that must match between two hosts, as text to text. It
        raises if the strategy does not work on the host.
        """

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Return why no process can move between hosts with these properties; "": it can. Pure."""


class Imaging(Protocol):
    """A migration strategy that dumps a process into an image, and restores it on the same host."""

    def checkpoint(self, move: Move) -> Plan:
        """Return the plan that stops the source and makes its image the owner of the name. Pure.

        The steps name one host, start no instance, and stop the source after the commit, because it
        must not run again. Raises `ValueError` with the reason if the process cannot be dumped.
        """

    def restore(self, move: Move) -> Plan:
        """Return the plan that restores the destination from the image of the source. Pure.

        The source does not run. Before the commit, each step has an undo that leaves the image in
        its place. An undo executor that finds the destination running returns `active: true`; the
        plan then goes forward again. Raises `ValueError` as `checkpoint` does.
        """


class PeriodicImaging(Protocol):
    """A migration strategy that dumps running processes periodically, for crash recovery."""

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """Return the requested seconds between two dumps of a process; 0.0: no dumps. Pure."""

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """Return the step that dumps an instance and resumes it. Pure.

        The executor's result may have `size` (bytes) and `seconds` (duration by name of the part).
        The process must resume after any failure. `now`: unix time in whole seconds.
        """

    @property
    def discard(self) -> str:
        """Return the name of the executor that removes such images of ended instances from a host.

        One call without arguments removes the images of all ended instances; there may be none.
        """


#: Function on a slave that an `Execute` step calls: arguments and answer are JSON objects.
Executor = Callable[[Mapping[str, Any]], Mapping[str, Any]]


@dataclass(frozen=True)
class Capabilities:
    """Capabilities of a migration strategy for a process; by default it moves the process only.

    Attributes:
        state: state that survives an instance. "topics": the node publishes its state by the
            handoff protocol, and rosrm stores snapshots and replicas of it. "memory": an image of
            the process's memory.
        shadow: True: a shadow follows the state before it takes over, so a process may have a
            standby.
        restart_from_image: True: the strategy implements `PeriodicImaging`, and its launcher
            restarts a crashed instance from its newest image.
        launcher: name of the launcher of its processes; "": they start by their command.
    """

    state: Literal["none", "topics", "memory"] = "none"
    shadow: bool = False
    restart_from_image: bool = False
    launcher: str = ""


@dataclass(frozen=True)
class MigrationOffer:
    """Registers a migration strategy; the fields are as in `ProbeOffer`.

    Attributes:
        capabilities: capabilities of the strategy; if they depend on options, a pure function of
            the options of one process. The function must not change `launcher`.
        executors: executors that `Execute` steps of its plans may name; each runs on a slave with
            the step's arguments (a JSON object) and returns a JSON object.
        own_options: a dataclass derived from `options`, if one process may have more options than
            the cluster.
        host_options: options of one host, which its own file gives under `strategies`; executors
            get them as `here.options`.
    """

    name: str
    create: Callable[[Any], MigrationStrategy]
    options: type[Any] = NoOptions
    summary: str = ""
    executors: Mapping[str, Executor] = field(default_factory=lambda: EMPTY)
    own_options: type[Any] | None = None
    capabilities: Capabilities | Callable[[Any], Capabilities] = Capabilities()
    host_options: type[Any] = NoOptions


# --- launchers (slave) ------------------------------------------------------------------------


@dataclass(frozen=True)
class LauncherContext:
    """Facts about the host, for the creation of a launcher.

    Attributes:
        state: directory of the slave; executors get it as `here.state`.
        python: path of the slave's Python interpreter.
        slave: incarnation of the slave.
    """

    state: Path
    python: str
    slave: int


@dataclass(frozen=True)
class Launch:
    """The start of one instance, before the supervisor executes it.

    Attributes:
        assignment: assignment of the instance; `assignment.restored`: start from an image on this
            host.
        cluster: name of the cluster of the master that sent the order.
        argv: command line, with all ROS arguments.
        environment: all environment variables of the process.
    """

    assignment: Assignment
    cluster: str
    argv: tuple[str, ...]
    environment: Mapping[str, str]


class Launcher(Protocol):
    """Replaces the command line or environment of instances. Called in the slave's main loop."""

    def prepare(self, launch: Launch) -> Launch | None:
        """Return the launch with another command line or environment.

        None: this host has no image of the instance. If the strategy of a restored instance names
        no launcher, each launcher is called in turn. Raises an error of `rosrm.errors` or a
        `ValueError` with the reason if the instance cannot be started on this host.
        """


class ProcessTreeLauncher(Protocol):
    """A launcher whose program stays the session leader, as the parent of the process.

    The process may have its own session and pid namespace. Each call takes the pid of an instance's
    session leader, which any launcher may have started. Raise where the launcher cannot tell; then
    the members stay as they were.
    """

    def leads(self, leader: int) -> bool | None:
        """Return True if the leader runs this launcher's program; None: it may begin to soon."""

    def members(self, leader: int) -> Sequence[int]:
        """Return the leader and all processes of the instance."""

    def root(self, leader: int) -> int:
        """Return the pid of the process itself."""


class GraphDepartureLauncher(Protocol):
    """A launcher of nodes that leave the ROS graph for a while."""

    def has_departed(self, leader: int) -> bool:
        """Return True while a node is out of the graph, which pauses its health checks.

        So does a call that is late or raises: raise where the launcher cannot tell.
        """


class ImageLauncher(Protocol):
    """A launcher that starts an instance from its newest image after a crash."""

    def discard_images(self, instance: InstanceId) -> None:
        """Discard the images of an instance, because a user restarts it without its old memory.

        If this raises an exception or is late, the slave refuses the restart with the reason.
        """


@dataclass(frozen=True)
class LauncherOffer:
    """Registers a launcher.

    Attributes:
        name: name by which `Capabilities.launcher` chooses it.
        create: creates it once for each run of a slave; raises `SkipPlugin` if it cannot work.
        summary: one line for `rosrm plugins`.
        variables: environment variables that it sets; processes do not inherit them from the slave.
    """

    name: str
    create: Callable[[LauncherContext], Launcher]
    summary: str = ""
    variables: tuple[str, ...] = ()


# --- checkpoints (master, pure) ---------------------------------------------------------------


@dataclass(frozen=True)
class CheckpointView:
    """A running stateful process, for a checkpoint policy.

    Attributes:
        spec: as submitted.
        host: host of the process, which always has the process's own snapshot.
        age: seconds since another host got a newer replica; None: no other host has one.
        size: size of its newest snapshot in bytes.
        replica_hosts: other hosts with a replica now, the newest first.
        hosts: name of each host that is up, including the host of the process, to its labels.
    """

    spec: ProcessSpec
    host: str
    age: float | None
    size: int
    replica_hosts: tuple[str, ...]
    hosts: Mapping[str, Mapping[str, str]]


@dataclass(frozen=True)
class CheckpointChoice:
    """Placement of the replicas of a snapshot from now on.

    Attributes:
        hosts: hosts of replicas, other than the process's own; (): none.
        every: shortest time between two transfers to a host, in seconds.
    """

    hosts: tuple[str, ...]
    every: float = 1.0


class CheckpointPolicy(Protocol):
    """Decides on the hosts and the period of snapshot replication. Pure."""

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        """Return the placement from now on; None: unchanged. Called about once a second."""


@dataclass(frozen=True)
class MemoryView:
    """A process that asks for periodic checkpoints, for a checkpoint policy.

    Attributes:
        spec: as submitted.
        host: host of the process.
        asked: seconds between two checkpoints that the process requests.
        size: size of the last checkpoint in bytes; 0: there is none yet.
        pause: seconds for which the last dump paused the process.
    """

    spec: ProcessSpec
    host: str
    asked: float
    size: int
    pause: float


class MemoryPacing(Protocol):
    """A checkpoint policy that also sets the period of memory dumps."""

    def pace(self, process: MemoryView) -> float | None:
        """Return the seconds from the last checkpoint to the next one; None: no checkpoints."""


@dataclass(frozen=True)
class CheckpointOffer:
    """Registers a checkpoint policy; the fields are as in `ProbeOffer`."""

    name: str
    create: Callable[[Any], CheckpointPolicy]
    options: type[Any] = NoOptions
    summary: str = ""
