"""Promises of the documentation after a loss of power, checked by the reader of each part.

Each check starts the real reader on a state of the disk, and compares the result with the answers
that the user had before.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.crash.disk import State
from benchmarks.crash.scenario import APPLICATION, COUNTER, HOSTS
from rosrm import clocks
from rosrm.archive.layout import read_segments
from rosrm.archive.reader import LogArchive
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.core.master.state.replicas import ReplicaIndex
from rosrm.errors import RosrmError
from rosrm.journal.sqlite import SqliteJournal
from rosrm.keys import key_files
from rosrm.model.rows import LogPart
from rosrm.model.values import InstanceState
from rosrm.slave.replication.store import SnapshotStore
from rosrm.supervisor import procfs
from rosrm.supervisor.client import SupervisorClient

_PATIENCE: Final = 20.0
_OTHER_BOOT: Final = "00000000-0000-0000-0000-000000000000"
#: Directory of the snapshots of a host. The states of this part are those of all hosts together.
SNAPSHOTS: Final = "kept"
_ENDED: Final = {"finished", "failed", "cancelled"}
_UNSETTLED: Final = {InstanceState.STARTING, InstanceState.HELD, InstanceState.STOPPING}


class Oracle:
    """Checks of states, each made where the recorded cluster had its files.

    Args:
        root: directory of the recording; its content is replaced.
        effects: file to which each process adds a line when it starts.
    """

    def __init__(self, root: Path, effects: Path) -> None:
        self._root, self._effects = root, effects
        self._first = _lines(effects)
        self._logs = {
            path.name: path.read_bytes()
            for path in root.glob("cluster/hosts/*/supervisor/logs/*.log")
        }
        #: Part of the directory to the check of its reader.
        self.checks: Mapping[str, Callable[[State], Iterator[str]]] = {
            "keys": self._keys, "cluster/master": self._journal, "archive": self._archive,
            **{directory_of(host): partial(self._host, host) for host in HOSTS},
            SNAPSHOTS: self._snapshots,
        }  # fmt: skip

    def faults(self, part: str, state: State) -> list[str]:
        """Return the promises that a state of one part breaks."""
        shutil.rmtree(self._root, ignore_errors=True)
        state.write(self._root)
        return list(self.checks[part](state))

    def _keys(self, state: State) -> Iterator[str]:
        home = self._root / "keys"
        try:
            secret, grants = key_files.read_secret(home), key_files.read_grants(home)
        except RosrmError as error:
            yield f"the keys cannot be read: {error}"
            return
        valid = {str(grant.principal) for grant in grants}
        for name in _told(state, "revoked"):
            if name in valid:
                yield f"the key of {name} is valid again"
        for name in _told(state, "added") - _told(state, "revoking"):
            if secret is None or name not in valid:
                yield f"the key of {name} is not valid any more"

    def _journal(self, state: State) -> Iterator[str]:
        path = self._root / "cluster" / "master" / "journal.sqlite"
        try:
            journal = SqliteJournal(path, sync="full")
        except RosrmError as error:
            yield f"the master does not start: {error}"
            return
        with contextlib.closing(journal):
            processes = journal.intents("process")
            phases = {name: one["phase"] for name, one in processes.items()}
            wanted = {one["wanted"] for one in journal.intents("application").values()}
            versions = [one["specs"] for one in journal.intents("version").values()]
        for name in _told(state, "submitted") - phases.keys():
            yield f"{name} was accepted, and is not known"
        for name in _told(state, "ended"):
            if phases.get(name) not in _ENDED:
                yield f"{name} has ended, and is {phases.get(name)}"

        applied = max(map(int, _told(state, "applied")), default=0)
        if applied > max(wanted, default=0):
            yield f"version {applied} was applied, and {wanted} is wanted"
        parts = [one for one in processes.values() if one["spec"].get("application") == APPLICATION]
        for one in parts:
            if not any(one["spec"] in specs for specs in versions):
                yield f"{one['spec']['name']} is of no version of its application"
        moves = [line.split() for line in state.told if line.startswith(("moving ", "moved "))]
        for what, name, host in moves[-1:]:
            if what == "moved" and name in processes and processes[name]["host"] != host:
                yield f"{name} was moved to {host}, and is on {processes[name]['host']}"

    def _host(self, host: str, state: State) -> Iterator[str]:
        supervisor = self._root / directory_of(host) / "supervisor"
        self._let_boot(supervisor)
        self._effects.write_text("")
        try:
            client = SupervisorClient.connect(supervisor)
        except RosrmError as error:
            yield f"no supervisor starts: {error}"
            return
        try:
            yield from self._unsettled(client)
        finally:
            _kill(client, supervisor)
        for name, found in _lines(self._effects).items():
            if name == COUNTER:
                yield f"{name} runs again, before the master knows its newest snapshot"
            elif name in _told(state, "ended"):
                yield f"{name} has ended, and runs again"
            elif not found <= self._first[name]:
                yield f"{name} runs with other files: {found}, not one of {self._first[name]}"

    def _snapshots(self, state: State) -> Iterator[str]:
        """Check the snapshot of the counter that a master and a slave would choose."""
        index, stores = ReplicaIndex(), {}
        for host in HOSTS:
            stores[host] = SnapshotStore(self._root / directory_of(host) / SNAPSHOTS, 1 << 30)
            stores[host].drop_torn()
            index.replace(host, stores[host].scan(), 0.0)
        told = [line.split()[1:] for line in state.told if line.startswith("kept ")]
        replicas = [(int(number), int(sequence), host) for number, sequence, host in told]
        reached = [one[:2] for one in replicas if directory_of(one[2]) not in state.lost]
        # The name of the newest replica may be missing; then the one before it is there.
        least = max([*reached, *(one[:2] for one in replicas[:-1])], default=(0, 0))
        if COUNTER in _told(state, "cancelling"):
            return
        newest = max((one.age for one in index.of(COUNTER).values()), default=(0, 0))
        if newest < least:
            yield f"the newest snapshot of {COUNTER} is {newest}, and {least} was reported"
        for host in index.hosts_of(COUNTER, 1)[:1]:
            found = stores[host].newer_than(COUNTER, (0, 0))
            if found is None or found[0].age < least:
                yield f"the snapshot {newest} of {COUNTER} on {host} cannot be read"

    def _archive(self, _: State) -> Iterator[str]:
        """Continue each stored log as a collector does, and compare it with the log itself."""
        directory = self._root / "archive"
        writer = ArchiveWriter(directory, ArchiveLimits(keep=1 << 40, keep_host=1 << 40))
        for source in list(read_segments(directory)):
            log = self._logs[f"{source.process}.{source.number}.log"]
            position = writer.position(source)
            if position > len(log):
                yield f"{position} bytes of {source.process} are stored, and it wrote {len(log)}"
                continue
            part = LogPart(
                source.number,
                [source.number],
                log[position:],
                position,
                len(log),
                ended=True,
                marks=(),
            )
            writer.add(source, part)
            stored = LogArchive(directory).read_log(*source, 0, len(log)).content
            if stored != log:
                yield f"the stored log of {source.process} is not what it wrote"

    def _let_boot(self, supervisor: Path) -> None:
        """Make this boot another one than that of the recording."""
        for name in ("instances.jsonl", "heard"):
            path = supervisor / name
            if path.exists():
                boot = procfs.boot_id().encode()
                path.write_bytes(path.read_bytes().replace(boot, _OTHER_BOOT.encode()))

    def _unsettled(self, client: SupervisorClient) -> Iterator[str]:
        """Wait until each instance has ended, or has told that it runs."""
        states = {one.instance: one.state for one in client.instances}
        until = clocks.boot_time() + _PATIENCE
        while clocks.boot_time() < until:
            waiting = {
                str(instance) for instance, one in states.items()
                if one in _UNSETTLED
                or (one is InstanceState.RUNNING and instance.process not in _lines(self._effects))
            }  # fmt: skip
            if not waiting:
                return
            for message in client.receive(0.05):
                if hasattr(message, "state"):
                    states[message.instance] = message.state
        yield f"not settled after {_PATIENCE:g} s: {sorted(waiting)}"


def directory_of(host: str) -> str:
    """Return the state directory of a host, below that of the recording."""
    return f"cluster/hosts/{host}"


def _told(state: State, verb: str) -> set[str]:
    """Return the names of the processes about which the user received an answer."""
    words = (line.split() for line in state.told)
    return {name for what, name, *_ in words if what == verb}


def _lines(effects: Path) -> dict[str, set[str]]:
    """Map the name of each process that has started to the checksums of the files of each start."""
    found = defaultdict[str, set[str]](set)
    for line in effects.read_text().splitlines():
        name, _, sums = line.partition(" ")
        found[name].add(sums)
    return found


def _kill(client: SupervisorClient, supervisor: Path) -> None:
    marked = procfs.find_marked(str(supervisor))
    for pid in [client.pid, *(one.pid for left in marked.values() for one in left)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    client.close()
