"""Master and slaves on the hosts of a lab, restarted as by a service manager."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

import psutil

from benchmarks.chaos import clocks
from benchmarks.chaos.faults import MASTER
from benchmarks.chaos.work import LINE_HOST, ROOT
from rosrm.errors import LabError
from rosrm_lab import GIB, MIB, HostPlan, Lab, uniform

if TYPE_CHECKING:
    from typing_extensions import Self

DESK: Final = "desk"
HOSTS: Final = tuple(plan.name for plan in uniform(5))
assert LINE_HOST in HOSTS

#: Seconds of silence after which a host is lost. Some faults last less than that, some longer.
LEASE_S: Final = 3.0
#: Instance record of a host's supervisor, on the host's disk.
INSTANCE_RECORD: Final = "slave/supervisor/instances.jsonl"
_ROSRM: Final = (sys.executable, "-m", "rosrm.cli")
_MEMORY: Final = 2 * GIB
_DISK: Final = 96 * MIB
#: Seconds after which the service manager restarts a part that has ended unexpectedly.
_AGAIN: Final = 1.0
#: Maximum number of runs of the master whose records are kept.
_MOST_RECORDS: Final = 1000
#: Seconds for parts to shut down.
_END: Final = 30.0
#: Part of a supervisor's command line.
_SUPERVISOR: Final = "rosrm/supervisor/"


@dataclass
class Part:
    """The master or a slave.

    Attributes:
        process: the process on this machine that runs the part in its host; None: not started yet.
        held: the part is down on purpose, and is not restarted.
        ended: monotonic time at which an unexpected end was seen; 0: there was none.
    """

    name: str
    host: str
    command: list[str]
    log: Path
    process: subprocess.Popen[bytes] | None = None
    held: bool = False
    ended: float = 0.0

    @property
    def pid(self) -> int:
        """Return the pid of the part itself on this machine; 0: it does not run."""
        with contextlib.suppress(psutil.Error):
            if self.process is not None:
                return next((one.pid for one in psutil.Process(self.process.pid).children()), 0)
        return 0


class Cluster:
    """A lab with a master on a host of its own and a slave on each other one; removed at exit.

    Args:
        name: of the lab.
        folder: for settings and logs.
        tell: is called with a line for each unexpected end of a part.
    """

    def __init__(self, name: str, folder: Path, tell: Callable[[str], None]) -> None:
        plans = uniform(len(HOSTS), memory=_MEMORY, disk=_DISK)
        self.lab: Final = Lab(name, [*plans, HostPlan(DESK, disk=_DISK)])
        self.folder: Final = folder
        self.records: Final = folder / "records"
        self._tell = tell
        self._opened = ExitStack()
        self.parts: Final = {MASTER: self._part(MASTER, DESK, _master_settings(self.records))}
        for host in HOSTS:
            self.parts[host] = self._part("slave", host, _slave_settings(host))

    def __enter__(self) -> Self:
        with ExitStack() as opened:
            opened.enter_context(self.lab)
            clocks.reset(self.folder, self.parts)
            for name in self.parts:
                self.start(name)
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._opened.close()
        for part in self.parts.values():  # the lab has ended them
            if part.process is not None:
                part.process.wait(_END)

    # --- parts --------------------------------------------------------------------------------

    def start(self, name: str) -> None:
        """Start a part, or start it again."""
        part = self.parts[name]
        part.held, part.ended = False, 0.0
        with part.log.open("ab") as sink:
            part.process = self.lab.popen(
                part.host, clocks.with_clock(self.folder, name, part.command), cwd=str(ROOT),
                stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
            )  # fmt: skip

    def kill(self, name: str) -> bool:
        """Send SIGKILL, and keep the part down until `start`; False: it did not run."""
        part = self.parts[name]
        if not part.pid or part.process is None:
            return False
        part.held = True
        os.kill(part.pid, signal.SIGKILL)
        part.process.wait(_END)
        return True

    def hold(self, name: str) -> None:
        """Do not restart a part that is about to end."""
        self.parts[name].held = True

    def tend(self) -> None:
        """Restart the parts that have ended unexpectedly; to be called often."""
        now = time.monotonic()
        for name, part in self.parts.items():
            if part.held or part.process is None or part.process.poll() is None:
                continue
            if not part.ended:
                part.ended = now
                self._tell(f"{name} ended with {part.process.returncode}: {_last_line(part.log)}")
            elif now >= part.ended + _AGAIN:
                self.start(name)

    def pids(self) -> dict[str, Callable[[], int]]:
        """Return by part the function that returns its pid on this machine, or 0."""
        return {name: partial(getattr, part, "pid") for name, part in self.parts.items()}

    def instance_record(self, host: str) -> str:
        """Return the instance record of a host's supervisor; "": it is out of reach."""
        with contextlib.suppress(LabError, OSError):
            return self.lab.outside(host, INSTANCE_RECORD).read_text()
        return ""

    def supervisor(self, host: str) -> int:
        """Return the pid of a host's supervisor on this machine; 0: there is none."""
        for pid in sorted(self.lab.pids(host)):
            with contextlib.suppress(OSError):
                if _SUPERVISOR in Path(f"/proc/{pid}/cmdline").read_text():
                    return pid
        return 0

    def proceed(self, name: str) -> bool:
        """Send SIGCONT to a stopped part and to its process outside the host, which stopped too.

        Return True if both run again.
        """
        part = self.parts[name]
        for pid in (part.pid, part.process.pid if part.process else 0):
            if pid:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
        return all(state != psutil.STATUS_STOPPED for state in self._states(part))

    @staticmethod
    def _states(part: Part) -> Iterator[str]:
        for pid in (part.pid, part.process.pid if part.process else 0):
            with contextlib.suppress(psutil.Error):
                if pid:
                    yield psutil.Process(pid).status()

    def shut_down(self) -> None:
        """Shut down the slaves, with all their processes, then the master."""
        for names in (HOSTS, (MASTER,)):
            running = [self.parts[name] for name in names if self.parts[name].process]
            for part in running:
                part.held = True
                if part.process is not None and part.process.poll() is None:
                    part.process.send_signal(signal.SIGINT)
            deadline = time.monotonic() + _END
            for part in running:
                assert part.process is not None
                with contextlib.suppress(subprocess.TimeoutExpired):
                    part.process.wait(max(0.1, deadline - time.monotonic()))

    def _part(self, name: str, host: str, settings: dict[str, object]) -> Part:
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / f"{host}.yaml"
        file.write_text(json.dumps(settings))  # JSON is YAML too
        command = [*_ROSRM, name, "--config", str(file)]
        return Part(name, host, command, self.folder / f"{name}-{host}.log")


def _master_settings(records: Path) -> dict[str, object]:
    return {
        "name": "chaos",
        "state": "/run/data/master",
        "record": {"directory": str(records), "keep": _MOST_RECORDS},
        "liveness": {"suspect": 1.0, "lease": LEASE_S},
        # A migration is requested by the benchmark or is a fault: the master starts none.
        "migration": {"strategies": {"relaunch": {}, "handoff": {}}, "automatic": False},
    }


def _slave_settings(host: str) -> dict[str, object]:
    return {
        "host": host,
        "state": "/run/data/slave",
        "labels": {"name": host},
        # Without cpu: the hosts share the processor, and a busy one would make all refuse work.
        "probes": {"memory": {}, "disk": {}},
        "limits": {"memory": 0.8, "disk": 0.95},
        # Five hosts of a lab share one machine: together they must not start too many processes.
        "max_starting": 2,
    }


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"
