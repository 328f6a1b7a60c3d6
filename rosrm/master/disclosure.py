"""Disclosure: what of a process only its owner and operators may read.

Environment and parameters never leave the master, except towards the host of the process. A host
may quote them in the details of a reason, such as the PATH in which a program was not found.
Details are the further lines of a text.
"""

from __future__ import annotations

from typing import Any

from rosrm.wording import first_line, one_line


def disclosed(value: Any, *, details: bool) -> Any:
    """Return a JSON value with each of its texts as one line, with or without its details."""
    if isinstance(value, str):
        return one_line(value) if details else first_line(value)
    if isinstance(value, dict):
        return {key: disclosed(item, details=details) for key, item in value.items()}
    if isinstance(value, list):
        return [disclosed(item, details=details) for item in value]
    return value
