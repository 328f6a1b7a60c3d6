"""Rules on the fields that only jobs have: arrays and schedules."""

from __future__ import annotations

from rosrm.model.arrays import LARGEST_INDEX
from rosrm.model.description_checks import name_fault
from rosrm.model.schedules import schedule_fault
from rosrm.model.values import Kind, ProcessSpec


def job_fault(spec: ProcessSpec) -> str:
    """Return why the array or the schedule of a spec is refused, with the key first; "": valid."""
    array, schedule = spec.array, spec.schedule
    if array.parallel and not array.name:
        return "parallel: only an array has a number of jobs at a time; give `array`, too"
    if spec.kind is not Kind.JOB:
        keys = {"array": array.name, "every": schedule.every, "at": schedule.at}
        for key in [key for key, value in keys.items() if value]:
            return f"{key}: only a job has it, and this process is a service; set `kind: job`"
    if not (0 <= array.index <= LARGEST_INDEX and 0 <= array.parallel <= LARGEST_INDEX):
        return f"array: index and parallel are within 0..{LARGEST_INDEX}"
    fault = name_fault(array.name, "array") if array.name else ""
    return f"array: {fault}" if fault else schedule_fault(schedule)
