"""Durable record of one host's instances: `instances.jsonl`, append-only, one JSON object a line.

    {"record": "header", "version": 1, "boot": ID}
    {"record": "environment", "id": ID, "variables": {...}}
    {"record": "order", "instance": ..., "argv": ...}       as in the protocol's `start`
    {"record": "spawning", "instances": [...]}              their spawns are about to be tried
    {"record": "state", "key": [process, number], "birth": ..., "oom_kills": ..., "phase": ..., ...}
                                                            also the fields of `Instance`
    {"record": "dead", "process": NAME, "number": N}        up to N they never start again

The last line about an item counts. Each line survives the supervisor's own SIGKILL, because one
`write` passes it to the kernel. No line is forced to the disk, because after a loss of power none
of the processes is left anyway. Each order has the content of the files that its instance reads, so
a process that is restarted then has them. A tail torn by a full disk, or a damaged line, is skipped
and reported in the notes.

A thread writes (`file_thread`). Lines that the disk does not take yet wait in memory; many of them
are replaced by the current state.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

from rosrm.core.supervisor.instance import (
    BACKOFF,
    ENDED,
    HELD,
    RUNNING,
    STARTING,
    STEPS,
    STOPPING,
    THEN_END,
    THEN_POLICY,
    THEN_RESTART,
    Instance,
)
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import Key
from rosrm.runtime import durable
from rosrm.runtime.file_thread import Call, FileThread
from rosrm.runtime.private_files import open_private
from rosrm.supervisor import json_lines, messages, paths, procfs
from rosrm.supervisor.messages import Launch
from rosrm.wording import reason_of

VERSION: Final = 1
#: The file is compacted beyond this size, and beyond this multiple of its size after the last time.
COMPACT_BYTES: Final = 1 << 20
COMPACT_FACTOR: Final = 4
#: Most faults of the record that are reported one by one.
MOST_NOTES: Final = 20


class InstanceRecordError(Exception):
    """The record exists, but cannot be read."""


class Recorded:
    """The content of a record.

    Attributes:
        births: start time of the leader of each instance, see `procfs.was_born`.
        kills: number of OOM kills in the control group of each instance before its run.
        spawning: instances whose last spawn may have been tried, with no outcome recorded.
        same_boot: the record was written since this machine's start.
        notes: faults of the record, as text for the user.
    """

    def __init__(self) -> None:
        self.environments: dict[str, dict[str, str]] = {}
        self.launches: dict[Key, Launch] = {}
        self.instances: dict[Key, Instance] = {}
        self.dead: dict[str, int] = {}
        self.births: dict[Key, int] = {}
        self.kills: dict[Key, int] = {}
        self.spawning: set[Key] = set()
        self.same_boot = False
        self.notes: list[str] = []


def read(state: str) -> Recorded:
    """Return the content of a state directory's record; empty where there is none."""
    recorded = Recorded()
    path = os.path.join(state, paths.RECORD)
    try:
        with open(path, "rb") as file:
            *written, tail = file.read().split(b"\n")
    except FileNotFoundError:
        return recorded
    except OSError as error:
        raise InstanceRecordError(f"{path} cannot be read: {reason_of(error)}") from None
    if tail:
        recorded.notes.append(f"{path}: the last {len(tail)} bytes, a torn line, were left out")
    for number, line in enumerate(written, 1):
        if not line:
            continue
        try:
            _take(recorded, json_lines.parse(line))
        except (json_lines.ProtocolError, *messages.UNREADABLE) as error:
            recorded.notes.append(f"{path}:{number}: left out, it cannot be read: {error}")
    if len(recorded.notes) > MOST_NOTES:
        more = len(recorded.notes) - MOST_NOTES
        recorded.notes[MOST_NOTES:] = [f"{path}: {more} more lines were left out"]
    return recorded


def _take(recorded: Recorded, fields: Mapping[str, Any]) -> None:
    kind = fields["record"]
    if kind == "state":
        _take_state(recorded, fields)
    elif kind == "order":
        launch = messages.read_launch(fields)
        recorded.launches[launch.instance] = launch
    elif kind == "spawning":
        recorded.spawning.update(messages.read_key(key) for key in fields["instances"])
    elif kind == "environment":
        identity = messages.read_text(fields["id"])
        recorded.environments[identity] = messages.read_texts(fields["variables"])
    elif kind == "dead":
        key = messages.read_key(fields["key"])
        process, number = messages.read_key((fields["process"], fields["number"]))
        recorded.dead[process] = number
        if recorded.instances.pop(key, None) is not None:
            recorded.launches.pop(key, None)
    elif kind == "header":
        if fields["version"] != VERSION:
            raise ValueError(f"version {fields['version']}, not {VERSION}")
        recorded.same_boot = fields["boot"] == procfs.boot_id()
    else:
        raise ValueError(f"unknown record {kind!r}")


def _take_state(recorded: Recorded, fields: Mapping[str, Any]) -> None:
    instance = Instance(
        messages.read_key(fields["key"]),
        messages.read_restart(fields["restart"]),
        messages.read_stop(fields["stop"]),
    )
    for name, reader in _FIELD_READERS.items():
        if name in fields or name not in _NEW_FIELDS:
            setattr(instance, name, reader(fields[name]))
    instance.fence = messages.read_fence(fields.get("fence"))
    birth = messages.read_whole(fields["birth"], 0)
    kills = messages.read_whole(fields.get("oom_kills", 0), 0)  # absent in older records
    _check(instance)
    recorded.instances[instance.key] = instance
    recorded.births[instance.key] = birth
    recorded.kills[instance.key] = kills
    recorded.spawning.discard(instance.key)
    if instance.ended:
        recorded.launches.pop(instance.key, None)


def _check(instance: Instance) -> None:
    """Set the deadline that the phase implies; raises `ValueError` for an impossible state."""
    if instance.phase == RUNNING and not instance.pid:
        raise ValueError("it runs without a pid")
    if instance.phase not in (STOPPING, BACKOFF):
        instance.deadline = None  # a deadline that no transition clears would be due for ever
    elif instance.deadline is None:
        instance.deadline = 0.0  # due at once; otherwise the stop or back-off would never end


def _one_of(*allowed: str) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if value not in allowed:
            raise ValueError(f"{value!r} is not one of {', '.join(map(repr, allowed))}")
        return str(value)

    return read


def _optional_time(value: Any) -> float | None:
    return None if value is None else messages.read_time(value)


def _times(value: Any) -> list[float]:
    return [messages.read_time(one) for one in value]


def _int32(value: Any) -> int:
    return messages.read_whole(value, -(2**31), 2**31 - 1)


#: Reader of each recorded field; the rules are read beside these.
_FIELD_READERS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "phase": _one_of(HELD, STARTING, RUNNING, STOPPING, BACKOFF, *sorted(ENDED)),
    "then": _one_of("", THEN_END, THEN_RESTART, THEN_POLICY),
    "pid": lambda value: messages.read_whole(value, 0, 2**31 - 1),
    "exit_code": _int32,
    "exit_signal": _int32,
    "restarts": lambda value: messages.read_whole(value, 0, 2**31 - 1),
    "recent": _times,
    "started": messages.read_time,
    "begun": _optional_time,
    "deadline": _optional_time,
    "step": lambda value: messages.read_whole(value, -1, len(STEPS) - 1),
    "kills": _int32,
    "stop_began": messages.read_time,
    "trail": messages.read_text,
    "fault": messages.read_text,
    "enforced": lambda value: tuple(messages.read_text(name) for name in value),
    "heard": messages.read_time,
    "fenced": messages.read_text,
    "kill_by": _optional_time,
    "withdrawn": bool,
    "adopted": bool,
    "unfound": messages.read_text,
    "slots": lambda value: messages.read_whole(value, 0),
    "peak_memory": messages.read_amount,
    "cpu_time": messages.read_amount,
    "run_time": messages.read_amount,
    "message": messages.read_text,
}
#: Fields that may be missing in older records.
_NEW_FIELDS: Final = frozenset({
    "adopted", "begun", "enforced", "fault", "fenced", "heard", "kill_by", "slots", "unfound",
    "withdrawn",
})  # fmt: skip


def _environment(identity: str, variables: Mapping[str, str]) -> dict[str, Any]:
    return {"record": "environment", "id": identity, "variables": dict(variables)}


def _launch(launch: Launch) -> dict[str, Any]:
    return {"record": "order", **messages.launch_fields(launch)}


def _state(instance: Instance, birth: int, kills: int) -> dict[str, Any]:
    fields = {name: getattr(instance, name) for name in Instance.__slots__}
    return {"record": "state", "birth": birth, "oom_kills": kills, **fields}


class _Outcome(NamedTuple):
    """Outcome of a write: what is still to be written, and why; "": it succeeded."""

    rest: bytes
    fault: str


class InstanceRecord:
    """Appends to the record; while the disk takes nothing, lines are delayed but not lost.

    Args:
        state: the state directory.
        disk: its thread.

    Attributes:
        trouble: reason of the last write's failure; "": it succeeded.
    """

    def __init__(self, state: str, disk: FileThread) -> None:
        self.trouble = ""
        self._path = os.path.join(state, paths.RECORD)
        self._boot = procfs.boot_id()
        self._disk = disk
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0
        self._compact_waiting_at = COMPACT_BYTES
        self._is_whole = False  # the waiting lines replace the file, and all that was written
        self._write: Call[_Outcome] | None = None  # without a known outcome
        self._writes_whole = False
        # Of the thread:
        self._file = -1
        self._size = 0
        self._has_header = False  # in the file, of this boot
        self._compact_at = COMPACT_BYTES

    def environment(self, identity: str, variables: Mapping[str, str]) -> None:
        """Add a base environment that launches refer to."""
        self._add(_environment(identity, variables))

    def launch(self, launch: Launch) -> None:
        """Add an order to start."""
        self._add(_launch(launch))

    def spawning(self, keys: Iterable[Key]) -> None:
        """Add the spawns that will be tried next."""
        self._add({"record": "spawning", "instances": list(keys)})

    def state(self, instance: Instance, birth: int, kills: int = 0) -> None:
        """Add the whole state of an instance; `birth` and `kills`: see `Recorded`."""
        self._add(_state(instance, birth, kills))

    def dead(self, key: Key, number: int) -> None:
        """Add a forgotten instance; its process starts no number up to `number` any more."""
        self._add({"record": "dead", "key": key, "process": key[0], "number": number})

    def flush(self) -> bool:
        """Pass all lines to the kernel in one write; return False, with `trouble`, if it failed."""
        if not self._settle():
            return False
        if not self._waiting:
            return True
        is_whole, self._is_whole = self._is_whole, False
        text = self._take_waiting()
        write = self._replace if is_whole else self._append
        return self._begin(partial(write, text, text), is_whole=is_whole)

    def is_large(self) -> bool:
        """Return True if the record should be compacted by `rewrite`."""
        if self._waiting_bytes >= self._compact_waiting_at:
            return True
        return self._size >= self._compact_at and self._write is None

    def rewrite(
        self, core_state: SupervisorState, launches: Mapping[Key, Launch],
        environments: Mapping[str, Mapping[str, str]], birth: Callable[[Key], int],
        kills: Callable[[Key], int] = lambda _: 0,
    ) -> None:  # fmt: skip
        """Replace the record by one that holds only the current state, if the disk has room.

        While the disk takes nothing, replace only the waiting lines. The environments are all that
        launches refer to now or may later; one may be missing, where a line was damaged.
        """
        is_free = self._settle() and self._waiting_bytes < self._compact_waiting_at
        lines = [
            {"record": "header", "version": VERSION, "boot": self._boot},
            *(
                {"record": "dead", "key": [process, -1], "process": process, "number": number}
                for process, number in core_state.dead.items()
            ),
            *(_environment(*one) for one in environments.items()),
            *map(_launch, launches.values()),
            *(_state(one, birth(key), kills(key)) for key, one in core_state.instances.items()),
        ]
        text = b"".join(map(json_lines.line, lines))
        waiting = self._take_waiting()  # only now: a failure before loses no line
        if is_free:
            # Without a header of this boot, what runs would count as ended with the machine.
            left = waiting if self._has_header else text
            self._begin(partial(self._replace, text, left), is_whole=not self._has_header)
        else:
            self._is_whole = True
            self._waiting, self._waiting_bytes = [text], len(text)
            self._compact_waiting_at = max(COMPACT_BYTES, COMPACT_FACTOR * self._waiting_bytes)

    def _take_waiting(self) -> bytes:
        text = b"".join(self._waiting)
        self._waiting, self._waiting_bytes = [], 0
        return text

    def _add(self, fields: Mapping[str, Any]) -> None:
        line = json_lines.line(fields)
        self._waiting.append(line)
        self._waiting_bytes += len(line)

    def _begin(self, write: Callable[[], _Outcome], *, is_whole: bool) -> bool:
        self._write, self._writes_whole = self._disk.begin(write), is_whole
        return self._settle()

    def _settle(self) -> bool:
        """Return True if no write is without an outcome; note the outcome of one that is over."""
        if self._write is None:
            return True
        if not self._disk.ends(self._write):
            self.trouble = f"{self._path} cannot be written: it does not answer"
            return False
        rest, fault = self._write.result()
        self._write = None
        self.trouble = f"{self._path} cannot be written: {fault}" if fault else ""
        if self._is_whole:
            return not fault  # the waiting lines replace what was written, and its rest
        if fault:
            self._waiting.insert(0, rest)
            self._waiting_bytes += len(rest)
            self._is_whole = self._writes_whole
        else:
            self._compact_waiting_at = COMPACT_BYTES
        return not fault

    # --- in the thread --------------------------------------------------------------------

    def _append(self, text: bytes, _: bytes) -> _Outcome:
        try:
            if self._file < 0:  # the existing record, behind a tail that may be torn
                self._file = open_private(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
                text = b"\n" + text
            written = os.write(self._file, text)
        except Exception as error:  # noqa: BLE001 - no fault may lose the lines
            return _Outcome(text, reason_of(error))
        self._size += written
        rest = text[written:]
        return _Outcome(rest, "No space left on device, after a part of it" if rest else "")

    def _replace(self, text: bytes, waiting: bytes) -> _Outcome:
        """Replace the file by a text; where that fails, `waiting` is still to be written."""
        self._compact_at = max(COMPACT_BYTES, COMPACT_FACTOR * max(self._size, len(text)))
        try:
            file = durable.replace_atomically(self._path, text, os.O_APPEND)
        except Exception as error:  # noqa: BLE001 - as in `_append`
            return _Outcome(waiting, reason_of(error))
        former, self._file = self._file, file
        self._has_header = True
        self._size = len(text)
        self._compact_at = max(COMPACT_BYTES, COMPACT_FACTOR * self._size)
        if former >= 0:
            with contextlib.suppress(OSError):  # the lines that it had are in the new file
                os.close(former)
        return _Outcome(b"", "")
