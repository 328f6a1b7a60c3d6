"""Journal gap: newest records that the journal has lost, and the wait of the master for reports.

A power failure (with `sync: normal`), a damaged write-ahead log or a restored older copy silently
removes the newest part of a journal. The decisions in it are unknown: submissions, and the hosts on
which instances run. A process that is queued by the rest of the journal may run on a host that has
not reported yet. So the master assigns no work

- after a reboot of the machine, until every host in the journal has rejoined or is lost;
- if a slave reports a newer record than the journal has, for one lease from the master's start.

An unknown instance is stopped when its host registers, and a queued process of the same name waits
for that end.

A master that ends during the wait passes it to the next one, as the intent `unheard`. If records
are known to be lost, the next master waits again for a whole lease.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent
from rosrm.wording import counted

_KEY: Final = "unheard"


def begin(state: MasterState, newest: int, now: float, *, machine_rebooted: bool) -> None:
    """Begin the wait at the start of a master, after its state was restored.

    The caller then makes `intent` durable, together with the mark that distinguishes the next
    start from this one.

    Args:
        newest: sequence of the newest record in the journal.
        machine_rebooted: True if the machine was rebooted, and the last master had not stopped
            before.
    """
    gap = state.journal_gap
    gap.newest, gap.started = newest, now
    gap.machine_rebooted = gap.machine_rebooted or machine_rebooted


def restore(state: MasterState, cluster: Mapping[str, Mapping[str, Any]]) -> None:
    """Restore the wait of a former master from the intents `cluster`."""
    stored, gap = cluster.get(_KEY, {}), state.journal_gap
    gap.machine_rebooted = bool(stored.get("fell"))
    gap.records_missing = bool(stored.get("short"))


def intent(state: MasterState) -> Intent:
    """Return the intent with the conditions for which the next master must wait."""
    gap = state.journal_gap
    waits = {"fell": gap.machine_rebooted, "short": gap.records_missing}
    return Intent("cluster", _KEY, waits if any(waits.values()) else None)


def review(state: MasterState, now: float) -> None:
    """End each wait whose condition no longer holds, in the journal too."""
    gap = state.journal_gap
    before = (gap.machine_rebooted, gap.records_missing)
    if not any(before):
        return
    gap.records_missing = gap.records_missing and now < gap.started + state.settings.lease
    gap.machine_rebooted = gap.machine_rebooted and bool(
        (state.hosts.condition == HostCondition.EXPECTED).any()
    )
    if (gap.machine_rebooted, gap.records_missing) != before:
        state.emit(intent(state))


def note_seen(state: MasterState, host: str, seen: int, now: float) -> None:
    """Begin a wait if a host has seen a newer record than the journal has."""
    gap = state.journal_gap
    lost = seen - gap.newest
    if lost <= gap.lost:
        return
    gap.lost = lost
    state.skip_numbers(state.next_instance + lost)  # each record may be of a new instance
    left = gap.started + state.settings.lease - now
    if left > 0 and not gap.records_missing:
        gap.records_missing = True
        state.emit(intent(state))
    wait = f"; the master assigns no work for {left:.1f} s, until all hosts have reported"
    records = counted(lost, "record is", "records are")
    state.record(
        now, EventKind.JOURNAL_BEHIND,
        f"the journal has lost its newest records: {host} has seen record {seen}, and the journal "
        f"ended at {gap.newest} when this master started: {records} missing. Repeat the "
        f"requests in them; processes that these started are stopped{wait if left > 0 else ''}",
        host=host, facts={"seen": seen, "newest": gap.newest, "lost": lost},
    )  # fmt: skip


def why_no_work(state: MasterState, now: float) -> str:
    """Return why the master assigns no work now; "" if it does."""
    review(state, now)
    if state.journal_gap.records_missing:
        return "the journal has lost its newest records: the master waits for all hosts to report"
    if state.journal_gap.machine_rebooted:
        return "the master's machine was rebooted: the master waits for all hosts to report"
    return ""
