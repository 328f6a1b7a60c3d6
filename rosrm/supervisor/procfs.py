"""Lookup in /proc of the processes that belong to an instance.

An instance is its session leader and the leader's descendants. These are the processes in the
leader's group or session, and those that left both (a daemon of their own) but carry the marks that
the supervisor puts into each environment. Only a daemon that also cleans its environment escapes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator
from typing import Final, NamedTuple

from rosrm import clocks
from rosrm.shortage import raise_shortage

_TICKS_PER_SECOND: Final = os.sysconf("SC_CLK_TCK")

#: Marks in a process's environment: its instance, and the state directory of its supervisor.
INSTANCE_MARK = "ROSRM_INSTANCE"
SUPERVISOR_MARK = "ROSRM_SUPERVISOR"
#: Variable with the directory of the node's snapshots.
KEEP: Final = "ROSRM_KEEP"

#: Flag of the kernel's own threads (PF_KTHREAD).
_KERNEL_THREAD: Final = 0x200000
#: Longest duration of an execve, and the interval between two checks of one, seconds.
_EXECVE: Final = 1.0
_LOOK: Final = 0.001
#: Most bytes of one read.
_PART: Final = 1 << 16


class Stat(NamedTuple):
    """The fields of /proc/PID/stat; `start` (clock ticks since boot) tells a reused pid apart."""

    pid: int
    state: str
    parent: int
    group: int
    session: int
    start: int
    flags: int = 0

    @property
    def is_kernel_thread(self) -> bool:
        """Return True for a thread of the kernel, which has no program."""
        return bool(self.flags & _KERNEL_THREAD)

    @property
    def alive(self) -> bool:
        """Return True unless the process is a zombie that waits to be reaped, or dead."""
        return self.state not in "ZX"


def read_stat(pid: int) -> Stat | None:
    """Return the fields of /proc/PID/stat; None: there is no such process.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            text = file.read()
    except OSError as error:
        raise_shortage(error)
        return None
    # The second field, the name in brackets, may itself hold spaces and brackets.
    fields = text[text.rindex(b")") + 2 :].split()
    return Stat(
        pid, fields[0].decode(), int(fields[1]), int(fields[2]), int(fields[3]), int(fields[19]),
        int(fields[6]),
    )  # fmt: skip


def content(path: str) -> bytes:
    """Return the content of a file that the kernel generates.

    The file objects of Python make four further system calls for each file.

    Raises:
        OSError: it cannot be opened or read.
    """
    file, parts = os.open(path, os.O_RDONLY | os.O_CLOEXEC), []
    try:
        while part := os.read(file, _PART):
            parts.append(part)
    finally:
        os.close(file)
    return b"".join(parts)


def open_pidfd(pid: int) -> int:
    """Return a descriptor that is readable once a process has ended; -1: none can be had.

    A filter of system calls, or an old kernel, may refuse it.

    Raises:
        ProcessLookupError: there is no such process.
    """
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        raise
    except OSError:
        with contextlib.suppress(PermissionError):  # it runs as another user
            os.kill(pid, 0)  # noqa: TID251 - a question; a refused call does not tell that the process has ended
        return -1


def inner_pid(pid: int, thread: int = 0) -> int:
    """Return the id of a process, or of one of its threads, in its own pid namespace.

    Raises:
        OSError: it has ended.
    """
    path = f"/proc/{pid}/task/{thread or pid}/status"
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("NSpid:"):
                return int(line.split()[-1])
    return thread or pid


def ticks_now() -> int:
    """Return the start time that /proc would show for a process started now, in clock ticks."""
    return int(clocks.boot_time() * _TICKS_PER_SECOND)


def was_born(stat: Stat, birth: int) -> bool:
    """Return True if the process started within a second of `birth`: pids are not reused so soon.

    Taking the time at each spawn is some 100 us cheaper than reading the start time from /proc.
    """
    return birth - 1 <= stat.start <= birth + _TICKS_PER_SECOND


def read_environment(pid: int) -> list[bytes]:
    """Return the variables that a process got from its last execve.

    During an execve /proc shows none, because the kernel has dropped the old ones and not yet
    copied the new ones. So this function waits for the end of the execve.

    Raises:
        OSError: the process has ended, may not be read by us, or its execve did not end.
    """
    deadline = clocks.awake_time() + _EXECVE
    while True:
        with open(f"/proc/{pid}/environ", "rb") as file:
            variables = file.read()
        if variables or _has_no_environment(pid):
            return variables.split(b"\0")
        if clocks.awake_time() > deadline:
            raise TimeoutError(errno.ETIMEDOUT, f"its execve did not end within {_EXECVE:g} s")
        time.sleep(_LOOK)


def _has_no_environment(pid: int) -> bool:
    """Return True if the process was started without variables, or has no memory (kernel thread).

    During an execve the end of the environment (env_end) is 0.
    """
    with open(f"/proc/{pid}/stat", "rb") as file:
        text = file.read()
    fields = text[text.rindex(b")") + 2 :].split()
    memory, start, end = (int(fields[index]) for index in (20, 47, 48))
    return memory == 0 or (end > 0 and start == end)


def read_marks(pid: int) -> tuple[str, str]:
    """Return instance and supervisor from a process's environment; "" for each that is missing.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        variables = read_environment(pid)
    except OSError as error:
        raise_shortage(error)
        return "", ""
    marks = {}
    for variable in variables:
        name, _, value = variable.partition(b"=")
        marks[name] = value
    return (
        os.fsdecode(marks.get(INSTANCE_MARK.encode(), b"")),
        os.fsdecode(marks.get(SUPERVISOR_MARK.encode(), b"")),
    )


def everyone() -> Iterator[Stat]:
    """Yield every living process; a walk over /proc, so only for rare occasions.

    Raises:
        OSError: the system has no room for a look.
    """
    for name in os.listdir("/proc"):
        if name.isdigit():
            stat = read_stat(int(name))
            if stat is not None and stat.alive:
                yield stat


def find_members(leader: int, mark: str, supervisor: str) -> list[Stat]:
    """Return the living processes of the instance whose session leader `leader` has ended.

    The kernel does not reuse a pid that still names a session or group. So where another process
    has this pid now, the old session is empty, and the session of this number is a stranger's.
    """
    stats = list(everyone())
    is_reused = any(stat.pid == leader for stat in stats)
    return [
        stat
        for stat in stats
        if (not is_reused and leader in (stat.session, stat.group))
        or read_marks(stat.pid) == (mark, supervisor)
    ]


def find_marked(supervisor: str) -> dict[str, list[Stat]]:
    """Return the living processes of a supervisor's instances, by instance mark.

    Only the marks count, because the pid of an instance's leader may have been reused.
    """
    found: dict[str, list[Stat]] = {}
    for stat in everyone():
        mark, owner = read_marks(stat.pid)
        if mark and owner == supervisor:
            found.setdefault(mark, []).append(stat)
    return found


def group_is_alive(leader: int) -> bool:
    """Return True if the group has a process; call this right after the leader was reaped."""
    try:
        os.killpg(leader, 0)  # noqa: TID251 - a question
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # a process exists, though it runs as another user
    return True


def own_children() -> list[int]:
    """Return the pids of this process's children, adopted ones included."""
    me = os.getpid()
    try:
        return [int(pid) for pid in content(f"/proc/self/task/{me}/children").split()]
    except FileNotFoundError:  # a kernel without CONFIG_PROC_CHILDREN
        return [stat.pid for stat in everyone() if stat.parent == me]


def descendants(pid: int) -> list[int]:
    """Return the pids of a process's children, of their children, and so on; not its own.

    Raises:
        OSError: the system has no room for a look.
    """
    found = [pid]
    for one in found:  # grows
        found += _children_of(one)
    return found[1:]


def _children_of(pid: int) -> list[int]:
    """Return the pids of the children of all threads of a process; [] if it has ended."""
    found: list[bytes] = []
    for thread in _threads_of(pid):
        children = f"/proc/{pid}/task/{thread}/children"
        try:
            with open(children, "rb") as file:
                found += file.read().split()
        except OSError as error:  # it may have ended
            raise_shortage(error)
    return [int(child) for child in found]


def _threads_of(pid: int) -> list[str]:
    """Return the ids of the threads of a process; [] if it has ended."""
    try:
        return os.listdir(f"/proc/{pid}/task")
    except OSError as error:
        raise_shortage(error)
        return []


def command_line(pid: int) -> list[str]:
    """Return the words of a process's command line; [] if it has none, or has ended.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            text = file.read()
    except OSError as error:
        raise_shortage(error)
        return []
    return [os.fsdecode(word) for word in text.removesuffix(b"\0").split(b"\0")] if text else []


def user_ids(pid: int) -> set[int]:
    """Return the real, effective and saved user id of a process; empty if it has ended.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        with open(f"/proc/{pid}/status", "rb") as file:
            text = file.read()
    except OSError as error:
        raise_shortage(error)
        return set()
    line = next(line for line in text.splitlines() if line.startswith(b"Uid:"))
    return {int(word) for word in line.split()[1:4]}


def boot_id() -> str:
    """Return the id of this boot; a process recorded under another id does not run any more."""
    with open("/proc/sys/kernel/random/boot_id") as file:
        return file.read().strip()
