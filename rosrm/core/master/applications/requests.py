"""Requests on applications: apply, revert and cancel, and their plans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from rosrm.core.master import events as happened
from rosrm.core.master.applications import rollout
from rosrm.core.master.applications.difference import Difference, differences
from rosrm.core.master.applications.listing import described, unwell_processes
from rosrm.core.master.applications.planning import Outlook, plan
from rosrm.core.master.assignment.gangs import check_gangs
from rosrm.core.master.cancellation import cancel
from rosrm.core.master.commands import Reply
from rosrm.core.master.contradictions import neighbour_fault
from rosrm.core.master.dependants import dependants_first
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.process_defaults import with_defaults
from rosrm.core.master.quotas import check_quota
from rosrm.core.master.requests import count, submission_fault
from rosrm.core.master.rights import check_rights
from rosrm.core.master.start_order import dependants_fault, start_order_fault
from rosrm.core.master.state.applications import Application, Version
from rosrm.core.master.state.process import WAITING, DesiredState, Process
from rosrm.core.master.stores import check_store, make_room
from rosrm.model.applications import Action, PlannedAction, Target
from rosrm.model.event_kinds import EventKind
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec
from rosrm.wording import listed, no_such


@dataclass(frozen=True, slots=True)
class Prepared:
    """A checked target.

    Attributes:
        version: desired version; None: the application is cancelled.
        found: name of each process that is not as desired to the difference.
    """

    application: Application
    version: Version | None
    found: Mapping[str, Difference]

    @property
    def number(self) -> int:
        """Return the number of the desired version; 0: the application is cancelled."""
        return 0 if self.version is None else self.version.number


def applications_requested(
    state: MasterState, event: happened.ApplicationsRequested, now: float
) -> None:
    """Make the requested versions the desired ones, or reply with the plan of that."""
    if event.plan_only:
        planned = outlook(state, event.targets, event.by, now)
        state.emit(Reply(event.request, message=planned.message, actions=planned.actions))
        return
    message, actions = execute(state, event.targets, event.by, now)
    state.emit(Reply(event.request, message=message, actions=actions))


def execute(
    state: MasterState, targets: Sequence[Target], by: Requester, now: float
) -> tuple[str, tuple[PlannedAction, ...]]:
    """Make versions of applications the desired ones; return a summary and the actions.

    Raises:
        RequestRefused: one of them cannot be; nothing was changed.
    """
    prepared = _prepared(state, targets, by)
    _want_all(state, prepared, by, now)
    for one in prepared:
        owner = one.application
        make_room(state, owner.principal, is_operator=owner.by_operator)
    return _summary(state, prepared), tuple(_actions(prepared))


def outlook(state: MasterState, targets: Sequence[Target], by: Requester, now: float) -> Outlook:
    """Return the plan of `execute`, which raises the same."""
    prepared = _prepared(state, targets, by)
    names = {one.application.name for one in prepared}
    planned = plan(state, lambda copy: _want_all(copy, prepared, by, now), names, now)
    return replace(planned, message="; ".join((_summary(state, prepared), *planned.returns)))


def _want_all(state: MasterState, prepared: Sequence[Prepared], by: Requester, now: float) -> None:
    changed = [one for one in prepared if _note_change(state, one, by, now)]
    _cancel_undesired(state, changed, now)
    for one in changed:
        rollout.want(state, state.applications[one.application.name], one.number, now)


# --- checks -----------------------------------------------------------------------------------


def _prepared(state: MasterState, targets: Sequence[Target], by: Requester) -> list[Prepared]:
    """Return the checked targets; refuse the request as a whole."""
    given, most = sum(len(one.specs) for one in targets), state.settings.max_processes
    if given > most:  # before any of them is looked at
        raise RequestRefused(
            f"{given} processes are requested at once, but the cluster may have {most} "
            f"(`queue.max_processes`). Nothing was changed"
        )
    _refuse_twice(
        (one.application for one in targets), "application", "put all its processes into one file"
    )
    versions = [_version_of(state, one, by) for one in targets]
    wanted = [spec for version in versions if version for spec in version.specs.values()]
    _refuse_twice((spec.name for spec in wanted), "process", "names are unique")
    prepared = []
    for target, version in zip(targets, versions, strict=True):
        specs: Mapping[str, ProcessSpec] = {} if version is None else version.specs
        application = state.applications.get(target.application)
        known = application or Application(target.application, by.name, by.is_operator)
        _check_names(state, known, specs, by)
        own = state.names_of(target.application)
        found = differences(state, target.application, specs, own)
        prepared.append(Prepared(known, version, found))
    _check_specs(state, prepared, by)
    return prepared


def _refuse_twice(names: Iterable[str], what: str, rule: str) -> None:
    twice = [name for name, number in Counter(names).items() if number > 1]
    if twice:
        raise RequestRefused(
            f"the {what} {listed(twice)} is given twice: {rule}. Nothing was changed",
            "name_taken",
        )


def _version_of(state: MasterState, target: Target, by: Requester) -> Version | None:
    """Return the desired version of a target; None: the application is cancelled."""
    application = state.applications.get(target.application)
    if application is not None and not by.may_act_on(application.principal):
        owner = application.principal or "an unknown owner"
        raise RequestRefused(
            f"the application {target.application} belongs to {owner}; ask the owner or an "
            f"operator. Nothing was changed",
            "denied",
        )
    if target.specs:
        return _new_version(state, target, application, by)
    if application is None:
        known = no_such("application", [target.application], reversed(state.applications))
        raise RequestRefused(known, "unknown")
    return _earlier_version(application, target.version, by, state.wall) if target.version else None


def _new_version(
    state: MasterState, target: Target, application: Application | None, by: Requester
) -> Version:
    """Return the version of given specs: the desired one, if it is the same."""
    defaults = state.settings.process_defaults
    filled = [with_defaults(spec, defaults) for spec in target.specs]
    _refuse_twice((spec.name for spec, _ in filled), "process", "names are unique")
    strangers = [spec.name for spec, _ in filled if spec.application != target.application]
    if strangers:
        raise RequestRefused(
            f"{listed(strangers)} of a request for the application {target.application} are not "
            f"its processes. Nothing was changed"
        )
    specs = {spec.name: spec for spec, _ in filled}
    current = application.version if application is not None else None
    if current is not None and (current.specs, current.rollout) == (specs, target.rollout):
        return current
    defaulted = {spec.name: paths for spec, paths in filled if paths}
    number = application.newest + 1 if application is not None else 1
    return Version(number, specs, defaulted, target.rollout, state.wall, by.name)


def _earlier_version(application: Application, number: int, by: Requester, wall: float) -> Version:
    """Return a new version with the processes of an earlier one."""
    version = application.versions.get(number)
    if version is None:
        kept = listed(str(one) for one in application.versions) or "none"
        raise RequestRefused(
            f"the application {application.name} has no version {number} (any more); kept: {kept}. "
            f"See `rosrm history {application.name}`. Nothing was changed",
            "unknown",
        )
    if version is application.version:
        return version
    return Version(
        application.newest + 1, version.specs, version.defaulted, version.rollout, wall, by.name,
        note=f"as version {number}",
    )  # fmt: skip


def _check_names(
    state: MasterState, application: Application, names: Iterable[str], by: Requester
) -> None:
    """Refuse names that other applications, users or single processes have."""
    known = [process for name in names if (process := state.processes.get(name)) is not None]
    check_rights(known, by)
    for process in known:
        of, is_live = process.spec.application, not process.phase.is_terminal
        if process.principal == application.principal and (of == application.name or not is_live):
            continue
        whose = f"of the application {of}" if of else "a single process"
        if process.principal != application.principal:
            whose = f"a process of {process.principal or 'an unknown owner'}"
        raise RequestRefused(
            f"{application.name} cannot have {process.name}, which is {whose} already; "
            f"{_remedy(process)}. Nothing was changed",
            "name_taken",
        )


def _remedy(process: Process) -> str:
    """Return how the name of a live process gets free."""
    if process.phase.is_terminal:
        return f"it has ended, and `rosrm prune {process.name}` removes it"
    if process.wanted is DesiredState.CANCEL:
        return "it is being cancelled: try again once it has ended"
    of = process.spec.application
    if of:
        return f"remove it from the file of {of} and apply that first, or choose another name"
    return f"`rosrm cancel {process.name}` ends it"


def _check_specs(state: MasterState, prepared: Iterable[Prepared], by: Requester) -> None:
    """Refuse new or changed processes that a submission would not accept."""
    changed = [
        (one.version.specs[name], one.version.defaulted.get(name, ()))
        for one in prepared
        if one.version is not None
        for name, difference in one.found.items()
        if difference.action is not Action.STOP
    ]
    specs = [spec for spec, _ in changed]
    superseded = {one.application.name for one in prepared}
    fault = submission_fault(state, changed, superseded) or neighbour_fault(state, specs, by.name)
    desired = [
        spec for one in prepared if one.version is not None for spec in one.version.specs.values()
    ]  # fmt: skip
    fault = fault or _start_order_fault(state, prepared, desired, by)
    if fault:
        raise RequestRefused(f"{fault}. Nothing was changed")
    action = {name: found.action for one in prepared for name, found in one.found.items()}
    applications = {one.application.name: one.application for one in prepared}
    for owner in _owners(prepared):  # an operator may apply those of a user
        own = [spec for spec in specs if applications[spec.application].principal == owner.name]
        new = [spec for spec in own if action[spec.name] is Action.START]
        check_gangs(state, new, owner.name, desired)
        waiting = [
            spec for spec in own
            if (known := state.processes.get(spec.name)) is not None and known.phase in WAITING
        ]  # fmt: skip
        check_gangs(state, [*new, *waiting], owner.name, desired, may_join=True)
        check_quota(state, own, by if owner.name == by.name else owner, superseded=superseded)
        versions = [
            one.version.specs.values() for one in prepared
            if one.application.principal == owner.name and one.version is not None
            and one.number not in one.application.versions
        ]  # fmt: skip
        check_store(state, new, owner.name, is_operator=owner.is_operator, versions=versions)


def _owners(prepared: Iterable[Prepared]) -> list[Requester]:
    """Return the owners of the requested applications."""
    found = {one.application.principal: one.application.by_operator for one in prepared}
    return [Requester(name, is_operator=operator) for name, operator in found.items()]


def _start_order_fault(
    state: MasterState, prepared: Iterable[Prepared], desired: Sequence[ProcessSpec],
    by: Requester,
) -> str:  # fmt: skip
    """Return why a desired process or a dependant of it could never start; "": each one may."""
    found = [item for one in prepared for item in one.found.items()]
    stopped = {name for name, difference in found if difference.action is Action.STOP}
    for spec in desired:
        for name in stopped.intersection(spec.start_order.after):
            return f"{spec.name}: after: {name} is no longer a process of its application"
    return start_order_fault(state, desired) or dependants_fault(state, desired, by.name)


# --- changes ----------------------------------------------------------------------------------


def _note_change(state: MasterState, one: Prepared, by: Requester, now: float) -> bool:
    """Keep and record a version; return False if all processes are as it wants them already."""
    application, version = state.applications.get(one.application.name), one.version
    if application is None:
        application = state.applications[one.application.name] = Application(
            one.application.name, by.name, by.is_operator
        )
    number = one.number
    if number == application.wanted and not one.found and not application.paused:
        return False  # unfinished work continues
    if version is not None and version.number > application.newest:
        application.newest = version.number
        state.save_version(application, version)
    what = f"version {number}" if number else "a cancellation"
    state.record(
        now, EventKind.APPLICATION_REQUESTED, f"{what} of {application.name} was requested", by=by,
        facts={"application": application.name, "version": number},
    )  # fmt: skip
    return True


def _cancel_undesired(state: MasterState, changed: Iterable[Prepared], now: float) -> None:
    """Cancel what no version has any more; dependants first, also of other applications."""
    ending = [
        state.processes[name] for one in changed for name, difference in one.found.items()
        if difference.action is Action.STOP
    ]  # fmt: skip
    for process in dependants_first(state, ending):
        if process.wanted is not DesiredState.CANCEL:
            cancel(state, process, now, by=Requester(process.principal))


def _actions(prepared: Iterable[Prepared]) -> Iterable[PlannedAction]:
    for one in prepared:
        for name, found in one.found.items():
            yield PlannedAction(
                name, found.action, one.application.name, fields=found.fields, reason=found.reason,
                version=one.number,
            )  # fmt: skip


def _summary(state: MasterState, prepared: Sequence[Prepared]) -> str:
    return "; ".join(_summary_of(state, one) for one in prepared)


def _summary_of(state: MasterState, one: Prepared) -> str:
    """Return a phrase on the version and the number of each kind of action."""
    name, version = one.application.name, one.version
    if not one.found:
        what = "is cancelled already" if version is None else f"is at version {version.number}"
        unwell = unwell_processes(state, one.application)
        return f"{name} {what}: nothing changes{f', but {described(unwell)}' if unwell else ''}"
    numbers = Counter(found.action for found in one.found.values())
    parts = [f"{count(number)} to {action.value}" for action, number in numbers.items()]
    title = f"{name}{f' version {version.number}' if version else ''}"
    return f"{title}: {listed(parts)}{_given_up_before(one)}"


def _given_up_before(one: Prepared) -> str:
    """Return a warning of a version with the same processes that was given up; "" for none."""
    for former in reversed(one.application.versions.values()):
        same = one.version is not None and former.specs == one.version.specs
        if same and (why := former.given_up):
            return f". Warning: version {former.number} was the same, and given up: {why}"
    return ""
