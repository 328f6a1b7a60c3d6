"""Changes of a spec: which of them a running instance follows, and which need a new start."""

from __future__ import annotations

from dataclasses import fields, replace
from operator import attrgetter
from typing import Final

from rosrm.model.values import ProcessSpec

#: Fields that only the master reads, and `restart`, whose change a slave can apply to a running
#: instance. A change of any other field takes effect with the next start, except that of `limits`
#: where the host can change them. (Of `array` only the number of jobs at a time changes: the index
#: is part of the name.)
IN_PLACE: Final = frozenset(
    {
        "restart", "needs", "required_labels", "preferred_labels", "avoided_labels", "priority",
        "migration", "neighbours", "talks_to", "reschedule", "protect", "time_limit",
        "start_order", "group", "together", "array",
    }
)  # fmt: skip
_in_place_of: Final = attrgetter(*sorted(IN_PLACE))
_FIELDS: Final = tuple(one.name for one in fields(ProcessSpec) if one.compare)


def changed_fields(spec: ProcessSpec, other: ProcessSpec) -> tuple[str, ...]:
    """Return the names of the fields in which two specs differ."""
    if spec is other or spec == other:
        return ()
    return tuple(name for name in _FIELDS if getattr(spec, name) != getattr(other, name))


def with_in_place(spec: ProcessSpec, desired: ProcessSpec) -> ProcessSpec:
    """Return a spec with those fields of the desired one that need no new start.

    If other fields differ, too, the needs stay: they are those of the program that still runs.
    """
    if spec is desired or _in_place_of(spec) == _in_place_of(desired):
        return spec
    changed = replace(spec, **{name: getattr(desired, name) for name in IN_PLACE})
    return changed if changed == desired else replace(changed, needs=spec.needs)
