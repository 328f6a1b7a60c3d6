"""Rights on processes: an owner may act on its own processes, an operator on all."""

from __future__ import annotations

from collections.abc import Iterable

from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.state.process import Process
from rosrm.model.requester import Requester
from rosrm.wording import few, listed


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
