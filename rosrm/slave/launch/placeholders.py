"""Replacement of the placeholders in the texts of an assignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rosrm.model.placeholders import PLACEHOLDER, WITH_PLACEHOLDERS
from rosrm.model.values import Assignment


def filled(assignment: Assignment, values: Mapping[str, str]) -> Assignment:
    """Return an assignment with the values of placeholders; those without a value stay.

    `values`: by the name of the placeholder, such as "device.camera".
    """
    if not values:
        return assignment
    spec = assignment.spec
    texts = {name: _filled(getattr(spec, name), values) for name in WITH_PLACEHOLDERS}
    return replace(assignment, spec=replace(spec, **texts))


def _filled(value: Any, values: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        return PLACEHOLDER.sub(lambda found: values.get(found[1], found[0]), value)
    if isinstance(value, (list, tuple)):
        return type(value)(_filled(one, values) for one in value)
    if isinstance(value, Mapping):
        return {key: _filled(one, values) for key, one in value.items()}
    return value
