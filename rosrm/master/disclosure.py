"""Removal of details that only the owner of a process and operators may read.

The master sends environment and parameters only to the host of the process. The host may quote them
in the details of a reason, such as the PATH in which a program was not found. Details are all lines
of a text after the first.
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
