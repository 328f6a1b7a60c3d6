"""States of the disk after a loss of power at each moment of a scenario, each given to its reader.

A real cluster is recorded. After each recorded call the legal states of ext4 and XFS are made, and
the real reader of each part starts on each that differs from all before: the master's journal, the
keys, the supervisor of each host, the snapshots of all hosts, the archive of logs. A fault is a
state that breaks a promise of docs/faults.md.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.crash.disk import Disk, FileSystem, State
from benchmarks.crash.oracle import SNAPSHOTS, Oracle, directory_of
from benchmarks.crash.recording import Recording
from benchmarks.crash.scenario import HOSTS, record
from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run


def measure(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Return the number of states of each part and file system, and the faults."""
    recording, effects = record(folder)
    oracle = Oracle(recording.root, effects)
    tried = {part: {kind.value: 0 for kind in FileSystem} for part in oracle.checks}
    faults: dict[str, dict[str, Any]] = {}
    seen: set[bytes] = set()
    for kind, part, state in _states(recording, oracle.checks.keys() - {SNAPSHOTS}, arguments):
        if (digest := _digest(state, part)) in seen:
            continue
        seen.add(digest)
        tried[part][kind.value] += 1
        for fault in oracle.faults(part, state):
            known = faults.setdefault(f"{part}: {fault}", {"states": 0, "first": state.how})
            known["states"] += 1
    return {"states": tried, "faults": faults}


def _states(
    recording: Recording, parts: Collection[str], arguments: argparse.Namespace
) -> Iterator[tuple[FileSystem, str, State]]:
    """Yield the states of a share of the moments, and of the last one, each with its part.

    Each part has a disk of its own, because a sync of another part must force nothing to it.
    """
    calls = list(recording.calls())
    draw = random.Random(arguments.seed)  # noqa: S311 - no secret
    for kind in FileSystem:
        disks = {part: Disk(kind, recording.attributes, part) for part in sorted(parts)}
        for number, call in enumerate(calls, 1):
            changed = {part for part, disk in disks.items() if disk.apply(call)}
            is_last = number == len(calls)
            for part, disk in disks.items():
                if is_last or (part in changed and draw.random() < arguments.share):
                    for state in disk.states(draw, arguments.each):
                        yield kind, part, state
                        yield from ((kind, SNAPSHOTS, one) for one in _losses(state, disks, draw))
            if number % 200 == 0:
                say(f"benchmarks.crash: {kind.value}, call {number} of {len(calls)}")


def _losses(state: State, disks: Mapping[str, Disk], draw: random.Random) -> Iterator[State]:
    """Yield the snapshots of all hosts after one host, or each host, has lost its power."""
    hosts = {directory_of(host) for host in HOSTS}
    if hosts.isdisjoint(state.lost):
        return
    (other,) = hosts.difference(state.lost)
    for one in disks[other].running(), draw.choice(list(disks[other].states(draw, 6))):
        yield state.beside(one).only(SNAPSHOTS)


def _digest(state: State, part: str) -> bytes:
    """Return a digest of a state, with the answers that the user had received."""
    found = hashlib.blake2b(digest_size=16)
    for path, content in sorted(state.entries.items()):
        found.update(f"{path}\0".encode())
        found.update(content if isinstance(content, bytes) else repr(content).encode())
    found.update(repr((part, state.told, state.lost)).encode())
    return found.digest()


def options() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    command_line = parser(__doc__)
    command_line.add_argument("--share", type=float, default=1.0, help="share of the calls")
    command_line.add_argument("--each", type=int, default=20, help="states after each call")
    command_line.add_argument("--seed", type=int, default=1, help="of what is drawn")
    return command_line


def main() -> None:
    """Measure and print one JSON object; exit with 1 if a promise is broken."""
    arguments = options().parse_args()
    with tempfile.TemporaryDirectory(prefix="rosrm-crash-") as folder:
        figures = measure(arguments, Path(folder))
    print_report("crash", {**vars(arguments), **figures}, runs=1)
    sys.exit(1 if figures["faults"] else 0)


if __name__ == "__main__":
    sys.exit(run("crash", main))
