"""How prompt Fast DDS is in the parts of rosrm, and in nodes that it moves (decision 0009)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Final, Literal

#: The first is the one that Fast DDS 2.14 (Jazzy) reads. Whatever the user names there stands.
_VARIABLES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PROFILES: Final = Path(__file__).parent / "profiles"

Pace = Literal["eager", "steady", "movable"]


def announcements(environment: Mapping[str, str], pace: Pace) -> dict[str, str]:
    """Variables that make Fast DDS announce a participant more often; none where a user set one.

    Args:
        environment: that a user may have set a profile in.
        pace: the profile.
    """
    if any(variable in environment for variable in _VARIABLES):
        return {}
    return {_VARIABLES[0]: str(_PROFILES / f"{pace}.xml")}


@contextlib.contextmanager
def announcing(environment: MutableMapping[str, str], pace: Pace) -> Iterator[None]:
    """Give Fast DDS a profile while a participant is made, unless the user has given one.

    Args:
        environment: of this process; it is as it was afterwards, for who is started by it.
        pace: the profile.
    """
    added = announcements(environment, pace)
    environment.update(added)
    try:
        yield
    finally:
        for variable in added:
            del environment[variable]
