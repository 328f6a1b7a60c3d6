"""JSON of a spec, from cached texts of its default fields and of policies that specs share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from operator import attrgetter
from typing import Final

from rosrm.model.codec import fields_to_plain, to_json, to_plain
from rosrm.model.remembered import remembered
from rosrm.model.values import ProcessSpec

_DEFAULT: Final = ProcessSpec("")
_DEFAULTS: Final = {
    one.name: getattr(_DEFAULT, one.name) for one in fields(ProcessSpec) if one.name != "name"
}
_MAPPINGS: Final = frozenset(
    name for name, default in _DEFAULTS.items() if isinstance(default, Mapping)
)
#: Names of the policies of a spec (its restarts, its limits), which are frozen dataclasses. Those
#: with a mapping are left out, because a user may change it between two submissions.
_POLICIES: Final = frozenset(
    name for name, default in _DEFAULTS.items()
    if is_dataclass(default)
    and not any(isinstance(getattr(default, own.name), Mapping) for own in fields(default))
)  # fmt: skip
_values_of: Final = attrgetter(*_DEFAULTS)
#: Most letters of the JSON of a policy that is cached.
_MOST_KEPT: Final = 4096
_policy_text: Final = remembered(
    lambda policy: to_json(to_plain(policy)), lambda text: len(text) <= _MOST_KEPT
)
_DEFAULT_TEXTS: Final = tuple(
    f'"{name}": {to_json(item)}' for name, item in fields_to_plain(_DEFAULT, _DEFAULTS).items()
)


def spec_to_json(spec: ProcessSpec) -> str:
    """Return the JSON of a spec: `to_json(to_plain(spec))` but for the order of the fields."""
    texts, others = [], ["name"]
    values = zip(_DEFAULTS.items(), _DEFAULT_TEXTS, _values_of(spec), strict=True)
    for (name, default), text, item in values:
        if item is default or (name in _MAPPINGS and not item):
            texts.append(text)
        elif name in _POLICIES:
            texts.append(f'"{name}": {_policy_text(item)}')
        else:
            others.append(name)
    return f"{{{', '.join(texts)}, {to_json(fields_to_plain(spec, others))[1:]}"
