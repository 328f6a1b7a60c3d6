"""Log of a run: on standard error, and as files beside each violation."""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.chaos.cluster import DESK, HOSTS, INSTANCE_RECORD, Cluster
from benchmarks.machine import say

#: Number of lines that the log keeps.
_LENGTH: Final = 400
#: Files of each host that help to find the cause.
_KEPT: Final = {
    DESK: ("master/journal.sqlite", "master/journal.sqlite-wal"),
    **dict.fromkeys(HOSTS, (INSTANCE_RECORD, "slave/supervisor/supervisor.log")),
}
#: Logs of one process on a host.
_OUTPUT: Final = "slave/supervisor/logs"


class EventLog:
    """Lines with times, in seconds of the monotonic clock, as the lines of the workload have."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._lines: list[str] = []

    def add(self, text: str, *, aloud: bool = False) -> None:
        """Add a line."""
        self._lines.append(f"{time.monotonic():.2f} {time.strftime('%H:%M:%S')} {text}")
        del self._lines[:-_LENGTH]
        if aloud:
            say(text)

    def keep(
        self, folder: Path, cluster: Cluster, violations: Sequence[Mapping[str, Any]],
        seen: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Write a violation with everything that may explain it."""
        folder.mkdir(parents=True, exist_ok=True)
        report = {"seed": self._seed, "violations": violations, "log": self._lines, "seen": seen}
        (folder / "violation.json").write_text(json.dumps(report, indent=1))
        for part in cluster.parts.values():
            with contextlib.suppress(OSError):
                shutil.copy(part.log, folder)
        logs = [f"{_OUTPUT}/{one['name']}.*.log" for one in violations]
        for host, files in _KEPT.items():
            for pattern in (*files, *logs):
                _copy(cluster, host, Path(pattern), folder)


def _copy(cluster: Cluster, host: str, pattern: Path, folder: Path) -> None:
    """Copy the files of a host that match a pattern; the host may be off."""
    with contextlib.suppress(Exception):
        for file in cluster.lab.outside(host, pattern.parent).glob(pattern.name):
            shutil.copy(file, folder / f"{host}-{file.name}")
