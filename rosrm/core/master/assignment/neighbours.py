"""Neighbour rules of a process with the current hosts of the other processes.

A rule "near" without a label ties processes to one host: they are placed, and move, together. A
process waits until each process near which it must run has a host. If some wait for each other, by
these rules or by their start orders, the first of them in the queue that may start does not wait.

A rule binds the process that declares it. Other processes are bound only if the owner of the
declaring process may act on them; otherwise a rule would move or hold back processes of others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.rights import may_affect
from rosrm.core.master.scheduling.proximity import same_place
from rosrm.core.master.state.demand import Neighbour
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import WAITING, DesiredState, Process
from rosrm.model.values import EMPTY, NeighbourRule
from rosrm.wording import standing

_NONE: Final = frozenset[str]()
#: Pairs of host and process, in order.
_At = dict[tuple[str, str], None]
#: Label and strictness of rules to the instances that they concern.
_Places = dict[tuple[str, bool], _At]
_NO_MEMBERS: Final[Mapping[tuple[str, bool], Iterable[str]]] = {}


def neighbours_of(
    state: MasterState, process: Process, *, together: AbstractSet[str] = _NONE
) -> tuple[Neighbour, ...]:
    """Return the rules of a process, and those of others about it, with their hosts.

    `together`: processes that move with it to one host; rules "near" them do not count.
    """
    if not state.neighbours.declared or not state.neighbours.concern(process.name):
        return ()
    own, of_others = _near(state, process, together), _near_of_others(state, process, together)
    return (*own, *of_others, *_apart(state, process))


# --- near -------------------------------------------------------------------------------------


def _near(state: MasterState, process: Process, together: AbstractSet[str]) -> Iterator[Neighbour]:
    for rule in process.spec.neighbours:
        for name in rule.processes if rule.relation == "near" else ():
            if name in together:
                continue
            host, why = host_of(state, name)
            if host is not None:
                yield Neighbour("near", rule.by, rule.prefer, ((host.name, name),))
            elif not rule.prefer and process.phase in WAITING:
                if _goes_first(state, process, name):
                    continue
                yield Neighbour("near", rule.by, False, absent=_awaited(name, why))


def _near_of_others(
    state: MasterState, process: Process, together: AbstractSet[str]
) -> Iterator[Neighbour]:
    """Return the rules of others that are near the process: it should stay near them.

    A rule by a label is required as long as it is kept. A required rule without a label moves both.
    """
    here, _ = host_of(state, process.name)
    for other in state.neighbours.about.get(process.name, ()):
        host, _ = host_of(state, other)
        if host is None or other in together:
            continue
        for rule in _rules_about(state, other, process.name, "near"):
            kept = here is not None and same_place(here, host, rule.by)
            required = bool(rule.by) and kept and not rule.prefer
            yield Neighbour("near", rule.by, not required, ((host.name, other),))


def _rules_about(
    state: MasterState, declaring: str, name: str, relation: str
) -> Iterator[NeighbourRule]:
    """Return the rules of one process that bind another one."""
    if not binds(state, declaring, name):
        return
    for rule in state.neighbours.declared[declaring]:
        if rule.relation == relation and name in rule.processes:
            yield rule


def binds(state: MasterState, declaring: str, name: str) -> bool:
    """Return True if the rules of one process bind another one, or will once that one exists."""
    process, other = state.processes.get(declaring), state.processes.get(name)
    return process is None or other is None or may_affect(process, other)


def host_of(state: MasterState, name: str) -> tuple[Host | None, str]:
    """Return the host of a process that stays there; or None, and a predicate with the reason."""
    process = state.processes.get(name)
    if process is None:
        return None, "does not exist"
    owner = state.owner_of(process)
    if name in state.migrations or owner is None:
        return None, standing(process.phase.value)
    if process.wanted is not DesiredState.RUN:
        return None, "is being stopped"
    return owner.host, ""


def awaited_neighbour(
    state: MasterState, process: Process, *, besides: AbstractSet[str] | None = None
) -> str:
    """Return why a waiting process waits for another one, near which it must run; "": none.

    `besides`: names of processes for which it does not wait; None: those of its gang.
    """
    if besides is None:
        besides = state.gangs.members.get(process.gang, EMPTY).keys()
    for rule in process.spec.neighbours:
        for name in rule.processes if rule.requires_near else ():
            host, why = host_of(state, name)
            if host is None and name not in besides and not _goes_first(state, process, name):
                return _awaited(name, why)
    return ""


def _awaited(name: str, why: str) -> str:
    return f"{name}, near which the process must run, {why}"


def _goes_first(state: MasterState, process: Process, name: str) -> bool:
    """Return True if a process waits in turn for this one, which is the first of them in line."""
    waiting = _awaited_by(state, name)
    if process.name not in waiting:
        return False
    in_circle = [one for one in waiting if process.name in _awaited_by(state, one)]
    first = min(in_circle, key=lambda one: _place_in_line(state, state.processes[one]))
    return first == process.name


def _place_in_line(state: MasterState, process: Process) -> tuple[bool, int, int]:
    queue, name = state.queue, process.name
    is_passed_over = name in queue.awaiting or name in queue.delayed or not queue.position(name)
    return is_passed_over, -process.spec.priority, process.order


def _awaited_by(state: MasterState, name: str) -> dict[str, None]:
    """Return the process and all without a host for which it waits, itself or through others."""
    found: dict[str, None] = {}
    open_names = [name]
    while open_names:
        one = open_names.pop()
        if one in found or one not in state.queue:
            continue
        found[one] = None
        for rule in state.neighbours.declared.get(one, ()):
            if rule.requires_near:
                open_names += rule.processes
        if one in state.start_orders.declared:
            open_names += state.start_orders.declared[one].after
    return found


# --- together ---------------------------------------------------------------------------------


def waiting_with(state: MasterState, process: Process) -> list[Process]:
    """Return the queued processes that must run on the host of a queued process."""
    return [one for one in _tied(state, process) if one.name in state.queue]


def running_with(state: MasterState, process: Process) -> list[Process]:
    """Return the processes on the host of a process that must stay on one host with it."""
    here, _ = host_of(state, process.name)
    if here is None:
        return []
    return [one for one in _tied(state, process, here) if one is not process]


def moving_neighbour(state: MasterState, process: Process) -> str:
    """Return a process that moves now, and that a required rule "near" concerns; "": none."""
    own = (rule for rule in process.spec.neighbours if rule.requires_near)
    names = [name for rule in own for name in rule.processes]
    for other in state.neighbours.about.get(process.name, ()):
        rules = _rules_about(state, other, process.name, "near")
        names += [other for rule in rules if rule.requires_near]
    return next((name for name in names if name in state.migrations), "")


def _tied(state: MasterState, process: Process, here: Host | None = None) -> list[Process]:
    """Return the processes that required rules "near" without a label tie to a process.

    `here`: only those on this host. Others on the way are followed only through such processes.
    """
    open_names = list(_tied_to(state, process))
    if not open_names:
        return []  # by far the most frequent case
    found = {process.name: process}
    while open_names:
        name = open_names.pop()
        one = state.processes.get(name)
        if one is None or name in found or host_of(state, name)[0] is not here:
            continue
        found[name] = one
        open_names += _tied_to(state, one)
    found.pop(process.name, None)
    return list(found.values())


def _tied_to(state: MasterState, process: Process) -> Iterator[str]:
    """Return the names in the rules of a process that tie to one host, and in those about it."""
    for rule in process.spec.neighbours:
        if _ties(rule):
            yield from (name for name in rule.processes if binds(state, process.name, name))
    for other in state.neighbours.about.get(process.name, ()):
        if any(_ties(rule) for rule in _rules_about(state, other, process.name, "near")):
            yield other


def _ties(rule: NeighbourRule) -> bool:
    return rule.requires_near and not rule.by


# --- apart ------------------------------------------------------------------------------------


def _apart(state: MasterState, process: Process) -> tuple[Neighbour, ...]:
    """Return the rules "apart" of a process and about it; cached until an instance changes."""
    known = state.neighbours.apart_of.get(process.name)
    if known is None or known[0] != state.neighbours.version:
        places = _places_apart(state, process)
        found = (
            Neighbour("apart", by, prefer, tuple(at)) for (by, prefer), at in sorted(places.items())
        )
        known = state.neighbours.version, tuple(one for one in found if one.at or one.by)
        state.neighbours.apart_of[process.name] = known
    return known[1]


def _places_apart(state: MasterState, process: Process) -> _Places:
    """Return label and strictness of each rule "apart" to the instances that it concerns."""
    found: _Places = defaultdict(dict)
    for rule in process.spec.neighbours:
        if rule.relation != "apart":
            continue
        own = found[rule.by, rule.prefer]  # a label is required even without others
        own.update(_instances_at(state, process, rule.processes))
        for theirs, members in state.neighbours.groups.get(rule.group, _NO_MEMBERS).items():
            binding = [name for name in members if binds(state, name, process.name)]
            at = _instances_at(state, process, binding)
            own.update(at)
            if found[theirs] is not own:
                found[theirs].update(at)
    for other in state.neighbours.about.get(process.name, ()):
        for rule in _rules_about(state, other, process.name, "apart"):
            found[rule.by, rule.prefer].update(_instances_at(state, process, (other,)))
    return found


def _instances_at(state: MasterState, process: Process, names: Iterable[str]) -> _At:
    """Return host and name of each instance of other processes that runs or may run."""
    located, found = state.neighbours.located, list[tuple[str, str]]()
    for name in names:
        at = located.get(name)
        if at is None:
            at = located[name] = locate(state, name)
        if at and name != process.name:
            found += at
    return dict.fromkeys(found)


def locate(state: MasterState, name: str) -> tuple[tuple[str, str], ...]:
    """Return host and name of each instance of a process that runs or may run."""
    process = state.processes.get(name)
    if process is None:
        return ()
    hosts = [state.instances[number].host.name for number in sorted(process.instances)]
    if process.left_behind is not None:
        hosts.append(process.left_behind.host)
    return tuple((host, name) for host in hosts)
