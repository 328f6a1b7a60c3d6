"""All that the master's core knows; the handlers of `master.py` change it in place."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

import numpy as np

from rosrm.core.commands import Command
from rosrm.core.hosts import FloatArray, Host, HostTable
from rosrm.core.migration import Plan
from rosrm.core.model import EMPTY, Assignment, InstanceId, InstanceState, InstanceStatus, ProcessSpec
from rosrm.core.needs import LearnedNeeds
from rosrm.core.placement import Decision, Ranking
from rosrm.core.queue import Queue
from rosrm.core.settings import CoreSettings
from rosrm.core.specs import spec_to_dict
from rosrm.ports import Intent, MigrationStrategy, Record, ScoringPolicy

#: Records of one process that `explain` tells.
_HISTORY: Final = 12


#: Instance numbers are made durable by so many at a time.
_RESERVED: Final = 1000


class ProcessPhase(str, Enum):
    """Where a process stands, as the master sees it."""

    QUEUED = "queued"
    SET_ASIDE = "set_aside"
    ASSIGNED = "assigned"
    STARTING = "starting"
    RUNNING = "running"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    MIGRATING = "migrating"
    FINISHED = "finished"
    FAILED = "failed"
    CANCELLED = "cancelled"
    UNREACHABLE = "unreachable"
    STUCK = "stuck"

    @property
    def over(self) -> bool:
        """Nothing more will happen to it unless somebody asks."""
        return self in _OVER


_OVER: Final = frozenset({ProcessPhase.FINISHED, ProcessPhase.FAILED, ProcessPhase.CANCELLED})


class Wanted(str, Enum):
    """What is to come of a process once its instance has ended."""

    RUN = "run"
    CANCEL = "cancel"
    REQUEUE = "requeue"


@dataclass(slots=True)
class Instance:
    """One run of a process on one host, as the master sees it.

    Attributes:
        state: as the slave said last; None: assigned, nothing said yet.
        charged: (R',) fractions that still count against its host.
        amounts: base units counted for it when it was assigned.
        estimated: resources whose amount is an estimate and stops counting after `settle`.
        since: time of the assignment.
        seen: newest usage in base units.
        peak: highest usage seen.
        order: of an unanswered stop, 0: none.
        order_at: when it was given.
    """

    id: InstanceId
    host: Host
    since: float
    amounts: Mapping[str, float]
    estimated: frozenset[str]
    charged: FloatArray
    state: InstanceState | None = None
    pid: int = 0
    restarts: int = 0
    seen: dict[str, float] = field(default_factory=dict)
    peak: dict[str, float] = field(default_factory=dict)
    stopping: bool = False
    order: int = 0
    order_at: float = 0.0


@dataclass(slots=True)
class Run:
    """A plan that is being carried out.

    Attributes:
        index: of the step in hand, in `steps` or, going back, in `undo`.
        undo: steps still to be done on the way back; None: going forward.
        committed: the destination owns the name.
        deadline: of the step in hand.
        begun: the step in hand has been ordered.
        order: of the step in hand, 0: none.
    """

    process: str
    plan: Plan
    strategy: str
    source: InstanceId
    source_host: Host
    destination: InstanceId
    destination_host: Host
    cause: str
    started: float
    index: int = 0
    undo: list[Any] | None = None
    committed: bool = False
    begun: bool = False
    deadline: float = 0.0
    order: int = 0
    order_at: float = 0.0
    failure: str = ""
    stuck: bool = False
    answer: tuple[bool, str] | None = None
    ended: dict[int, InstanceStatus] = field(default_factory=dict)


@dataclass(slots=True)
class Process:
    """One submitted process.

    Attributes:
        order: place in the line; kept when it returns to the queue.
        owner: number of the instance that owns the name; 0: none.
        excluded: host name to the reason why it cannot run there.
        decision: the newest one about it, with its kind.
    """

    spec: ProcessSpec
    order: int
    phase: ProcessPhase
    since: float
    wanted: Wanted = Wanted.RUN
    owner: int = 0
    reason: str = ""
    excluded: dict[str, str] = field(default_factory=dict)
    migrations: int = 0
    moved_at: float = float("-inf")
    exit_code: int = 0
    restarts: int = 0
    decision: Mapping[str, Any] | None = None
    decided_at: float = 0.0
    history: deque[tuple[float, str, str]] = field(default_factory=lambda: deque(maxlen=_HISTORY))

    @property
    def name(self) -> str:
        """Its name."""
        return self.spec.name


class MasterState:
    """The state of the master's core, with the few moves that every handler shares."""

    def __init__(
        self,
        settings: CoreSettings,
        policy_name: str,
        policy: ScoringPolicy,
        strategies: Mapping[str, MigrationStrategy],
        epoch: int,
        fallback: tuple[str, ScoringPolicy] | None = None,
    ) -> None:
        self.settings = settings
        self.policy_name = policy_name
        self.policy = policy
        self.fallback = fallback
        self.strategies = dict(strategies)
        self.epoch = epoch
        self.hosts = HostTable()
        self.queue = Queue()
        self.processes: dict[str, Process] = {}
        self.instances: dict[int, Instance] = {}
        self.runs: dict[str, Run] = {}
        self.runs_by_order: dict[int, str] = {}
        self.learned = LearnedNeeds()
        self.rankings: dict[Any, Ranking] = {}
        self.next_order = 1
        self.next_instance = 1
        self.reserved_instances = 1
        self.next_order_id = 1
        self.wall = 0.0
        self.queue_told: tuple[str, str] = ("", "")
        self.missing_since: dict[int, float] = {}
        self.reviewed = float("-inf")
        self.policy_told = float("-inf")
        self._out: list[Command] = []

    # --- what handlers emit --------------------------------------------------------------

    def emit(self, command: Command) -> None:
        """Add a command to the outcome of the event in hand."""
        self._out.append(command)

    def take(self) -> list[Command]:
        """The commands so far; the next event begins with none."""
        out, self._out = self._out, []
        return out

    def record(
        self, now: float, kind: str, message: str, *, process: str = "", host: str = "",
        facts: Mapping[str, Any] = EMPTY,
    ) -> None:  # fmt: skip
        """Write a line of the event record."""
        self.emit(Record(kind, process, host, message, facts))
        known = self.processes.get(process)
        if known is not None:
            known.history.append((now, kind, message))

    def save(self, process: Process) -> None:
        """Make what is intended with a process durable."""
        owner = self.instances.get(process.owner)
        self.emit(
            Intent(
                "process", process.name,
                {
                    "spec": spec_to_dict(process.spec), "order": process.order,
                    "phase": process.phase.value, "wanted": process.wanted.value,
                    "owner": process.owner, "host": owner.host.name if owner else "",
                    "reason": process.reason, "excluded": dict(process.excluded),
                    "migrations": process.migrations, "exit_code": process.exit_code,
                    "restarts": process.restarts,
                },
            )
        )  # fmt: skip

    def order_id(self) -> int:
        """A number for an order to a slave, unique within this run of the master."""
        self.next_order_id += 1
        return self.next_order_id - 1

    # --- processes -----------------------------------------------------------------------

    def set_phase(self, process: Process, phase: ProcessPhase, now: float, reason: str = "") -> None:
        """Move a process to another phase."""
        if process.phase is not phase:
            process.since = now
        process.phase = phase
        process.reason = reason

    def enqueue(self, process: Process, now: float, reason: str = "") -> None:
        """Queue a process at its place in the line."""
        process.owner = 0
        process.wanted = Wanted.RUN
        self.set_phase(process, ProcessPhase.QUEUED, now, reason)
        self.queue.add(process.name, process.spec.priority, process.order)

    def instances_of(self, process: str) -> Iterable[Instance]:
        """Every instance of a process that may still run."""
        return [i for i in self.instances.values() if i.id.process == process]

    # --- instances -----------------------------------------------------------------------

    def new_instance_id(self, process: Process) -> InstanceId:
        """A number that no instance has had, in any run of the master."""
        if self.next_instance >= self.reserved_instances:
            self.reserved_instances = self.next_instance + _RESERVED
            self.emit(Intent("cluster", "instances", {"next": self.reserved_instances}))
        self.next_instance += 1
        return InstanceId(process.name, self.next_instance - 1)

    def add_instance(
        self, instance: InstanceId, spec: ProcessSpec, host: Host, now: float,
        *, at_least: Mapping[str, float] = EMPTY,
    ) -> Instance:  # fmt: skip
        """Count an instance against a host from now on.

        Args:
            at_least: base units that an earlier instance of the process was seen to use.
        """
        estimate = self.learned.estimate(spec, self.settings.default_needs)
        amounts = larger(estimate.amounts, at_least)
        need = self.hosts.fractions_of(host, amounts)
        charged = np.where(np.isfinite(need), need, 0.0)
        added = Instance(instance, host, now, amounts, estimate.estimated, charged)
        self.instances[instance.number] = added
        host.instances.add(instance.number)
        self.hosts.charge(host, charged, processes=1)
        return added

    def drop_instance(self, instance: Instance) -> None:
        """An instance has ended: it counts no more."""
        del self.instances[instance.id.number]
        instance.host.instances.discard(instance.id.number)
        self.hosts.charge(instance.host, -instance.charged, processes=-1)

    def assignment(self, instance: InstanceId, spec: ProcessSpec, node_name: str = "") -> Assignment:
        """The order for a slave to run an instance."""
        return Assignment(instance, spec, self.epoch, node_name or spec.name)

    def note_decision(self, process: Process, decision: Decision, kind: str, now: float) -> None:
        """Remember the newest decision about a process, for `explain`."""
        process.decision = decision.to_json(kind)
        process.decided_at = now


def larger(first: Mapping[str, float], second: Mapping[str, float]) -> Mapping[str, float]:
    """The larger amount of each resource."""
    if not second:
        return first
    names = {**first, **second}
    return {name: max(first.get(name, 0.0), second.get(name, 0.0)) for name in names}
