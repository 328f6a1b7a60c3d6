"""A third party's probe: the machine's temperature as a fraction of its maximum."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Gt, Le

from rosrm import ProbeContext, ProbeOffer, Reading, ResourceDescription, SkipPlugin, hookimpl


@dataclass(frozen=True)
class ThermometerOptions:
    """Options of the probe in host.yaml.

    Attributes:
        sensor: file with the temperature in thousandths of a degree.
        hottest: temperature in degrees that counts as 1.0.
    """

    sensor: str = "/sys/class/thermal/thermal_zone0/temp"
    hottest: Annotated[float, Gt(0), Le(150)] = 95.0


class Thermometer:
    """A probe of one temperature sensor."""

    def __init__(self, options: ThermometerOptions, _context: ProbeContext) -> None:
        if not Path(options.sensor).is_file():
            raise SkipPlugin(f"no sensor at {options.sensor}")
        self._options = options
        self._resource = ResourceDescription("heat", "K", options.hottest)

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return the only resource, `heat`."""
        return [self._resource]

    def read(self) -> Iterable[Reading]:
        """Return the current temperature."""
        degrees = int(Path(self._options.sensor).read_text(encoding="ascii")) / 1000.0
        return [Reading("heat", max(0.0, degrees / self._options.hottest))]

    def close(self) -> None:
        """Do nothing: the probe holds no resources."""


@hookimpl
def register_probes() -> Sequence[ProbeOffer]:
    """Offer the probe."""
    return [ProbeOffer("heat", Thermometer, ThermometerOptions, "how hot it is", period=1.0)]
