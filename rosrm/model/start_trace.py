"""Trace of one start: the times at which the parts hand it over, from the client to the process.

The trace is a variable of the environment of the process, so it travels with the start itself: each
part adds its stamps, and a start without the variable is not traced. The supervisor writes the
trace into the log of the process, where the client reads it. A stamp is a unix time in nanoseconds,
by the clock of the machine that made it. The supervisor imports this module, so it must stay small.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, TypeVar

#: Variable with the stamps so far, as words `NAME=NANOSECONDS`.
VARIABLE: Final = "ROSRM_TRACE"
#: Beginning of the line in the log of the process; the stamps follow.
LINE: Final = "rosrm: trace: "

_Value = TypeVar("_Value")


def stamped_in(environment: Mapping[str, _Value], **stamps: int) -> Mapping[str, _Value | str]:
    """Return variables with further stamps in their trace; without a trace return them as given."""
    text = environment.get(VARIABLE)
    if not isinstance(text, str):
        return environment
    added = (f"{name}={at}" for name, at in stamps.items())
    return {**environment, VARIABLE: " ".join((text, *added))}
