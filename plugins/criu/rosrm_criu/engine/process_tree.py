"""The processes of an instance as /proc shows them: who they are, and whether they stand still."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from rosrm.supervisor.procfs import inner_pid, read_stat

#: Namespaces that CRIU has to share with what it dumps, with the option of nsenter for each.
_NAMESPACES: Final = {
    "mnt": "--mount", "pid": "--pid", "net": "--net", "ipc": "--ipc", "uts": "--uts",
    "cgroup": "--cgroup",
}  # fmt: skip
#: Names the program that holds a restored process, in its command line, and the one that may become
#: it, or else the process itself.
HOLD: Final = "rosrm_criu/engine/shim.py"
_AGAIN: Final = "rosrm_criu/engine/restart_from_image.py"


def children(pid: int) -> list[int]:
    """Of all its threads, the oldest first; none where it has ended."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                found.extend(map(int, (thread / "children").read_text().split()))
    return found


def tree(root: int) -> list[int]:
    """A process and all that descend from it, parents before children."""
    found = [root]
    for pid in found:
        found.extend(children(pid))
    return found


def root_of(leader: int) -> int:
    """The process that an instance is about: its leader, or what the leader holds, if restored.

    While it is being restored that is CRIU.
    """
    if not is_hold(leader):
        return leader
    for child in children(leader):
        if not is_hold(child):
            return child
        held = children(child)
        if held:
            return held[0]  # what came to it later are orphans
    return leader


def is_hold(pid: int) -> bool:
    """It runs the program that holds a restored process."""
    return _names(_words(pid), HOLD)


def leads(pid: int) -> bool | None:
    """Return True if it is a hold; None: not yet, but it may be one in a moment.

    One that was spawned just now has no command line yet: it may be anything.
    """
    words = _words(pid)
    if _names(words, HOLD):
        return True
    return None if words == [""] or _names(words, _AGAIN) else False


def _names(words: Sequence[str], program: str) -> bool:
    return any(word.endswith(program) for word in words[1:5])


def _words(pid: int) -> list[str]:
    """Its command line; [""] in the middle of an execve, [] where there is no such process."""
    try:
        return os.fsdecode(Path(f"/proc/{pid}/cmdline").read_bytes()).split("\0")
    except OSError:
        return []


def is_alive(pid: int) -> bool:
    """It runs, or is stopped."""
    stat = read_stat(pid)
    return stat is not None and stat.alive


def is_gone(pid: int) -> bool:
    """It has ended with all its threads, and nothing of it is open any more.

    The first thread may wait to be reaped while others still end, and their sockets are bound.
    """
    try:
        threads = sum(1 for _ in Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return True
    return threads <= 1 and not is_alive(pid)


def is_stopped(pid: int) -> bool:
    """By a signal, not by a debugger."""
    stat = read_stat(pid)
    return stat is not None and stat.state == "T"


def inner_ids(pid: int) -> list[int]:
    """The ids of its threads in its own pid namespace; raises OSError where it has ended."""
    return sorted(inner_pid(pid, int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir())


def entering(pid: int) -> tuple[str, ...]:
    """The words that run a command in the namespaces of a process; () where they are our own."""
    flags = [flag for name, flag in _NAMESPACES.items() if _namespace(pid, name) != _own(name)]
    return ("nsenter", f"--target={pid}", *flags, "--") if flags else ()


def _namespace(pid: int, name: str) -> str:
    return os.readlink(f"/proc/{pid}/ns/{name}")  # noqa: PTH115 - it is no path


def _own(name: str) -> str:
    return os.readlink(f"/proc/thread-self/ns/{name}")  # noqa: PTH115


def memory_of(pids: Iterable[int]) -> int:
    """Bytes that an image of them takes at least: memory that no file backs."""
    total = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/{pid}/status").read_text(errors="replace").splitlines():
                if line.startswith(("RssAnon:", "RssShmem:", "VmSwap:")):
                    total += int(line.split()[1]) * 1024
    return total


def wait_until_stopped(pids: Iterable[int], timeout: float) -> bool:
    """Until each of them is stopped or gone; False: not within so many seconds."""
    end = time.monotonic() + timeout
    waiting = list(pids)
    while waiting := [pid for pid in waiting if is_alive(pid) and not is_stopped(pid)]:
        if time.monotonic() > end:
            return False
        time.sleep(0.001)  # a stop that was asked for: nothing tells of it but a look
    return True


def send(pids: Iterable[int], number: signal.Signals) -> None:
    """A signal to each that is still there."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
