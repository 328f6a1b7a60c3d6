"""Handoff protocol on the master's side: phases sent, reports received, decisions.

The destination alone decides when it becomes active. After the master has published SWITCH, silence
of the destination proves nothing: the destination may be active. So the master orders the source to
resume only when the destination has reported that it will never become active, or has ended.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master import lifecycle
from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import blackout
from rosrm.core.master.outcomes import (
    StepFailed,
    StepOutcome,
    StepProgress,
    done_if,
)
from rosrm.core.master.recovery import journal_gap
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.migration import HandoffReports, Migration
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase
from rosrm.model.values import InstanceId, qualified_name

#: Reports of a destination that follows the source or is in a later phase.
_READY: Final = frozenset({ReportPhase.READY, ReportPhase.SWITCHING, ReportPhase.ACTIVE})

#: Action that the master orders in each phase, as the subject of a sentence.
TITLES: Final[Mapping[HandoffPhase, str]] = {
    HandoffPhase.SHADOW: "copying the state to the destination",
    HandoffPhase.SWITCH: "switching from the source to the destination",
    HandoffPhase.TAKE_OVER: "letting the destination take over",
    HandoffPhase.ABORT: "aborting the handoff at the destination",
    HandoffPhase.RESUME: "letting the source publish again",
    HandoffPhase.DONE: "ending the handoff",
}
#: Predicate of a sentence for each report, with the node as its subject.
_REPORTS: Final[Mapping[ReportPhase, str]] = {
    ReportPhase.ATTACHED: "takes part in the handoff",
    ReportPhase.SILENT: "has stopped publishing",
    ReportPhase.RELEASED: "has delivered its last messages",
    ReportPhase.RESUMED: "publishes again",
    ReportPhase.SHADOWING: "receives the state of the source",
    ReportPhase.READY: "has the state of the source and can take over",
    ReportPhase.SWITCHING: "is taking over",
    ReportPhase.ACTIVE: "is active",
    ReportPhase.ABORTED: "has aborted the handoff",
    ReportPhase.FAILED: "cannot continue the handoff",
}


# --- phases sent ------------------------------------------------------------------------------


def publish(state: MasterState, migration: Migration, phase: HandoffPhase) -> None:
    """Publish the phase of a handoff to its source and destination."""
    state.emit(
        PublishStateConfig(
            migration.process, phase, migration.source.number, migration.destination.number,
            _full_name(state, migration, migration.source, migration.source_node),
            _full_name(state, migration, migration.destination, migration.destination_node),
        )
    )  # fmt: skip


def _full_name(state: MasterState, migration: Migration, instance: InstanceId, node: str) -> str:
    """Return the name of a node of the source or the destination, which may differ in versions."""
    known = state.instances.get(instance.number)
    former = state.processes[migration.process].spec
    spec = migration.spec_of(instance, former) if known is None else known.spec
    return qualified_name(spec.namespace, node)


def close(state: MasterState, migration: Migration) -> None:
    """Publish the end of a handoff, if anything was published of it before."""
    reported = [step.phase for step in migration.begun_steps if isinstance(step, Configure)]
    if reported and HandoffPhase.DONE not in reported:
        publish(state, migration, HandoffPhase.DONE)


def republish(state: MasterState, migration: Migration, step: Configure, now: float) -> None:
    """Repeat a phase without an answer, because the message may be lost.

    If the source has ended, publish the order to take over in its place.
    """
    if _needs_take_over(state, migration, step):
        _take_over(state, migration, step, now)
    elif step.awaited and now - migration.order_at >= state.settings.order_retry:
        migration.order_at = now
        publish(state, migration, step.phase)


def republish_unawaited(state: MasterState, migration: Migration, now: float) -> None:
    """Repeat a SHADOW without a reply during the step after it.

    The destination may join only when newer messages about other handoffs have replaced the first.
    """
    before = migration.plan.steps[migration.index - 1] if migration.index else None
    if migration.undo is not None or not isinstance(before, Configure) or before.awaited:
        return
    late = now - migration.order_at >= state.settings.order_retry
    if before.phase is HandoffPhase.SHADOW and late:
        migration.order_at = now
        publish(state, migration, before.phase)


def _needs_take_over(state: MasterState, migration: Migration, step: Configure) -> bool:
    """Return True if the source ended while the master awaited its silence.

    The destination takes over from the state that it has.
    """
    alone = (
        migration.source.number not in state.instances
        and migration.destination.number in state.instances
    )
    return step.phase is HandoffPhase.SWITCH and alone and not is_active(state, migration)


def _take_over(state: MasterState, migration: Migration, step: Configure, now: float) -> None:
    if migration.taking_over and now - migration.order_at < state.settings.order_retry:
        return
    if not migration.taking_over:
        migration.taking_over = True
        migration.deadline = now + step.timeout
        state.record(
            now, EventKind.TAKE_OVER,
            f"{migration.source} has ended: {migration.destination} takes over from it",
            process=migration.process, host=migration.destination_host.name,
        )  # fmt: skip
    migration.order_at = now
    publish(state, migration, HandoffPhase.TAKE_OVER)


# --- reports received -------------------------------------------------------------------------


def handoff_reported(state: MasterState, event: happened.HandoffReported, now: float) -> None:
    """Note the reported phase of the source or the destination."""
    of_process = (state.migrations.get(event.process), state.standbys.get(event.process))
    for migration in of_process:
        if migration is not None and migration.destination.number == event.destination:
            _note(state, migration, event, now)


def source_stranded(state: MasterState, event: happened.SourceStranded, now: float) -> None:
    """Let a silent source resume whose handoff is not under way.

    Forged messages can silence a node, and the source cannot know if its destination is active. The
    master knows that it is not: the source owns the name, no migration of the process is under way,
    and the destination never existed or has ended.
    """
    source = state.instances.get(event.source)
    process = None if source is None else state.owned_by(source)
    if source is None or process is None or source.stopping:
        return
    if process.name in state.migrations or event.destination in state.instances:
        return
    hosts_missing = bool((state.hosts.condition == HostCondition.EXPECTED).any())
    if hosts_missing or journal_gap.why_no_work(state, now):
        return  # a destination may run that the journal does not have; the source asks again
    spec = process.spec
    node = qualified_name(spec.namespace, source.node_name or spec.node)
    state.record(
        now, EventKind.SOURCE_STRANDED,
        f"{source.id} is silent for a handoff to {process.name}#{event.destination}, which is not "
        f"under way: it publishes again",
        process=process.name, host=source.host.name,
    )  # fmt: skip
    for phase in (HandoffPhase.RESUME, HandoffPhase.DONE):
        state.emit(
            PublishStateConfig(process.name, phase, event.source, event.destination, node, "")
        )


def _note(
    state: MasterState, migration: Migration, event: happened.HandoffReported, now: float
) -> None:
    if event.instance not in (migration.source.number, migration.destination.number):
        return
    reports = migration.handoff_reports.setdefault(event.instance, HandoffReports())
    if event.phase not in reports.phases:
        blackout.note_reported(migration, event.phase, now)
        # The message of SHADOWING belongs to the wait that has just ended. Only the text of a
        # time-out shows it.
        is_news = event.message and event.phase is not ReportPhase.SHADOWING
        details = f": {event.message}" if is_news else ""
        message = f"{migration.process}#{event.instance} {_REPORTS[event.phase]}{details}"
        state.record(
            now, EventKind.HANDOFF_REPORTED, message, process=migration.process,
            facts={"phase": event.phase.name, "sequence": event.sequence},
        )  # fmt: skip
    reports.phases[event.phase] = reports.message = event.message
    reports.sequence = max(reports.sequence, event.sequence)


def is_active(state: MasterState, migration: Migration) -> bool:
    """Return True if the destination has reported that it is active, and was not ordered to stop.

    After an order to stop, the master waits for the end of the destination.
    """
    instance = state.instances.get(migration.destination.number)
    if instance is None or instance.stopping:
        return False
    reported = migration.phases_of(migration.destination)
    return ReportPhase.ACTIVE in reported and ReportPhase.ABORTED not in reported


def is_released(state: MasterState, migration: Migration, instance: InstanceId) -> bool:
    """Return True if a silent source has delivered everything, or has ended."""
    ended = instance.number not in state.instances
    return ended or ReportPhase.RELEASED in migration.phases_of(instance)


def is_switching(migration: Migration) -> bool:
    """Return True if the current step is the one in which the destination becomes active."""
    step = migration.current_step
    if migration.undo is not None or not isinstance(step, Configure):
        return False
    return step.phase is HandoffPhase.SWITCH


# --- outcome of a phase -----------------------------------------------------------------------


def outcome(state: MasterState, migration: Migration, step: Configure) -> StepOutcome:
    """Return the outcome of the current phase."""
    return _OUTCOMES[step.phase](state, migration) if step.awaited else StepProgress.DONE


def _shadowing(state: MasterState, migration: Migration) -> StepOutcome:
    is_ready = bool(_READY & migration.phases_of(migration.destination).keys())
    return _fault(state, migration) or done_if(is_ready)


def _switching(state: MasterState, migration: Migration) -> StepOutcome:
    if is_active(state, migration):
        return StepProgress.DONE
    return _fault(state, migration) or StepProgress.PENDING


def _fault(state: MasterState, migration: Migration) -> StepFailed | None:
    """Return why the destination can no longer become active; None: it can."""
    if migration.destination.number not in state.instances:
        how = migration.how_ended(migration.destination)
        return StepFailed(
            f"{migration.destination} ended on {migration.destination_host.name}: {how}"
        )
    for instance in (migration.destination, migration.source):
        reported = migration.phases_of(instance)
        if ReportPhase.FAILED in reported:
            how = f"{_REPORTS[ReportPhase.FAILED]}: {reported[ReportPhase.FAILED]}"
            return StepFailed(f"{instance} {how}")
    if ReportPhase.ABORTED in migration.phases_of(migration.destination):
        return StepFailed(f"{migration.destination} {_REPORTS[ReportPhase.ABORTED]}")
    return None


def _aborting(state: MasterState, migration: Migration) -> StepOutcome:
    reported = migration.phases_of(migration.destination)
    aborted = ReportPhase.ABORTED in reported or ReportPhase.FAILED in reported
    return done_if(aborted or migration.destination.number not in state.instances)


def _resuming(state: MasterState, migration: Migration) -> StepOutcome:
    resumed = ReportPhase.RESUMED in migration.phases_of(migration.source)
    ended = migration.source.number not in state.instances
    # A source without the protocol reports nothing, and never stopped publishing.
    unaware = not was_switched(migration) and not migration.phases_of(migration.source)
    return done_if(resumed or ended or unaware)


_OUTCOMES: Final[Mapping[HandoffPhase, Callable[[MasterState, Migration], StepOutcome]]] = {
    HandoffPhase.SHADOW: _shadowing,
    HandoffPhase.SWITCH: _switching,
    HandoffPhase.ABORT: _aborting,
    HandoffPhase.RESUME: _resuming,
    HandoffPhase.DONE: lambda _state, _migration: StepProgress.DONE,
}


def was_switched(migration: Migration) -> bool:
    """Return True if SWITCH may have been published, so that the source may be silent."""
    return any(
        isinstance(step, Configure) and step.phase is HandoffPhase.SWITCH
        for step in migration.begun_steps
    )


# --- time-outs --------------------------------------------------------------------------------


def timed_out(state: MasterState, migration: Migration, step: Configure, now: float) -> StepOutcome:
    """Return the outcome of a phase after its time-out."""
    if step.phase is HandoffPhase.RESUME and not was_switched(migration):
        return StepProgress.DONE  # the source was never ordered to be silent
    if step.phase is HandoffPhase.ABORT:
        instance = state.instances[migration.destination.number]
        if not instance.stopping:
            _stop_silent_destination(state, migration, now)
            return StepProgress.PENDING
    what = f"{TITLES[step.phase]} took longer than {step.timeout:g} s"
    return StepFailed(f"{what}: {newest_reports(migration)}", timed_out=True)


def _stop_silent_destination(state: MasterState, migration: Migration, now: float) -> None:
    """Stop a destination without an answer, because only its end proves that it is not active."""
    destination = state.instances[migration.destination.number]
    lifecycle.stop_instance(state, destination, now)
    migration.deadline = now + destination.spec.stop.timeout
    state.record(
        now, EventKind.DESTINATION_UNHEARD,
        f"{migration.destination} does not confirm the abort of the handoff: the master stops it",
        process=migration.process, host=migration.destination_host.name,
    )  # fmt: skip
    state.save_migration(migration)


def newest_reports(migration: Migration) -> str:
    """Return the newest reports of source and destination, which say what a phase waits for."""
    if not migration.handoff_reports:
        return (
            "neither node has reported. Do they use rosrm.node? A node that meets only the "
            "constraints of the paper needs `protocol: paper` in the options of its migration"
        )
    both = (migration.destination, migration.source)
    return "; ".join(f"{one} {_newest_report(migration, one)}" for one in both)


def _newest_report(migration: Migration, instance: InstanceId) -> str:
    reports = migration.handoff_reports.get(instance.number)
    if reports is None:
        return "has not reported"
    details = f": {reports.message}" if reports.message else ""
    return f"{_REPORTS[list(reports.phases)[-1]]}{details}"
