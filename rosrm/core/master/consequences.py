"""What a change makes possible or necessary: the end of each step of the core, and of a plan."""

from __future__ import annotations

from rosrm.core.master import start_order
from rosrm.core.master.assignment.assign import place_waiting
from rosrm.core.master.assignment.gangs import recall_gangs
from rosrm.core.master.cancellation import cancel_groups
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import executor


def follow_up(state: MasterState, now: float) -> None:
    """Advance migrations and groups, and place what waits, after a change of the state."""
    executor.advance_all(state, now)
    cancel_groups(state, now)
    start_order.review(state, now)
    recall_gangs(state, now)
    place_waiting(state, now)
    cancel_groups(state, now)  # of which a process has failed, because no host can start it
