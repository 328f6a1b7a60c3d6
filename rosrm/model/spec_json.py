"""Conversion of process specs to JSON values for the journal: complete, so defaults may change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, Final

from rosrm.model.values import (
    Health,
    HostLossPolicy,
    IsolationPolicy,
    Kind,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    StandbyPolicy,
    StopPolicy,
)

_POLICIES: Final[Mapping[str, type[Any]]] = {
    "restart": RestartPolicy,
    "migration": MigrationPolicy,
    "readiness": Readiness,
    "stop": StopPolicy,
    "host_loss": HostLossPolicy,
    "isolation": IsolationPolicy,
    "standby": StandbyPolicy,
    "health": Health,
}
_TUPLES: Final = ("command", "arguments")
_MAPPINGS: Final = (
    "parameters",
    "remappings",
    "environment",
    "needs",
    "required_labels",
    "preferred_labels",
    "avoided_labels",
)
_KINDS: Final[tuple[type[Any], ...]] = (ProcessSpec, *_POLICIES.values())
_FIELDS: Final = {kind.__name__: tuple(f.name for f in fields(kind)) for kind in _KINDS}


def spec_to_dict(spec: ProcessSpec) -> dict[str, Any]:
    """Return all fields of a spec as JSON values."""
    plain = {name: getattr(spec, name) for name in _FIELDS["ProcessSpec"]}
    plain["kind"] = spec.kind.value
    for name in _TUPLES:
        plain[name] = list(plain[name])
    for name in _MAPPINGS:
        plain[name] = dict(plain[name])
    for name, kind in _POLICIES.items():
        plain[name] = {inner: getattr(plain[name], inner) for inner in _FIELDS[kind.__name__]}
    plain["migration"]["options"] = dict(plain["migration"]["options"])
    plain["standby"]["apart_by"] = list(plain["standby"]["apart_by"])
    return plain


def spec_from_dict(plain: Mapping[str, Any]) -> ProcessSpec:
    """Return the spec of `spec_to_dict`'s answer; a missing field has its default.

    Raises:
        ValueError: for a field that this version does not know.
    """
    values = dict(_known(ProcessSpec, plain))
    if "kind" in values:
        values["kind"] = Kind(values["kind"])
    for name in _TUPLES:
        if name in values:
            values[name] = tuple(values[name])
    for name, kind in _POLICIES.items():
        if name in values:
            values[name] = kind(**_known(kind, values[name]))
    if "standby" in values:
        standby = values["standby"]
        values["standby"] = replace(standby, apart_by=tuple(standby.apart_by))
    return ProcessSpec(**values)


def _known(kind: type[Any], plain: Mapping[str, Any]) -> Mapping[str, Any]:
    strange = set(plain).difference(_FIELDS[kind.__name__])
    if strange:
        raise ValueError(f"unknown field of {kind.__name__}: {', '.join(sorted(strange))}")
    return plain
