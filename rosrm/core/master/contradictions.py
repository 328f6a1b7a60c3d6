"""Contradictions between the required neighbour rules of submitted and live processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rosrm.core.master.master_state import MasterState
from rosrm.model.contradictions import contradiction_in
from rosrm.model.values import ProcessSpec

_Specs = Mapping[str, ProcessSpec]


def neighbour_fault(state: MasterState, submitted: Sequence[ProcessSpec], owner: str) -> str:
    """Return a sentence on a rule that can never be kept, with both sides; "": none is known.

    Args:
        owner: owner of the submitted processes. Rules of others about them do not count.
    """
    if not state.neighbours.declared and not any(spec.neighbours for spec in submitted):
        return ""
    return contradiction_in(_tied(state, {spec.name: spec for spec in submitted}, owner))


def _tied(state: MasterState, submitted: _Specs, owner: str) -> _Specs:
    """Return the submitted processes and those that rules "near" tie to one of them."""
    specs, open_names = dict(submitted), list(submitted)
    named: dict[str, list[str]] = {}
    for spec in submitted.values():
        for name in _near(spec):
            named.setdefault(name, []).append(spec.name)
    seen = set[str]()
    while open_names:
        name = open_names.pop()
        if name in seen:
            continue
        seen.add(name)
        known = state.processes.get(name)
        if name not in specs and known is not None and not known.phase.is_terminal:
            specs[name] = known.spec
        open_names += _near(specs[name]) if name in specs else ()
        open_names += named.get(name, ())
        principal = owner if name in submitted or known is None else known.principal
        about = (state.processes[other] for other in state.neighbours.about.get(name, ()))
        open_names += [
            one.name for one in about
            if name in _near(one.spec) and (one.by_operator or one.principal == principal)
        ]  # fmt: skip
    live = {name: spec for name, spec in specs.items() if name not in submitted}
    return {**live, **submitted}


def _near(spec: ProcessSpec) -> list[str]:
    rules = (rule for rule in spec.neighbours if rule.requires_near)
    return [name for rule in rules for name in rule.processes]
