"""A whole cluster on this machine: real master, slaves and processes, for demos, tests, benchmarks.

Every part is a process of its own, started as `rosrm master` and `rosrm slave` start it, in a ROS
domain of its own on loopback. When its block is left, also by an exception, the parts are ended,
by pid.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

import psutil

from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.errors import NoMaster, RosrmError
from rosrm.model.rows import HostRow, ProcessRow, Snapshot
from rosrm.ros.client import MasterClient
from rosrm.runtime.bootstrap import arguments, hand_over, interrupts_held
from rosrm.testing.loopback import settings_on_this_machine

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds in which a part must have ended after SIGINT; its processes have their own grace.
_END: Final = 30.0
#: Domains that DDS maps to ports below the ephemeral range.
_DOMAINS: Final = range(1, 101)
#: Participants whose ports are looked at: the first of a cluster may have ended, and others live.
_PARTICIPANTS: Final = range(8)
_LOOK: Final = 0.02
#: Seconds for a master to come up and to be found.
_FIND: Final = 15.0


def claim_domain() -> tuple[int, socket.socket]:
    """A ROS domain in which nobody on this machine listens, and the claim to it.

    Until DDS binds its ports nothing shows that a domain is taken: who was given it holds a name
    among the machine's abstract sockets, which frees itself when the claim is closed or we die.
    """
    for domain in sorted(_DOMAINS, key=lambda number: (number * 37 + os.getpid()) % 101):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0rosrm-domain-{domain}")
            for participant in _PARTICIPANTS:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                    probe.bind(("127.0.0.1", 7410 + 250 * domain + 2 * participant))
        except OSError:
            claim.close()
            continue
        return domain, claim
    raise RosrmError("every ROS domain from 1 to 100 is in use on this machine")


@dataclass
class Part:
    """A master or a slave that was started.

    Attributes:
        log: what it writes to its standard error.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def end(self, number: int = signal.SIGINT) -> None:
        """Send a signal, if it lives."""
        if self.process.poll() is None:
            self.process.send_signal(number)


@dataclass
class LocalCluster:
    """A master and slaves on this machine; a context manager that ends them.

    Attributes:
        directory: for states and logs.
        cluster: the master's settings; its `ros` and `state` are set here.
        hosts: the slaves' settings; likewise.
        domain: ROS domain; None: a free one.
    """

    directory: Path
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    hosts: Sequence[HostConfig] = ()
    domain: int | None = None
    master: Part | None = None
    slaves: dict[str, Part] = field(default_factory=dict)
    _client: MasterClient | None = None
    _claim: socket.socket | None = None

    def __post_init__(self) -> None:
        """Choose the domain."""
        # Processes run in directories of their own, and are given the names of files in it.
        self.directory = self.directory.absolute()
        if self.domain is None:
            self.domain, self._claim = claim_domain()
        self.ros = settings_on_this_machine(self.domain)

    # --- parts ---------------------------------------------------------------------------

    def start_master(self) -> Part:
        """Start the master, or start it again."""
        settings = replace(self.cluster, ros=self.ros, state=self.directory / "master")
        self.master = self._start("master", "rosrm.master", settings.to_json())
        return self.master

    def start_slave(self, host: HostConfig) -> Part:
        """Start a slave, or start it again."""
        state = self.directory / "hosts" / host.host
        settings = replace(host, ros=self.ros, state=state)
        part = self._start(host.host, "rosrm.slave", settings.to_json())
        self.slaves[host.host] = part
        return part

    def _start(self, name: str, module: str, settings: str) -> Part:
        self.directory.mkdir(parents=True, exist_ok=True)
        log = self.directory / f"{name}.log"
        holder = hand_over(settings)
        try:
            with log.open("ab") as sink, interrupts_held():
                process = subprocess.Popen(
                    [sys.executable, "-m", module, *arguments(holder)],
                    pass_fds=[holder], stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
                    start_new_session=True,
                )  # fmt: skip
        finally:
            os.close(holder)
        return Part(name, process, log)

    def switch_off(self, name: str) -> float:
        """End a host as a loss of power would: slave, supervisor and processes at one moment.

        Returns:
            When that was, unix time.
        """
        pids = {host: part.process.pid for host, part in self.slaves.items()}
        slave = self.slaves.pop(name).process
        at = time.time()
        stopped: set[int] = set()
        # Who is stopped starts nobody: in the end a look finds no more.
        while found := _processes_of(self.directory / "hosts", name, pids) - stopped:
            _send(found, signal.SIGSTOP)
            stopped |= found
        _send(stopped, signal.SIGKILL)
        slave.wait(_END)
        return at

    # --- looking -------------------------------------------------------------------------

    @property
    def client(self) -> MasterClient:
        """A connection to the master."""
        deadline = time.monotonic() + _FIND
        while self._client is None:
            self._check_parts()
            try:
                self._client = MasterClient.connect(self.ros, name="local cluster", timeout=3.0)
            except NoMaster:
                if time.monotonic() >= deadline:
                    raise
        return self._client

    def wait_until(
        self, what: str, condition: Callable[[Snapshot], bool], timeout: float = 30.0
    ) -> Snapshot:
        """Look at hosts and processes until a condition holds.

        Raises:
            TimeoutError: it did not hold in time; the message says what was waited for, and what
                there was instead.
        """
        deadline = time.monotonic() + timeout
        while True:
            view = self.client.list(hosts=True, processes=True)
            if condition(view):
                return view
            if time.monotonic() >= deadline:
                raise TimeoutError(f"{what} did not come about in {timeout:g} s: {_brief(view)}")
            self._check_parts()
            self.client.spin(_LOOK)

    def wait_for_hosts(self, timeout: float = 30.0) -> None:
        """Wait until every slave has registered and asks for work."""

        def all_accept(view: Snapshot) -> bool:
            accepting = {row.description.name for row in view.hosts if row.accepting}
            return accepting >= set(self.slaves)

        self.wait_until(f"hosts {', '.join(self.slaves)} accepting", all_accept, timeout)

    def host(self, name: str) -> HostRow:
        """A host's row now."""
        rows = self.client.list(hosts=True).hosts
        return next(row for row in rows if row.description.name == name)

    def process(self, name: str) -> ProcessRow:
        """A process's row now."""
        rows = self.client.list(processes=True).processes
        return next(row for row in rows if row.name == name)

    def _check_parts(self) -> None:
        for part in (self.master, *self.slaves.values()):
            if part is not None and part.process.poll() not in (None, 0):
                tail = part.log.read_text(errors="replace")[-2000:]
                raise RosrmError(f"{part.name} ended with {part.process.returncode}:\n{tail}")

    # --- begin and end -------------------------------------------------------------------

    def __enter__(self) -> Self:
        """Start everything and wait until every host asks for work."""
        try:
            self.start_master()
            for host in self.hosts:
                self.start_slave(host)
            if self.hosts:
                self.wait_for_hosts()
        except BaseException:
            self.close()
            raise
        return self

    def close(self) -> None:
        """End the slaves with their processes, then the master."""
        if self._client is not None:
            self._client.close()
            self._client = None
        _end_all(list(self.slaves.values()))
        if self.master is not None:
            _end_all([self.master])
        if self._claim is not None:
            self._claim.close()
            self._claim = None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _processes_of(hosts: Path, name: str, slaves: Mapping[str, int]) -> set[int]:
    """Pids of a host's slave and supervisor, and of all below them; of other users none.

    A process whose supervisor was killed is known by its environment. One that was restored here
    has the environment of where it began, so whom it is below comes first.

    Args:
        hosts: the directory that holds those of the hosts.
        name: of the host.
        slaves: pid of each host's slave.
    """
    parents: dict[int, int] = {}
    host_of = {pid: host for host, pid in slaves.items()}
    mark = re.compile(re.escape(f"{hosts}/") + "([^/]+)/supervisor")
    for process in psutil.process_iter(["ppid", "cmdline", "environ"]):
        info = process.info
        parents[process.pid] = info["ppid"]
        words = "\0".join((*(info["cmdline"] or ()), *(info["environ"] or {}).values()))
        if process.pid != os.getpid() and (found := mark.search(words)):
            host_of.setdefault(process.pid, found[1])

    def is_here(pid: int) -> bool:
        host = None
        while pid in parents:
            host, pid = host_of.get(pid, host), parents[pid]
        return host == name

    return {pid for pid in parents if is_here(pid)}


def _send(pids: Iterable[int], number: signal.Signals) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def _end_all(parts: Sequence[Part]) -> None:
    for part in parts:
        part.end()
    deadline = time.monotonic() + _END
    for part in parts:
        try:
            part.process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            part.end(signal.SIGKILL)
            part.process.wait(5.0)


def _brief(view: Snapshot) -> str:
    hosts = ", ".join(f"{row.description.name} {row.state}" for row in view.hosts) or "no host"
    processes = ", ".join(f"{row.name} {row.state}" for row in view.processes[:20])
    return f"{hosts}; {processes or 'no process'}"
