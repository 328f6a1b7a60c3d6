"""What the master knows of each process and of each of its instances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Any, Final

from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.lazy import Lazy
from rosrm.model.event_kinds import EventKind
from rosrm.model.spec_json import spec_to_dict
from rosrm.model.values import InstanceId, InstanceState, ProcessSpec


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
    CHECKPOINTED = "checkpointed"

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
        settled: its estimates stopped counting.
        restarting: it was ordered to restart, and has not been seen to do so yet.
        given_again: the assignment was delivered anew, since its slave did not take it up.
        recalled: a master ordered it to stop and was itself restarted: its end is not its own.
        at_once: it is to end without delay, as another instance owns the name.
        order: of an unanswered stop, 0: none.
        order_at: when it was given.
        node_name: under which its node runs, where that is not the process's name.
        ready_at: time at which this master learned that it is ready.
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
    restarting: bool = False
    settled: bool = False
    given_again: bool = False
    recalled: bool = False
    at_once: bool = False
    order: int = 0
    order_at: float = 0.0
    node_name: str = ""
    ready_at: float = inf

    @property
    def runs(self) -> bool:
        """Its slave says that it runs, ready or not."""
        return self.state in _RUNS

    @property
    def measured(self) -> dict[str, float]:
        """Newest usage of the resources that a probe of its host reads, base units."""
        probed = {resource.name for resource in self.host.description.resources}
        return {name: amount for name, amount in self.seen.items() if name in probed}


_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.READY})


@dataclass(frozen=True, slots=True)
class LeftBehind:
    """The owner that a process had on a host which was lost, as long as nothing has followed it.

    Attributes:
        number: of the instance.
        host: name of the host.
        node_name: under which its node runs, where that is not the process's name.
    """

    number: int
    host: str
    node_name: str = ""


@dataclass(frozen=True, slots=True)
class Image:
    """What a process goes on from that was checkpointed: it owns the name.

    Attributes:
        number: of the instance that it is of.
        host: name of the host on which it lies.
        strategy: that made it, and restores it.
        drop: the executor that removes it.
        made_at: unix time.
        node_name: under which its node runs, where that is not the process's name.
        needs: base units that it was seen to use, by resource.
    """

    number: int
    host: str
    strategy: str
    drop: str
    made_at: float
    node_name: str = ""
    needs: Mapping[str, float] = field(default_factory=dict)


class PlainSpec(Lazy):
    """A spec as JSON has it: made once for all the intents that it is in."""

    __slots__ = ("_spec",)

    def __init__(self, spec: ProcessSpec) -> None:
        super().__init__()
        self._spec = spec

    def render(self) -> Mapping[str, Any]:
        """All fields of the spec."""
        return spec_to_dict(self._spec)


@dataclass(slots=True)
class Process:
    """One submitted process.

    Attributes:
        order: place in the line; kept when it returns to the queue.
        since: when its phase began, by this master's clock; before its own start, where the journal
            says so.
        wall: unix time at which its phase began.
        out_of_sight: its phase when its host was lost, with the start of that phase (`since` and
            `wall`); None: its host reports, or the process has another phase since.
        born: lowest number that an instance of it can have; what lower ones kept is not its own.
        owner: number of the instance that owns the name; 0: none.
        instances: numbers of all its instances that may still run.
        excluded: host name to the reason why it cannot run there.
        exit_code: of its last run, a signal as a negative number; None: it is not known, or it
            runs.
        ended_on: name of the host on which it has ended; "": it has not, or ran nowhere.
        decision: the newest one about it, with its kind.
        left_behind: the instance that may still run on a lost host, while this process waits in the
            queue for another one.
        image: what it goes on from, when it is restored; None: it is not checkpointed.
        standby_at: time before which no standby is begun.
        standby_tries: standbys that were lost, one after the other.
        standby_reason: how it stands with its standby, for people.
        demand: what decides where it may go, and the version of what was learned that is in it.
    """

    spec: ProcessSpec
    order: int
    phase: ProcessPhase
    since: float
    wanted: Wanted = Wanted.RUN
    owner: int = 0
    instances: set[int] = field(default_factory=set)
    reason: str = ""
    excluded: dict[str, str] = field(default_factory=dict)
    born: int = 0
    migrations: int = 0
    moved_at: float = float("-inf")
    exit_code: int | None = None
    ended_on: str = ""
    wall: float = 0.0
    out_of_sight: tuple[ProcessPhase, float, float] | None = None
    restarts: int = 0
    decision: Mapping[str, Any] | None = None
    decided_at: float = 0.0
    left_behind: LeftBehind | None = None
    image: Image | None = None
    standby_at: float = 0.0
    standby_tries: int = 0
    standby_reason: str = ""
    history: list[tuple[float, EventKind, str]] = field(default_factory=list)
    demand: tuple[int, Demand] | None = None
    plain: PlainSpec = field(init=False)

    def __post_init__(self) -> None:
        self.plain = PlainSpec(self.spec)

    @property
    def name(self) -> str:
        """Its name."""
        return self.spec.name
