"""The directory of the artifacts of an assignment, in the texts of its spec."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rosrm.artifacts.cache import set_directory
from rosrm.model.artifacts import ARTIFACTS_PLACEHOLDER
from rosrm.model.values import Assignment


def with_artifacts(assignment: Assignment, root: Path | None) -> Assignment:
    """Return an assignment with the directory of its artifacts in place of `{artifacts}`.

    Args:
        root: directory of the artifacts of all processes; None: there are none.
    """
    spec = assignment.spec
    if not spec.artifacts or root is None:
        return assignment
    directory = str(set_directory(root, spec.artifacts))
    changed = {
        name: _filled(getattr(spec, name), directory)
        for name in ("command", "arguments", "parameters", "environment", "working_directory")
    }
    return replace(assignment, spec=replace(spec, **changed))


def _filled(value: Any, directory: str) -> Any:
    if isinstance(value, str):
        return value.replace(ARTIFACTS_PLACEHOLDER, directory)
    if isinstance(value, (list, tuple)):
        return type(value)(_filled(one, directory) for one in value)
    if isinstance(value, dict):
        return {key: _filled(one, directory) for key, one in value.items()}
    return value
