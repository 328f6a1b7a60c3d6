"""The directory of the artifacts of an assignment, in the texts of its spec."""

from __future__ import annotations

from pathlib import Path

from rosrm.artifacts.cache import set_directory
from rosrm.model.placeholders import ARTIFACTS
from rosrm.model.values import Assignment
from rosrm.slave.launch.placeholders import filled


def with_artifacts(assignment: Assignment, root: Path | None) -> Assignment:
    """Return an assignment with the directory of its artifacts in place of `{artifacts}`.

    Args:
        root: directory of the artifacts of all processes; None: there are none.
    """
    spec = assignment.spec
    if not spec.artifacts or root is None:
        return assignment
    return filled(assignment, {ARTIFACTS: str(set_directory(root, spec.artifacts))})
