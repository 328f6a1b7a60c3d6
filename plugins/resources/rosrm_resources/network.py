"""The probe `network`: how full the busiest link is, in its busier direction."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from annotated_types import Gt, Le

from rosrm import ConfigError, ProbeContext, Reading, ResourceDescription, SkipPlugin
from rosrm_resources.rate import Rate

_BYTES_PER_MEGABIT: Final = 1e6 / 8


@dataclass(frozen=True)
class NetworkOptions:
    """Settings of the probe `network`.

    Attributes:
        interfaces: names of those that count; (): every physical one whose speed is known.
        capacity: bytes a second that each of them carries in one direction; None: as the link
            says (a wireless one does not).
        window: seconds over which the usage is a mean.
    """

    interfaces: tuple[str, ...] = ()
    capacity: Annotated[float, Gt(0)] | None = None
    window: Annotated[float, Gt(0), Le(60)] = 2.0


def create(options: NetworkOptions, _context: ProbeContext) -> NetworkProbe:
    """Make the probe.

    Raises:
        SkipPlugin: no physical interface with a known speed is up.
        ConfigError: a chosen interface does not exist, or its speed is not known.
    """
    return NetworkProbe(links(options), options.window)


class NetworkProbe:
    """Reads the counters of some links.

    The usage is that of the busiest link, the capacity that of the slowest: what fits then fits
    on whichever link it goes.

    Args:
        links: bytes a second by interface.
        window: seconds.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        links: dict[str, float],
        window: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._resources = (ResourceDescription("network", "B/s", min(links.values()), "machine"),)
        self._links = links
        self._clock = clock
        now, counters = clock(), _counters()
        self._rates = {
            name: (Rate(window, now, counters[name][0]), Rate(window, now, counters[name][1]))
            for name in links
        }

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """The one resource `network`."""
        return self._resources

    def read(self) -> Sequence[Reading]:
        """Usage of the busiest link; raises where one has gone."""
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
        """Nothing is kept."""


def links(options: NetworkOptions, classes: Path = Path("/sys/class/net")) -> dict[str, float]:
    """The interfaces that count, and the bytes a second that each carries.

    Args:
        options: of the probe.
        classes: where the kernel lists the interfaces.
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
        if state.isup and (classes / name / "device").exists()
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
    """Bytes received and sent by interface, since it came up."""
    # A counter that wraps round is begun anew by `Rate`; psutil need not remember it too.
    counters = _psutil().net_io_counters(pernic=True, nowrap=False)
    return {
        name: (float(counter.bytes_recv), float(counter.bytes_sent))
        for name, counter in counters.items()
    }


def _psutil() -> Any:
    import psutil  # noqa: PLC0415 - it takes 2 MiB of the slave, and only this probe needs it

    return psutil
