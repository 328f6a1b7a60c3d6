"""Metrics of a slave's own host, for the textfile collector of a node exporter.

`rosrm web` has the metrics of the cluster. This file shows a host also while the network, the
master or the gateway is away.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.model.values import InstanceState, InstanceStatus
from rosrm.runtime import durable
from rosrm.runtime.path_calls import NoAnswer, at
from rosrm.wording import reason_of

#: Seconds between two versions of the file.
PERIOD: Final = 15.0
#: Mode of the file: the node exporter runs as another user.
_READABLE: Final = 0o644

_log = logging.getLogger("rosrm.slave")


@dataclass(frozen=True)
class HostMetrics:
    """Values of a host.

    Attributes:
        is_registered: the master has registered the host.
        is_accepting: the slave asks for more processes.
        usage: resource to its usage as a fraction of the capacity; stale ones are left out.
        limits: resource to its limit as a fraction of the capacity.
        instances: statuses of the instances that the slave knows.
    """

    is_registered: bool
    is_accepting: bool
    usage: Mapping[str, float]
    limits: Mapping[str, float]
    instances: Iterable[InstanceStatus]


class Textfile:
    """The file of a host, written every `PERIOD` in a thread, because its disk may not answer.

    Attributes:
        is_being_written: set by the caller of `write`, until its end.

    Args:
        directory: of the collector; `Path()`: no file is written.
        host: name of the host.
    """

    def __init__(self, directory: Path, host: str) -> None:
        self._host = host
        self._path = directory / f"rosrm_slave_{host}.prom" if directory != Path() else None
        self._due = float("-inf")
        self._fault = ""
        self.is_being_written = False

    def is_due(self, now: float) -> bool:
        """Return True if the file must be written at a monotonic time (s)."""
        return self._path is not None and now >= self._due and not self.is_being_written

    def write(self, metrics: HostMetrics, now: float) -> None:
        """Replace the file; log the beginning and the end of a failure."""
        self._due = now + PERIOD
        fault, path = "", self._path
        assert path is not None
        try:
            at(path)
            text = text_of(metrics, self._host)
            os.close(durable.replace_atomically(str(path), text, mode=_READABLE))
        except (OSError, NoAnswer) as error:
            fault = reason_of(error)
        finally:
            self.is_being_written = False
        if fault and not self._fault:
            _log.warning("textfile: %s cannot be written: %s; the slave tries again", path, fault)
        elif self._fault and not fault:
            _log.info("textfile: %s is written again", path)
        self._fault = fault

    def remove(self) -> None:
        """Remove the file, because its values are no longer current."""
        if self._path is not None and not self.is_being_written:
            with suppress(OSError):
                self._path.unlink()


def text_of(metrics: HostMetrics, host: str) -> bytes:
    """Return metrics in the text format of Prometheus."""
    lines: list[str] = []
    for name, meaning, values in _series(metrics):
        lines += (f"# HELP {name} {meaning}", f"# TYPE {name} gauge")
        for labels, value in values.items():
            listed = ",".join(f'{key}="{_escaped(one)}"' for key, one in (("host", host), *labels))
            lines.append(f"{name}{{{listed}}} {value:.10g}")
    return ("\n".join(lines) + "\n").encode()


_Labels = tuple[tuple[str, str], ...]


def _series(metrics: HostMetrics) -> Iterator[tuple[str, str, Mapping[_Labels, float]]]:
    """Yield name, meaning and values of each metric. docs/reference/metrics.md has them, too."""
    instances = list(metrics.instances)
    states = Counter(dict.fromkeys((one.value for one in InstanceState), 0))
    states.update(one.state.value for one in instances)
    yield (
        "rosrm_slave_registered",
        "1: the master has registered the host",
        {(): metrics.is_registered},
    )
    yield (
        "rosrm_slave_accepting",
        "1: the slave asks for more processes",
        {(): metrics.is_accepting},
    )
    yield (
        "rosrm_slave_usage_ratio",
        "usage, as a fraction of the capacity",
        {(("resource", name),): value for name, value in metrics.usage.items()},
    )
    yield (
        "rosrm_slave_limit_ratio",
        "limit, as a fraction of the capacity",
        {(("resource", name),): value for name, value in metrics.limits.items()},
    )
    yield (
        "rosrm_slave_instances",
        "instances in each state",
        {(("state", name),): number for name, number in states.items()},
    )
    yield (
        "rosrm_slave_restarts",
        "restarts of the instances that have not ended",
        {(): sum(one.restarts for one in instances if not one.state.ended)},
    )


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
