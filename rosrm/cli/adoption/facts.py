"""Facts about a process of this machine, read from /proc."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rosrm.errors import Refused
from rosrm.model.adoption import LARGEST_PID
from rosrm.supervisor import adoption, procfs
from rosrm.wording import reason_of

#: End of the path of a file that was removed, in a link of /proc.
_DELETED: Final = " (deleted)"


@dataclass(frozen=True, slots=True)
class ProcessFacts:
    """Command line and environment of a process that runs.

    Attributes:
        birth: start time in clock ticks since the boot.
        words: its command line.
        program: path of the file that it executes.
        directory: its working directory.
        has_ros: it has loaded the client library of ROS 2.
    """

    pid: int
    birth: int
    words: tuple[str, ...]
    program: str
    directory: str
    environment: Mapping[str, str] = field(repr=False)
    has_ros: bool = False


def read_facts(pid: int) -> ProcessFacts:
    """Read the facts about a process; raises `Refused` if it cannot be adopted."""
    stat = procfs.read_stat(pid) if 0 < pid <= LARGEST_PID else None
    if stat is None or not stat.alive:
        raise Refused(f"no process {pid} runs on this machine")
    fault = adoption.why_not(stat)
    if not fault and procfs.read_marks(pid)[1]:
        fault = f"it is the instance {procfs.read_marks(pid)[0]} of rosrm already"
    if fault:
        raise Refused(f"process {pid} is not adopted: {fault}")
    try:
        program, directory = (
            str(Path(f"/proc/{pid}/{link}").readlink()) for link in ("exe", "cwd")
        )
        words = tuple(procfs.command_line(pid))
        environment, has_ros = environment_of(pid), _has_ros(pid)
    except OSError as error:
        raise Refused(f"process {pid} cannot be read: {reason_of(error)}") from None
    program, directory = program.removesuffix(_DELETED), directory.removesuffix(_DELETED)
    return ProcessFacts(pid, stat.start, words, program, directory, environment, has_ros)


def environment_of(pid: int) -> dict[str, str]:
    """Return the environment with which a process was started; raises `OSError`."""
    pairs = (os.fsdecode(one).partition("=") for one in procfs.read_environment(pid) if one)
    return {name: value for name, _, value in pairs}


def _has_ros(pid: int) -> bool:
    return b"/librcl.so" in Path(f"/proc/{pid}/maps").read_bytes()
