"""A probe for rosrm: reads a resource of the host, on each slave that chooses it."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rosrm import (
    PositiveCount,
    ProbeContext,
    ProbeOffer,
    Reading,
    ResourceDescription,
    SkipPlugin,
    hookimpl,
)

COUNTS = Path("/proc/sys/fs/file-nr")


@dataclass(frozen=True)
class ExampleOptions:
    """Options of the probe in host.yaml.

    Attributes:
        most: number of open files of the machine that counts as full.
    """

    most: PositiveCount = 1_000_000


class ExampleProbe:
    """Reads how many files are open on the machine."""

    def __init__(self, options: ExampleOptions, context: ProbeContext) -> None:
        if not COUNTS.exists():
            raise SkipPlugin(f"this machine has no {COUNTS}")
        self._most = float(options.most)
        self.resources = [ResourceDescription("example", "1", self._most, "machine", "shared")]
        self.labels = {"example.kernel": os.uname().release}

    def read(self) -> Iterable[Reading]:
        """Return the reading as a fraction of the capacity; may block."""
        return [Reading("example", int(COUNTS.read_text().split()[0]) / self._most)]

    def close(self) -> None:
        """Release nothing, because the probe keeps no file open."""


@hookimpl
def register_probes() -> list[ProbeOffer]:
    """Offer the probe by the name with which host.yaml chooses it."""
    return [
        ProbeOffer(
            name="example",
            create=ExampleProbe,
            options=ExampleOptions,
            summary="open files of the machine",
            period=1.0,
        )
    ]
