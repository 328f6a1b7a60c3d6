"""State of each process and of each of its instances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from math import inf, isinf
from typing import Any, Final

from rosrm.core.master.graph_names import node_of
from rosrm.core.master.state.backoff import Backoff, Retries
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host
from rosrm.model.devices import HeldDevice
from rosrm.model.event_kinds import EventKind
from rosrm.model.lazy import Plain
from rosrm.model.values import GroupEnd, InstanceId, InstanceState, Kind, ProcessSpec, Run

#: Principal and name of a gang.
GangKey = tuple[str, str]


class ProcessPhase(str, Enum):
    """Phase of a process as the master sees it."""

    QUEUED = "queued"
    SET_ASIDE = "set_aside"
    SCHEDULED = "scheduled"
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
    def is_terminal(self) -> bool:
        """Return True for a terminal phase, which only a client's request leaves."""
        return self in _TERMINAL


#: Phases of a process that has ended without a cancellation, by the member of `GroupEnd`.
_ENDS_GROUP: Final[Mapping[GroupEnd, tuple[ProcessPhase, ...]]] = {
    "never": (),
    "on-failure": (ProcessPhase.FAILED,),
    "always": (ProcessPhase.FAILED, ProcessPhase.FINISHED),
}
_TERMINAL: Final = frozenset({ProcessPhase.FINISHED, ProcessPhase.FAILED, ProcessPhase.CANCELLED})
#: Phases in which a process has not started since it was last queued.
BEFORE_START: Final = (
    ProcessPhase.QUEUED, ProcessPhase.SET_ASIDE, ProcessPhase.ASSIGNED, ProcessPhase.STOPPING,
)  # fmt: skip
#: Phases of processes that wait for a host.
WAITING: Final = (ProcessPhase.QUEUED, ProcessPhase.SET_ASIDE)


class DesiredState(str, Enum):
    """Desired state of a process once its instance has ended."""

    RUN = "run"
    CANCEL = "cancel"
    REQUEUE = "requeue"


@dataclass(slots=True)
class PendingRestart:
    """Restart of an instance in place that no status shows yet.

    Attributes:
        pid, restarts: the run that is to end.
        follows: a dependency was restarted; False: a client has requested the restart.
        ordered_at: time of the first order; -inf: unknown, because it was given before a boot of
            the master's machine.
    """

    pid: int
    restarts: int
    follows: bool
    ordered_at: float = -inf
    backoff: Backoff = field(default_factory=Backoff)

    @property
    def run(self) -> Run:
        """Return the run that is to end."""
        return Run(self.pid, self.restarts)


#: Fields of a pending restart that are journaled.
JOURNALED_RESTART: Final = ("pid", "restarts", "follows")


@dataclass(slots=True)
class Instance:
    """One start of a process on one host, as the master sees it.

    Attributes:
        spec: spec with which it was started, with the later changes that need no new start. That of
            its process, if the instance owns the name.
        since: time of the assignment.
        demand: base units that the assignment reserved.
        estimated: resources whose amount is an estimate and stops counting after `settle`.
        reserved: (R',) reservation on its host, fractions.
        state: state that the slave has reported last; None: assigned, without a report yet.
        seen: newest usage in base units; also of resources that are not attributed, if measured.
        peak: highest usage in base units.
        message: text of its slave's newest report, e.g. how its program ended.
        restarting: restart that was ordered and that no status shows yet; None: there is none.
        settled: its estimates no longer count.
        shown: the readings show its load of shared resources, which no longer counts.
        redelivered: the assignment was delivered again, because its slave did not accept it.
        recalled: a former run of the master may have ordered it to stop, so its end counts as
            ordered.
        at_once: it must be killed without delay, because another instance owns the name.
        order_at: time of the last order to stop or withdraw it; -inf: none.
        node_name: name of its node, if it differs from the name of the process.
        enforced: names of its limits and scheduling settings that hold, as its slave reports.
        ready_at: time at which the first report of its readiness arrived at this master.
        devices: devices of its host that it holds.
        stray: its host reports it, and the master has not assigned it to that host.
        began: its first start, as its host reports; inf: unknown.
        restarts_off: its slave may apply another restart policy than that of its spec, because
            a migration ordered another one, and no order of the spec's was confirmed since.
    """

    id: InstanceId
    host: Host
    spec: ProcessSpec
    since: float
    demand: Mapping[str, float]
    estimated: frozenset[str]
    reserved: FloatArray
    state: InstanceState | None = None
    pid: int = 0
    restarts: int = 0
    message: str = ""
    seen: dict[str, float] = field(default_factory=dict)
    peak: dict[str, float] = field(default_factory=dict)
    stopping: bool = False
    restarting: PendingRestart | None = None
    settled: bool = False
    shown: bool = False
    redelivered: bool = False
    recalled: bool = False
    at_once: bool = False
    order_at: float = -inf
    node_name: str = ""
    enforced: tuple[str, ...] = ()
    ready_at: float = inf
    devices: tuple[HeldDevice, ...] = ()
    stray: bool = False
    began: float = inf
    restarts_off: bool = False

    @property
    def is_running(self) -> bool:
        """Return True if the slave reports that the instance runs, ready or not."""
        return self.state in _RUNS

    @property
    def measured(self) -> dict[str, float]:
        """Return its newest usage, in base units, of the attributed resources that are probed."""
        probed = {resource.name for resource in self.host.description.resources}
        counted = probed & self.host.attributed
        return {name: amount for name, amount in self.seen.items() if name in counted}


_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.READY})


@dataclass(slots=True)
class PendingAmendment:
    """Change of a running instance that its slave has not made yet.

    Attributes:
        limits: the limits may differ, too.
        backoff: of the order.
        refusal: why the slave refuses it; "": it does not.
    """

    limits: bool = True
    backoff: Backoff = field(default_factory=Backoff)
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class LeftBehind:
    """The owning instance of a process on a lost host, until a successor is assigned.

    Attributes:
        began: unix time at which the process first started since it left the queue; 0: it did not.
        spec: spec of the instance; None: that of its process, as in older journals.
        restarts_off: that attribute of the instance.
    """

    number: int
    host: str
    node_name: str = ""
    began: float = 0.0
    spec: ProcessSpec | None = None
    restarts_off: bool = False


@dataclass(frozen=True, slots=True)
class Image:
    """The checkpoint image of a checkpointed process; the image owns the name.

    Attributes:
        number: number of the dumped instance.
        host: name of the host that stores it.
        strategy: name of the strategy that made it and can restore it.
        drop: name of the executor that removes it.
        made_at: unix time of the dump.
        node_name: name of the node, if it differs from the name of the process.
        needs: resource name to the measured usage of the instance, in base units.
    """

    number: int
    host: str
    strategy: str
    drop: str
    made_at: float
    node_name: str = ""
    needs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Failure:
    """The failure of a process on a host, which excludes the host.

    Attributes:
        incarnation: run of the host's slave in which it happened; the next run ends the exclusion.
    """

    reason: str
    incarnation: int


#: Fields of a process that are journaled unchanged.
JOURNALED: Final = (
    "order", "wanted", "owner", "reason", "excluded", "migrations", "exit_code", "restarts", "born",
    "principal", "owned_from", "defaulted", "began", "overdue", "reschedules", "queue_delay",
    "failed_on", "next_run", "restart_due", "cancel_cause", "awaits_gang", "by_operator", "killed",
)  # fmt: skip


@dataclass(slots=True)
class Process:
    """One submitted process.

    Attributes:
        next_spec: spec with which it is started again once its instances have ended; None: `spec`.
        order: place in the queue; unchanged when the process returns to the queue.
        principal: owner, the user that submitted the process, "user:ada"; "": unknown.
        by_operator: its owner was an operator at the submission: its spec may affect every process.
        since: start of its phase by this master's clock; earlier than the master's own start if the
            phase is from the journal.
        wall: unix time of the start of its phase.
        phase_before_loss: its phase when its host was lost, with the start of that phase (`since`
            and `wall`); None: its host reports, or the process has had another phase since.
        wanted: desired state.
        born: lowest number of an instance since the submission; snapshots of lower numbers are
            void.
        owned_from: lowest number of an instance since the name belongs to its principal; logs of
            lower numbers are of another owner.
        owner: number of the instance that owns the name; 0: none.
        instances: numbers of all its instances that may still run.
        excluded: name of each host that has refused the process to the reason.
        refusals: the same hosts, with the time from which on each is tried again.
        failed_on: name of each host that is excluded because the process failed there, in order.
        exit_code: exit code of the last run, a signal as a negative number; None: unknown, or the
            process runs.
        ended_on: name of the host of its last run; "": it has not ended, or never ran.
        ran_on: name of the host on which a supervisor saw the end of its last instance; "": none.
            That host may have a newer snapshot than its slave has reported. Not persisted.
        decision: newest placement decision about it, with its kind.
        left_behind: instance that may still run on a lost host, while this process waits in the
            queue.
        image: checkpoint image from which it can be restored; None: it is not checkpointed.
        moves: failed moves and standbys, by their hosts.
        standby_backoff: time before which no standby is started.
        standby_since: time at which its standby was ready; inf: it is not.
        standby_reason: condition of its standby, for listings.
        started_at: time at which it first started since it left the queue; inf: not yet, or its
            host has not yet reported for how long it has run.
        began: unix time of `started_at`, for displays; 0: not yet.
        ran_before: seconds from that start to the start of its owner, after moves, as a former
            master or a lost host left it.
        overdue: True: its time limit has passed, and it is being stopped.
        cancel_cause: why it is, or was, cancelled without a request of a client; "": it was not.
        killed: True: its cancellation is by force: neither the graces of its `stop` nor other
            processes delay the end.
        awaits_gang: True: it has a gang, and has not started since it was submitted; so it is
            placed together with the others of which this is true.
        reschedules: number of times that it was queued again after it had failed, in a row.
        queue_delay: seconds in the queue before its next placement.
        next_run: unix time of the next run of its schedule; 0: none.
        strays_until: time until which it waits in the queue for the ends of its strays; 0: it did
            not wait for them.
        restart_due: True: a dependency was restarted, and the process must be restarted in place as
            soon as the conditions of its start order hold.
        defaulted: paths of the fields of its spec whose values are the cluster's defaults.
        demand: its demand, with the version of the learned needs in it.
        name: its name, the same in each of its specs.
        node: phrase for the node that it adds to the ROS graph (`node_of`).
    """

    spec: ProcessSpec
    order: int
    phase: ProcessPhase
    since: float
    principal: str = ""
    by_operator: bool = False
    wanted: DesiredState = DesiredState.RUN
    owner: int = 0
    instances: set[int] = field(default_factory=set)
    reason: str = ""
    excluded: dict[str, str] = field(default_factory=dict)
    refusals: Retries = field(default_factory=Retries)
    failed_on: dict[str, Failure] = field(default_factory=dict)
    born: int = 0
    owned_from: int = 0
    migrations: int = 0
    moved_at: float = -inf
    exit_code: int | None = None
    ended_on: str = ""
    ran_on: str = ""
    wall: float = 0.0
    phase_before_loss: tuple[ProcessPhase, float, float] | None = None
    restarts: int = 0
    decision: Mapping[str, Any] | None = None
    decided_at: float = 0.0
    left_behind: LeftBehind | None = None
    image: Image | None = None
    moves: Retries = field(default_factory=Retries)
    standby_backoff: Backoff = field(default_factory=Backoff)
    standby_since: float = inf
    standby_reason: str = ""
    started_at: float = inf
    began: float = 0.0
    ran_before: float = 0.0
    overdue: bool = False
    cancel_cause: str = ""
    killed: bool = False
    awaits_gang: bool = False
    reschedules: int = 0
    queue_delay: float = 0.0
    next_run: float = 0.0
    strays_until: float = 0.0
    restart_due: bool = False
    history: list[tuple[float, EventKind, str]] = field(default_factory=list)
    defaulted: tuple[str, ...] = ()
    next_spec: ProcessSpec | None = None
    demand: tuple[int, Demand] | None = None
    name: str = field(init=False)
    plain: Plain = field(init=False)
    node: str = field(init=False)

    def __post_init__(self) -> None:
        self.name, self.plain, self.node = self.spec.name, Plain(self.spec), node_of(self.spec)

    @property
    def is_at_rest(self) -> bool:
        """Return True if nothing of it runs or waits for a host: terminal, or between two runs."""
        return self.phase.is_terminal or self.phase is ProcessPhase.SCHEDULED

    @property
    def is_finished_job(self) -> bool:
        """Return True for a job that has done its work; a finished service should run."""
        return self.phase is ProcessPhase.FINISHED and self.spec.kind is Kind.JOB

    @property
    def gang(self) -> GangKey | None:
        """Return the gang together with which it is placed; None: it is placed alone."""
        return (self.principal, self.spec.together) if self.awaits_gang else None

    @property
    def forbidden_hosts(self) -> dict[str, str]:
        """Return host name to the reason why the process must not run there."""
        if not self.failed_on:
            return dict(self.excluded)
        failed = {
            host: f"{self.name} failed there: {one.reason}" for host, one in self.failed_on.items()
        }
        return {**self.excluded, **failed}

    @property
    def placed_from(self) -> float:
        """Return the time from which a queued process may be placed."""
        return self.since + self.queue_delay

    def note_run_time(self, seconds: float, now: float) -> None:
        """Note for how long its owner has run, by the clock of that host.

        Only the host knows that after a restart of the master or a loss of the host: unix time may
        have been set since, and says nothing about a duration.
        """
        self.started_at = min(self.started_at, now - self.ran_before - seconds)

    def ran_before_owner(self, owner: Instance | None) -> float:
        """Return the seconds from its first start to that of its owner."""
        if owner is None or isinf(owner.began) or isinf(self.started_at):
            return self.ran_before
        return max(0.0, owner.began - self.started_at)


def ends_group(process: Process) -> bool:
    """Return True if a process has ended in a way that ends its group, too."""
    return process.phase in _ENDS_GROUP[process.spec.group.ends]
