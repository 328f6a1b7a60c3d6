"""States of a directory that ext4 and XFS may leave after a loss of power, of recorded calls.

The model, with the default options of both:

- Changes of names are kept in their order: a state has a first part of them. `fsync` forces what
  came before: with ext4 all of it, with XFS what came before the last change of that inode.
- The data of a file is kept in any order with names and other files. What a file got since its last
  `fsync` may be missing, be there in part, or (an append to the last block) be zeros, also before
  further data.
- ext4 writes the data of a file before a rename that replaces another (`auto_da_alloc`).

Sources: Pillai and others, "All File Systems Are Not Created Equal", OSDI 2014 (the tool ALICE),
and the crash tests of SQLite (`test6.c`), which also drop and cut the writes since the last sync.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path, PurePosixPath
from typing import Final

from benchmarks.crash.recording import MARK, Attributes, Call

_BLOCK: Final = 4096
#: Flag of renameat2 that exchanges two names.
_EXCHANGE: Final = 2
#: Most files of a state of which one alone has, or lacks, its new data.
_SINGLE: Final = 3


class FileSystem(Enum):
    """Kind of file system, as far as its states after a loss of power differ."""

    EXT4 = "ext4"
    XFS = "xfs"


class Data(Enum):
    """Part of what a file got since its last `fsync` that the disk has."""

    NONE = "none"
    HALF = "half"
    ZEROS = "zeros"
    HOLE = "hole"
    LATE = "late"
    ALL = "all"


@dataclass(eq=False)
class Node:
    """A file (`durable` is content), a directory (None) or a symbolic link (`target`).

    Attributes:
        pending: writes since the last `fsync`: offset and data, or size and None.
        named: number of the last change of names that touched it.
        floors: number of a change of names to the pending writes that are on the disk with it.
    """

    inode: int
    durable: bytes | None = None
    target: str = ""
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)
    named: int = 0
    floors: dict[int, int] = field(default_factory=dict)

    def content(self, data: Data, cut: int) -> bytes:
        """Return the content that the disk has if it has the changes of names up to `cut`."""
        assert self.durable is not None
        count = max((n for number, n in self.floors.items() if number <= cut), default=0)
        base, rest = _applied(self.durable, self.pending[:count]), self.pending[count:]
        if data is Data.NONE or not rest:
            return base
        if data in (Data.ZEROS, Data.HOLE):
            # The file already had the rest of its last block, so its new size may come first.
            new, end = _applied(base, rest), -(-len(base) // _BLOCK) * _BLOCK
            zeros = base.ljust(min(len(new), end), b"\0")
            return zeros if data is Data.ZEROS else zeros + new[end:]
        if data is Data.HALF:
            *whole, (offset, last) = rest[: (len(rest) + 1) // 2]
            cut_off = last if last is None else last[: len(last) // 2]
            return _applied(base, [*whole, (offset, cut_off)])
        if data is Data.LATE:
            rest = [one for one in rest if one[1] is not None and one[0] + len(one[1]) <= len(base)]
            rest = rest[1:]
        return _applied(base, rest)


def _applied(content: bytes, writes: list[tuple[int, bytes | None]]) -> bytes:
    if not writes:
        return content
    changed = bytearray(content)
    for offset, data in writes:
        if data is None:
            del changed[offset:]
        if len(changed) < offset:
            changed.extend(bytes(offset - len(changed)))
        if data is not None:
            changed[offset : offset + len(data)] = data
    return bytes(changed)


@dataclass(frozen=True, slots=True)
class State:
    """Possible content of the disk.

    Attributes:
        entries: path to content, None for a directory, a text for a symbolic link.
        attributes: path to mode and time.
        told: marks before the loss of power, in order.
        how: the point, the file system and the choices, for a report.
        lost: directories of the disks that have lost their power.
    """

    entries: Mapping[str, bytes | str | None]
    attributes: Mapping[str, Attributes]
    told: tuple[str, ...]
    how: str
    lost: tuple[str, ...] = ()

    def only(self, folder: str) -> State:
        """Return the part of this state that is below folders of this name."""
        entries = {path: one for path, one in self.entries.items() if f"/{folder}/" in f"/{path}/"}
        attributes = {path: one for path, one in self.attributes.items() if path in entries}
        return replace(self, entries=entries, attributes=attributes)

    def beside(self, other: State) -> State:
        """Return this state together with that of another disk at the same moment."""
        return State(
            {**self.entries, **other.entries}, {**self.attributes, **other.attributes},
            self.told, f"{self.how}; {other.how}", self.lost + other.lost,
        )  # fmt: skip

    def write(self, directory: Path) -> None:
        """Make the state in a new directory."""
        directory.mkdir()
        for name, content in sorted(self.entries.items()):
            path = directory / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if content is None:
                path.mkdir(mode=0o700, exist_ok=True)
            elif isinstance(content, str):
                path.symlink_to(content)
            else:
                path.write_bytes(content)
                path.chmod(0o600)
        for name, one in self.attributes.items():
            path = directory / name
            if not path.is_symlink():
                path.chmod(one.mode)
                os.utime(path, ns=(one.modified_ns, one.modified_ns))


class Disk:
    """A directory to which recorded calls are applied in order, and the states it may be left in.

    Args:
        kind: of the file system.
        attributes: of each inode, at the end of the recording.
        directory: directory that is this disk; "": all. Other disks may lose their power at other
            moments.
    """

    def __init__(
        self, kind: FileSystem, attributes: Mapping[int, Attributes], directory: str = ""
    ) -> None:
        self._kind = kind
        self._attributes = attributes
        self._directory = directory
        self._names: list[dict[str, Node]] = [{}]  # after each change of names
        self._nodes: dict[int, Node] = {}
        self._directories: dict[str, int] = {}  # number of the last change in each
        self._forced = 0
        self._told: list[str] = []
        self._at = 0

    @property
    def names(self) -> Mapping[str, Node]:
        """Return path to file of all that exists."""
        return self._names[-1]

    def apply(self, call: Call) -> bool:
        """Apply the next call; return True if it changes this disk or the answers to the user.

        Raises:
            KeyError: the call is on a file that no earlier call has created.
        """
        self._at += 1
        if not self._is_here(call):
            return False
        if call.kind == MARK:
            self._told.append(call.path)
        elif call.kind in "WT":
            data = None if call.kind == "T" else call.content
            self._nodes[call.inode].pending.append((call.offset, data))
        elif call.kind == "F":
            self._force(self._nodes[call.inode])
        elif call.kind == "O" and call.path in self.names:
            if call.flags:
                self.names[call.path].pending.append((0, None))
        elif call.kind != "U" or call.path in self.names:  # a socket is not recorded
            self._change_names(call)
        return True

    def _is_here(self, call: Call) -> bool:
        if not self._directory or call.kind == MARK:
            return True
        if call.kind in "WTF":
            return call.inode in self._nodes
        return f"{call.path}/".startswith(f"{self._directory}/")

    def _force(self, node: Node) -> None:
        if node.durable is not None:
            node.durable = _applied(node.durable, node.pending)
            node.pending.clear()
            node.floors.clear()
        number = len(self._names) - 1
        if self._kind is FileSystem.XFS:
            inside = [
                self._directories.get(path, 0) for path, one in self.names.items() if one is node
            ]
            number = max([node.named, *inside])
        self._forced = max(self._forced, number)

    def _change_names(self, call: Call) -> None:
        number, names = len(self._names), dict(self.names)
        target = call.content.decode() if call.kind in "RLS" else ""
        touched = [call.path]
        if call.kind in "OM":
            names[call.path] = self._nodes[call.inode] = Node(
                call.inode, b"" if call.kind == "O" else None
            )
        elif call.kind == "S":
            names[call.path] = Node(0, target=target)
        elif call.kind == "L":
            names[target] = names[call.path]
        elif call.kind == "U":
            names.pop(call.path).named = number
        elif call.kind == "R":
            touched.append(target)
            self._rename(names, call.path, target, number, exchanges=bool(call.flags & _EXCHANGE))
        for path in touched:
            if path in names:
                names[path].named = number
            self._directories[str(PurePosixPath(path).parent)] = number
        self._names.append(names)

    def _rename(
        self, names: dict[str, Node], source: str, target: str, number: int, *, exchanges: bool
    ) -> None:
        moved, replaced = _taken(names, source), _taken(names, target)
        for below, node in moved.items():
            names[target + below] = node
            if replaced and self._kind is FileSystem.EXT4:
                node.floors[number] = len(node.pending)
        if exchanges:
            names.update({source + below: node for below, node in replaced.items()})

    def states(self, draw: random.Random, most: int) -> Iterator[State]:
        """Yield up to `most` of the states that a loss of power now may leave, the worst first."""
        last = len(self._names) - 1
        choices = [(cut, data) for cut in {self._forced, last} for data in Data]
        for single in Data.NONE, Data.ALL:
            choices += [(last, single)] * _SINGLE
        choices += [(cut, Data.ALL) for cut in range(self._forced + 1, last)]
        first, rest = choices[0], choices[1:]
        draw.shuffle(rest)
        for cut, data in [first, *rest][:most]:
            yield self._state(cut, data, draw)

    def running(self) -> State:
        """Return the state that a machine without a loss of power reads."""
        state = self._state(len(self._names) - 1, Data.ALL, None)
        return replace(state, how=f"{self._directory} runs", lost=())

    def _state(self, cut: int, data: Data, draw: random.Random | None) -> State:
        names = self._names[cut]
        unsynced = [path for path, node in names.items() if node.pending]
        other, opposite = "", data
        if draw is not None and len(unsynced) > 1 and draw.random() < 0.5:
            other = draw.choice(unsynced)
            opposite = Data.ALL if data is not Data.ALL else draw.choice(list(Data)[:-1])
        entries: dict[str, bytes | str | None] = {}
        for path, node in names.items():
            if node.durable is not None:
                entries[path] = node.content(opposite if path == other else data, cut)
            else:
                entries[path] = node.target or None
        but = f", but {other}: {opposite.value}" if other else ""
        how = f"{self._kind.value}, call {self._at}, names {cut} of {len(self._names) - 1}"
        return State(
            entries,
            {
                path: self._attributes[node.inode]
                for path, node in names.items()
                if node.inode in self._attributes
            },
            tuple(self._told),
            f"{how}, data {data.value}{but}",
            (self._directory,),
        )


def _taken(names: dict[str, Node], path: str) -> dict[str, Node]:
    """Take a path, and all that is below it, from the names; keys are what follows the path."""
    found = {
        name.removeprefix(path): node
        for name, node in names.items()
        if name == path or name.startswith(f"{path}/")
    }
    for below in found:
        del names[path + below]
    return found
