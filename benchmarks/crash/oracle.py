"""Promises of the documentation after a loss of power, checked by the reader of each part.

Each check starts the real reader on a state of the disk, and compares the result with the answers
that the user had before.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from benchmarks.crash.disk import State
from benchmarks.crash.scenario import HOST
from rosrm import clocks
from rosrm.archive.layout import read_segments
from rosrm.archive.reader import LogArchive
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.errors import RosrmError
from rosrm.journal.sqlite import SqliteJournal
from rosrm.keys import key_files
from rosrm.model.rows import LogPart
from rosrm.model.values import InstanceState
from rosrm.supervisor import procfs
from rosrm.supervisor.client import SupervisorClient

_PATIENCE: Final = 20.0
_OTHER_BOOT: Final = "00000000-0000-0000-0000-000000000000"
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
        logs = root / "cluster" / "hosts" / HOST / "supervisor" / "logs"
        self._logs = {path.name: path.read_bytes() for path in logs.glob("*.log")}
        #: Part of the directory to the check of its reader.
        self.checks: Mapping[str, Callable[[State], Iterator[str]]] = {
            "keys": self._keys, "cluster/master": self._journal,
            f"cluster/hosts/{HOST}": self._host, "archive": self._archive,
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
            phases = {name: one["phase"] for name, one in journal.intents("process").items()}
            wanted = {one["wanted"] for one in journal.intents("application").values()}
        for name in _told(state, "submitted") - phases.keys():
            yield f"{name} was accepted, and is not known"
        for name in _told(state, "ended"):
            if phases.get(name) not in _ENDED:
                yield f"{name} has ended, and is {phases.get(name)}"

        applied = max(map(int, _told(state, "applied")), default=0)
        if applied > max(wanted, default=0):
            yield f"version {applied} was applied, and {wanted} is wanted"

    def _host(self, state: State) -> Iterator[str]:
        supervisor = self._root / "cluster" / "hosts" / HOST / "supervisor"
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
            if name in _told(state, "ended"):
                yield f"{name} has ended, and runs again"
            elif found != self._first[name]:
                yield f"{name} runs with other files: {found}, not {self._first[name]}"

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


def _told(state: State, verb: str) -> set[str]:
    """Return the names about which the user had this answer."""
    words = (line.split() for line in state.told)
    return {name for what, name in words if what == verb}


def _lines(effects: Path) -> dict[str, str]:
    """Return the name of each process that has started to the checksums of its files."""
    lines = effects.read_text().splitlines()
    return {name: sums for name, _, sums in (line.partition(" ") for line in lines)}


def _kill(client: SupervisorClient, supervisor: Path) -> None:
    marked = procfs.find_marked(str(supervisor))
    for pid in [client.pid, *(one.pid for left in marked.values() for one in left)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    client.close()
