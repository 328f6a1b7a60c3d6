"""Quotas of users: limits on the processes that have not ended, and on their needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.settings import DEFAULT_QUOTA
from rosrm.model.requester import Requester
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import amount

_UNITS: Final = {"memory": "B", "cpu": "core"}
#: Tolerance for floating point: 320 times 0.1 cores is slightly more than 32 cores.
_ROUNDING: Final = 1e-9


def check_quota(state: MasterState, specs: Iterable[ProcessSpec], by: Requester) -> None:
    """Refuse processes that would together exceed the quota of their requester."""
    quota = _quota_of(state, by)
    if not quota:
        return
    live = (
        process.spec
        for process in state.processes.values()
        if process.principal == by.name and not process.phase.is_terminal
    )
    in_use, requested = _usage(state, live), _usage(state, specs)
    exceeded = [
        f"{resource}: {_text(resource, in_use[resource])} in use, "
        f"{_text(resource, requested[resource])} more requested, {_text(resource, limit)} allowed"
        for resource, limit in quota.items()
        # Negated, because every comparison with NaN is false.
        if not in_use[resource] + requested[resource] <= limit * (1.0 + _ROUNDING)
    ]
    if exceeded:
        raise RequestRefused(
            f"{by.name or 'an unknown user'} would exceed its quota of {'; '.join(exceeded)}. "
            f"Cancel processes, or ask an operator for a larger quota (`quotas` in cluster.yaml). "
            f"Nothing was queued",
            "quota",
        )


def _quota_of(state: MasterState, by: Requester) -> Mapping[str, float]:
    """Return the limits of a requester by resource; an operator has only those of its own entry."""
    quotas = state.settings.quotas
    default = EMPTY if by.is_operator else quotas.get(DEFAULT_QUOTA, EMPTY)
    return {**default, **quotas.get(by.name, EMPTY)}


def _usage(state: MasterState, specs: Iterable[ProcessSpec]) -> Mapping[str, float]:
    """Return the number of processes, and the sums of their declared or estimated needs."""
    usage = {"processes": 0.0, "memory": 0.0, "cpu": 0.0}
    for spec in specs:
        needs = state.estimate(spec).amounts
        usage["processes"] += 1.0
        for resource in _UNITS:
            usage[resource] += needs.get(resource, 0.0)
    return usage


def _text(resource: str, value: float) -> str:
    return f"{value:.0f}" if resource == "processes" else amount(value, _UNITS[resource])
