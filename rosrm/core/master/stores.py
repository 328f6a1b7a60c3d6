"""Bound of the specs that the master keeps for one owner: of processes, and of versions.

Ended processes and cancelled applications give way to new ones of the same owner, the oldest first.
Only what still runs, waits or is desired can refuse a request.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import chain
from typing import Final

from rosrm.core.master.garbage import is_gone, remove_application, remove_process
from rosrm.core.master.master_state import (
    PROCESS,
    MasterState,
    SpecKey,
    process_key,
    version_key,
)
from rosrm.core.master.outcomes import RequestRefused
from rosrm.model.ledger import Store, bound_of
from rosrm.model.sizes import size_of
from rosrm.model.values import ProcessSpec
from rosrm.wording import size as sized

#: Share of `queue.max_processes` that the processes of one user may take; an operator's may take
#: all, so that a user cannot keep an operator out.
MOST_OF_USER: Final = 0.8


def check_store(
    state: MasterState, started: Sequence[ProcessSpec], owner: str, *, is_operator: bool,
    versions: Sequence[Collection[ProcessSpec]] = (),
) -> None:  # fmt: skip
    """Refuse specs that would exceed the bound of their owner, whatever gives way to them.

    Args:
        started: specs of new processes.
        versions: those of each new version of an application.
    """
    check_number(state, len(started), owner, is_operator=is_operator)
    bound, used = bound_of(Store.SPECS, is_operator=is_operator), state.ledger.of(owner)
    size = used.size + sum(map(size_of, (*started, *chain.from_iterable(versions))))
    number = used.number + len(started) + len(versions)
    if number <= bound.number and size <= bound.size:
        return
    spare = [state.ledger.size_of(owner, key) for one in _spare(state, owner) for key in one]
    if number - len(spare) > bound.number or size - sum(spare) > bound.size:
        raise RequestRefused(
            f"{owner or 'an unknown user'} would have {number} specs of processes and versions "
            f"with {sized(size)}; for one user at most {bound.number} with {sized(bound.size)} "
            f"are kept. Cancel processes or applications first, or put large contents into files. "
            f"Nothing was queued",
            "quota",
        )


def make_room(state: MasterState, owner: str, *, is_operator: bool) -> None:
    """Remove ended processes and cancelled applications of an owner beyond its bound."""
    bound, used = bound_of(Store.SPECS, is_operator=is_operator), state.ledger.of(owner)
    if used.number <= bound.number and used.size <= bound.size:
        return
    for keys in _spare(state, owner):
        kind, name, *_ = keys[0]
        if kind == PROCESS:
            remove_process(state, name)
        else:
            remove_application(state, state.applications[name])
        used = state.ledger.of(owner)
        if used.number <= bound.number and used.size <= bound.size:
            return


def check_number(state: MasterState, added: int, owner: str, *, is_operator: bool) -> None:
    """Refuse processes with which a user would have too large a share of all."""
    most = int(state.settings.max_processes * MOST_OF_USER)
    if is_operator or len(state.processes) - len(state.terminal) + added <= most:
        return
    live = (one for one in state.processes.values() if not one.phase.is_terminal)
    own = sum(one.principal == owner for one in live)
    if own + added > most:
        raise RequestRefused(
            f"{own} processes of {owner or 'an unknown user'} have not ended, and {added} more "
            f"would exceed the {most} that one user may have: {MOST_OF_USER:.0%} of "
            f"`queue.max_processes` ({state.settings.max_processes}). Nothing was queued",
            "quota",
        )


def _spare(state: MasterState, owner: str) -> list[list[SpecKey]]:
    """Return the keys of each process and application that gives way, the oldest first."""
    ended = (state.processes[name] for name in state.terminal)
    gone = {one.name for one in ended if one.principal == owner and is_gone(state, one)}
    stay = (one for name, one in state.processes.items() if name not in gone)
    used = {one.spec.application for one in stay}
    unused = (
        one for one in state.applications.values()
        if one.principal == owner and not (one.wanted or one.tasks or one.name in used)
    )  # fmt: skip
    spare = [[process_key(name)] for name in state.terminal if name in gone]
    return spare + [[version_key(one.name, number) for number in one.versions] for one in unused]
