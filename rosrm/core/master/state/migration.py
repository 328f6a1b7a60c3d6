"""What the master knows of each move under way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.lazy import Lazy
from rosrm.model.plan import Aim, Commit, Plan, ReportPhase, Step
from rosrm.model.plan_json import plan_to_dict
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.wording import one_line


@dataclass(frozen=True, slots=True)
class End:
    """How an instance ended.

    Attributes:
        ordered: it had been told to stop, so that its exit code says nothing.
        completed: a job that came to its end by itself, whatever it had been told meanwhile.
        gone: its host does not hold it any more and says nothing of its end.
    """

    status: InstanceStatus
    ordered: bool = False
    completed: bool = False
    gone: bool = False


@dataclass(slots=True)
class Heard:
    """What the source or the destination of a handoff has said.

    Attributes:
        phases: all of them, with the newest message of each.
        message: the newest of all.
    """

    phases: dict[ReportPhase, str] = field(default_factory=dict)
    message: str = ""


class PlainPlan(Lazy):
    """A plan as JSON has it: made once for all the intents that it is in."""

    __slots__ = ("_plan",)

    def __init__(self, plan: Plan) -> None:
        super().__init__()
        self._plan = plan

    def render(self) -> Mapping[str, Any]:
        """All fields of the plan."""
        return plan_to_dict(self._plan)


@dataclass(slots=True)
class Run:
    """A plan that is being carried out.

    Attributes:
        started: when it began, by this master's clock; before its own start, where it was taken up.
        wall: unix time at which it began.
        source_node, destination_node: names of their nodes, without the namespace.
        index: of the step in hand, in the plan or, going back, in `undo`.
        undo: steps still to be done on the way back; None: going forward.
        turned_at: index of the step in hand when it turned back.
        committed: the destination owns the name.
        deadline: of the step in hand.
        begun: the step in hand has been ordered.
        order: of the step in hand, 0: none.
        stuck: a step that must be done failed; it is tried again from `retry_at` on.
        answer: of the slave to the order of the step in hand: accepted, message.
        bad_result: the executor of the step in hand ran to its end, but answered no JSON object.
        launched: numbers of the instances that were ordered to start.
        suspended: numbers of the instances whose slave was told not to restart them. It may have
            been told otherwise since: its answer may come before the news of an end.
        ended: how its instances ended, by number.
        heard: what they said of a handoff, by number.
        taking_over: the destination was told to go on without its source.
        results: what executors have answered, by their names.
        aim: what it is to bring about. Source and destination of a checkpoint or a restore have the
            same host.
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
    order: int = 0
    order_at: float = 0.0
    failure: str = ""
    stuck: bool = False
    retry_at: float = 0.0
    answer: tuple[bool, str] | None = None
    bad_result: bool = False
    launched: set[int] = field(default_factory=set)
    suspended: set[int] = field(default_factory=set)
    ended: dict[int, End] = field(default_factory=dict)
    heard: dict[int, Heard] = field(default_factory=dict)
    taking_over: bool = False
    results: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    aim: Aim = Aim.MOVE
    plain_plan: PlainPlan = field(init=False)

    def __post_init__(self) -> None:
        self.plain_plan = PlainPlan(self.plan)

    @property
    def step_in_hand(self) -> Step | None:
        """The step that is being done, or is to be done next; None: all are done."""
        steps = self._steps
        return steps[self.index] if self.index < len(steps) else None

    @property
    def ahead(self) -> Sequence[Step]:
        """The steps that have not been begun, on the way on which it is."""
        return self._steps[self.index + self.begun :]

    @property
    def _steps(self) -> Sequence[Step]:
        return self.plan.steps if self.undo is None else self.undo

    @property
    def so_far(self) -> Sequence[Step]:
        """The steps of the plan that were begun, or may have been, on the way forward."""
        reached = self.index if self.undo is None else self.turned_at
        return self.plan.steps[: reached + 1]

    @property
    def went_on(self) -> bool:
        """An executor has answered that the destination goes on already: there is no way back."""
        return any(result.get("active") is True for result in self.results.values())

    @property
    def course(self) -> str:
        """What happens to the process meanwhile, for people."""
        host = self.destination_host.name
        return {
            Aim.MOVE: f"to {host}",
            Aim.CHECKPOINT: f"it is being checkpointed on {host}",
            Aim.RESTORE: f"it is being restored on {host}",
        }[self.aim]

    @property
    def commit_index(self) -> int:
        """Where in the plan its commit is."""
        return next(at for at, step in enumerate(self.plan.steps) if isinstance(step, Commit))

    def turn_back(self) -> None:
        """From here on undo every step so far, the one in hand included, newest first."""
        self.turned_at = self.index
        self.undo = way_back(self.plan, self.turned_at)
        self.index, self.begun = 0, False

    def how_ended(self, instance: InstanceId) -> str:
        """How one of its instances ended, for people."""
        end = self.ended.get(instance.number)
        if end is None:
            return "it was never started"
        status = end.status
        return (
            one_line(status.message) or f"exit code {status.exit_code}, signal {status.exit_signal}"
        )

    def phases_of(self, instance: InstanceId) -> Mapping[ReportPhase, str]:
        """All that the source or the destination has said."""
        heard = self.heard.get(instance.number)
        return heard.phases if heard is not None else {}


def way_back(plan: Plan, turned_at: int) -> Sequence[Step]:
    """What undoes the steps of a plan up to one of them, newest first."""
    so_far = plan.steps[: turned_at + 1]
    return [step.undo for step in reversed(so_far) if step.undo is not None]


def run_to_dict(run: Run, stopping: Sequence[int]) -> dict[str, Any]:
    """All that a master which was started anew must know of a run.

    What is heard of a handoff is not in it: it is heard again.

    Args:
        run: it.
        stopping: numbers of its instances that were ordered to stop.
    """
    return {
        "strategy": run.strategy, "cause": run.cause, "wall": run.wall, "plan": run.plain_plan,
        "source": run.source.number, "source_host": run.source_host.name,
        "source_node": run.source_node, "destination": run.destination.number,
        "destination_host": run.destination_host.name, "destination_node": run.destination_node,
        "index": run.index, "back": run.undo is not None, "turned_at": run.turned_at,
        "committed": run.committed, "failure": run.failure, "launched": sorted(run.launched),
        "suspended": sorted(run.suspended), "stopping": list(stopping),
        "ended": {str(number): _end_to_dict(end) for number, end in run.ended.items()},
        "results": {name: dict(result) for name, result in run.results.items()},
        "aim": run.aim.value,
    }  # fmt: skip


def _end_to_dict(end: End) -> dict[str, Any]:
    status = end.status
    return {
        "state": status.state.value, "exit_code": status.exit_code,
        "exit_signal": status.exit_signal, "message": status.message, "ordered": end.ordered,
        "completed": end.completed, "gone": end.gone, "run_time": status.run_time,
    }  # fmt: skip


def end_from_dict(instance: InstanceId, plain: Mapping[str, Any]) -> End:
    """How an instance ended, as `run_to_dict` has it; what nobody asks for later is not in it."""
    status = InstanceStatus(
        instance, InstanceState(plain["state"]), exit_code=int(plain["exit_code"]),
        exit_signal=int(plain["exit_signal"]), message=str(plain["message"]),
        run_time=float(plain.get("run_time", 0.0)),  # older journals have none
    )  # fmt: skip
    return End(status, bool(plain["ordered"]), bool(plain["completed"]), bool(plain["gone"]))
