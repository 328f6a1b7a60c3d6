"""Index of the neighbour rules of all processes that have not ended, by the named processes."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import TypeVar

from rosrm.core.master.state.demand import Neighbour
from rosrm.model.values import NeighbourRule, ProcessSpec

_K = TypeVar("_K", bound=Hashable)
_Names = dict[str, dict[str, None]]


class NeighbourRules:
    """Rules of the processes that have not ended, and rules about a process.

    Attributes:
        declared: name of each process with rules to its rules, in order of submission.
        about: name of a process to the processes with rules that name it.
        groups: group to label and strictness of its rules, to the processes with such a rule.
        version: counter of changes of the rules and of the hosts of the processes concerned.
        apart_of: process to the version and its resolved rules of the relation "apart".
        located: process to host and name of each of its instances, where they are known.
        separated: process that runs apart from one near which it must run, to the reason and the
            time of the next attempt to move it there.
    """

    def __init__(self) -> None:
        self.declared: dict[str, tuple[NeighbourRule, ...]] = {}
        self.about: _Names = {}
        self.groups: dict[str, dict[tuple[str, bool], dict[str, None]]] = {}
        self.version = 0
        self.apart_of: dict[str, tuple[int, tuple[Neighbour, ...]]] = {}
        self.located: dict[str, tuple[tuple[str, str], ...]] = {}
        self.separated: dict[str, tuple[str, float]] = {}

    def add(self, spec: ProcessSpec) -> None:
        """Add the rules of a process, unless they are known."""
        if self.declared.get(spec.name) == spec.neighbours:
            return
        self.remove(spec.name)
        self.declared[spec.name] = spec.neighbours
        for name in _named(spec.neighbours):
            self.about.setdefault(name, {})[spec.name] = None
        for group, strictness in _groups(spec.neighbours):
            self.groups.setdefault(group, {}).setdefault(strictness, {})[spec.name] = None
        self.version += 1

    def remove(self, name: str) -> None:
        """Remove the rules of a process, if it has any."""
        self.note_change(name)
        self.separated.pop(name, None)
        self.apart_of.pop(name, None)
        rules = self.declared.pop(name, ())
        if not rules:
            return
        for other in _named(rules):
            _discard(self.about, other, name)
        for group, strictness in _groups(rules):
            _discard(self.groups[group], strictness, name)
            if not self.groups[group]:
                del self.groups[group]

    def note_change(self, name: str) -> None:
        """Note that an instance of a process was added, has ended, or no longer counts."""
        self.located.pop(name, None)
        if self.concern(name):
            self.version += 1

    def concern(self, name: str) -> bool:
        """Return True if a process has rules, or another process has a rule about it."""
        return name in self.about or name in self.declared


def _named(rules: Iterable[NeighbourRule]) -> set[str]:
    return {name for rule in rules for name in rule.processes}


def _groups(rules: Iterable[NeighbourRule]) -> Iterable[tuple[str, tuple[str, bool]]]:
    return dict.fromkeys((rule.group, (rule.by, rule.prefer)) for rule in rules if rule.group)


def _discard(table: dict[_K, dict[str, None]], key: _K, name: str) -> None:
    del table[key][name]
    if not table[key]:
        del table[key]
