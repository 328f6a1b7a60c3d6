"""Process tree of an instance as /proc shows it: its members and their states."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.runtime import signalling
from rosrm.shortage import raise_shortage
from rosrm.supervisor.procfs import everyone, inner_pid, read_stat

#: Namespaces that CRIU must share with the process that it dumps, each with its nsenter option.
_NAMESPACES: Final = {
    "mnt": "--mount", "pid": "--pid", "net": "--net", "ipc": "--ipc", "uts": "--uts",
    "cgroup": "--cgroup",
}  # fmt: skip
#: Parts of command lines: of the shim, and of the program that becomes either the shim or the
#: process itself.
SHIM: Final = "rosrm_criu/engine/shim.py"
_AGAIN: Final = "rosrm_criu/engine/restart_from_image.py"


def children(pid: int) -> list[int]:
    """Return the children of all threads of a process, oldest first; none if it has ended."""
    found: list[int] = []
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                found.extend(map(int, (thread / "children").read_text().split()))
    return found


def tree(root: int) -> list[int]:
    """Return a process and all its descendants, parents before children."""
    found = [root]
    for pid in found:
        found.extend(children(pid))
    return found


def root_of(leader: int) -> int:
    """Return the main process of an instance: its leader, or the restored process of a shim.

    While the restore runs, this is CRIU.
    """
    if not is_shim(leader):
        return leader
    for child in children(leader):
        if not is_shim(child):
            return child
        held = children(child)
        if held:
            return held[0]  # children that were added later are orphans
    return leader


def is_shim(pid: int) -> bool:
    """Return True if a process is a shim."""
    return _names(_words(pid), SHIM)


def has_shim(directory: Path) -> bool:
    """Return True if the shim of an image runs; a walk over /proc, so only for rare occasions."""
    return any(str(directory) in _words(stat.pid) for stat in everyone())


def leads(pid: int) -> bool | None:
    """Return True if a process is a shim; None: not yet, but it may become one in a moment.

    A process that was spawned just now has no command line yet, so it may become a shim.
    """
    words = _words(pid)
    if _names(words, SHIM):
        return True
    return None if words == [""] or _names(words, _AGAIN) else False


def _names(words: Sequence[str], program: str) -> bool:
    return any(word.endswith(program) for word in words[1:5])


def _words(pid: int) -> list[str]:
    """Return the command line; [""] in the middle of an execve, [] if there is no such process.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        return os.fsdecode(Path(f"/proc/{pid}/cmdline").read_bytes()).split("\0")
    except OSError as error:
        raise_shortage(error)
        return []


def is_alive(pid: int) -> bool:
    """Return True if a process runs or is stopped."""
    stat = read_stat(pid)
    return stat is not None and stat.alive


def is_gone(pid: int) -> bool:
    """Return True if a process has ended with all its threads, and all its files are closed.

    The first thread may be a zombie while other threads still end and their sockets are bound.
    """
    try:
        threads = sum(1 for _ in Path(f"/proc/{pid}/task").iterdir())
    except OSError as error:
        raise_shortage(error)
        return True
    return threads <= 1 and not is_alive(pid)


def is_stopped(pid: int) -> bool:
    """Return True if a process is stopped by a signal (not by a debugger)."""
    stat = read_stat(pid)
    return stat is not None and stat.state == "T"


def inner_ids(pid: int) -> list[int]:
    """Return a process's thread ids in its own pid namespace; raise OSError if it has ended."""
    return sorted(inner_pid(pid, int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir())


def entering(pid: int) -> tuple[str, ...]:
    """Return the nsenter prefix for a process's namespaces; (): they are those of this process."""
    flags = [flag for name, flag in _NAMESPACES.items() if _namespace(pid, name) != _own(name)]
    return ("nsenter", f"--target={pid}", *flags, "--") if flags else ()


def _namespace(pid: int, name: str) -> str:
    return os.readlink(f"/proc/{pid}/ns/{name}")  # noqa: PTH115 - it is no path


def _own(name: str) -> str:
    return os.readlink(f"/proc/thread-self/ns/{name}")  # noqa: PTH115


def memory_of(pids: Iterable[int]) -> int:
    """Return the least bytes that an image of processes needs: memory that no file backs."""
    total = 0
    for pid in pids:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            for line in Path(f"/proc/{pid}/status").read_text(errors="replace").splitlines():
                if line.startswith(("RssAnon:", "RssShmem:", "VmSwap:")):
                    total += int(line.split()[1]) * 1024
    return total


def wait_until_stopped(pids: Iterable[int], timeout: float) -> bool:
    """Wait until each process is stopped or gone; return False after the timeout in seconds."""
    end = clocks.boot_time() + timeout
    waiting = list(pids)
    while waiting := [pid for pid in waiting if is_alive(pid) and not is_stopped(pid)]:
        if clocks.boot_time() > end:
            return False
        time.sleep(0.001)  # polled, because no event reports a stop
    return True


def send(pids: Iterable[int], number: int) -> None:
    """Send a signal to each process that still exists, and is not another user's."""
    for pid in pids:
        signalling.send(pid, number)
