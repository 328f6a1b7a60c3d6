"""How Fast DDS is in the parts of rosrm, and in nodes that it moves (decisions 0009, 0015)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Final, Literal

#: The first is the one that Fast DDS 2.14 (Jazzy) reads. Whatever the user names there stands.
_VARIABLES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PROFILES: Final = Path(__file__).parent / "profiles"

_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"

Pace = Literal["eager", "steady", "movable"]
#: Of rosrm's own parts. They speak UDP alone: a process that was killed leaves ports in shared
#: memory that hold up its peers, or keep them from being heard; nodes may pay that price for large
#: messages, who watches over them may not.
_OF_PARTS: Final = ("eager", "steady")


def announcements(
    environment: Mapping[str, str], pace: Pace, *, udp: bool = False
) -> dict[str, str]:
    """Variables that Fast DDS makes a participant by; none where a user set a profile.

    Args:
        environment: that a user may have set a profile, or transports, in.
        pace: the profile.
        udp: over UDP alone, also where it is no part of rosrm.
    """
    if any(variable in environment for variable in _VARIABLES):
        return {}
    variables = {_VARIABLES[0]: str(_PROFILES / f"{pace}.xml")}
    if (udp or pace in _OF_PARTS) and _TRANSPORTS not in environment:
        variables[_TRANSPORTS] = "UDPv4"
    return variables


@contextlib.contextmanager
def announcing(
    environment: MutableMapping[str, str], pace: Pace, *, udp: bool = False
) -> Iterator[None]:
    """Give Fast DDS a profile while a participant is made, unless the user has given one.

    Args:
        environment: of this process; it is as it was afterwards, for who is started by it.
        pace: the profile.
        udp: over UDP alone, also where it is no part of rosrm.
    """
    added = announcements(environment, pace, udp=udp)
    environment.update(added)
    try:
        yield
    finally:
        for variable in added:
            del environment[variable]
