"""Update of Fast DDS in this process after a restore on another host.

Fast DDS 2.14 determines its location once in the life of a process, and keeps it: the network
interfaces, an id of the host that is made from them, and the prefix of all GUIDs (host, pid and
random number). After a restore on another host a new participant would use loopback only. After a
second restore of one checkpoint image its GUIDs would be known to peers, which drop its samples as
repeated. Only Fast DDS's own C++ symbols can start a new determination (docs/decisions/0024).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rosrm.errors import PortableError
from rosrm.ros.graph_remains import close_leaked, open_sockets

_LIBRARIES: Final = ("libfastrtps.so", "libfastdds.so")
_INTERFACES: Final = "_ZN8eprosima10SystemInfo17update_interfacesEv"
#: Pairs of a constructor and the one object that it made. The objects hold numbers, nothing to
#: destroy. The second takes over the results of the first.
_PLACES: Final = (
    ("_ZN8eprosima4HostC1Ev", "_ZZN8eprosima4Host8instanceEvE9singleton"),
    (
        "_ZN8eprosima7fastdds4rtps9GuidUtilsC1Ev",
        "_ZZN8eprosima7fastdds4rtps9GuidUtils8instanceEvE9singleton",
    ),
)


def check() -> None:
    """Check that `look_again` can work; called before a node leaves.

    Raises:
        PortableError: this Fast DDS has no such symbol, so the node could not join elsewhere.
    """
    library = _library()
    if library is not None:
        _interfaces_of(library)


def look_again() -> bool:
    """Let Fast DDS determine its location again, while this process has no participant.

    Returns:
        True if the GUIDs of the next participant are new as well. False costs only this: the
        checkpoint image can be restored only once.

    Raises:
        PortableError: it is impossible; a participant would be reachable on loopback only.
    """
    library = _library()
    if library is None:
        return True  # another vendor, or no participant ever
    if not _interfaces_of(library)():
        raise PortableError("Fast DDS cannot read the network interfaces of this host")
    return _renew_places(library)


def _library() -> ctypes.CDLL | None:
    """Return the loaded Fast DDS; None: it is not loaded."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    for line in maps.splitlines():
        path = line.partition("/")[2]
        if path.rpartition("/")[2].startswith(_LIBRARIES):
            try:
                return ctypes.CDLL(f"/{path}")
            except OSError as error:  # replaced on disk since
                raise PortableError(f"Fast DDS (/{path}) cannot be asked: {error}") from None
    return None


def _interfaces_of(library: ctypes.CDLL) -> Callable[[], bool]:
    try:
        look = library[_INTERFACES]
    except AttributeError:
        raise PortableError(
            "this Fast DDS has no SystemInfo::update_interfaces, as 2.14 has: after a move to "
            "another host the node would be heard on loopback alone. Use the Fast DDS of ROS 2 "
            "Jazzy, or move it with the strategy relaunch or handoff"
        ) from None
    look.argtypes, look.restype = (), ctypes.c_bool
    return look


def _renew_places(library: ctypes.CDLL) -> bool:
    try:
        pairs = [(library[made], _address(library, one)) for made, one in _PLACES]
    except (AttributeError, ValueError):
        return False
    before = open_sockets()
    for construct, address in pairs:
        construct.argtypes, construct.restype = (ctypes.c_void_p,), None
        construct(address)
    close_leaked({number: one for number, one in open_sockets().items() if number not in before})
    return True


def _address(library: ctypes.CDLL, symbol: str) -> int:
    return ctypes.addressof(ctypes.c_byte.in_dll(library, symbol))
