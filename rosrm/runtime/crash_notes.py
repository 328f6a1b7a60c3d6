"""Notes of the running calls of plugins, so that a plugin that ends its process has a name.

A part keeps a small mapped file in its state directory: each thread has a slot with the call that
runs in it. The file of a process that ended in order is removed. From any other one the next start
reads whom it called:

================================================================  ==========================  ====
end of the process                                                blamed                      each
================================================================  ==========================  ====
a crash in C, which `faulthandler` wrote behind the slots         the call of that thread     2
`os._exit` in a call                                              that call                   2
unknown, such as `kill -9`                                        each call that ran          1
the machine rebooted                                              none
================================================================  ==========================  ====

A plugin with `LEFT_OUT` or more is left out: each call of it fails. A new version of its
distribution is tried again, as is every plugin after `plugin-crashes.json` was removed.
"""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import json
import logging
import mmap
import os
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rosrm.extensions import guard
from rosrm.extensions.guard import Crash
from rosrm.runtime import durable
from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.wording import reason_of

_log = logging.getLogger("rosrm.plugins")

#: Weight from which on a plugin is left out.
LEFT_OUT: Final = 4

_FILE: Final = "plugin-calls"
_SLOT: Final = 256
_SLOTS: Final = 64
_EMPTY: Final = bytes(_SLOT)
_EXITED: Final = b"!"
_CRASHED: Final = re.compile(rb"Current thread 0x([0-9a-f]+)")
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class CrashNotes:
    """The notes of this process, and what former processes of the same state directory left.

    Args:
        directory: state directory of the part.

    Attributes:
        found: calls in which a former process has ended since the last orderly end.
    """

    def __init__(self, directory: Path) -> None:
        if not directory.exists():  # the lock restricts the rights of an existing one
            make_private_directory(directory)
        self._weights = directory / "plugin-crashes.json"
        self._known: dict[str, dict[str, Any]] = _read(self._weights)
        self.found = self._former(directory)
        self._path = directory / f"{_FILE}.{os.getpid()}"
        self._descriptor = open_private(
            str(self._path), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        )
        content = _boot().ljust(_SLOT, b"\0") + _EMPTY * _SLOTS
        if os.write(self._descriptor, content) < len(content):  # SIGBUS at a hole in the map
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._map = mmap.mmap(self._descriptor, _SLOT * (_SLOTS + 1))
        self._free = list(range(_SLOTS, 0, -1))
        self._pid = os.getpid()
        self._exit = os._exit
        faulthandler.enable(self._descriptor)
        os._exit = self._note_exit  # type: ignore[assignment]

    def note_versions(self, versions: Mapping[str, str]) -> None:
        """Note the distribution of each plugin, because a new version is tried again."""
        before = json.dumps(self._known)
        for key, known in list(self._known.items()):
            version = versions.get(key.partition("\t")[0])
            if version is None or known["version"] == version:
                continue
            if known["version"] is None:  # of the crash that this start has found
                known["version"] = version
            else:
                del self._known[key]
        if json.dumps(self._known) != before:
            self._write()

    def reason(self, whom: str, hook: str) -> str:
        """Return why a plugin's method is not called; "": it is."""
        known = self._known.get(_key(whom, hook))
        if known is None or known["weight"] < LEFT_OUT:
            return ""
        return (
            f"{known['text']} repeatedly, so it is not called until its version changes or "
            f"{self._weights} is removed"
        )

    def begin(self, whom: str, hook: str) -> int:
        """Note a call; return its slot, 0: there is none free."""
        try:
            slot = self._free.pop()
        except IndexError:
            return 0
        text = f"{threading.get_ident():x}\t{whom}\t{hook}".encode(errors="replace")
        start = slot * _SLOT
        self._map[start : start + _SLOT] = b"\0" + text[: _SLOT - 2].ljust(_SLOT - 1, b"\0")
        return slot

    def end(self, slot: int) -> None:
        """Remove the note of a call."""
        if slot:
            self._map[slot * _SLOT : (slot + 1) * _SLOT] = _EMPTY
            self._free.append(slot)

    def close(self) -> None:
        """Remove the file, because the process ends in order; forget plugins that are called."""
        if os.getpid() != self._pid:
            return
        os._exit = self._exit
        faulthandler.disable()
        kept = {whom: one for whom, one in self._known.items() if one["weight"] >= LEFT_OUT}
        if kept != self._known:
            self._known = kept
            self._write()
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)

    def _note_exit(self, status: int) -> None:
        own = f"{threading.get_ident():x}\t".encode()
        if os.getpid() == self._pid:  # a forked child ends in this way
            for slot in range(1, _SLOTS + 1):
                start = slot * _SLOT
                if self._map[start + 1 : start + 1 + len(own)] == own:
                    self._map[start : start + 1] = _EXITED
        self._exit(status)

    # --- former processes -----------------------------------------------------------------

    def _former(self, directory: Path) -> tuple[Crash, ...]:
        found, read = [], []
        for path in directory.glob(f"{_FILE}.*"):
            pid = path.suffix[1:]
            # In a container each run may have the same pid.
            if not pid.isdigit() or (int(pid) != os.getpid() and _runs(int(pid))):
                continue
            with contextlib.suppress(OSError):
                found += self._blamed(path.read_bytes())
                read.append(path)
        if not found or self._write():  # otherwise the next start reads the files again
            for path in read:
                path.unlink(missing_ok=True)
        return tuple(found)

    def _blamed(self, content: bytes) -> list[Crash]:
        ran = [content[at : at + _SLOT] for at in range(_SLOT, _SLOT * (_SLOTS + 1), _SLOT)]
        ran = [one for one in ran if one.strip(b"\0")]
        crashed = _CRASHED.search(content, _SLOT * (_SLOTS + 1))
        if crashed:
            proven = [one for one in ran if _thread(one) == crashed[1].lstrip(b"0")]
            how = "by a crash"
        else:
            proven, how = [one for one in ran if one.startswith(_EXITED)], "by os._exit"
        if crashed and not proven:  # a crash outside of plugins
            return []
        if not proven and content[:_SLOT].rstrip(b"\0") != _boot():
            return []
        return [self._blame(one, how if proven else "") for one in proven or ran]

    def _blame(self, slot: bytes, how: str) -> Crash:
        words = slot.strip(b"!\0").decode(errors="replace").split("\t")
        whom, hook = (*words[1:], "", "")[:2]
        text = f"this process ended{how and f' {how}'} in {hook or 'a call'}"
        known = self._known.setdefault(_key(whom, hook), {"weight": 0, "version": None})
        known["text"], known["weight"] = text, known["weight"] + (2 if how else 1)
        return Crash(whom, text)

    def _write(self) -> bool:
        """Store the weights; return False, with the file unchanged, if they cannot be written."""
        try:
            text = json.dumps(self._known).encode()
            os.close(durable.replace_atomically(str(self._weights), text))
        except OSError:
            return False
        return True


def _key(whom: str, hook: str) -> str:
    return f"{whom}\t{hook}"


def _thread(slot: bytes) -> bytes:
    return slot.strip(b"!\0").partition(b"\t")[0]


def _read(path: Path) -> dict[str, dict[str, Any]]:
    try:
        found = json.loads(path.read_bytes())
        return {
            str(whom): {
                "weight": int(one["weight"]), "text": str(one["text"]), "version": one["version"],
            }
            for whom, one in found.items()
        }  # fmt: skip
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        return {}


def _runs(pid: int) -> bool:
    return os.path.exists(f"/proc/{pid}")  # noqa: PTH110 - as short as it can be


def _boot() -> bytes:
    try:
        return _BOOT_ID.read_bytes().strip()
    except OSError:
        return b""


@contextlib.contextmanager
def kept_notes(directory: Path) -> Iterator[Sequence[Crash]]:
    """Keep notes of the calls of plugins in a state directory; remove them at an orderly end.

    Yields the calls in which former processes have ended. On a full disk there are no notes.
    """
    try:
        notes = CrashNotes(directory)
    except OSError as fault:
        _log.warning("no notes of the calls of plugins are kept: %s", reason_of(fault))
        yield ()
        return
    guard.keep_notes(notes)
    try:
        yield notes.found
    finally:
        guard.keep_notes(None)
        notes.close()
