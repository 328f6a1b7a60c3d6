"""Complete cluster on this machine for `rosrm up`, demos, tests and benchmarks.

Master, slaves and processes are real. Every part is a process of its own, started as by
`rosrm master` and `rosrm slave`, in a separate ROS domain on loopback. At the end of the `with`
block, also after an exception, the parts are ended by pid.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from rosrm import clocks
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.errors import NoMaster, RosrmError
from rosrm.model.ros_settings import RosSettings
from rosrm.model.rows import HostRow, Listing, ProcessRow
from rosrm.ros.master_connection import MasterClient
from rosrm.runtime.bootstrap import command_line, hand_over, interrupts_held
from rosrm.runtime.log_tail import last_lines
from rosrm.runtime.settings_check import SettingsSource
from rosrm.runtime.signalling import send
from rosrm.supervisor import procfs
from rosrm.testing.loopback import settings_on_this_machine
from rosrm.wording import ending_of

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds for a part to end after SIGINT, on a busy machine; its processes have their own grace
#: times. A slave that is killed leaves its processes running.
_END: Final = 60.0
#: ROS domains whose DDS ports are below the ephemeral range.
_DOMAINS: Final = range(1, 101)
#: Participants whose ports are checked, because the first one of a cluster may have ended before
#: the others.
_PARTICIPANTS: Final = range(8)
_LOOK: Final = 0.02
#: Seconds for a master to start and to be discovered.
_FIND: Final = 30.0


def claim_domain() -> tuple[int, socket.socket]:
    """Return a ROS domain that is unused on this machine, and a socket that claims the domain.

    Until DDS binds its ports, an occupied domain looks free. So each owner binds an abstract socket
    of this machine. The kernel releases its name when the socket is closed or its process ends.
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
    """Running master or slave.

    Attributes:
        name: "master", or the name of the host.
        process: of the part.
        log: file with its standard output and standard error.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def has_ended(self) -> bool:
        """Return True if it has ended, but for threads that wait for a dead file system."""
        if self.process.poll() is not None:
            return True
        stat = procfs.read_stat(self.process.pid)
        return stat is None or not stat.alive

    def wait(self, seconds: float) -> bool:
        """Wait for its end; return False if it still runs after some seconds."""
        until = clocks.boot_time() + seconds
        while not self.has_ended:
            if clocks.boot_time() >= until:
                return False
            time.sleep(_LOOK)
        return True

    def end(self, number: int = signal.SIGTERM) -> None:
        """Send a signal if the part still runs; SIGINT is ignored by parts of a `rosrm up &`."""
        if self.process.poll() is None:
            self.process.send_signal(number)


@dataclass
class LocalCluster:
    """Master and slaves on this machine; a context manager that ends them.

    Attributes:
        directory: for state directories and logs.
        cluster: the master's settings; this class replaces their `ros` and `state`.
        hosts: the slaves' settings; likewise.
        domain: ROS domain; None: a free one, or that of `joining`.
        files: name of a part to the file from which it reloads its settings.
        joining: ROS settings of all parts; None: those that keep the traffic on this machine.
        ends_with_starter: True: the parts stop when this process ends, also if it is killed.
    """

    directory: Path
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    hosts: Sequence[HostConfig] = ()
    domain: int | None = None
    files: dict[str, Path] = field(default_factory=dict)
    joining: RosSettings | None = None
    ends_with_starter: bool = False
    master: Part | None = None
    slaves: dict[str, Part] = field(default_factory=dict)
    _client: MasterClient | None = None
    _claim: socket.socket | None = None

    def __post_init__(self) -> None:
        """Choose the domain."""
        # An absolute path, because processes with other working directories get file names in it.
        self.directory = self.directory.absolute()
        if self.domain is None and self.joining is None:
            self.domain, self._claim = claim_domain()
        self.ros = self.joining or settings_on_this_machine(self.domain)

    # --- parts ---------------------------------------------------------------------------

    def start_master(self) -> Part:
        """Start the master, or start it again."""
        settings = replace(self.cluster, ros=self.ros, state=self.directory / "master")
        self.master = self._start("master", "rosrm.master", settings.to_json())
        return self.master

    def start_slave(self, host: HostConfig) -> Part:
        """Start a slave, or start it again."""
        state = self.directory / "hosts" / host.host
        settings = replace(host, ros=self.ros, state=state, security=self.cluster.security)
        part = self._start(host.host, "rosrm.slave", settings.to_json())
        self.slaves[host.host] = part
        return part

    def _start(self, name: str, module: str, settings: str) -> Part:
        self.directory.mkdir(parents=True, exist_ok=True)
        log = self.directory / f"{name}.log"
        role, path = module.removeprefix("rosrm."), str(self.files.get(name, ""))
        parent = os.getpid() if self.ends_with_starter else 0
        holder = hand_over(settings, SettingsSource(role, path), parent)
        try:
            with log.open("ab") as sink, interrupts_held():
                process = subprocess.Popen(
                    command_line(module, holder),
                    pass_fds=[holder], stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
                    start_new_session=True,
                )  # fmt: skip
        finally:
            os.close(holder)
        return Part(name, process, log)

    def switch_off(self, name: str) -> float:
        """Simulate a power failure of a host: kill slave, supervisor and processes at once.

        Returns:
            Unix time of the failure.
        """
        running = [item for item in self.slaves.items() if item[1].process.poll() is None]
        pids = {host: part.process.pid for host, part in running}
        slave = self.slaves.pop(name)
        at = clocks.wall_time()
        stopped: set[int] = set()
        # A process that is stopped by a signal starts no other, so the loop ends.
        while found := _processes_of(self.directory / "hosts", name, pids) - stopped:
            for pid in found:
                send(pid, signal.SIGSTOP)
            stopped |= found
        for pid in stopped:
            send(pid, signal.SIGKILL)
        slave.wait(_END)
        return at

    # --- queries -------------------------------------------------------------------------

    @property
    def client(self) -> MasterClient:
        """Return the connection to the master, opened on first use."""
        deadline = clocks.boot_time() + _FIND
        while self._client is None:
            self._check_parts()
            try:
                self._client = MasterClient.connect(
                    self.ros, name="local cluster", security=self.cluster.security
                )
            except NoMaster:
                if clocks.boot_time() >= deadline:
                    raise
        return self._client

    def wait_until(
        self, what: str, condition: Callable[[Listing], bool], timeout: float = 30.0
    ) -> Listing:
        """Poll hosts and processes until a condition holds; return the last listing.

        Raises:
            TimeoutError: the condition did not hold in time; the message has `what` and the last
                states.
        """
        deadline = clocks.boot_time() + timeout
        while True:
            view = self.client.list(hosts=True, processes=True)
            if condition(view):
                return view
            if clocks.boot_time() >= deadline:
                raise TimeoutError(f"{what} did not come about in {timeout:g} s: {_brief(view)}")
            self._check_parts()
            self.client.spin(_LOOK)

    def wait_for_hosts(self, timeout: float = 30.0) -> None:
        """Wait until every slave has registered and requests work."""

        def all_accept(view: Listing) -> bool:
            accepting = {row.description.name for row in view.hosts if row.accepting}
            return accepting >= set(self.slaves)

        self.wait_until(f"hosts {', '.join(self.slaves)} accepting", all_accept, timeout)

    def host(self, name: str) -> HostRow:
        """Return the current row of a host."""
        rows = self.client.list(hosts=True).hosts
        return next(row for row in rows if row.description.name == name)

    def process(self, name: str) -> ProcessRow:
        """Return the current row of a process."""
        rows = self.client.list(processes=True).processes
        return next(row for row in rows if row.name == name)

    def _check_parts(self) -> None:
        for part in (self.master, *self.slaves.values()):
            if part is not None and part.process.poll() not in (None, 0):
                tail = "\n".join(last_lines(part.log))[-2000:]
                raise RosrmError(f"{part.name}: {ending_of(part.process.returncode)}:\n{tail}")

    # --- begin and end -------------------------------------------------------------------

    def __enter__(self) -> Self:
        """Start everything and wait until every host requests work."""
        try:
            self.start_master()
            for host in self.hosts:
                self.start_slave(host)
            if self.hosts:
                self.wait_for_hosts()
        except BaseException:  # also an interrupt must leave no process
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

    def __exit__(self, *_: object) -> None:
        self.close()


def _processes_of(hosts: Path, name: str, slaves: Mapping[str, int]) -> set[int]:
    """Return the pids of a host's slave, supervisor and their descendants, of this user only.

    A process whose supervisor was killed is found by its environment. A restored process has the
    environment of its first host, so its ancestors take precedence.

    Args:
        hosts: the directory that contains the directories of the hosts.
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


def _end_all(parts: Sequence[Part]) -> None:
    for part in parts:
        part.end()
    deadline = clocks.boot_time() + _END
    for part in parts:
        try:
            part.process.wait(max(0.1, deadline - clocks.boot_time()))
        except subprocess.TimeoutExpired:
            part.end(signal.SIGKILL)
            part.wait(5.0)  # one that a disk holds must not keep the others running


def _brief(view: Listing) -> str:
    hosts = ", ".join(f"{row.description.name} {row.state}" for row in view.hosts) or "no host"
    processes = ", ".join(f"{row.name} {row.state}" for row in view.processes[:20])
    return f"{hosts}; {processes or 'no process'}"
