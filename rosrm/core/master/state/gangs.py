"""Index of the gangs whose processes have not all started yet."""

from __future__ import annotations

from rosrm.core.master.state.process import GangKey, Process


class Gangs:
    """Processes that are placed together, by gang.

    Attributes:
        members: gang to the names of those of its processes that have not started.
        judged: names of waiting processes to the time of a judgement, and why they do not even fit
            together on empty hosts; "": they may.
        version: counter of changes.
        returned: gangs of which a process has returned to the queue before its start.
    """

    def __init__(self) -> None:
        self.members: dict[GangKey | None, dict[str, None]] = {}
        self.judged: dict[tuple[str, ...], tuple[float, str]] = {}
        self.version = 0
        self.returned: dict[GangKey, None] = {}

    def add(self, process: Process) -> None:
        """Add a process that awaits its gang, unless it is known."""
        self.version += process.name not in self.members.setdefault(process.gang, {})
        self.members[process.gang][process.name] = None

    def leave(self, process: Process) -> None:
        """Let a process be placed alone from now on."""
        members = self.members.get(process.gang)
        if members is not None:
            members.pop(process.name, None)
            self.version += 1
            self.judged.clear()
            if not members:
                del self.members[process.gang]
        process.awaits_gang = False

    def of(self, process: Process) -> list[str]:
        """Return the names of all processes together with which a process is placed, or its own."""
        return list(self.members.get(process.gang, (process.name,)))

    def note_return(self, process: Process) -> None:
        """Note that a process has returned to the queue."""
        if process.gang is not None:
            self.returned[process.gang] = None
