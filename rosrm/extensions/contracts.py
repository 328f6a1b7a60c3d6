"""Plugin contracts: Protocols that plugins and adapters implement, and the values they exchange.

A plugin registers an *offer* of each thing it brings (`ProbeOffer`, `ScoringOffer`, ...): a name, a
frozen dataclass of options, and a function that makes the object. The configuration chooses offers
by name; their options are checked against the dataclass's annotations before anything is made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Execute, Move, Plan
from rosrm.model.values import (
    EMPTY,
    Assignment,
    InstanceId,
    ProcessSpec,
    Reading,
    ResourceDescription,
)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class NoOptions:
    """Options of a plugin that has nothing to set."""


# --- probes (slave) ---------------------------------------------------------------------------


class Probe(Protocol):
    """Reads the utilisation of one or more resources of a host.

    `read` may block: it runs in a thread of its own with a deadline. A late or raising probe makes
    its readings *stale*, never zero.
    """

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return the resources that `read` reports; fixed, with names unique on a host."""

    def read(self) -> Iterable[Reading]:
        """Return the utilisation now: one reading per resource, fractions of the capacity."""

    def close(self) -> None:
        """Release what the probe holds; called once, at the slave's end."""


class Sessions(Protocol):
    """The sessions (process trees) that the slave runs, for probes whose scope is the slice."""

    def pids(self) -> Sequence[int]:
        """Return the pids of all processes in the slave's sessions; up to 1 s old."""

    def ended_cpu_time(self) -> float:
        """Return the CPU seconds that ended processes used; never falls."""


@dataclass(frozen=True)
class ProbeContext:
    """Facts about the host, for the creation of a probe.

    Attributes:
        scope: "machine", "cgroup" or "slice", as the host's configuration says; a probe's own
            option may override it.
        budget: for the scope "slice", base units by resource name ("memory": bytes, "cpu": cores).
        data_directory: where the slave keeps its files (the disk that counts).
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
        name: by which the configuration chooses it.
        create: makes it; raises `SkipPlugin` with the reason where its hardware or driver is
            absent.
        options: a frozen dataclass of its settings, each with a default.
        summary: one line for `rosrm plugins`.
        period: seconds between reads.
        deadline: seconds after which a read counts as late.
        default: chosen where the configuration names no probes.
        resources: names of all that it may read; (): one with the name of the probe.
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
        limit: (N, R) upper limits, fractions; 1 where a host sets none.
        capacity: (N, R) base units for usage 1.0; NaN as in `usage`.
        processes: (N,) processes held or reserved.
        labels: N mappings, the labels of each host.
    """

    names: Sequence[str]
    resources: tuple[str, ...]
    usage: FloatArray
    limit: FloatArray
    capacity: FloatArray
    processes: npt.NDArray[np.int64]
    labels: Sequence[Mapping[str, str]] = ()

    def column(self, resource: str, missing: float = 0.0) -> FloatArray:
        """Return the usage of one resource, (N,), as a new array without NaN.

        Args:
            resource: its name.
            missing: value for a host that does not measure it.
        """
        if resource not in self.resources:
            return np.full(len(self.usage), missing)
        column = self.usage[:, self.resources.index(resource)]
        # One product shows any NaN, in a tenth of the time that a replacement takes.
        if math.isnan(column.dot(column)):
            return np.nan_to_num(column, nan=missing)
        return np.array(column)


@dataclass(frozen=True)
class ProcessView:
    """The process to place, for a scoring policy.

    Attributes:
        spec: as submitted. A policy gets the standard fields (program, `namespace`, `kind`,
            `priority`, `needs` and labels) and those that its offer declares in `reads`; to read
            another one raises `UndeclaredField`.
        need: (N, R) demand of the process on each host, fractions of that host's capacity.
    """

    spec: ProcessSpec
    need: FloatArray


@dataclass(frozen=True)
class Scores:
    """A policy's judgement of N hosts: the lowest value goes first.

    Attributes:
        value: (N,) finite where not vetoed.
        veto: (N,) True: this host may not take it; None: no vetoes.
        veto_reason: returns the reason of the veto on the host at a row.
        reason: returns the origin of the value of the host at a row.
    """

    value: FloatArray
    veto: BoolArray | None = None
    veto_reason: Callable[[int], str] = field(default=lambda _row: "vetoed by the scoring policy")
    reason: Callable[[int], str] = field(default=lambda _row: "")


class ScoringPolicy(Protocol):
    """Orders the hosts that fit. Pure and deterministic: the same arguments, the same scores."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Judge each row of `hosts` separately: no row's score may depend on the other rows.

        The core calls this once for all hosts, and again for single rows that have changed.
        """


@dataclass(frozen=True)
class ScoringOffer:
    """Registers a scoring policy; the fields are as in `ProbeOffer`.

    Attributes:
        reads: fields of the spec that it reads beyond the standard ones, as `("name",)`. Processes
            that differ in none of these fields are judged together.
    """

    name: str
    create: Callable[[Any], ScoringPolicy]
    options: type[Any] = NoOptions
    summary: str = ""
    reads: tuple[str, ...] = ()


# --- migration (master, pure; executors on the slaves) ----------------------------------------


class MigrationStrategy(Protocol):
    """Proposes the migration of a process, as data. Pure; the core carries the plan out."""

    def propose(self, move: Move) -> Plan:
        """Return the plan of a migration; raise `ValueError` with the reason if there is none."""


class SpecChecking(Protocol):
    """A migration strategy that checks, before a spec is queued, that it can move the process."""

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the fault of a spec, its own `migration.options` included; "": none. Pure."""


class HostChecking(Protocol):
    """A migration strategy that does not work on every host, or not between all of them."""

    @property
    def host_check(self) -> str:
        """Return the executor that checks on a host that the strategy works there.

        The core runs it once after each registration of a host, without arguments. It answers with
        the properties that must match on another host, text to text. It raises where the strategy
        does not work.
        """

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Return why nothing can move between hosts with these answers; "": it can. Pure."""


class Imaging(Protocol):
    """A migration strategy that dumps a process into an image, and restores it on the same host."""

    def checkpoint(self, move: Move) -> Plan:
        """Return the plan that ends the source and gives its name to its image. Pure.

        The steps name one host, start nothing, and stop the source after the commit: it must not
        run again. Raises `ValueError` with the reason where no image of the process can be made.
        """

    def restore(self, move: Move) -> Plan:
        """Return the plan that restores the destination from the image of the source. Pure.

        The source does not run. Before the commit, each step has an undo that leaves the image in
        its place. An undo that finds the destination running already answers `active: true`, and
        the plan goes forward from there. Raises `ValueError` as `checkpoint`.
        """


class PeriodicImaging(Protocol):
    """A migration strategy that dumps running processes periodically, for a start after a crash."""

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """Return the seconds between two dumps that the process asks for; 0.0: none. Pure."""

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """Return the step that dumps an instance and resumes it. Pure.

        Its answer may have `size` (bytes) and `seconds` (of each part, by its name). The process
        must resume after any failure. `now` is unix time, whole seconds.
        """

    @property
    def discard(self) -> str:
        """Return the executor that removes such images of ended instances from its host.

        It runs without arguments, not for each of them, and possibly with nothing to remove.
        """


@dataclass(frozen=True)
class Capabilities:
    """Declares what a migration strategy can do for a process; by default it only moves it.

    Attributes:
        state: what outlives an instance. "topics": its node publishes its state by the handoff
            protocol, so rosrm keeps snapshots and replicas of it. "memory": an image of its memory.
        shadow: a second instance follows the state before it takes over, so a process may have a
            standby.
        restart_from_image: the strategy implements `PeriodicImaging`, and its launcher starts an
            instance that has crashed from its newest image.
        launcher: name of the launcher of its processes; "": a plain command.
    """

    state: Literal["none", "topics", "memory"] = "none"
    shadow: bool = False
    restart_from_image: bool = False
    launcher: str = ""


@dataclass(frozen=True)
class MigrationOffer:
    """Registers a migration strategy; the fields are as in `ProbeOffer`.

    Attributes:
        capabilities: what it can do; where that depends on options, a pure function of the options
            that hold for one process. It must not change `launcher`.
        executors: those that the open step of its plans may name; each runs on a slave with the
            step's arguments (a JSON object) and answers with one.
        own_options: options of one process, where they are more than those for all: a dataclass
            that derives from `options`.
    """

    name: str
    create: Callable[[Any], MigrationStrategy]
    options: type[Any] = NoOptions
    summary: str = ""
    executors: Mapping[str, Callable[[Mapping[str, Any]], Mapping[str, Any]]] = field(
        default_factory=lambda: EMPTY
    )
    own_options: type[Any] | None = None
    capabilities: Capabilities | Callable[[Any], Capabilities] = Capabilities()


# --- launchers (slave) ------------------------------------------------------------------------


@dataclass(frozen=True)
class LauncherContext:
    """The facts about its host that a launcher gets when it is made.

    Attributes:
        state: directory of the slave; executors get it as `here.state`.
        python: interpreter of the slave.
        slave: random number of this run of the slave.
    """

    state: Path
    python: str
    slave: int


@dataclass(frozen=True)
class Launch:
    """The start of one instance, as the supervisor is about to carry it out.

    Attributes:
        assignment: what is to run; `assignment.restored`: from an image on this host.
        cluster: name of the cluster whose master gives the order.
        argv: command line, with all ROS arguments.
        environment: all variables of the process.
    """

    assignment: Assignment
    cluster: str
    argv: tuple[str, ...]
    environment: Mapping[str, str]


class Launcher(Protocol):
    """Starts instances in another way than by their plain command. Called in the slave's loop."""

    def prepare(self, launch: Launch) -> Launch | None:
        """Return the launch with another command line or environment.

        None: there is no image of this instance here. A restored instance whose strategy has no
        launcher is offered to each launcher in turn. An error of `rosrm.errors`, or a `ValueError`,
        says why the instance cannot be started here.
        """


class ProcessTreeLauncher(Protocol):
    """A launcher whose program stays the leader of the session, with the process below it.

    The process may have a session and a pid namespace of its own. Each call takes the pid of an
    instance's leader, whichever launcher has started it.
    """

    def leads(self, leader: int) -> bool | None:
        """Return True if it runs this launcher's program; None: not yet, but it may in a moment."""

    def members(self, leader: int) -> Sequence[int]:
        """Return the leader and all processes of the instance."""

    def root(self, leader: int) -> int:
        """Return the pid of the process itself."""


class GraphDepartureLauncher(Protocol):
    """A launcher of nodes that leave the ROS graph for a while."""

    def has_departed(self, leader: int) -> bool:
        """Return True while a node is out of the graph; its health is not watched then."""


class ImageLauncher(Protocol):
    """A launcher that starts an instance from its newest image after a crash."""

    def discard_images(self, instance: InstanceId) -> None:
        """Have the next start begin from nothing: a user restarts the instance."""


@dataclass(frozen=True)
class LauncherOffer:
    """Registers a launcher.

    Attributes:
        name: by which `Capabilities.launcher` chooses it.
        create: makes it, once for each run of a slave; raises `SkipPlugin` where it cannot work.
        summary: one line for `rosrm plugins`.
        variables: environment variables that it sets; no process inherits them from the slave.
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
        host: of the process; its own snapshot is there whatever the policy decides.
        age: seconds since another host got a newer replica; None: no other host ever had one.
        size: bytes of its newest snapshot.
        kept_on: other hosts with a replica now, the newest first.
        hosts: every host that is up, this one included, by name, with its labels.
    """

    spec: ProcessSpec
    host: str
    age: float | None
    size: int
    kept_on: tuple[str, ...]
    hosts: Mapping[str, Mapping[str, str]]


@dataclass(frozen=True)
class CheckpointChoice:
    """Placement of the replicas of a snapshot from now on.

    Attributes:
        hosts: other than the process's own; (): none.
        every: seconds between two transfers to a host, at least.
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
        host: of the process.
        asked: seconds between two checkpoints of its memory that the process asks for.
        size: bytes of the last one; 0: there is none yet.
        pause: seconds for which the dump paused the process.
    """

    spec: ProcessSpec
    host: str
    asked: float
    size: int
    pause: float


class MemoryPacing(Protocol):
    """A checkpoint policy that also sets the period of memory dumps."""

    def pace(self, process: MemoryView) -> float | None:
        """Return the seconds from the last checkpoint of its memory to the next one; None: none."""


@dataclass(frozen=True)
class CheckpointOffer:
    """Registers a checkpoint policy; the fields are as in `ProbeOffer`."""

    name: str
    create: Callable[[Any], CheckpointPolicy]
    options: type[Any] = NoOptions
    summary: str = ""


# --- the durable record -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Record:
    """One line of the event record, and the intent that it changes.

    Attributes:
        process: name; "" for none.
        host: name; "" for none.
        message: one sentence for logs and listings.
        facts: JSON-able particulars.
    """

    kind: EventKind
    process: str = ""
    host: str = ""
    message: str = ""
    facts: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """A record as the journal keeps it.

    Attributes:
        sequence: 1, 2, 3, ... without a gap.
        wall_time: unix time by the master's clock, seconds.
        elapsed: seconds since this master's start, by its monotonic clock.
    """

    sequence: int
    wall_time: float
    elapsed: float
    record: Record


@dataclass(frozen=True, slots=True)
class Intent:
    """A desired value, durable: the newest value under a key replaces the older ones.

    Attributes:
        table: "process", "migration", "host", "learned", "cluster", "removed".
        key: within the table.
        value: JSON-able; None: the key is removed.
    """

    table: str
    key: str
    value: Mapping[str, Any] | None


@runtime_checkable
class Journal(Protocol):
    """Stores intents and the event record; data survives a SIGKILL once `write` has returned."""

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], now: float
    ) -> Sequence[StoredRecord]:
        """Append records and replace intents in one atomic group; raises `JournalError`."""

    def intents(self, table: str) -> Mapping[str, Mapping[str, Any]]:
        """Return all intents of a table by key."""

    def records(
        self, *, after: int = 0, process: str = "", host: str = "", newest: int = 1000
    ) -> Sequence[StoredRecord]:
        """Return the newest matching records after a sequence, oldest first.

        Those of a host include migrations from it: their facts name the host as `from`.
        """

    def close(self) -> None:
        """Flush and release the files."""
