"""Rule for the stop of a process, checked at every boundary."""

from __future__ import annotations

from rosrm.model.durations import LONGEST_STOP
from rosrm.model.values import ProcessSpec


def stop_fault(spec: ProcessSpec) -> str:
    """Return why a process would be stopped too late, or never; "": it is not."""
    graces = spec.stop.interrupt_grace, spec.stop.terminate_grace
    if min(graces) >= 0.0 and sum(graces) <= LONGEST_STOP:  # false for NaN
        return ""
    return (
        f"stop: {graces[0]:g} s until SIGTERM and {graces[1]:g} s more until SIGKILL; allowed: "
        f"{LONGEST_STOP:g} s together, so that every stop ends"
    )
