"""Migration plans as data: steps in order, each with its undo, and one commit.

A strategy proposes a `Plan`; the master's core executes it, and a `Migration` has its progress.
A failure before the commit undoes the completed steps, newest first, back to a running source. A
failed step after the commit is retried. A migration that can do neither is shown as stuck.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from math import inf
from typing import Any, ClassVar, Final

from rosrm.model.codec import ByName
from rosrm.model.values import EMPTY, InstanceId, LifecycleGoal, ProcessSpec, RestartPolicy


@dataclass(frozen=True, slots=True)
class Move:
    """Input of a strategy: a process to be migrated.

    Attributes:
        spec: as submitted.
        source: the running instance.
        source_host: name of its host.
        destination: the instance to be started, already numbered.
        destination_host: name of its host.
        fallback: an instance for a new start at the source, if the undo of a stop needs one.
        now: unix time in whole seconds, for the alias of a handoff.
        source_node: name of the source's node: an alias, if a handoff started it.
        options: options of the strategy for this process: those of the cluster, overridden by those
            of the process; an object of the offer's `own_options` or `options`.
        new_spec: spec of the destination, if the process is replaced by another version of it;
            None: the destination has the spec of the source.
        lacking: executors of the strategy's offer that one of the two hosts does not have, because
            it has another version of the plugin.
    """

    spec: ProcessSpec
    source: InstanceId
    source_host: str
    destination: InstanceId
    destination_host: str
    fallback: InstanceId
    now: int
    source_node: str
    options: Any = None
    new_spec: ProcessSpec | None = None
    lacking: frozenset[str] = frozenset()

    @property
    def destination_spec(self) -> ProcessSpec:
        """Return the spec of the destination."""
        return self.spec if self.new_spec is None else self.new_spec


class Aim(str, Enum):
    """Purpose of a plan.

    A checkpoint dumps the source into an image on its host and starts no destination. In a restore,
    the source is the dumped instance, which does not run any more.
    """

    MOVE = "move"
    CHECKPOINT = "checkpoint"
    RESTORE = "restore"


class HandoffPhase(ByName, IntEnum):
    """Phase that the master publishes for a handoff, as in `StateConfig`."""

    SHADOW = 1
    SWITCH = 2
    TAKE_OVER = 3
    ABORT = 4
    RESUME = 5
    DONE = 6


_FORWARD: Final = (HandoffPhase.SHADOW, HandoffPhase.SWITCH, HandoffPhase.DONE)


class ReportPhase(IntEnum):
    """Phase that the source or the destination of a handoff reports, as in `HandoffReport`."""

    ATTACHED = 1
    SILENT = 2
    RELEASED = 3
    RESUMED = 4
    SHADOWING = 11
    READY = 12
    SWITCHING = 13
    ACTIVE = 14
    ABORTED = 15
    FAILED = 20


@dataclass(frozen=True, slots=True)
class Start:
    """Start an instance on a host; done when the slave reports that it runs.

    A shadow is the destination of a handoff: it has an alias, stays silent, and is not restarted. A
    restored instance starts from an image of the frozen source, which earlier steps have copied to
    the host; it is not restarted either. An inactive instance has a lifecycle node that its slave
    configures, and does not activate before a `SetLifecycle`. `remappings` are added to those of
    the spec.
    """

    KIND: ClassVar = "start"

    instance: InstanceId
    host: str
    timeout: float
    node_name: str = ""
    undo: Step | None = None
    shadow: bool = False
    remappings: Mapping[str, str] = field(default_factory=dict)
    restored: bool = False
    inactive: bool = False

    def may_run_beside(self, node: str) -> bool:
        """Return True if the new instance does not claim the name of a running node at once."""
        return self.node_name not in ("", node) or self.restored or self.inactive


@dataclass(frozen=True, slots=True)
class AwaitReady:
    """Wait until an instance is ready; done `settle` seconds after its slave has reported that."""

    KIND: ClassVar = "await_ready"

    instance: InstanceId
    host: str
    timeout: float
    undo: Step | None = None
    settle: float = 0.0


@dataclass(frozen=True, slots=True)
class AwaitReleased:
    """Wait until a silent source reports that its last outputs have arrived, or the time-out.

    This step never fails, because the successor is active and sent messages cannot be recalled.
    """

    KIND: ClassVar = "await_released"

    instance: InstanceId
    host: str
    timeout: float
    undo: Step | None = None


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop an instance; done when its slave reports the end."""

    KIND: ClassVar = "stop"

    instance: InstanceId
    host: str
    timeout: float
    undo: Step | None = None


@dataclass(frozen=True, slots=True)
class Configure:
    """Publish `state_config` with this phase to the source and the destination of the migration.

    A phase is done when both have answered by the handoff protocol. DONE, and a phase that is not
    `awaited`, is done at once.
    """

    KIND: ClassVar = "configure"

    phase: HandoffPhase
    timeout: float
    awaited: bool = True
    undo: Step | None = None


@dataclass(frozen=True, slots=True)
class SetRestart:
    """Replace the restart policy of an instance; done when its slave has accepted the order."""

    KIND: ClassVar = "set_restart"

    instance: InstanceId
    host: str
    restart: RestartPolicy
    timeout: float
    undo: Step | None = None


@dataclass(frozen=True, slots=True)
class SetLifecycle:
    """Bring a lifecycle node to a state, now and after each restart; done when it is there.

    Only nodes with `lifecycle` in their spec, whose slave makes their transitions.
    """

    KIND: ClassVar = "set_lifecycle"

    instance: InstanceId
    host: str
    state: LifecycleGoal
    timeout: float
    undo: Step | None = None


@dataclass(frozen=True, slots=True)
class Commit:
    """Make the destination the owner of the name; each plan has one commit.

    In the plan of a checkpoint, the image becomes the owner instead of an instance. `image` names
    the executor that removes an unwanted image; "": the plan is not that of a checkpoint.
    """

    KIND: ClassVar = "commit"

    timeout: float = 0.0
    undo: Step | None = None
    image: str = ""


@dataclass(frozen=True, slots=True)
class Execute:
    """Run an executor of the strategy's plugin on a slave.

    The executor gets the arguments and, as `results`, the answers of the executors of earlier steps
    of the same migration, by their names.
    """

    KIND: ClassVar = "execute"

    executor: str
    host: str
    arguments: Mapping[str, Any]
    timeout: float
    undo: Step | None = None


#: Any step of a plan.
Step = (
    Start | AwaitReady | AwaitReleased | Stop | Configure | SetRestart | SetLifecycle | Commit
    | Execute
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Plan:
    """Plan of the migration of one process.

    Attributes:
        steps: in order; exactly one is a `Commit`.
        overlap: declared seconds for which both instances may be active at once; 0: never.
        options: stored with the migration.
    """

    steps: tuple[Step, ...]
    overlap: float = 0.0
    options: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


def plan_fault(plan: Plan, move: Move, aim: Aim = Aim.MOVE) -> str:
    """Return the fault of a plan that a strategy proposed for an aim; "": none."""
    given: object = plan
    if not isinstance(given, Plan):
        return f"it is {'None' if given is None else type(given).__name__}, not a Plan"
    commits = sum(isinstance(step, Commit) for step in plan.steps)
    if commits != 1:
        return f"it has {commits} commit points, not one"
    if not 0.0 <= plan.overlap < inf:
        return f"its overlap is {plan.overlap:g} s"
    for step in all_steps(plan.steps):
        fault = _step_fault(step, move)
        if fault:
            return f"{type(step).__name__} {fault}"
    for step in plan.steps:
        fault = _handoff_fault(step)
        if fault:
            return fault
    return _commit_fault(plan, move, aim) or _overlap_fault(plan, move, aim)


def _overlap_fault(plan: Plan, move: Move, aim: Aim) -> str:
    """Return why a start would wait for the end of the source for ever; "" if none does.

    Without an overlap the core delays a start of the same name until the source has ended. A plan
    with an earlier executor on the host of the source is accepted, because it may end the source.
    """
    if plan.overlap or aim is not Aim.MOVE:
        return ""
    for step in plan.steps:
        ends = isinstance(step, Execute) and step.host == move.source_host
        if ends or (isinstance(step, Stop) and step.instance == move.source):
            return ""
        if isinstance(step, Start) and not step.may_run_beside(move.spec.node):
            return (
                f"it starts {step.instance} under the name of the source before a Stop of the "
                "source, and its overlap is 0 s: declare an overlap, or stop the source first"
            )
    return ""


def _commit_fault(plan: Plan, move: Move, aim: Aim) -> str:
    """Return why the new owner of the name may not exist at the commit; "" if it does."""
    at = next(at for at, step in enumerate(plan.steps) if isinstance(step, Commit))
    before, commit, after = plan.steps[:at], plan.steps[at], plan.steps[at + 1 :]
    if isinstance(commit, Commit) and bool(commit.image) != (aim is Aim.CHECKPOINT):
        return f"the plan of a {aim.value} commits to {'an image' if commit.image else 'no image'}"
    if aim is Aim.CHECKPOINT:
        return _checkpoint_fault(plan, after, move)
    begun = [
        step for step in before
        if isinstance(step, (Start, AwaitReady)) and step.instance == move.destination
    ]  # fmt: skip
    if not begun:
        return "it commits to a destination that it never starts or awaits"
    activated = any(isinstance(one, SetLifecycle) and one.state == "active" for one in before)
    if any(isinstance(one, Start) and one.inactive for one in begun) and not activated:
        return "it commits to an inactive destination"
    if aim is Aim.RESTORE and not any(isinstance(one, Start) and one.restored for one in begun):
        return "a restore starts the destination without its image"
    return ""


def _checkpoint_fault(plan: Plan, after: Iterable[Step], move: Move) -> str:
    """Return why an instance may run beside the image after a checkpoint; "" if none may."""
    if any(isinstance(step, Start) for step in all_steps(plan.steps)):
        return "a checkpoint starts an instance"
    if not any(isinstance(step, Stop) and step.instance == move.source for step in after):
        return "a checkpoint does not stop its source after the commit"
    return ""


def _step_fault(step: Step, move: Move) -> str:
    if isinstance(step, Commit):
        return ""
    if not 0.0 < step.timeout < inf:
        return "has no time-out"
    if isinstance(step, Configure):
        return ""
    hosts = {move.source_host, move.destination_host}
    if step.host not in hosts:
        return f"names the host {step.host!r}, not one of {sorted(hosts)}"
    numbered = (move.source, move.destination, move.fallback)
    if not isinstance(step, Execute) and step.instance not in numbered:
        return f"names the instance {step.instance}, which is not of this move"
    if isinstance(step, Start) and step.restored and step.instance != move.destination:
        return "restores an instance that is not the destination"
    if isinstance(step, Start) and step.shadow:
        return _shadow_fault(step, move)
    return _lifecycle_fault(step, move)


def _lifecycle_fault(step: Step, move: Move) -> str:
    """Return why the slave cannot do a step, because it does not manage the lifecycle."""
    if not isinstance(step, SetLifecycle) and not (isinstance(step, Start) and step.inactive):
        return ""
    spec = move.spec if step.instance == move.source else move.destination_spec
    return "" if spec.lifecycle.is_managed else "needs `lifecycle` in the spec of the process"


def _shadow_fault(step: Start, move: Move) -> str:
    if step.instance != move.destination:
        return "starts a shadow that is not the destination"
    if step.node_name in ("", move.spec.node, move.source_node):
        return "starts a shadow without an alias"
    return ""


def _handoff_fault(step: Step) -> str:
    """Return the fault of a step of the handoff protocol; "": none.

    A silent source may resume only if the destination never becomes active, so SWITCH needs ABORT
    as its undo.
    """
    if not isinstance(step, Configure):
        return ""
    if step.phase not in _FORWARD:
        return f"it has the phase {step.phase.name}, which only an undo may have"
    undo = step.undo
    aborts = isinstance(undo, Configure) and undo.phase is HandoffPhase.ABORT and undo.awaited
    if step.phase is HandoffPhase.SWITCH and not aborts:
        return "it has the phase SWITCH, and its undo is not ABORT"
    return ""


def executors_of(plan: Plan) -> Iterator[tuple[str, str]]:
    """Return the executors that a plan and its undo name, with their hosts."""
    for step in all_steps(plan.steps):
        if isinstance(step, Execute):
            yield step.executor, step.host


def all_steps(steps: Iterable[Step]) -> Iterator[Step]:
    """Return the steps, each followed by the chain of its undo steps."""
    for step in steps:
        current: Step | None = step
        while current is not None:
            yield current
            current = current.undo
