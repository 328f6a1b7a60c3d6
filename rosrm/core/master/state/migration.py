"""State of each migration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosrm.core.master.commands import OrderId
from rosrm.core.master.events import OrderAnswered
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host
from rosrm.model.codec import fields_from_plain, fields_to_plain, to_plain
from rosrm.model.devices import HeldDevice
from rosrm.model.lazy import Plain
from rosrm.model.plan import Aim, Commit, Plan, ReportPhase, Step
from rosrm.model.values import InstanceId, InstanceStatus, ProcessSpec
from rosrm.wording import first_line


@dataclass(frozen=True, slots=True)
class End:
    """The end of an instance.

    Attributes:
        ordered: the instance was ordered to stop, so its exit code has no meaning.
        completed: a job ran to completion, even if an order to stop was on its way.
        gone: the instance is missing or lost, and its process may be queued again.
        restarts_off: its slave may have applied another restart policy than that of its spec.
    """

    status: InstanceStatus
    ordered: bool = False
    completed: bool = False
    gone: bool = False
    restarts_off: bool = False


@dataclass(slots=True)
class HandoffReports:
    """Reports of the source or the destination of a handoff.

    Attributes:
        phases: reported phase to its newest message.
        message: newest message of all phases.
        sequence: cycles that the newest reported state covers.
    """

    phases: dict[ReportPhase, str] = field(default_factory=dict)
    message: str = ""
    sequence: int = 0


@dataclass(slots=True)
class Migration:
    """A migration: the execution of a plan.

    Attributes:
        started: time of its begin by this master's clock; earlier than the master's own start if a
            former master began it.
        wall: unix time of its begin.
        source_node, destination_node: names of the nodes, without the namespace.
        index: index of the current step in the plan, or in `undo` on the way back.
        undo: steps of the way back; None: the migration goes forward.
        turned_at: index of the current step when the undo began.
        committed: the destination owns the name.
        deadline: time at which the current step times out.
        begun: the current step has been ordered.
        orders: orders of the current step since it was begun; the step may have none.
        stuck: a step that must succeed failed; it is retried with a back-off.
        answer: the slave's answer to the order of the current step; None: no answer yet.
        launched: numbers of the instances that were ordered to start.
        ended: instance number to the end of that instance.
        handoff_reports: instance number to its reports on a handoff.
        taking_over: the destination was ordered to take over without its source.
        results: executor name to its result.
        spec: spec of the destination, if it is another one than the source's, which it replaces at
            the commit; None: both have one spec.
        source_devices: devices that the source holds; they stay reserved until the commit or the
            end of the undo, because the source may be started again.
        silent_at, active_at: begin and end of the blackout; None: it has not begun, or ended.
        is_timed: this master has seen all of the migration.
        source_restarted: the source was restarted after a standby was READY, so that the standby
            has the state of the former run.
        aim: purpose of the plan. Source and destination of a checkpoint or restore are on one host.
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
    source_node: str
    destination_node: str
    wall: float
    index: int = 0
    undo: Sequence[Step] | None = None
    turned_at: int = 0
    committed: bool = False
    begun: bool = False
    deadline: float = 0.0
    orders: set[OrderId] = field(default_factory=set)
    order_at: float = 0.0
    failure: str = ""
    stuck: bool = False
    retry: Backoff = field(default_factory=Backoff)
    answer: OrderAnswered | None = None
    launched: set[int] = field(default_factory=set)
    ended: dict[int, End] = field(default_factory=dict)
    handoff_reports: dict[int, HandoffReports] = field(default_factory=dict)
    taking_over: bool = False
    results: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    aim: Aim = Aim.MOVE
    source_devices: tuple[HeldDevice, ...] = ()
    spec: ProcessSpec | None = None
    silent_at: float | None = None
    active_at: float | None = None
    is_timed: bool = True
    source_restarted: bool = False
    plain_plan: Plain = field(init=False)

    def __post_init__(self) -> None:
        self.plain_plan = Plain(self.plan)

    @property
    def current_step(self) -> Step | None:
        """Return the current or next step; None: all steps are done."""
        steps = self._steps
        return steps[self.index] if self.index < len(steps) else None

    @property
    def remaining_steps(self) -> Sequence[Step]:
        """Return the steps not begun yet, in the current direction."""
        return self._steps[self.index + self.begun :]

    @property
    def _steps(self) -> Sequence[Step]:
        return self.plan.steps if self.undo is None else self.undo

    @property
    def begun_steps(self) -> Sequence[Step]:
        """Return the steps of the plan up to the last one that may have been begun forward."""
        reached = self.index if self.undo is None else self.turned_at
        return self.plan.steps[: reached + 1]

    @property
    def destination_is_active(self) -> bool:
        """Return True if an executor has found the destination running, which forbids an undo."""
        return any(result.get("active") is True for result in self.results.values())

    @property
    def completion(self) -> str:
        """Return the sentence that the source, a job, has run to completion; "": it has not.

        As the reason of an undo this is no failure: no version of the job has failed.
        """
        end = self.ended.get(self.source.number)
        if end is None or not end.completed:
            return ""
        return f"{self.source} ran to completion during the {self.aim.value}"

    @property
    def progress_text(self) -> str:
        """Return the reason shown for the process during the migration."""
        host = self.destination_host.name
        if self.spec is not None:
            return f"it is being replaced on {host}"
        return {
            Aim.MOVE: f"to {host}",
            Aim.CHECKPOINT: f"it is being checkpointed on {host}",
            Aim.RESTORE: f"it is being restored on {host}",
        }[self.aim]

    @property
    def commit(self) -> Commit:
        """Return the commit of the plan."""
        return next(step for step in self.plan.steps if isinstance(step, Commit))

    def spec_of(self, instance: InstanceId, spec: ProcessSpec) -> ProcessSpec:
        """Return the spec of one of its instances; `spec`: that of its process."""
        if self.spec is None or instance != self.destination:
            return spec
        return self.spec

    def begin_undo(self) -> None:
        """Begin the undo of all steps up to the current one, newest first."""
        self.turned_at = self.index
        self.undo = undo_steps(self.plan, self.turned_at)
        self.index, self.begun = 0, False

    def how_ended(self, instance: InstanceId) -> str:
        """Return a phrase on how one of its instances ended."""
        end = self.ended.get(instance.number)
        if end is None:
            return "it was never started"
        codes = f"exit code {end.status.exit_code}, signal {end.status.exit_signal}"
        return first_line(end.status.message) or codes

    def phases_of(self, instance: InstanceId) -> Mapping[ReportPhase, str]:
        """Return all phases that the source or the destination has reported."""
        reports = self.handoff_reports.get(instance.number)
        return reports.phases if reports is not None else {}


def undo_steps(plan: Plan, turned_at: int) -> Sequence[Step]:
    """Return the undo of the steps of a plan up to one of them, newest first."""
    begun_steps = plan.steps[: turned_at + 1]
    return [step.undo for step in reversed(begun_steps) if step.undo is not None]


#: Fields that are journaled unchanged: of a migration, of an end, and of the status of an end.
JOURNALED: Final = (
    "strategy", "cause", "wall", "source_node", "destination_node", "index", "turned_at",
    "committed", "failure", "launched", "results", "aim",
    "source_devices",
)  # fmt: skip
_END: Final = ("ordered", "completed", "gone", "restarts_off")
_STATUS: Final = ("state", "exit_code", "exit_signal", "message", "run_time")


def migration_to_dict(migration: Migration, stopping: Sequence[int]) -> dict[str, Any]:
    """Return all fields of a migration that a restarted master needs.

    Reports of a handoff are left out, because the nodes repeat them. `stopping`: numbers of its
    instances that were ordered to stop.
    """
    return {
        "plan": migration.plain_plan, "back": migration.undo is not None,
        "stopping": list(stopping),
        "source": migration.source.number, "source_host": migration.source_host.name,
        "destination": migration.destination.number,
        "destination_host": migration.destination_host.name,
        "ended": {str(number): _end_to_dict(end) for number, end in migration.ended.items()},
        **({} if migration.spec is None else {"spec": to_plain(migration.spec)}),
        **fields_to_plain(migration, JOURNALED),
    }  # fmt: skip


def _end_to_dict(end: End) -> dict[str, Any]:
    return {**fields_to_plain(end.status, _STATUS), **fields_to_plain(end, _END)}


def end_from_dict(instance: InstanceId, plain: Mapping[str, Any]) -> End:
    """Return an end from its form in `migration_to_dict`."""
    status = InstanceStatus(instance, **fields_from_plain(InstanceStatus, plain, _STATUS))
    return End(status, **fields_from_plain(End, plain, _END))
