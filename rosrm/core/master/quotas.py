"""Quotas of users, and the limit of the cluster: on the processes that have not ended.

Every request that starts or changes processes is checked here, by the resulting total.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Final

import numpy as np

from rosrm.core.master.applications.difference import difference_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.settings import DEFAULT_QUOTA
from rosrm.model.requester import Requester
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import amount

_UNITS: Final = {"memory": "B", "cpu": "core"}
#: Tolerance for floating point: 320 times 0.1 cores is slightly more than 32 cores.
_ROUNDING: Final = 1e-9


def check_quota(
    state: MasterState, specs: Iterable[ProcessSpec], by: Requester, *,
    superseded: AbstractSet[str] = frozenset(),
) -> None:  # fmt: skip
    """Refuse processes with which a user would have more than its quota.

    The check uses the total that the user would then have, as far as it is known. A process that is
    being replaced counts with the larger needs of both versions.

    Args:
        specs: new processes, and new versions of others.
        by: their owner.
        superseded: names of the applications whose desired versions the request replaces.
    """
    quota = _quota_of(state, by)
    if not quota:
        return
    before = _usage(state, _claims(state, by.name, frozenset()).values())
    claims = _claims(state, by.name, superseded)
    for spec in specs:
        claims.setdefault(spec.name, []).append(spec)
    after = _usage(state, claims.values())
    exceeded = [
        f"{resource}: {_text(resource, before[resource])} in use, "
        f"{_text(resource, after[resource] - before[resource])} more requested, "
        f"{_text(resource, limit)} allowed"
        for resource, limit in quota.items()
        # Negated, because every comparison with NaN is false.
        if not after[resource] <= max(before[resource], limit * (1.0 + _ROUNDING))
    ]
    if exceeded:
        raise RequestRefused(
            f"{by.name or 'an unknown user'} would exceed its quota of {'; '.join(exceeded)}. "
            f"Cancel processes, or ask an operator for a larger quota (`quotas` in cluster.yaml). "
            f"Nothing was queued",
            "quota",
        )


def processes_fault(
    state: MasterState, names: Iterable[str], *, superseded: AbstractSet[str] = frozenset()
) -> str:
    """Return why the cluster cannot have processes of these names, too; "": it can.

    Args:
        superseded: as in `check_quota`.
    """
    live, most = len(state.processes) - len(state.terminal), state.settings.max_processes
    before = {spec.name for _, spec in _pending(state, frozenset())}
    after = {*names, *(spec.name for _, spec in _pending(state, superseded))}
    before, after = ({one for one in some if not _is_live(state, one)} for some in (before, after))
    added = len(after) - len(before)
    live += len(before)
    if added <= 0 or live + added <= most:
        return ""
    return (
        f"{live} processes have not ended, and {added} more would exceed "
        f"`queue.max_processes` ({most})"
    )


def _is_live(state: MasterState, name: str) -> bool:
    return name in state.processes and name not in state.terminal


def _claims(
    state: MasterState, owner: str, superseded: AbstractSet[str]
) -> dict[str, list[ProcessSpec]]:
    """Return the specs with which each process of a user runs, or is to run without a request."""
    claims = {
        name: [state.spec_to_be(process)]
        for name, process in state.processes.items()
        if process.principal == owner and not process.phase.is_terminal
    }
    for principal, spec in _pending(state, superseded):
        if principal == owner:
            claims.setdefault(spec.name, []).append(spec)
    return claims


def _pending(state: MasterState, superseded: AbstractSet[str]) -> Iterator[tuple[str, ProcessSpec]]:
    """Yield the owner and the spec of each process that an application has yet to start or change.

    This includes processes that it would start if its version failed and the former one returned.
    """
    for application in state.applications.values():
        is_superseded = application.name in superseded
        if not is_superseded:
            open_ones = application.tasks.keys() | application.behind.keys()
            for name in open_ones & application.specs.keys():
                yield application.principal, application.specs[name]
        if is_superseded or application.tasks:
            number = application.reached if is_superseded else application.former
            former = application.versions.get(number)
            for name, spec in former.specs.items() if former is not None else ():
                if difference_of(state, application.name, name, spec) is not None:
                    yield application.principal, spec


def _quota_of(state: MasterState, by: Requester) -> Mapping[str, float]:
    """Return the limits of a requester by resource; an operator has only those of its own entry."""
    quotas = state.settings.quotas
    default = EMPTY if by.is_operator else quotas.get(DEFAULT_QUOTA, EMPTY)
    return {**default, **quotas.get(by.name, EMPTY)}


def _usage(state: MasterState, claims: Iterable[Sequence[ProcessSpec]]) -> Mapping[str, float]:
    """Return the number of processes, and the sums of their declared or estimated needs.

    `claims`: the specs that each process has or may have; the largest needs count.
    """
    usage = {"processes": 0.0, "memory": 0.0, "cpu": 0.0}
    for specs in claims:
        needs = [state.estimate(spec).amounts for spec in specs]
        usage["processes"] += 1.0
        for resource in _UNITS:  # unlike `max`, numpy keeps a NaN
            usage[resource] += float(np.max([one.get(resource, 0.0) for one in needs]))
    return usage


def _text(resource: str, value: float) -> str:
    return f"{value:.0f}" if resource == "processes" else amount(value, _UNITS[resource])
