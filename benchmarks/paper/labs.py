"""A cluster on the hosts of a lab: master, slaves and a client, started as users start them."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final

from benchmarks.paper.settings import cluster_settings, host_settings
from benchmarks.paper.trace import Look, Trace
from rosrm_lab import DATA, MIB, HostPlan, Lab

if TYPE_CHECKING:
    from typing_extensions import Self

ROOT: Final = Path(__file__).resolve().parents[2]
DESK: Final = "desk"
_ROSRM: Final = str(Path(sys.executable).with_name("rosrm"))
#: Seconds between two looks at the cluster.
LOOK_S: Final = 0.2
#: Seconds for a part to start, on a busy machine and within a small quota.
_START: Final = 90.0
_ANSWER: Final = 30.0
#: A run that takes so many times as long as on a quiet machine is given up.
_SLOWEST: Final = 4.0
_END: Final = 15.0
#: Lines of the master's record that are shown with an error.
_TOLD: Final = 15
_WRONG: Final = frozenset({"failed", "cancelled", "set_aside", "stuck", "unreachable"})


class Failed(Exception):
    """A figure could not be measured; the text says why."""


@dataclass(frozen=True)
class Part:
    """A program on a host.

    Attributes:
        log: the file of its output.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def check(self) -> None:
        """Raise `Failed` with the last lines of its output where it has ended."""
        if self.process.poll() is not None:
            raise self.last_words()

    def last_words(self) -> Failed:
        """Return an error with its exit code and the last lines of its output."""
        words = self.log.read_text(errors="replace").strip().splitlines()[-5:]
        said = "\n  ".join(words) or "no output"
        return Failed(f"{self.name} ended with exit code {self.process.returncode}:\n  {said}")


class LabCluster:
    """A master on a desk without a quota, and hosts on which slaves are started; removed at exit.

    Attributes:
        records: folder with the record of the run, complete once the master has stopped.

    Args:
        name: of the lab.
        hosts: in addition to the desk.
        folder: for settings, logs and the record.
        cluster: the master's `cluster.yaml`; None: with the paper's settings.
    """

    def __init__(
        self,
        name: str,
        hosts: Sequence[HostPlan],
        folder: Path,
        cluster: Mapping[str, Any] | None = None,
    ) -> None:
        self.lab: Final = Lab(name, [*hosts, HostPlan(DESK, disk=64 * MIB)])
        self.trace = Trace()
        self._folder = folder
        self.records: Final = folder / "records"
        settings = cluster_settings() if cluster is None else cluster
        self._settings = {**settings, "record": {"directory": str(self.records)}}
        self._parts: list[Part] = []
        self._works = 0
        self._opened = ExitStack()
        self._desk: LabClient | None = None

    def __enter__(self) -> Self:
        """Make the hosts, and start master and desk."""
        with ExitStack() as opened:
            opened.enter_context(self.lab)
            settings = self._write("cluster.yaml", self._settings)
            self._start("master", DESK, [_ROSRM, "master", "--config", settings])
            self._desk = opened.enter_context(LabClient(self._start_desk, self._check))
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self.stop_master()
        finally:
            self._opened.close()

    # --- parts --------------------------------------------------------------------------------

    def start_slave(self, host: str) -> None:
        """Start a host's slave, within its limits; `wait_for_slaves` waits for it."""
        settings = self._write(f"{host}.yaml", host_settings(host))
        self._start(f"the slave of {host}", host, [_ROSRM, "slave", "--config", settings])

    def start_slave_beside(self, host: str) -> None:
        """Start a host's slave outside the host's limits; its processes are within them."""
        state = str(DATA / "slave")
        self.lab.supervise(host, state, timeout=_START)
        measured = {name: {"group": self.lab.group(host)} for name in ("cpu", "memory")}
        plain = host_settings(host, state=state, probes={**measured, "disk": {}})
        settings = self._write(f"{host}.yaml", plain)
        command = [_ROSRM, "slave", "--config", settings]
        self._start(f"the slave of {host}", host, command, limited=False)

    def check_supervisors(self, hosts: Sequence[str]) -> None:
        """Raise `Failed` where a slave has started a second supervisor, outside the limits."""
        for host in hosts:
            commands = [_command(pid) for pid in self.lab.pids(host)]
            count = sum(b"rosrm/supervisor/" in command for command in commands)
            if count != 1:
                raise Failed(f"{host} has {count} supervisors: its jobs may be beside its limits")

    def wait_for_slaves(self, hosts: Sequence[str]) -> None:
        """Wait until the slaves of some hosts are registered and request work."""

        def asking(look: Look) -> bool:
            return all(name in look.hosts and look.hosts[name].accepting for name in hosts)

        self.wait_until(f"slaves of {', '.join(hosts)} requesting work", asking, _START)

    def stop_master(self) -> None:
        """Shut down the master if it runs."""
        master = next((part for part in self._parts if part.name == "master"), None)
        if master is None:
            return
        self._parts.remove(master)
        master.process.send_signal(signal.SIGINT)
        try:
            master.process.wait(_END)
        except subprocess.TimeoutExpired:
            raise Failed(f"the master did not end within {_END:g} s of SIGINT") from None

    def _start_desk(self) -> Part:
        command = [sys.executable, "-m", "benchmarks.paper.desk"]
        log = self._folder / "desk.log"
        with log.open("wb") as sink:
            process = self.lab.popen(
                DESK, command, cwd=str(ROOT), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=sink,
            )  # fmt: skip
        return Part("the client at the desk", process, log)

    def _start(self, name: str, host: str, command: list[str], *, limited: bool = True) -> None:
        log = self._folder / f"{name.replace(' ', '-')}.log"
        with log.open("ab") as sink:
            process = self.lab.popen(
                host, command, limited=limited, cwd=str(ROOT), stdin=subprocess.DEVNULL,
                stdout=sink, stderr=sink,
            )  # fmt: skip
        self._parts.append(Part(name, process, log))

    def _write(self, name: str, plain: Mapping[str, Any]) -> str:
        path = self._folder / name
        path.write_text(json.dumps(plain))  # JSON is YAML too
        return str(path)

    def _check(self) -> None:
        for part in self._parts:
            part.check()

    # --- using it -----------------------------------------------------------------------------

    def submit(self, *processes: Mapping[str, Any]) -> None:
        """Queue processes, as entries of a work file."""
        self._works += 1
        work = self._write(f"work{self._works}.yaml", {"processes": list(processes)})
        self._ask({"do": "submit", "work": work})

    def look(self) -> Look:
        """Look at the cluster, and add the look to the trace.

        Raises:
            Failed: a part has ended, or a process is in a wrong state.
        """
        self._check()
        plain = self._ask({"do": "look", "after": self.trace.last_sequence})
        look = self.trace.add(plain)
        wrong = [
            f"{name} is {state} ({plain['reasons'].get(name, 'no reason given')})"
            for name, state in look.states.items()
            if state in _WRONG
        ]
        if wrong:
            told = "\n  ".join(
                f"{event.elapsed - self.trace.start:.1f} s: {event.message}"
                for event in self.trace.events[-_TOLD:]
            )
            raise Failed(
                f"on the cluster {'; '.join(wrong[:3])}; last events of the master:\n  {told}"
            )
        return look

    def begin(self) -> None:
        """Set the run's own time to 0."""
        self.trace.looks.clear()
        self.trace.start = self.look().elapsed

    def wait_until(
        self, what: str, condition: Callable[[Look], bool], timeout: float, every: float = LOOK_S
    ) -> Look:
        """Look until a condition holds; at the timeout raise `Failed` with its name."""
        deadline = time.monotonic() + timeout
        while not condition(look := self.look()):
            if time.monotonic() >= deadline:
                seen = {state: look.count(state) for state in set(look.states.values())}
                raise Failed(
                    f"{what}: not within {timeout:g} s (hosts {sorted(look.hosts)}, {seen})"
                )
            time.sleep(every)  # time of the next look
        return look

    def play(self, due: Sequence[tuple[float, Callable[[], None]]], seconds: float) -> Look:
        """Carry out actions at their times (s from `begin`), and look until the run is over."""
        coming = sorted(due, key=lambda one: one[0])
        while True:
            look = self.look()
            elapsed = look.elapsed - self.trace.start
            while coming and coming[0][0] <= elapsed:
                coming.pop(0)[1]()
            if elapsed >= seconds:
                return look
            time.sleep(LOOK_S)  # time of the next look

    def feed(
        self, entries: Sequence[Mapping[str, Any]], *, every: float, after: float,
        also: Sequence[tuple[float, Callable[[], None]]] = (),
    ) -> Look:  # fmt: skip
        """Submit processes one by one, and look until the run is over.

        Each is submitted `every` seconds after the one before, but not before the readings contain
        that one: so a busy machine only stretches the run.

        Args:
            entries: of a work file.
            every: seconds.
            after: seconds from the last submission to the end.
            also: other actions, at their times from `begin`.
        """
        coming, other = list(entries), sorted(also, key=lambda one: one[0])
        longest = _SLOWEST * (len(coming) * every + after)
        due = 0.0
        while True:
            look = self.look()
            elapsed = look.elapsed - self.trace.start
            while other and other[0][0] <= elapsed:
                other.pop(0)[1]()
            if coming and elapsed >= due and _shown(look):
                self.submit(coming.pop(0))
                due = elapsed + (every if coming else after)
            elif not coming and elapsed >= due:
                return look
            if elapsed > longest:
                raise Failed(f"{len(coming)} processes were not submitted within {longest:.0f} s")
            time.sleep(min(LOOK_S, every / 2))  # time of the next look

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._desk is not None, "the cluster is used outside of its `with` block"
        return self._desk.ask(request)


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:  # the process has ended
        return b""


def _shown(look: Look) -> bool:
    """Return True if all assignments are in the readings."""
    return look.count("assigned") + look.count("starting") == 0 and all(
        host.in_flight == 0.0 for host in look.hosts.values()
    )


class LabClient:
    """The client of the master in the lab.

    Args:
        start: starts it, with pipes to and from it.
        check: raises `Failed` where another part that it needs has ended.
    """

    def __init__(self, start: Callable[[], Part], check: Callable[[], None]) -> None:
        self._check = check
        self._part = start()
        self._lines = b""

    def __enter__(self) -> Self:
        try:
            self._line(_START)
        except BaseException:  # also a Ctrl-C: `__exit__` is not called where `__enter__` fails
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._part.process.kill()
        self._part.process.communicate()

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request, and return the answer; raises `Failed`."""
        to = self._part.process.stdin
        assert to is not None
        try:
            to.write(json.dumps(request).encode() + b"\n")
            to.flush()
        except BrokenPipeError:
            raise self._ended() from None
        answer = self._line(_ANSWER)
        if "error" in answer:
            raise Failed(f"the master: {answer['error']}")
        return answer

    def _line(self, timeout: float) -> dict[str, Any]:
        source: IO[bytes] | None = self._part.process.stdout
        assert source is not None
        deadline = time.monotonic() + timeout
        while b"\n" not in self._lines:
            self._check()
            if select.select([source], [], [], 0.5)[0]:
                read = os.read(source.fileno(), 1 << 16)
                if not read:
                    raise self._ended()
                self._lines += read
            elif time.monotonic() >= deadline:
                raise Failed(f"the client at the desk did not answer within {timeout:g} s")
        line, _, self._lines = self._lines.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _ended(self) -> Failed:
        """Return the error for a desk that has closed its pipes."""
        try:
            self._part.process.wait(_END)
        except subprocess.TimeoutExpired:
            return Failed(f"{self._part.name} has closed its pipes, and still runs")
        return self._part.last_words()
