"""Rules for the adoption of a running process, checked at every boundary."""

from __future__ import annotations

from rosrm.model.adoption import LARGEST_PID, NO_ADOPTION
from rosrm.model.description_checks import name_fault
from rosrm.model.values import Kind, ProcessSpec
from rosrm.wording import listed


def adoption_fault(spec: ProcessSpec) -> str:
    """Return why the adoption of a spec is refused; "": it is valid, or none is given."""
    adoption = spec.adoption
    if adoption == NO_ADOPTION:
        return ""
    fault = name_fault(adoption.host, "host")
    if fault:
        return f"adoption: {fault}"
    if not 1 < adoption.pid <= LARGEST_PID:
        return f"adoption: pid {adoption.pid} cannot be adopted; allowed: 2 to {LARGEST_PID}"
    if not adoption.boot:
        return "adoption: the id of the boot is missing"
    # Each of these takes effect at a start, which an adopted process has behind it.
    conflicts = {
        "kind: job": spec.kind is Kind.JOB, "container": spec.container.image,
        "artifacts": spec.artifacts, "devices": spec.devices, "secrets": spec.secrets,
        "standby": spec.standby.wanted, "together": spec.together, "app": spec.application,
        "limits.enforce: required": spec.limits.enforce == "required",
    }  # fmt: skip
    found = [name for name, given in conflicts.items() if given]
    if found:
        return f"a running process cannot be adopted with {listed(found)}"
    return ""
