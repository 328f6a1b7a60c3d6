"""Network interfaces of this machine: their speed, their counters and the one in use."""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.model.links import INTERFACES, Interface
from rosrm.model.ros_settings import RosSettings
from rosrm.runtime.addresses import addresses

_CLASSES: Final = Path("/sys/class/net")
_BYTES_PER_MEGABIT: Final = 1e6 / 8
_LOOPBACK: Final = "127.0.0.1"


def own_address(settings: RosSettings) -> str:
    """Return the only address of this host's ROS traffic; "": it uses all interfaces."""
    interface = settings.interface_in_force()
    if interface:
        return addresses().get(interface, interface)
    return _LOOPBACK if settings.is_local() else ""


def interface_towards(address: str) -> str:
    """Return the name of the interface by which packets to an address leave; "": unknown."""
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route,
    ):
        route.connect((address, 9))  # sends nothing
        own = route.getsockname()[0]
        return next((name for name, its in addresses().items() if its == own), "")
    return ""


class Traffic:
    """Rate and traffic of the interfaces that lead to other hosts, each with a number that stays.

    Args:
        rate: bytes a second that each link can carry; None: the speed of its interface.
        rates: bytes a second by name of the other host, for links with another rate.
        clock: monotonic seconds.
        classes: directory in which the kernel lists the interfaces.
    """

    def __init__(
        self, rate: float | None, rates: Mapping[str, float],
        clock: Callable[[], float] = clocks.boot_time, classes: Path = _CLASSES,
    ) -> None:  # fmt: skip
        self._rate, self._rates = rate, rates
        self._clock = clock
        self._classes = classes
        self._numbers: dict[tuple[str, str], int] = {}
        self._counted: dict[str, tuple[float, int, int]] = {}
        self._last: dict[str, float] = {}

    def number(self, interface: str, host: str) -> int | None:
        """Return the number of an interface towards a host; None: there are too many.

        A link with a rate of its own counts as an interface of its own.
        """
        key = (interface, host if host in self._rates else "")
        if key not in self._numbers and len(self._numbers) >= INTERFACES:
            return None
        return self._numbers.setdefault(key, len(self._numbers))

    def read(self) -> tuple[Interface, ...]:
        """Return all interfaces in the order of their numbers, with the traffic since the last."""
        carried = {name: self._carried(name) for name, _ in self._numbers}
        return tuple(
            Interface(self._rates[host])
            if host
            else Interface(self._rate or self._speed(name), carried[name])
            for name, host in self._numbers
        )

    def _speed(self, name: str) -> float:
        """Return the speed of an interface in bytes a second; NaN: it reports none."""
        try:
            megabits = float((self._classes / name / "speed").read_text())
        except (OSError, ValueError):
            return math.nan
        return megabits * _BYTES_PER_MEGABIT if megabits > 0 else math.nan

    def _carried(self, name: str) -> float:
        """Return the bytes a second of the busier direction since the last call; 0: the first one.

        If the counters cannot be read, the last rate stays, because 0 would mean a free link.
        """
        try:
            received, sent = (
                int((self._classes / name / "statistics" / f"{way}_bytes").read_text())
                for way in ("rx", "tx")
            )
        except (OSError, ValueError):
            return self._last.get(name, 0.0)
        now = self._clock()
        then, *before = self._counted.get(name, (now, received, sent))
        self._counted[name] = (now, received, sent)
        if now <= then:
            return self._last.get(name, 0.0)
        carried = max(0.0, received - before[0], sent - before[1]) / (now - then)
        self._last[name] = carried
        return carried
