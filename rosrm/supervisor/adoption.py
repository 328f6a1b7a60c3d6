"""Adoption of a process that was started without rosrm: the checks before it.

An adopted process is no child of the supervisor, and may share its session and its process group
with others, such as the shell in which it was started. So it consists of its leader and the
leader's descendants, and its exit code is never known.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Final

from rosrm.core.supervisor.rules import AdoptionRule, Key
from rosrm.supervisor import procfs
from rosrm.supervisor.procfs import Stat
from rosrm.supervisor.spawn_error import SpawnError

#: Modules of rosrm's own processes. A component container belongs to the user.
_OWN_MODULES: Final = ("rosrm.cli", "rosrm.master", "rosrm.slave", "rosrm.supervisor")
_BARE: Final = "rosrm/supervisor/bare_interpreter.py"
#: Words of a command line before the arguments of a program.
_FIRST_WORDS: Final = 5

#: Returns the instance of which a process is the leader or a descendant; None: of none.
OwnerOf = Callable[[int], Key | None]


def check(rule: AdoptionRule, owner_of: OwnerOf) -> Stat:
    """Return the process that a rule names; raises `SpawnError` if it cannot be adopted."""
    stat = _identified(rule)
    fault = why_not(stat) or _why_managed(stat.pid, owner_of)
    if fault:
        raise SpawnError(f"process {stat.pid} is not adopted: {fault}")
    return stat


def _identified(rule: AdoptionRule) -> Stat:
    """Return the process that a rule names; raises `SpawnError` if it has ended."""
    stat = procfs.read_stat(rule.pid)
    if rule.boot != procfs.boot_id():
        raise SpawnError(f"process {rule.pid} is not adopted: it ran before a restart of this host")
    if stat is None or not stat.alive:
        raise SpawnError(ended(rule))
    if stat.start != rule.birth:
        raise SpawnError(f"{ended(rule)}, and another process has its pid now")
    return stat


def ended(rule: AdoptionRule) -> str:
    """Return a sentence on a process that has ended before it was adopted."""
    return f"process {rule.pid} is not adopted: it has ended"


def why_not(stat: Stat) -> str:
    """Return why a process cannot be adopted on any host; "": no reason is known."""
    if stat.pid == 1:
        return "it is the first process of its machine"
    if stat.is_kernel_thread:
        return "it is a thread of the kernel"
    if procfs.user_ids(stat.pid) != {os.geteuid()}:
        return f"it runs as another user than this one (uid {os.geteuid()})"
    if is_own(procfs.command_line(stat.pid)):
        return "it belongs to rosrm"
    below = procfs.descendants(stat.pid)
    if os.getpid() in below or any(is_own(procfs.command_line(pid)) for pid in below):
        return "a process of rosrm is among its descendants"
    return ""


def _why_managed(pid: int, owner_of: OwnerOf) -> str:
    for member in (pid, *procfs.descendants(pid)):
        what = "it" if member == pid else f"its descendant {member}"
        owner = owner_of(member)
        if owner is not None:
            return f"{what} belongs to the process {owner[0]} already"
        if procfs.read_marks(member)[1]:
            return f"{what} was started by rosrm already"
    return ""


def is_own(words: Sequence[str]) -> bool:
    """Return True for the command line of a process of rosrm."""
    first = words[:_FIRST_WORDS]
    if any(word.endswith(_BARE) for word in first):
        return True
    if "-m" in first[:-1]:
        return first[first.index("-m") + 1].startswith(_OWN_MODULES)
    names = [os.path.basename(word) for word in first]
    while names and names[0].startswith(("python", "ros2")):
        del names[0]
    return names[:1] == ["rosrm"] and names[1:2] != ["container"]
