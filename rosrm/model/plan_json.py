"""Conversion of plans to plain JSON values for the journal: complete, and read strictly."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, fields
from typing import Any, Final

from rosrm.errors import PluginError
from rosrm.model.plan import (
    AwaitReady,
    AwaitReleased,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Plan,
    SetRestart,
    Start,
    Step,
    Stop,
)
from rosrm.model.values import InstanceId, RestartPolicy

_KINDS: Final[Mapping[str, type[Any]]] = {
    "start": Start,
    "await_ready": AwaitReady,
    "await_released": AwaitReleased,
    "stop": Stop,
    "configure": Configure,
    "set_restart": SetRestart,
    "commit": Commit,
    "execute": Execute,
}
_NAMES: Final = {kind: name for name, kind in _KINDS.items()}


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """Return all fields of a plan as JSON values."""
    return {
        "steps": [step_to_dict(step) for step in plan.steps],
        "overlap": plan.overlap,
        "options": dict(plan.options),
    }


def plan_from_dict(plain: Mapping[str, Any]) -> Plan:
    """Return the plan of `plan_to_dict`'s answer.

    Raises:
        ValueError: for a field or kind that this version does not know.
    """
    known = _known("Plan", Plan, plain)
    try:
        steps = tuple(step_from_dict(step) for step in known["steps"])
        return Plan(steps, _number(known["overlap"]), _mapping(known["options"]))
    except (KeyError, TypeError) as fault:
        raise ValueError(f"no plan: {fault}") from fault


def checked_plan(plan: Plan) -> Plan:
    """Return a plan as the journal gives it back.

    Raises:
        PluginError: a field has the wrong type, or is no JSON.
    """
    try:
        return plan_from_dict(json.loads(json.dumps(plan_to_dict(plan))))
    except (ValueError, TypeError) as fault:
        raise PluginError(f"an unsound plan: {fault}") from fault


def checked_step(step: Step) -> Step:
    """Return a step as the journal gives it back; raise `PluginError` as `checked_plan`."""
    try:
        return step_from_dict(json.loads(json.dumps(step_to_dict(step))))
    except (ValueError, TypeError) as fault:
        raise PluginError(f"an unsound step: {fault}") from fault


def step_to_dict(step: Step) -> dict[str, Any]:
    """Return all fields of a step and of its undo, with its kind."""
    plain: dict[str, Any] = {field.name: getattr(step, field.name) for field in fields(step)}
    for name in ("instance", "restart"):
        if name in plain:
            plain[name] = asdict(plain[name])
    if "phase" in plain:
        plain["phase"] = plain["phase"].name
    for name in ("arguments", "remappings"):
        if name in plain:
            plain[name] = dict(plain[name])
    plain["undo"] = None if step.undo is None else step_to_dict(step.undo)
    return {"kind": _NAMES[type(step)], **plain}


def step_from_dict(plain: Mapping[str, Any]) -> Step:
    """Return the step of `step_to_dict`'s answer; raise `ValueError` as `plan_from_dict`."""
    try:
        kind = _KINDS[plain["kind"]]
        given = {name: value for name, value in plain.items() if name != "kind"}
        known = _known(kind.__name__, kind, given)
        step: Step = kind(**{name: _READ[name](value) for name, value in known.items()})
    except (KeyError, TypeError) as fault:
        raise ValueError(f"no step of a plan: {fault}") from fault
    return step


def _known(name: str, kind: type[Any], plain: Any) -> Mapping[str, Any]:
    """Return the fields of a dataclass; refuse missing and unknown ones."""
    given = _mapping(plain)
    strange = set(given).difference(field.name for field in fields(kind))
    if strange:
        raise ValueError(f"unknown field of {name}: {', '.join(sorted(strange))}")
    for field in fields(kind):
        needed = field.default is MISSING and field.default_factory is MISSING
        if needed and field.name not in given:
            raise ValueError(f"{name} has no {field.name}")
    return given


def _instance(plain: Any) -> InstanceId:
    known = _known("InstanceId", InstanceId, plain)
    return InstanceId(_text(known["process"]), _whole(known["number"]))


def _restart(plain: Any) -> RestartPolicy:
    known = _known("RestartPolicy", RestartPolicy, plain)
    return RestartPolicy(**{name: _READ[name](value) for name, value in known.items()})


def _undo(plain: Any) -> Step | None:
    return None if plain is None else step_from_dict(plain)


def _phase(plain: Any) -> HandoffPhase:
    return HandoffPhase[_text(plain)]


def _mapping(plain: Any) -> Mapping[str, Any]:
    if not isinstance(plain, Mapping):
        raise TypeError(f"{plain!r} is no mapping")
    return dict(plain)


def _texts(plain: Any) -> Mapping[str, str]:
    return {_text(key): _text(value) for key, value in _mapping(plain).items()}


def _text(plain: Any) -> str:
    if not isinstance(plain, str):
        raise TypeError(f"{plain!r} is no text")
    return plain


def _whole(plain: Any) -> int:
    if not isinstance(plain, int) or isinstance(plain, bool):
        raise TypeError(f"{plain!r} is no whole number")
    return plain


def _number(plain: Any) -> float:
    if not isinstance(plain, (int, float)) or isinstance(plain, bool):
        raise TypeError(f"{plain!r} is no number")
    return float(plain)


def _truth(plain: Any) -> bool:
    if not isinstance(plain, bool):
        raise TypeError(f"{plain!r} is neither true nor false")
    return plain


#: Reader of each field of a step and of a restart policy.
_READ: Final[Mapping[str, Callable[[Any], Any]]] = {
    "instance": _instance,
    "host": _text,
    "timeout": _number,
    "settle": _number,
    "node_name": _text,
    "shadow": _truth,
    "restored": _truth,
    "phase": _phase,
    "awaited": _truth,
    "restart": _restart,
    "executor": _text,
    "arguments": _mapping,
    "remappings": _texts,
    "undo": _undo,
    "image": _text,
    "when": _text,
    "delay": _number,
    "max_delay": _number,
    "factor": _number,
    "attempts": _whole,
    "window": _number,
}
