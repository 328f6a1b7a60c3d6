"""What the journal has lost, as far as the hosts show it, and what the master does about it.

A power failure (with `sync: normal`), a damaged write-ahead log or an older copy put back take the
newest part of a journal without a word. What was decided in it is unknown: who was submitted,
where something runs. A process that is queued by what is left of the journal may run on a host
that has not been heard yet. So no work is given

- after a fall of the machine, until every host that the journal knows has come back or is lost;
- once a host has seen more of the journal than there is, for one lease from the master's start.

What runs unknown is stopped when its host registers, and what is queued under its name waits for
that end.

A master that is killed or stopped while it waits leaves that to the next one: it is an intent,
`unheard`, until it has been waited for. A loss that hosts told of is waited for anew, for a lease
from the next start, as they tell it to one master only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition
from rosrm.extensions.contracts import Intent
from rosrm.model.event_kinds import EventKind
from rosrm.wording import counted

_KEY: Final = "unheard"


def begin(state: MasterState, newest: int, now: float, *, fell: bool) -> None:
    """A master starts.

    Args:
        state: as it was restored.
        newest: sequence of the newest record that the journal holds.
        fell: the machine was started anew, and the last master had not stopped before.

    Then `intent` is to become durable, together with what tells the next start from this one.
    """
    state.tail.newest, state.tail.started = newest, now
    state.tail.fell = state.tail.fell or fell


def restore(state: MasterState, cluster: Mapping[str, Mapping[str, Any]]) -> None:
    """Take over what a former master had still to wait for, from the intents `cluster`."""
    kept = cluster.get(_KEY, {})
    state.tail.fell, state.tail.short = bool(kept.get("fell")), bool(kept.get("short"))


def intent(state: MasterState) -> Intent:
    """What the next master has to wait for, were it to start now."""
    tail = state.tail
    waits = {"fell": tail.fell, "short": tail.short}
    return Intent("cluster", _KEY, waits if any(waits.values()) else None)


def review(state: MasterState, now: float) -> None:
    """What has been waited for is done with, for the next master too."""
    tail = state.tail
    before = (tail.fell, tail.short)
    if not any(before):
        return
    tail.short = tail.short and now < tail.started + state.settings.lease
    tail.fell = tail.fell and bool((state.hosts.condition == HostCondition.EXPECTED).any())
    if (tail.fell, tail.short) != before:
        state.emit(intent(state))


def note_seen(state: MasterState, host: str, seen: int, now: float) -> None:
    """A host says how much of the journal a former run of this master had said there was."""
    tail = state.tail
    lost = seen - tail.newest
    if lost <= tail.lost:
        return
    tail.lost = lost
    state.skip_numbers(state.next_instance + lost)  # each may have told of a new instance
    left = tail.started + state.settings.lease - now
    if left > 0 and not tail.short:
        tail.short = True
        state.emit(intent(state))
    wait = (
        f"; the master assigns no work for {left:.1f} s, until all hosts have reported"
        if left > 0
        else ""
    )
    records = counted(lost, "record is", "records are")
    state.record(
        now, EventKind.JOURNAL_BEHIND,
        f"the journal has lost its newest records: {host} has seen record {seen}, and the journal "
        f"ended at {tail.newest} when this master started: {records} missing. Repeat the "
        f"requests that they held; processes that these started are stopped{wait}",
        host=host, facts={"seen": seen, "newest": tail.newest, "lost": lost},
    )  # fmt: skip


def why_no_work(state: MasterState, now: float) -> str:
    """Why nobody is given work just now; "" if they may be."""
    review(state, now)
    if state.tail.short:
        return "the journal has lost its newest records: the master waits for all hosts to report"
    if state.tail.fell:
        return "the master's machine was rebooted: the master waits for all hosts to report"
    return ""
