"""Checks of names, of the description of a host by its slave, and of a resource by a probe."""

from __future__ import annotations

import math
import re
from typing import Final, get_args

from rosrm.model.devices import device_fault
from rosrm.model.sizes import size_of
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Accounting,
    HostDescription,
    ResourceDescription,
)
from rosrm.wording import with_article

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
_NAMESPACE: Final = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST_NAMESPACE: Final = 255
_NODE_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,199}")
_RESOURCE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
#: Seconds: the longest period of readings.
_LONGEST_PERIOD: Final = 3600.0
#: Maximum number of characters and entries in the description of a host, of which every listing has
#: a part.
LARGEST_DESCRIPTION: Final = 1 << 16
_ACCOUNTINGS: Final = get_args(Accounting)
#: Examples of fields in the description of a resource.
_EXAMPLES: Final = {"unit": '"B", "core", "B/s" or "1"', "scope": '"machine"'}


def name_fault(name: str, what: str) -> str:
    """Return why a text cannot be a name, which becomes a part of files and topics; "" if it can.

    Args:
        name: the text.
        what: "host", "process", "cluster".
    """
    if _NAME.fullmatch(name):
        return ""
    return (
        f"{name!r:.250} cannot be the name of {with_article(what)}. Allowed: at most 200 letters, "
        "digits, '_', '-' and '.', the first of them a letter, digit or '_'"
    )


def other_process_fault(name: str, own: str) -> str:
    """Return why a name cannot be that of another process than `own`; "" if it can."""
    if name == own:
        return f"{own} names itself; only other processes are allowed"
    return name_fault(name, "process")


def is_namespace(text: str) -> bool:
    """Return True for an absolute ROS namespace such as "/robot1"."""
    return len(text) <= _LONGEST_NAMESPACE and _NAMESPACE.fullmatch(text) is not None


def is_node_name(text: str) -> bool:
    """Return True for a name that a ROS node may have."""
    return _NODE_NAME.fullmatch(text) is not None


def node_name_fault(text: str) -> str:
    """Return why a text cannot be the name of a ROS node."""
    allowed = "at most 200 letters, digits and '_', the first of them not a digit"
    return f"{text!r:.250} cannot be the name of a ROS node. Allowed: {allowed}"


def is_resource_name(name: str) -> bool:
    """Return True for a name that a resource may have."""
    return _RESOURCE_NAME.fullmatch(name) is not None


def description_fault(description: HostDescription) -> str:
    """Return the fault of a slave's description of its host; "" for none."""
    resources = description.resources
    if not description.name:
        return "a host needs a name"
    fault = name_fault(description.name, "host")
    if fault:
        return fault
    if not description.incarnation:
        return f"{description.name}: the incarnation of a slave is not 0"
    if len(resources) > RESOURCE_SLOTS:
        return f"{description.name} has {len(resources)} resources; {RESOURCE_SLOTS} are the most"
    names = [resource.name for resource in resources]
    if len(set(names)) < len(names):
        return f"{description.name} names a resource twice: {', '.join(names)}"
    if not 0.0 < description.period <= _LONGEST_PERIOD:
        return (
            f"{description.name} reports every {description.period} s; allowed: above 0, at most "
            f"{_LONGEST_PERIOD:g}"
        )
    words = (description.hostname, description.software_version, *description.executors,
             *description.launchers, *description.absent, *description.unenforced,
             *description.labels, *description.labels.values())  # fmt: skip
    unprintable = next((word for word in words if not word.isprintable()), None)
    if unprintable is not None:
        return f"{description.name} has {unprintable!r:.200} in its description: no printable text"
    fault = _size_fault(description) or next(filter(None, map(resource_fault, resources)), "")
    if not fault and (wrong := device_fault(description.devices)):
        fault = f"has devices that no host can have: {wrong}"
    return fault and f"{description.name} {fault}"


def _size_fault(description: HostDescription) -> str:
    """Return why a description is too large, as a predicate; "": it is not."""
    size = size_of(description)
    if size <= LARGEST_DESCRIPTION:
        return ""
    return (
        f"has a description (labels, devices, plugins, reasons) of {size} characters and entries; "
        f"at most {LARGEST_DESCRIPTION}"
    )


def resource_fault(resource: object) -> str:
    """Return the fault of the description of a resource; "": none."""
    if not isinstance(resource, ResourceDescription):
        return f"describes a resource by {resource!r}, which is not a ResourceDescription"
    name: object = resource.name
    if not (isinstance(name, str) and is_resource_name(name)):
        return (
            f"names a resource {name!r}. Allowed: at most 64 letters, digits, '_', '-' and '.', "
            "the first of them a letter"
        )
    for field in ("unit", "scope"):
        word: object = getattr(resource, field)
        if not (isinstance(word, str) and word.isprintable()):
            return f"gives {name!r} the {field} {word!r}; text is required, as {_EXAMPLES[field]}"
    accounting: object = resource.accounting
    if accounting not in _ACCOUNTINGS:
        allowed = ", ".join(map(repr, _ACCOUNTINGS))
        return f"gives {name!r} the accounting {accounting!r:.100}; allowed: {allowed}"
    capacity: object = resource.capacity
    numeric = isinstance(capacity, (int, float)) and not isinstance(capacity, bool)
    if not (numeric and math.isfinite(resource.capacity) and resource.capacity > 0.0):
        return f"gives {name!r} a capacity of {capacity!r}; a number above 0 is required"
    return ""
