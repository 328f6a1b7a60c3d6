"""Handoff protocol on the master's side: phases sent, reports received, decision.

The destination alone decides when it becomes active. After the master has published SWITCH, it may
guess that the destination is not active, but never act on the guess. It orders the source to resume
only when the destination has reported that it never will be active, or has ended.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master import lifecycle
from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import StepFailed, StepOutcome, StepProgress, done_if
from rosrm.core.master.state.migration import Heard, Run
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase
from rosrm.model.values import InstanceId, ProcessSpec

#: Reports of a destination that follows the source, or is further still.
_READY: Final = frozenset({ReportPhase.READY, ReportPhase.SWITCHING, ReportPhase.ACTIVE})

#: Action that the master orders in each phase, as the subject of a sentence.
TITLES: Final[Mapping[HandoffPhase, str]] = {
    HandoffPhase.SHADOW: "copying the state to the destination",
    HandoffPhase.SWITCH: "switching from the source to the destination",
    HandoffPhase.TAKE_OVER: "letting the destination take over",
    HandoffPhase.ABORT: "calling the handoff off at the destination",
    HandoffPhase.RESUME: "letting the source publish again",
    HandoffPhase.DONE: "ending the handoff",
}
#: Predicate of a sentence for each report, with the node as its subject.
_REPORTS: Final[Mapping[ReportPhase, str]] = {
    ReportPhase.ATTACHED: "takes part in the handoff",
    ReportPhase.SILENT: "has stopped publishing",
    ReportPhase.RELEASED: "has handed everything over",
    ReportPhase.RESUMED: "publishes again",
    ReportPhase.SHADOWING: "receives the state of the source",
    ReportPhase.READY: "has the state of the source and can take over",
    ReportPhase.SWITCHING: "is taking over",
    ReportPhase.ACTIVE: "is active",
    ReportPhase.ABORTED: "has called the handoff off",
    ReportPhase.FAILED: "cannot continue the handoff",
}


# --- phases sent ------------------------------------------------------------------------------


def publish(state: MasterState, run: Run, phase: HandoffPhase) -> None:
    """Publish the phase of a handoff to its source and destination."""
    spec = state.processes[run.process].spec
    state.emit(
        PublishStateConfig(
            run.process, phase, run.source.number, run.destination.number,
            qualified(spec, run.source_node), qualified(spec, run.destination_node),
        )
    )  # fmt: skip


def qualified(spec: ProcessSpec, node_name: str) -> str:
    """Return the name of a node with the namespace of its process: "/robot/camera"."""
    namespace = spec.namespace.strip("/")
    return f"/{namespace}/{node_name}" if namespace else f"/{node_name}"


def close(state: MasterState, run: Run) -> None:
    """Publish the end of a handoff, if anything was published of it before."""
    said = [step.phase for step in run.so_far if isinstance(step, Configure)]
    if said and HandoffPhase.DONE not in said:
        publish(state, run, HandoffPhase.DONE)


def say_again(state: MasterState, run: Run, step: Configure, now: float) -> None:
    """Repeat a phase without an answer, because the message may be lost.

    If the source has ended, publish the order to take over in its place.
    """
    if _needs_take_over(state, run, step):
        _take_over(state, run, step, now)
    elif step.awaited and now - run.order_at >= state.settings.order_retry:
        run.order_at = now
        publish(state, run, step.phase)


def _needs_take_over(state: MasterState, run: Run, step: Configure) -> bool:
    """Return True if the source ended while the master awaited its silence.

    The destination takes over from the state that it has.
    """
    alone = run.source.number not in state.instances and run.destination.number in state.instances
    return step.phase is HandoffPhase.SWITCH and alone and not is_active(state, run)


def _take_over(state: MasterState, run: Run, step: Configure, now: float) -> None:
    if run.taking_over and now - run.order_at < state.settings.order_retry:
        return
    if not run.taking_over:
        run.taking_over = True
        run.deadline = now + step.timeout
        state.record(
            now, EventKind.TAKE_OVER,
            f"{run.source} has ended: {run.destination} takes over from it",
            process=run.process, host=run.destination_host.name,
        )  # fmt: skip
    run.order_at = now
    publish(state, run, HandoffPhase.TAKE_OVER)


# --- reports received -------------------------------------------------------------------------


def handoff_reported(state: MasterState, event: happened.HandoffReported, now: float) -> None:
    """Note the reported phase of the source or the destination."""
    for run in (state.runs.get(event.process), state.standbys.get(event.process)):
        if run is not None and run.destination.number == event.destination:
            _note(state, run, event, now)


def _note(state: MasterState, run: Run, event: happened.HandoffReported, now: float) -> None:
    if event.instance not in (run.source.number, run.destination.number):
        return
    heard = run.heard.setdefault(event.instance, Heard())
    if event.phase not in heard.phases:
        # A destination that receives the state waits no more; a time-out shows the older message.
        is_news = event.message and event.phase is not ReportPhase.SHADOWING
        said = f": {event.message}" if is_news else ""
        message = f"{run.process}#{event.instance} {_REPORTS[event.phase]}{said}"
        state.record(
            now, EventKind.HANDOFF_REPORTED, message,
            process=run.process,
            facts={"phase": event.phase.name, "sequence": event.sequence},
        )  # fmt: skip
    heard.phases[event.phase] = heard.message = event.message


def is_active(state: MasterState, run: Run) -> bool:
    """Return True if the destination has reported that it is active, with no order to stop since.

    After an order to stop, only its end decides.
    """
    instance = state.instances.get(run.destination.number)
    if instance is None or instance.stopping:
        return False
    said = run.phases_of(run.destination)
    return ReportPhase.ACTIVE in said and ReportPhase.ABORTED not in said


def is_released(state: MasterState, run: Run, instance: InstanceId) -> bool:
    """Return True if a silent source has handed everything over, or has ended."""
    ended = instance.number not in state.instances
    return ended or ReportPhase.RELEASED in run.phases_of(instance)


def is_switching(run: Run) -> bool:
    """Return True if the current step is the one in which the destination becomes active."""
    step = run.step_in_hand
    if run.undo is not None or not isinstance(step, Configure):
        return False
    return step.phase is HandoffPhase.SWITCH


# --- outcome of a phase -----------------------------------------------------------------------


def outcome(step: Configure, state: MasterState, run: Run) -> StepOutcome:
    """Return the outcome of the current phase."""
    return _OUTCOMES[step.phase](state, run) if step.awaited else StepProgress.DONE


def _shadowing(state: MasterState, run: Run) -> StepOutcome:
    is_ready = bool(_READY & run.phases_of(run.destination).keys())
    return _fault(state, run) or done_if(is_ready)


def _switching(state: MasterState, run: Run) -> StepOutcome:
    if is_active(state, run):
        return StepProgress.DONE
    return _fault(state, run) or StepProgress.PENDING


def _fault(state: MasterState, run: Run) -> StepFailed | None:
    """Return why the destination can no longer become active; None: it can."""
    if run.destination.number not in state.instances:
        how = run.how_ended(run.destination)
        return StepFailed(f"{run.destination} ended on {run.destination_host.name}: {how}")
    for instance in (run.destination, run.source):
        said = run.phases_of(instance)
        if ReportPhase.FAILED in said:
            how = f"{_REPORTS[ReportPhase.FAILED]}: {said[ReportPhase.FAILED]}"
            return StepFailed(f"{instance} {how}")
    if ReportPhase.ABORTED in run.phases_of(run.destination):
        return StepFailed(f"{run.destination} {_REPORTS[ReportPhase.ABORTED]}")
    return None


def _aborting(state: MasterState, run: Run) -> StepOutcome:
    said = run.phases_of(run.destination)
    aborted = ReportPhase.ABORTED in said or ReportPhase.FAILED in said
    return done_if(aborted or run.destination.number not in state.instances)


def _resuming(state: MasterState, run: Run) -> StepOutcome:
    resumed = ReportPhase.RESUMED in run.phases_of(run.source)
    ended = run.source.number not in state.instances
    # A source without the protocol reports nothing, and never stopped publishing.
    deaf = not was_switched(run) and not run.phases_of(run.source)
    return done_if(resumed or ended or deaf)


def _at_once(state: MasterState, run: Run) -> StepOutcome:
    return StepProgress.DONE


_OUTCOMES: Final[Mapping[HandoffPhase, Callable[[MasterState, Run], StepOutcome]]] = {
    HandoffPhase.SHADOW: _shadowing,
    HandoffPhase.SWITCH: _switching,
    HandoffPhase.ABORT: _aborting,
    HandoffPhase.RESUME: _resuming,
    HandoffPhase.DONE: _at_once,
}


def was_switched(run: Run) -> bool:
    """Return True if SWITCH may have been published, so that the source may be silent."""
    return any(
        isinstance(step, Configure) and step.phase is HandoffPhase.SWITCH for step in run.so_far
    )


# --- time-outs --------------------------------------------------------------------------------


def timed_out(state: MasterState, run: Run, step: Configure, now: float) -> StepOutcome:
    """Return the outcome of a phase after its time-out, as `outcome` does."""
    if step.phase is HandoffPhase.RESUME and not was_switched(run):
        return StepProgress.DONE  # it was never ordered to be silent
    if step.phase is HandoffPhase.ABORT:
        instance = state.instances[run.destination.number]
        if not instance.stopping:
            _stop_unheard(state, run, now)
            return StepProgress.PENDING
    what = f"{TITLES[step.phase]} took longer than {step.timeout:g} s"
    return StepFailed(f"{what}: {_waited(run)}")


def _stop_unheard(state: MasterState, run: Run, now: float) -> None:
    """Stop a destination that does not answer: only its end ensures that it is never active."""
    stop = state.processes[run.process].spec.stop
    lifecycle.stop_instance(state, state.instances[run.destination.number], now)
    run.deadline = now + stop.timeout
    state.record(
        now, EventKind.DESTINATION_UNHEARD,
        f"{run.destination} does not confirm that the handoff is called off: the master stops it",
        process=run.process, host=run.destination_host.name,
    )  # fmt: skip
    state.save_run(run)


def _waited(run: Run) -> str:
    """Return the newest report of source and destination, for a time-out."""
    source, destination = run.heard.get(run.source.number), run.heard.get(run.destination.number)
    if source is None and destination is None:
        return (
            "neither node has reported. Do they use rosrm.node? One that keeps only the "
            "paper's constraints needs `protocol: paper` in the options of its migration"
        )
    said = [
        f"{instance} has not reported"
        if heard is None
        else f"{instance} {_REPORTS[list(heard.phases)[-1]]}"
        + (f": {heard.message}" if heard.message else "")
        for instance, heard in ((run.destination, destination), (run.source, source))
    ]
    return "; ".join(said)
