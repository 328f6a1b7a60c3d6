"""Probe `network`: usage of the busiest link, in its busier direction."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rosrm import (
    ConfigError,
    PositiveSeconds,
    ProbeContext,
    Reading,
    ResourceDescription,
    SkipPlugin,
)
from rosrm.shortage import exists
from rosrm_resources.rate import Rate, check_window

_BYTES_PER_MEGABIT: Final = 1e6 / 8


@dataclass(frozen=True)
class NetworkOptions:
    """Settings of the probe `network`.

    Attributes:
        interfaces: names of the interfaces that count; (): every physical one of known speed.
        capacity: bytes a second of each interface in one direction; None: as the link reports
            (a wireless link reports none).
        window: seconds over which the usage is a mean.
    """

    interfaces: tuple[str, ...] = ()
    capacity: float | None = None
    window: PositiveSeconds = 2.0

    def __post_init__(self) -> None:
        """Raise `ValueError` for a capacity or a window that is out of range."""
        if self.capacity is not None and not self.capacity > 0.0:
            raise ValueError(
                f"`capacity` is {self.capacity!r}; it must be greater than 0 bytes a second"
            )
        check_window(self.window)


def create(options: NetworkOptions, _context: ProbeContext) -> NetworkProbe:
    """Create the probe.

    Raises:
        SkipPlugin: no physical interface with a known speed is up.
        ConfigError: a chosen interface does not exist, or its speed is not known.
    """
    return NetworkProbe(links(options), options.window)


class NetworkProbe:
    """Probe that reads the counters of network links.

    The usage is that of the busiest link, and the capacity that of the slowest. So traffic that
    fits by these numbers fits on every link.

    Args:
        links: capacity in bytes a second by interface.
        window: seconds.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        links: dict[str, float],
        window: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        slowest = min(links.values())
        self._resources = (ResourceDescription("network", "B/s", slowest, "machine", "shared"),)
        self._links = links
        self._clock = clock
        now, counters = clock(), _counters()
        self._rates = {
            name: (Rate(window, now, counters[name][0]), Rate(window, now, counters[name][1]))
            for name in links
        }

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return the only resource, `network`."""
        return self._resources

    def read(self) -> Sequence[Reading]:
        """Return the usage of the busiest link; raises `OSError` if an interface is gone."""
        now, counters = self._clock(), _counters()
        usage = 0.0
        for name, (received, sent) in self._rates.items():
            if name not in counters:
                raise OSError(f"interface {name} is gone")
            in_count, out_count = counters[name]
            rate = max(received.update(now, in_count), sent.update(now, out_count))
            usage = max(usage, rate / self._links[name])
        return (Reading("network", usage),)

    def close(self) -> None:
        """Do nothing, because no file is open."""


def links(options: NetworkOptions, classes: Path = Path("/sys/class/net")) -> dict[str, float]:
    """Return the capacity in bytes a second of each interface that counts.

    Args:
        options: of the probe.
        classes: directory in which the kernel lists the interfaces.
    """
    statistics = _psutil().net_if_stats()
    unknown = [name for name in options.interfaces if name not in statistics]
    if unknown:
        raise ConfigError(
            f"probe network: interfaces {', '.join(unknown)} do not exist; there are: "
            f"{', '.join(sorted(statistics))}"
        )
    chosen = options.interfaces or tuple(
        name
        for name, state in statistics.items()
        if state.isup and exists(classes / name / "device")
    )
    if not chosen:
        raise SkipPlugin("no physical network interface is up")
    speeds = {
        name: options.capacity or statistics[name].speed * _BYTES_PER_MEGABIT for name in chosen
    }
    silent = [name for name, speed in speeds.items() if not speed > 0]
    if silent and options.interfaces:
        raise ConfigError(
            f"probe network: the speed of {', '.join(silent)} is not known; "
            "give it as the option `capacity`, in bytes a second"
        )
    known = {name: speed for name, speed in speeds.items() if speed > 0}
    if not known:
        raise SkipPlugin(
            f"the speed of {', '.join(silent)} is not known; the option `capacity` would give it"
        )
    return known


def _counters() -> dict[str, tuple[float, float]]:
    """Return the bytes received and sent by interface, since it came up."""
    # `Rate` handles a counter that wraps around, so psutil need not (`nowrap=False`).
    counters = _psutil().net_io_counters(pernic=True, nowrap=False)
    return {
        name: (float(counter.bytes_recv), float(counter.bytes_sent))
        for name, counter in counters.items()
    }


def _psutil() -> Any:
    import psutil  # noqa: PLC0415 - it takes 2 MiB of the slave, and only this probe needs it

    return psutil
