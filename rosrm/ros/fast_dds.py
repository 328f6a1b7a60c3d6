"""Fast DDS settings of rosrm's components and of migratable nodes (decisions 0009, 0015)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Final, Literal

#: The first is the one that Fast DDS 2.14 (Jazzy) reads. A value set by the user is not changed.
_VARIABLES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PROFILES: Final = Path(__file__).parent / "profiles"

_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"
_UDP: Final = "UDPv4"

Pace = Literal["eager", "steady"]


def announcements(environment: Mapping[str, str], pace: Pace, *, udp: bool) -> dict[str, str]:
    """Return the variables that configure a participant; none if the user has set a profile.

    Args:
        environment: may have a profile, or transports, of the user.
        udp: receive by UDP alone, unless the user has set other transports. A killed process leaves
            ports in shared memory that delay its peers. Nodes may accept that for large messages;
            rosrm's components must not.
    """
    if any(variable in environment for variable in _VARIABLES):
        return {}
    if not udp or environment.get(_TRANSPORTS, _UDP) != _UDP:
        return {_VARIABLES[0]: str(_PROFILES / f"{pace}.xml")}
    variables = {_VARIABLES[0]: str(_PROFILES / f"{pace}-udp.xml"), _TRANSPORTS: _UDP}
    return {name: value for name, value in variables.items() if name not in environment}


@contextlib.contextmanager
def announcing(environment: MutableMapping[str, str], pace: Pace, *, udp: bool) -> Iterator[None]:
    """Apply `announcements` to this process while a participant is created.

    The environment is restored afterwards, for the processes that this one starts.
    """
    added = announcements(environment, pace, udp=udp)
    environment.update(added)
    try:
        yield
    finally:
        for variable in added:
            del environment[variable]
