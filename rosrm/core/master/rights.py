"""Rights on processes: an owner may act on its own processes, an operator on all.

`check_rights` is for requests, `may_affect` for what a process causes by its spec: its neighbour
rules, its dependencies, its flows and its priority affect no process on which its owner could not
act by a request.
"""

from __future__ import annotations

from collections.abc import Iterable

from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.state.process import Process
from rosrm.model.requester import Requester
from rosrm.wording import few, listed


def may_affect(process: Process, other: Process) -> bool:
    """Return True if the spec of a process may move, stop or hold back another process."""
    return process.by_operator or process.principal == other.principal


def check_rights(processes: Iterable[Process], by: Requester) -> None:
    """Refuse a request as a whole if its requester may not act on one of the processes."""
    denied: dict[str, list[str]] = {}
    for process in processes:
        if not by.may_act_on(process.principal):
            denied.setdefault(process.principal, []).append(process.name)
    if denied:
        phrases = [
            f"{listed(names)} {'belongs' if len(names) == 1 else 'belong'} to "
            f"{owner or 'an unknown owner'}"
            for owner, names in denied.items()
        ]
        raise RequestRefused(
            f"{'; '.join(few(phrases))}; {by.name or 'an unknown user'} may act only on its own "
            f"processes: ask the owner or an operator. Nothing was changed",
            "denied",
        )
