"""Stamps in the traces of process specs and assignments; those without a trace stay as they are."""

from __future__ import annotations

from dataclasses import replace

from rosrm.model.start_trace import VARIABLE, stamped_in
from rosrm.model.values import Assignment, ProcessSpec


def stamped_spec(spec: ProcessSpec, **stamps: int) -> ProcessSpec:
    """Return a spec with further stamps in its trace, if it has one."""
    if VARIABLE not in spec.environment:
        return spec
    return replace(spec, environment=stamped_in(spec.environment, **stamps))


def stamped_assignment(assignment: Assignment, **stamps: int) -> Assignment:
    """Return an assignment with further stamps in the trace of its spec, if it has one."""
    spec = stamped_spec(assignment.spec, **stamps)
    return assignment if spec is assignment.spec else replace(assignment, spec=spec)
