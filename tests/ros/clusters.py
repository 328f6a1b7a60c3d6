"""Real clusters for the tests, with a check that nothing of them is left afterwards."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosrm.config.settings import (
    ClusterConfig,
    HostConfig,
    LivenessSettings,
    MigrationSettings,
    ProcessDefaults,
)
from rosrm.errors import Refused
from rosrm.model.rows import Listing, ProcessRow
from rosrm.model.values import Kind, ProcessSpec, Readiness, StopPolicy
from rosrm.runtime.durable import SYNC_IN_LOOP
from rosrm.supervisor.procfs import read_environment
from rosrm.testing.local_cluster import LocalCluster, Part
from tests.waiting import PATIENCE, holds_for, wait_until

MIB = 2**20
QUICK = StopPolicy(interrupt_grace=0.5, terminate_grace=0.5)
#: For processes that end on a signal, as soon as the machine permits. A killed node leaves its
#: shared memory behind.
CALM = StopPolicy(interrupt_grace=20.0, terminate_grace=5.0)
#: For tests that are not about liveness. A busy machine may stall a slave for longer than the usual
#: second, and then the host gets no work, or its name is given away. The time must not exceed a
#: restarted slave's wait for its name.
STEADY = LivenessSettings(suspect=3.0, lease=30.0)


def host(name: str, memory: float = 2048 * MIB, cpu: float = 16.0, **options) -> HostConfig:
    """Return a slice: a host that measures only its own processes, not the machine."""
    options.setdefault("probes", {"memory": {}, "cpu": {}})
    return HostConfig(
        host=name, scope="slice", budget={"memory": memory, "cpu": cpu}, **options
    )  # fmt: skip


def job(name: str, *command: str, **options) -> ProcessSpec:
    """Return a process that runs to completion."""
    options.setdefault("stop", QUICK)
    return ProcessSpec(name, command=command, kind=Kind.JOB, **options)


def service(name: str, *command: str, **options) -> ProcessSpec:
    """Return a process that runs until it is stopped."""
    options.setdefault("stop", QUICK)
    return ProcessSpec(name, command=command or ("sleep", "1000"), **options)


def python(name: str, code: str, **options) -> ProcessSpec:
    """Return a process that runs a few lines of Python."""
    kind = options.pop("kind", Kind.SERVICE)
    options.setdefault("stop", QUICK)
    return ProcessSpec(name, command=(sys.executable, "-ISc", code), kind=kind, **options)


#: Last lines of a program with a node. A signal or a shutdown of the context raises an exception
#: whose class depends on the moment; the program ends with success after each of them.
SPIN = """
try:
    rclpy.spin(node)
except BaseException:
    pass
"""
#: A ROS node of a few lines that prints its name, parameters and topic, and ends with its context.
NODE = (
    """
import json, sys, rclpy
from rclpy.node import Node
rclpy.init()
node = Node("unnamed", automatically_declare_parameters_from_overrides=True)
names = sorted(name for name in node._parameters if not name.startswith(("use_sim", "start_")))
print(json.dumps({
    "name": node.get_fully_qualified_name(),
    "parameters": {name: node.get_parameter(name).value for name in names},
    "topic": node.resolve_topic_name("chatter"),
}), flush=True)
"""
    + SPIN
)


def node(name: str, code: str = NODE, **options) -> ProcessSpec:
    """Return a process with a real ROS node."""
    options.setdefault("stop", CALM)
    options.setdefault("readiness", Readiness(timeout=PATIENCE))
    return ProcessSpec(name, command=(sys.executable, "-c", code), ros=True, **options)


class Cluster(LocalCluster):
    """A local cluster with the operations that tests need.

    Attributes:
        started: every part that was ever started.
        is_attacked: a test sends messages that no key opens; otherwise one fails the test.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self.started: list[Part] = []
        self.is_attacked = False

    def _start(self, name: str, module: str, settings: str) -> Part:
        part = super()._start(name, module, settings)
        self.started.append(part)
        return part

    def submit(self, *specs: ProcessSpec) -> str:
        return self.client.submit(list(specs))

    def run(self, *specs: ProcessSpec, timeout: float = PATIENCE) -> list[ProcessRow]:
        """Submit processes, and wait until all have ended."""
        self.submit(*specs)
        return [self.ended(spec.name, timeout) for spec in specs]

    def wait(
        self,
        name: str,
        *states: str,
        timeout: float = PATIENCE,
        where: Callable[[ProcessRow], bool] = lambda _: True,
        **fields,
    ) -> ProcessRow:
        """Return the row of a process, once it is in one of these states.

        Args:
            name: of the process.
            states: any of them.
            timeout: seconds.
            where: further condition on the row.
            fields: values that the row must have, too.
        """

        def found(view: Listing) -> Iterator[ProcessRow]:
            return (
                row for row in view.processes
                if row.name == name and row.state in states and where(row)
                and all(getattr(row, field) == value for field, value in fields.items())
            )  # fmt: skip

        what = f"{name} {' or '.join(states)} {fields or ''}"
        return next(found(self.wait_until(what, lambda view: any(found(view)), timeout)))

    def stays(self, seconds: float, condition: Callable[[], object], what: str) -> None:
        """Check that a condition holds at each look for some seconds."""
        holds_for(seconds, condition, what, pause=self.client.spin)

    def ended(self, name: str, timeout: float = PATIENCE) -> ProcessRow:
        return self.wait(name, "finished", "failed", "cancelled", timeout=timeout)

    def cancel(self, *names: str) -> None:
        """Cancel processes, and wait until they have ended."""
        self.client.cancel(names)
        for name in names:
            self.ended(name)

    def log(self, name: str) -> str:
        """Return the log of the newest instance of a process."""
        for event in reversed(self.client.list(events=True, process=name).events):
            if event.host:
                part = self.client.read_log(event.host, name, 0, 0, 0)
                return part.content.decode(errors="replace")
        raise AssertionError(f"{name} was on no host")

    def wait_for_log(self, name: str, text: str, timeout: float = PATIENCE) -> str:
        self._await(
            lambda: text in self._log_so_far(name), f"{name} prints {text!r}", timeout,
            lambda: self._log_so_far(name),
        )  # fmt: skip
        return self._log_so_far(name)

    def _await(self, condition, what: str, timeout: float, seen: Callable[[], object]):
        return wait_until(condition, what, timeout, seen=seen, pause=self.client.spin)

    def _log_so_far(self, name: str) -> str:
        try:
            return self.log(name)
        except Refused as refusal:
            if refusal.code != "unknown":
                raise
            return ""  # assigned, and not yet started by its host

    def kinds(self, name: str) -> list[str]:
        """Return the kinds of a process's events, oldest first."""
        return [event.kind for event in self.client.list(events=True, process=name).events]

    def events(self, kind: str = "", **narrow) -> list:
        found = self.client.list(events=True, **narrow).events
        return [event for event in found if kind in ("", event.kind)]

    def wait_for_event(self, kind: str, says: str = "", timeout: float = PATIENCE, **narrow):
        """Return the first event of a kind whose message contains a text."""
        found = self._await(
            lambda: [e for e in self.events(kind, **narrow) if says in e.message],
            f"an event {kind} {says}", timeout, lambda: self.log_of("master"),
        )  # fmt: skip
        return found[0]

    def log_of(self, part: str) -> str:
        """Return the log of the master or of a slave."""
        return (self.directory / f"{part}.log").read_text(errors="replace")

    def reconnect(self) -> None:
        """Drop the client's connection after a restart of the master."""
        if self._client is not None:
            self._client.close()
            self._client = None

    @property
    def is_connected(self) -> bool:
        return self._client is not None

    def end(self, part: Part, number: int) -> int:
        """Send a signal to a part; return its exit code."""
        part.end(number)
        return part.process.wait(PATIENCE)

    def restart_master(self, number: int = signal.SIGKILL) -> None:
        """End the master with a signal, and start the next one."""
        self.end(self.master, number)
        self.reconnect()
        self.start_master()

    def supervisor(self, name: str) -> int:
        """Return the pid of the supervisor of a host."""
        lock = self.directory / "hosts" / name / "supervisor" / "supervisor.lock"
        return int(wait_until(lock.read_text, "the pid of the supervisor"))

    def add(self, config: HostConfig) -> Part:
        part = self.start_slave(config)
        self.wait_for_hosts()
        return part

    def start_slave_again(self, name: str) -> Part:
        """Kill the slave of a host, if it runs, start the next one, and await its registration.

        Until then the master may consider the former run alive, and the host available.
        """
        before = self.client.list().last_sequence
        if name in self.slaves:
            self.end(self.slaves[name], signal.SIGKILL)
        part = self.start_slave(next(one for one in self.hosts if one.host == name))
        self.wait_for_event("host_registered", host=name, after=before)
        return part

    def parts(self) -> list[Part]:
        return [part for part in (self.master, *self.slaves.values()) if part is not None]


# --- the end ----------------------------------------------------------------------------------


def pids_of(directory: Path) -> dict[int, str]:
    """Return processes whose command line or environment names the cluster's directory."""
    mark = str(directory).encode()
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            environment = read_environment(int(entry.name))
            command = (entry / "cmdline").read_bytes()
            ours = [v for v in environment if v.startswith(b"ROSRM_SUPERVISOR=")]
            if command and (mark in command or any(mark in value for value in ours)):
                found[int(entry.name)] = command.replace(b"\0", b" ").decode(errors="replace")
    return found


def shared_memory_of(pid: int) -> set[str]:
    """Return the files in /dev/shm that a process has mapped for its own DDS participant."""
    with contextlib.suppress(OSError):
        lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
        mapped = [line.split(None, 5)[5] for line in lines if "/dev/shm/" in line]
        paths = {path.removesuffix(" (deleted)") for path in mapped}
        return {path for path in paths if "fastrtps" in path and "port" not in path}
    return set()


def zombie(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists() and not zombie(pid)


def end_and_check(cluster: Cluster) -> None:
    """End a cluster; kill its remaining processes, which fail the test."""
    codes = {part.name: part.process.poll() for part in cluster.parts()}
    memory = {part.name: shared_memory_of(part.process.pid) for part in cluster.parts()}
    # A master that no client has talked to may not yet handle signals.
    good = {0} if cluster.is_connected else {0, -signal.SIGINT}
    cluster.close()
    left = wait_until_none(cluster.directory)
    for pid in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    assert not left, f"left behind: {left}"
    for part in cluster.parts():
        said = cluster.log_of(part.name)
        assert "Traceback" not in said, said
        assert SYNC_IN_LOOP not in said, said
        strangers = [line for line in said.splitlines() if "without a valid key" in line]
        assert cluster.is_attacked or not strangers, strangers
        if codes[part.name] is None:  # the part was alive, and ended on a signal
            assert part.process.returncode in good, (
                f"{part.name}: {part.process.returncode}\n{said}"
            )
    files = {path for paths in memory.values() for path in paths if Path(path).exists()}
    if files:  # a peer's files are mapped, too, and that peer may live
        live = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]
        files -= set().union(*map(shared_memory_of, live))
    if any(part.process.returncode == -signal.SIGKILL for part in cluster.started):
        for path in files:  # a killed participant cannot remove its files
            for name in (path, f"{path}_el"):
                Path(name).unlink(missing_ok=True)
    else:
        assert not files, f"left in shared memory: {files}"


def wait_until_none(directory: Path, timeout: float = PATIENCE) -> dict[int, str]:
    """Return the processes that are left when the time is up."""
    with contextlib.suppress(AssertionError):
        wait_until(lambda: not pids_of(directory), "no process", timeout)
    return pids_of(directory)


Make = Callable[..., Cluster]


def left_and_right(make: Make) -> Cluster:
    """Return a cluster of two hosts, without automatic migration."""
    return make(
        host("left"), host("right"),
        migration=MigrationSettings(automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip


@contextlib.contextmanager
def clusters(new_directory: Callable[[], Path], **defaults) -> Iterator[Make]:
    """Yield a factory of clusters with default settings; end all clusters afterwards."""
    made: list[Cluster] = []

    def make(*hosts: HostConfig, started: bool = True, **cluster) -> Cluster:
        one = Cluster(new_directory(), ClusterConfig(**{**defaults, **cluster}), hosts)
        made.append(one)
        if started:
            one.__enter__()
        return one

    faults = []
    try:
        yield make
    finally:
        for one in reversed(made):
            try:
                end_and_check(one)
            except AssertionError as fault:
                faults.append(str(fault))
    if faults:
        pytest.fail("\n".join(faults), pytrace=False)
