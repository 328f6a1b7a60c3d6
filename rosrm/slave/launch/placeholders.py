"""Replacement of the placeholders in the texts of an assignment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from rosrm.model.placeholders import PLACEHOLDER, WITH_PLACEHOLDERS
from rosrm.model.values import Assignment, Component, ParameterSource, ProcessSpec


def filled(assignment: Assignment, values: Mapping[str, str]) -> Assignment:
    """Return an assignment with the values of placeholders; those without a value stay.

    `values`: by the name of the placeholder, such as "device.camera".
    """
    if not values:
        return assignment

    def change(text: str) -> str:
        return PLACEHOLDER.sub(lambda found: values.get(found[1], found[0]), text)

    return replace(assignment, spec=with_texts(assignment.spec, change))


def with_texts(spec: ProcessSpec, change: Callable[[str], str]) -> ProcessSpec:
    """Return a spec with changed texts in the fields in which placeholders stand.

    The same spec if there is nothing to change, as in most starts.
    """
    given = {name: value for name in WITH_PLACEHOLDERS if (value := getattr(spec, name))}
    texts = {name: _changed(value, change) for name, value in given.items()}
    return spec if texts == given else replace(spec, **texts)


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    if isinstance(value, str):
        return change(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_changed(one, change) for one in value)
    if isinstance(value, Mapping):
        return {key: _changed(one, change) for key, one in value.items()}
    if isinstance(value, ParameterSource):
        parameters = _changed(value.parameters, change)
        return replace(value, file=change(value.file), parameters=parameters)
    if isinstance(value, Component):
        parameters = _changed(value.parameters, change)
        return replace(value, parameters=parameters, arguments=_changed(value.arguments, change))
    return value
