"""Contradictions between the required neighbour rules of processes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from rosrm.model.values import NeighbourRule, ProcessSpec

_Specs = Mapping[str, ProcessSpec]


def contradiction_in(specs: _Specs) -> str:
    """Return a sentence on a rule that can never be kept, with both sides; "": none is known.

    The sentence begins with the name of a process.
    """
    for name, rule in _required(specs.values()):
        if name in rule.processes:
            relation = "near" if rule.relation == "near" else "apart from"
            return f"{name}: it must run {relation} itself; only other processes are allowed"
    labels = {rule.by for _, rule in _required(specs.values())}
    faults = (_fault_in_places(specs, by) for by in sorted(labels | {""}))
    return next(filter(None, faults), "")


def _required(specs: Iterable[ProcessSpec]) -> Iterator[tuple[str, NeighbourRule]]:
    for spec in specs:
        for rule in spec.neighbours:
            if not rule.prefer:
                yield spec.name, rule


def _fault_in_places(specs: _Specs, by: str) -> str:
    """Return a contradiction between processes that must be in one place by a label; "": none."""
    places = _places(specs, by)
    return (
        _fault_of_pairs(specs, by, places)
        or _fault_of_groups(specs, by, places)
        or _fault_of_labels(specs, by, places)
    )


def _places(specs: _Specs, by: str) -> dict[str, str]:
    """Return each process of a required rule "near" with the first process of its place.

    A rule without a label ties to one place by every label.
    """
    leaders: dict[str, str] = {}

    def leader(name: str) -> str:
        while leaders.setdefault(name, name) != name:
            leaders[name] = leaders[leaders[name]]
            name = leaders[name]
        return name

    for name, rule in _required(specs.values()):
        for other in rule.processes if rule.relation == "near" and rule.by in ("", by) else ():
            leaders[leader(name)] = leader(other)
    return {name: leader(name) for name in list(leaders)}


def _fault_of_pairs(specs: _Specs, by: str, places: Mapping[str, str]) -> str:
    for name, rule in _required(specs.values()):
        # Processes on one host are in one place by every label.
        if rule.relation == "apart" and (rule.by == by or not by):
            for other in rule.processes:
                if name in places and places[name] == places.get(other):
                    return _both(specs, name, other, rule.by, by)
    return ""


def _fault_of_groups(specs: _Specs, by: str, places: Mapping[str, str]) -> str:
    members: dict[tuple[str, str], str] = {}
    for name, rule in _required(specs.values()):
        if rule.group and name in places and (rule.by == by or not by):
            other = members.setdefault((rule.group, places[name]), name)
            if other != name:
                return _both(specs, name, other, rule.by, by)
    return ""


def _both(specs: _Specs, name: str, other: str, apart_by: str, near_by: str) -> str:
    return (
        f"{name} and {other} must run apart{_in(apart_by)}, and near each other{_in(near_by)}"
        f"{_through(specs, name, other)}: no hosts can keep both rules"
    )


def _fault_of_labels(specs: _Specs, by: str, places: Mapping[str, str]) -> str:
    """Return two processes of one place that require different values of a label; "": none."""
    first: dict[tuple[str, str], str] = {}
    for name, spec in specs.items():
        for key, value in spec.required_labels.items() if name in places else ():
            if by and key != by:
                continue
            other = first.setdefault((places[name], key), name)
            wanted = specs[other].required_labels[key]
            if wanted != value:
                return (
                    f"{other} and {name} must run near each other{_in(by)}"
                    f"{_through(specs, name, other)}, but {other} requires {key}={wanted}, and "
                    f"{name} {key}={value}"
                )
    return ""


def _in(by: str) -> str:
    return f" by {by}" if by else ""


def _through(specs: _Specs, name: str, other: str) -> str:
    """Return a note if no rule "near" names the two processes directly."""
    for one, another in ((name, other), (other, name)):
        rules = specs[one].neighbours if one in specs else ()
        if any(rule.relation == "near" and another in rule.processes for rule in rules):
            return ""
    return " through other processes"
