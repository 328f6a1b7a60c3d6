"""A host with real log files, a master that reads them, and an archive that collects them."""

from __future__ import annotations

import time
from pathlib import Path

from rosrm.archive.reader import LogArchive
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.client.log_collection import LogCollector
from rosrm.errors import NoMaster
from rosrm.model.rows import Listing
from rosrm.model.values import InstanceId
from rosrm.ros.slave.services import LogQuery
from rosrm.slave.logs import newest_instance, read_log
from rosrm.supervisor import log_index
from rosrm.supervisor.client import log_path
from rosrm.supervisor.log_index import Mark
from rosrm.supervisor.logs import LogLimits, rotate
from tests.unit.cli.conftest import event, host, process

HOST, PROCESS = "alpha", "nav"
ROOMY = ArchiveLimits(1 << 40, 1 << 40)


class Host:
    """Logs of one host, written and rotated as its supervisor does it."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.ended: set[tuple[str, int]] = set()

    def path(self, number=1, name=PROCESS) -> Path:
        path = log_path(self.state, InstanceId(name, number))
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, content: bytes, number=1, name=PROCESS, *, at=0.0) -> None:
        path = self.path(number, name)
        if not path.exists():
            log_index.add(str(path), Mark(at or time.time(), 0, 77))
        with path.open("ab") as log:
            log.write(content)
        end = (log_index.base(str(path)) or 0) + path.stat().st_size
        log_index.add(str(path), Mark(at or time.time(), end, 0))

    def rotate(self, number=1, *, most=1 << 20, keep=100) -> None:
        path = self.path(number)
        if path.exists():
            rotate(str(path), path.stat().st_size, LogLimits(most, keep))

    def remove_logs(self) -> None:
        for path in self.path().parent.iterdir():
            path.unlink()

    def read_log(self, process, number, offset, most, tail=0, since=0.0):
        number = number or newest_instance(self.state, process).number
        ended = (process, number) in self.ended
        query = LogQuery(process, number, offset, tail, since, most)
        return read_log(self.state, query, ended=ended)


class Master:
    """Answers like a master, and passes requests for logs to the hosts."""

    def __init__(self, **hosts: Host) -> None:
        self.slaves = hosts
        self.hosts = [host(name) for name in hosts]
        self.processes = [process(PROCESS, host=HOST)]
        self.events: list = []
        self.asked: list = []
        self.silent: set[str] = set()

    def note(self, **fields) -> None:
        self.events.append(event(len(self.events) + 1, process=PROCESS, **fields))

    def list(self, *, after=0, **_):
        return Listing(
            "m", 1.0, len(self.events), hosts=self.hosts, processes=self.processes,
            events=self.events[after:],
        )  # fmt: skip

    def read_log(self, host, process, number=0, offset=0, max_bytes=0, *, tail=0, since=0.0):
        self.asked.append((host, process, number))
        if host in self.silent:
            raise NoMaster(f"the slave of {host} does not answer")
        return self.slaves[host].read_log(process, number, offset, max_bytes, tail, since)


class Rig:
    """A cluster, and its collector with an archive below a folder."""

    def __init__(self, folder: Path, limits: ArchiveLimits = ROOMY) -> None:
        self.directory, self.limits = folder / "archive", limits
        self.alpha = Host(folder / "alpha")
        self.master = Master(alpha=self.alpha)
        self.said: list[str] = []
        self.start()

    def start(self) -> None:
        """Start the collector, or another one after a crash."""
        self.writer = ArchiveWriter(self.directory, self.limits)
        self.collector = LogCollector(
            self.writer, self.said.append, every=0.0, rate=float("inf")
        )  # fmt: skip

    def collect(self, looks=1) -> None:
        for _ in range(looks):
            self.collector.look(self.master)

    def chunks(self, number=1, name=PROCESS, most=7):
        """Return offset and content of each contiguous part in the archive."""
        archive, at = LogArchive(self.directory), 0
        found: list[list] = []
        while (part := archive.read_log(HOST, name, number, at, most)).content:
            if found and part.offset == at:
                found[-1][1] += part.content
            else:
                found.append([part.offset, part.content])
            at = part.next_offset
        return [tuple(one) for one in found]

    def files(self):
        return sorted(path.name for path in self.directory.glob("hosts/*/*"))
