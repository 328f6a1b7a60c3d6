"""Checks of the description of a host, sent by its slave, and of a resource, also by a probe."""

from __future__ import annotations

import math
import re
from typing import Final

from rosrm.model.values import RESOURCE_SLOTS, HostDescription, ResourceDescription

_RESOURCE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
#: Examples of fields in the description of a resource.
_EXAMPLES: Final = {"unit": '"B", "core", "B/s" or "1"', "scope": '"machine"'}


def description_fault(description: HostDescription) -> str:
    """Return the fault of a slave's description of its host; "" for none."""
    resources = description.resources
    if not description.name:
        return "a host needs a name"
    if not description.incarnation:
        return f"{description.name}: the incarnation of a slave is not 0"
    if len(resources) > RESOURCE_SLOTS:
        return f"{description.name} has {len(resources)} resources; {RESOURCE_SLOTS} are the most"
    names = [resource.name for resource in resources]
    if len(set(names)) < len(names):
        return f"{description.name} names a resource twice: {', '.join(names)}"
    fault = next(filter(None, map(resource_fault, resources)), "")
    return fault and f"{description.name} {fault}"


def resource_fault(resource: object) -> str:
    """Return the fault of the description of a resource; "": none."""
    if not isinstance(resource, ResourceDescription):
        return f"describes a resource by {resource!r}, which is not a ResourceDescription"
    name: object = resource.name
    if not (isinstance(name, str) and _RESOURCE_NAME.fullmatch(name)):
        return (
            f"names a resource {name!r}. Allowed: at most 64 letters, digits, '_', '-' and '.', "
            "the first of them a letter"
        )
    for field in ("unit", "scope"):
        word: object = getattr(resource, field)
        if not isinstance(word, str):
            return f"gives {name!r} the {field} {word!r}; text is required, as {_EXAMPLES[field]}"
    capacity: object = resource.capacity
    numeric = isinstance(capacity, (int, float)) and not isinstance(capacity, bool)
    if not (numeric and math.isfinite(resource.capacity) and resource.capacity > 0.0):
        return f"gives {name!r} a capacity of {capacity!r}; a number above 0 is required"
    return ""
