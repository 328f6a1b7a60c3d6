"""The cluster's defaults for the fields that the submitter of a process leaves out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Final

from rosrm.model.codec import to_plain
from rosrm.model.values import Kind, ProcessSpec

#: Fields that identify a process, its program and its kind, and so have no default of the cluster.
IDENTITY: Final = (
    "namespace", "node_name", "package", "executable", "module", "command", "prefix", "ros", "kind",
    "container", "parameter_sources", "lifecycle", "components", "adoption",
)  # fmt: skip
#: Fields that relate the processes of one file to each other, and so have none, either.
_OF_ONE_FILE: Final = (
    "name", "given", "neighbours", "start_order", "application", "group", "together",
)  # fmt: skip
#: Fields that only a ROS node has.
_OF_NODES: Final = ("parameters", "remappings", "health")
#: Fields of services only; a job does not restart by default, because it may not be repeatable.
_OF_SERVICES: Final = ("standby", "restart.when")
#: Fields of jobs only.
_OF_JOBS: Final = ("time_limit",)
#: Fields whose values may be secret.
_PRIVATE: Final = ("arguments", "parameters", "environment")
_BUILT_IN: Final = ProcessSpec("")


def with_defaults(
    spec: ProcessSpec, defaults: ProcessSpec | None
) -> tuple[ProcessSpec, tuple[str, ...]]:
    """Return a submitted spec with the cluster's defaults, and the paths of the filled fields."""
    if defaults is None:
        return replace(spec, given=()) if spec.given else spec, ()
    chosen = dict(_chosen(spec, defaults))
    return replace(_with(spec, chosen), given=()), tuple(chosen)


def defaulted_values(spec: ProcessSpec, paths: tuple[str, ...]) -> Mapping[str, Any]:
    """Return the values at the paths of a spec as JSON; None for one that may be secret."""
    values = {}
    for path in paths:
        value: Any = None
        if path not in _PRIVATE:
            value = spec
            for name in path.split("."):
                value = getattr(value, name)
        values[path] = to_plain(value)
    return values


def _chosen(spec: ProcessSpec, defaults: ProcessSpec) -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of each field that a default changes."""
    for path, own, default, built_in in _leaves(spec, defaults, _BUILT_IN):
        if not _applies(path, default, spec):
            continue
        if isinstance(own, Mapping):
            value = {**_without_set(default, path, spec), **own}
        elif path in defaults.given and _is_left_out(path, own, built_in, spec):
            value = default
        else:
            continue
        if value != own:
            yield path, value


def _without_set(defaults: Mapping[str, Any], path: str, spec: ProcessSpec) -> Mapping[str, Any]:
    """Return the defaults of a mapping, without variables that the process sets in another way."""
    others = {"environment": spec.secrets, "secrets": spec.environment}.get(path, {})
    return {name: value for name, value in defaults.items() if name not in others}


def _leaves(
    own: Any, default: Any, built_in: Any, before: str = ""
) -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield each field, and each field of a policy: its path and its three values."""
    for field in fields(own):
        path = f"{before}{field.name}"
        a, b, c = (getattr(one, field.name) for one in (own, default, built_in))
        if is_dataclass(a):
            yield from _leaves(a, b, c, f"{path}.")
        else:
            yield path, a, b, c


def _applies(path: str, default: Any, spec: ProcessSpec) -> bool:
    """Return True if a field may have a default, and the process is of the right kind for it."""
    first = path.partition(".")[0]
    if first in IDENTITY or first in _OF_ONE_FILE:
        return False
    if path == "migration.options" and not _is_left_out(
        "migration.strategy", spec.migration.strategy, None, spec
    ):
        return False  # they are options of another strategy
    if not spec.ros and (first in _OF_NODES or (path, default) == ("readiness.kind", "graph")):
        return False
    others = _OF_SERVICES if spec.kind is Kind.JOB else _OF_JOBS
    return not {first, path} & set(others)


def _is_left_out(path: str, own: Any, built_in: Any, spec: ProcessSpec) -> bool:
    if not spec.given:
        return bool(own == built_in)
    return path not in spec.given and path.partition(".")[0] not in spec.given


def _with(value: Any, changes: Mapping[str, Any]) -> Any:
    """Return a value with other values at the paths."""
    own: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for path, changed in changes.items():
        name, _, rest = path.partition(".")
        if rest:
            inner.setdefault(name, {})[rest] = changed
        else:
            own[name] = changed
    own |= {name: _with(getattr(value, name), one) for name, one in inner.items()}
    return replace(value, **own)
