"""Usage of one instance as its control group measures it: shared pages count once."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.model.values import InstanceId
from rosrm.shortage import is_directory, raise_unless_absent
from rosrm.supervisor.instance_groups import group_name, pids

#: Control groups of a supervisor: version, directory and controllers of each.
Trees = Iterable[tuple[int, str, tuple[str, ...]]]
#: Keys of memory.stat: bytes that the kernel cannot reclaim, as for a session without a group.
_USED: Final = {1: ("total_rss", "total_shmem"), 2: ("anon", "shmem")}


class _Files(NamedTuple):
    """Control files of a group.

    Attributes:
        group: first directory of the group; "": there is none.
        memory, cpu: file of the usage, "" for none, and version of its tree.
    """

    group: str
    memory: tuple[str, int]
    cpu: tuple[str, int]


class InstanceGroup:
    """The control group of one instance, below one directory for each tree.

    The directories are looked up when the group is first read, because most instances of a busy
    host end before that.

    Args:
        trees: of the supervisor; those without a group of the instance are left out.
    """

    def __init__(self, trees: Trees, instance: InstanceId) -> None:
        self._trees = trees
        self._name = group_name((instance.process, instance.number))

    @cached_property
    def _files(self) -> _Files:
        first, memory, cpu = "", ("", 0), ("", 0)
        for version, top, controllers in self._trees:
            group = str(Path(top, self._name))
            if not is_directory(group):
                continue
            first = first or group
            if "memory" in controllers:
                memory = (f"{group}/memory.stat", version)
            if version == 2 or "cpuacct" in controllers:
                file = "cpuacct.usage" if version == 1 else "cpu.stat"
                cpu = (f"{group}/{file}", version)
        return _Files(first, memory, cpu)

    @property
    def exists(self) -> bool:
        """Return True if the instance has a group."""
        return bool(self._files.group)

    def pids(self) -> list[int]:
        """Return the pids of all processes of the instance."""
        return pids(self._files.group)

    def cpu_time(self) -> float | None:
        """Return the CPU seconds of all its processes, ended ones included; None: not measured."""
        path, version = self._files.cpu
        text = _content(path)
        if not text:
            return None
        return int(text) / 1e9 if version == 1 else _numbers(text)["usage_usec"] / 1e6

    def memory(self) -> int | None:
        """Return anonymous and shared memory in bytes; None: not measured."""
        path, version = self._files.memory
        text = _content(path)
        if not text:
            return None
        numbers = _numbers(text)
        return sum(numbers[key] for key in _USED[version])


def _numbers(text: str) -> dict[str, int]:
    words = text.split()
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))


def _content(path: str) -> str:
    """Return the content of a control file; "": there is none.

    Raises:
        OSError: the file cannot be read now.
    """
    if not path:
        return ""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.read(descriptor, 1 << 14).decode()
        finally:
            os.close(descriptor)
    except OSError as error:  # the instance has ended, and its group is removed
        raise_unless_absent(error)
        return ""
