"""What the journal has lost, as far as the hosts show it, and what the master does about it.

A power failure (with `sync: normal`), a damaged write-ahead log or an older copy put back take the
newest part of a journal without a word. What was decided in it is unknown: who was submitted,
where something runs. A process that is queued by what is left of the journal may run on a host
that has not been heard yet. So no work is given

- after a fall of the machine, until every host that the journal knows has come back or is lost;
- once a host has seen more of the journal than there is, for one lease from the master's start.

What runs unknown is stopped when its host registers, and what is queued under its name waits for
that end.
"""

from __future__ import annotations

from rosrm.core.hosts import HostCondition
from rosrm.core.state import MasterState


def begin(state: MasterState, newest: int, now: float, *, fell: bool) -> None:
    """A master starts.

    Args:
        state: as it was restored.
        newest: sequence of the newest record that the journal holds.
        fell: the machine was started anew, and the last master had not stopped before.
    """
    state.tail.newest, state.tail.started, state.tail.fell = newest, now, fell


def note_seen(state: MasterState, host: str, seen: int, now: float) -> None:
    """A host says how much of the journal a former run of this master had said there was."""
    tail = state.tail
    lost = seen - tail.newest
    if lost <= tail.lost:
        return
    tail.lost = lost
    state.skip_numbers(state.next_instance + lost)  # each may have told of a new instance
    left = tail.started + state.settings.lease - now
    wait = f"; no work is given for {left:.1f} s, until all hosts were heard" if left > 0 else ""
    state.record(
        now, "journal_behind",
        f"the journal has lost what was newest in it: {host} has seen record {seen}, and it ended "
        f"at {tail.newest} when this master started: {lost} are gone. What was submitted or "
        f"cancelled in them must be so again; what was started in them is stopped{wait}",
        host=host, facts={"seen": seen, "newest": tail.newest, "lost": lost},
    )  # fmt: skip


def why_no_work(state: MasterState, now: float) -> str:
    """Why nobody is given work just now; "" if they may be."""
    tail = state.tail
    if tail.lost and now < tail.started + state.settings.lease:
        return "the journal has lost its newest part: all hosts must be heard first"
    if tail.fell:
        away = state.hosts.condition == HostCondition.EXPECTED
        if away.any():
            return "the machine of the master fell: all hosts must be heard first"
        tail.fell = False
    return ""
