"""Settings of Fast DDS for a node that can be moved."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Final

#: Where Fast DDS looks for settings; whatever the user names there stands.
_VARIABLES: Final = (
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
)
_PROFILE: Final = Path(__file__).parents[1] / "ros" / "profiles" / "movable.xml"


@contextlib.contextmanager
def prompt(environment: MutableMapping[str, str]) -> Iterator[None]:
    """While a process makes its first node, Fast DDS reads there how prompt it has to be.

    Args:
        environment: of this process; it is as it was afterwards, for who is started by it.
    """
    if any(variable in environment for variable in _VARIABLES):
        yield
        return
    environment[_VARIABLES[0]] = str(_PROFILE)
    try:
        yield
    finally:
        del environment[_VARIABLES[0]]
