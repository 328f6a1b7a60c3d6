"""The Protocols that plugins and adapters implement, and the values that pass through them.

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
    """For a plugin that has nothing to set."""


# --- probes (slave) ---------------------------------------------------------------------------


class Probe(Protocol):
    """Reads the utilisation of one or more resources of a host.

    `read` may block: it runs in a thread of its own with a deadline. A late or raising probe makes
    its readings *stale*, never zero.
    """

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """What `read` reports, known when the probe is made; names are unique on a host."""

    def read(self) -> Iterable[Reading]:
        """The utilisation now: one reading for each of `resources`, fractions of the capacity."""

    def close(self) -> None:
        """Release what the probe holds; called once, at the slave's end."""


class Sessions(Protocol):
    """The sessions (process trees) that the slave runs, for probes whose scope is the slice."""

    def pids(self) -> Sequence[int]:
        """Every known process of the slave's sessions; may be up to 1 s behind."""

    def ended_cpu_time(self) -> float:
        """Seconds of CPU that processes which have ended used; never falls."""


@dataclass(frozen=True)
class ProbeContext:
    """What a probe may know of its host when it is made.

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
        resources: names of all that it may read; (): one of its own name.
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
        """Fill in the resource of a probe that has one name for both."""
        object.__setattr__(self, "resources", tuple(self.resources) or (self.name,))


# --- scoring (master, pure) -------------------------------------------------------------------


@dataclass(frozen=True)
class HostView:
    """A read-only view of N hosts for a scoring policy. Arrays run in parallel.

    Attributes:
        names: N host names.
        resources: R resource names, the columns.
        usage: (N, R) reading + in-flight load, fractions of the capacity; NaN where a host does
            not measure such a resource. `column` has no NaN.
        limit: (N, R) upper limits, fractions; 1 where a host sets none.
        capacity: (N, R) base units for usage 1.0; NaN as in `usage`.
        processes: (N,) processes held or promised.
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
            missing: stands where a host does not measure it.
        """
        if resource not in self.resources:
            return np.full(len(self.usage), missing)
        column = self.usage[:, self.resources.index(resource)]
        # One product tells whether there is any NaN, in a tenth of the time that replacing takes.
        if math.isnan(column.dot(column)):
            return np.nan_to_num(column, nan=missing)
        return np.array(column)


@dataclass(frozen=True)
class ProcessView:
    """What a scoring policy may know of the process to place.

    Attributes:
        spec: as submitted. A policy gets the standard fields (what it runs, `namespace`, `kind`,
            `priority`, `needs` and labels) and those that its offer declares in `reads`; to read
            another one raises `UndeclaredField`.
        need: (N, R) what it will use on each host, fractions of that host's capacity.
    """

    spec: ProcessSpec
    need: FloatArray


@dataclass(frozen=True)
class Scores:
    """A policy's judgement of N hosts: the lowest value goes first.

    Attributes:
        value: (N,) finite where not vetoed.
        veto: (N,) True: this host may not take it; None: no vetoes.
        veto_reason: says why the host at a row is vetoed.
        reason: says how the value of the host at a row came about.
    """

    value: FloatArray
    veto: BoolArray | None = None
    veto_reason: Callable[[int], str] = field(default=lambda _row: "vetoed by the scoring policy")
    reason: Callable[[int], str] = field(default=lambda _row: "")


class ScoringPolicy(Protocol):
    """Orders the hosts that fit. Pure and deterministic: the same arguments, the same scores."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Judge every row of `hosts` by itself: no row's score may depend on the other rows.

        The core asks for all hosts once and then anew for single rows that have changed.
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
    """Proposes how a process moves, as data. Pure; the core carries the plan out."""

    def propose(self, move: Move) -> Plan:
        """The steps of this move. Raises `ValueError` with the reason where it cannot move it."""


class SpecChecking(Protocol):
    """A migration strategy that says of a spec, before it is queued, whether it can move it."""

    def spec_fault(self, spec: ProcessSpec) -> str:
        """What is wrong with it, its own `migration.options` included; "": nothing. Pure."""


class HostChecking(Protocol):
    """A migration strategy that does not work on every host, or not between all of them."""

    @property
    def ability(self) -> str:
        """The executor that says of a host whether the strategy works there.

        It is asked once after each registration of a host, without arguments, and answers with
        what must match on another host, text to text. Where it does not work it raises.
        """

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Why nothing can be moved so between two hosts of these answers; "": it can. Pure."""


class Imaging(Protocol):
    """A migration strategy that dumps a process into an image, and restores it on the same host."""

    def checkpoint(self, move: Move) -> Plan:
        """The steps until the source has ended, and its image owns the name. Pure.

        They name one host, start nothing, and stop the source after the commit: it must not run
        again. Raises `ValueError` with the reason where it can make no image of the process.
        """

    def restore(self, move: Move) -> Plan:
        """The steps until the destination goes on from the image of the source. Pure.

        The source does not run. Before the commit each step is undone so that the image lies where
        it lay; an undo that finds the destination going on already answers `active: true`, and the
        plan goes forward from there. Raises `ValueError` as `checkpoint`.
        """


class PeriodicImaging(Protocol):
    """A migration strategy that dumps a process which then goes on, for its start after a crash."""

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """Seconds from one dump to the next, as the process asks for them; 0.0: none. Pure."""

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """The step that dumps an instance and lets it go on. Pure.

        Its answer may have `size` (bytes) and `seconds` (of each part, by its name). Whatever
        fails, the process goes on. `now` is unix time, whole seconds.
        """

    @property
    def discard(self) -> str:
        """The executor that removes such images of instances that have ended from its host.

        Without arguments; it does not come for each of them, and may come in vain.
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
        executors: what the open step of its plans may name; each runs on a slave with the step's
            arguments (a JSON object) and answers with one.
        own_options: what can be set for one process, where that is more than for all: a dataclass
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
    """What a launcher may know of its host when it is made.

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
    """What a checkpoint policy may know of a stateful process that runs.

    Attributes:
        spec: as submitted.
        host: where it runs; it keeps a state of its own there whatever the policy says.
        age: seconds since a newer state was kept on any other host; None: on none it ever was.
        size: bytes of its newest state.
        kept_on: other hosts that keep a state of it now, the newest first.
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
    """Where a state is kept from now on.

    Attributes:
        hosts: other than the process's own; (): nowhere.
        every: seconds between two transfers to a host, at least.
    """

    hosts: tuple[str, ...]
    every: float = 1.0


class CheckpointPolicy(Protocol):
    """Decides where the state of a process is kept, and how often. Pure."""

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        """Where to keep it from now on; None: as before. Asked about once a second."""


@dataclass(frozen=True)
class MemoryView:
    """What a checkpoint policy may know of a process that asks for periodic checkpoints.

    Attributes:
        spec: as submitted.
        host: where it runs.
        asked: seconds from one checkpoint of its memory to the next, as it asks for them.
        size: bytes of the last one; 0: there is none yet.
        pause: seconds for which the process stood still for it.
    """

    spec: ProcessSpec
    host: str
    asked: float
    size: int
    pause: float


class MemoryPacing(Protocol):
    """A checkpoint policy that has the memory of processes dumped, too."""

    def pace(self, process: MemoryView) -> float | None:
        """Seconds from the last checkpoint of its memory to the next one; None: none is made."""


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
        process: that it concerns; "" for none.
        host: that it concerns; "" for none.
        message: one sentence for people.
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
    """What shall be, durably: the newest value under a key replaces the older ones.

    Attributes:
        table: "process", "migration", "host", "learned", "cluster", "removed".
        key: within the table.
        value: JSON-able; None: the key is gone.
    """

    table: str
    key: str
    value: Mapping[str, Any] | None


@runtime_checkable
class Journal(Protocol):
    """Keeps intent and the event record. What `write` has returned from survives a SIGKILL."""

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], now: float
    ) -> Sequence[StoredRecord]:
        """Append records and replace intents in one atomic group; raises `JournalError`."""

    def intents(self, table: str) -> Mapping[str, Mapping[str, Any]]:
        """All intents of a table by key."""

    def records(
        self, *, after: int = 0, process: str = "", host: str = "", newest: int = 1000
    ) -> Sequence[StoredRecord]:
        """The newest matching records after a sequence, oldest first.

        Those of a host include moves from it: their facts name the host as `from`.
        """

    def close(self) -> None:
        """Flush and release the files."""
