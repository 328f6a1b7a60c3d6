"""What the workload said of itself: the lines of `plain.Lines`, read as they grow, as runs.

Knows nothing of rosrm.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Run:
    """One life of one operating system process, as its lines tell it.

    Attributes:
        instance, host, pid, born: who it is; the pid as its host numbers it.
        first, last: monotonic time of the first and last "active"; 0: there was none.
        first_number, last_number: said with them.
        told: its last word, and when.
        backwards: how often a number did not exceed the one before it.
    """

    instance: str
    host: str
    pid: int
    born: float
    first: float = 0.0
    last: float = 0.0
    first_number: int = 0
    last_number: int = 0
    told: str = ""
    told_at: float = 0.0
    backwards: int = 0

    def take(self, time: float, word: str, number: int) -> None:
        """One more line."""
        self.told, self.told_at = word, time
        if word != "active":
            return
        if not self.first:
            self.first, self.first_number = time, number
        elif number <= self.last_number:
            self.backwards += 1
        self.last, self.last_number = time, number

    def __str__(self) -> str:
        active = f"active {self.first:.2f}..{self.last:.2f}" if self.first else "never active"
        numbers = f"numbers {self.first_number}..{self.last_number}"
        return f"{self.instance} pid {self.pid} on {self.host} ({active}, {numbers}, {self.told})"


@dataclass
class _File:
    offset: int = 0
    rest: bytes = b""
    runs: dict[tuple[str, ...], Run] = field(default_factory=dict)


class Outputs:
    """All runs of all processes, from the files in a folder.

    Args:
        folder: of the lines; a file is called as its process.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, _File] = {}

    def read(self, process: str) -> list[Run]:
        """The runs of a process, in order of birth, with all that was said by now."""
        known = self._files.setdefault(process, _File())
        try:
            with (self._folder / process).open("rb") as file:
                file.seek(known.offset)
                new = file.read()
        except FileNotFoundError:
            new = b""
        known.offset += len(new)
        *lines, known.rest = (known.rest + new).split(b"\n")
        for line in lines:
            time, instance, host, pid, born, word, number = line.decode().split()
            key = (instance, host, pid, born)
            run = known.runs.get(key)
            if run is None:
                run = known.runs[key] = Run(instance, host, int(pid), float(born))
            run.take(float(time), word, int(number))
        return sorted(known.runs.values(), key=lambda run: run.born)

    def forget(self, process: str, before: float) -> None:
        """Drop the runs of which nothing was heard since a time; they were judged."""
        known = self._files.get(process)
        if known is not None:
            known.runs = {key: run for key, run in known.runs.items() if run.told_at >= before}
