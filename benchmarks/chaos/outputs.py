"""Output of the workload: the lines of `plain.Lines`, read as they grow, as runs.

Imports nothing from rosrm.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Run:
    """The lifetime of one operating system process, by its lines.

    Attributes:
        instance, host, pid, born: the identity; the pid is the one in its host.
        first, last: monotonic time of the first and last "active"; 0: there was none.
        first_number, last_number: the numbers in those lines.
        word, word_at: word and time of its last line.
        backwards: how often a number did not exceed the one before.
        version: of its application; 0: it has none.
    """

    instance: str
    host: str
    pid: int
    born: float
    first: float = 0.0
    last: float = 0.0
    first_number: int = 0
    last_number: int = 0
    word: str = ""
    word_at: float = 0.0
    backwards: int = 0
    version: int = 0

    def take(self, time: float, word: str, number: int) -> None:
        """Add a line."""
        self.word, self.word_at = word, time
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
        what = f"{self.instance} version {self.version}" if self.version else self.instance
        return f"{what} pid {self.pid} on {self.host} ({active}, {numbers}, {self.word})"


@dataclass
class _File:
    offset: int = 0
    rest: bytes = b""
    runs: dict[tuple[str, ...], Run] = field(default_factory=dict)


class Outputs:
    """All runs of all processes, from the files in a folder.

    Args:
        folder: of the lines; a file has the name of its process.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, _File] = {}

    def read(self, process: str) -> list[Run]:
        """Return the runs of a process, in order of birth, with all lines written so far."""
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
            time, instance, host, pid, born, version, word, number = line.decode().split()
            key = (instance, host, pid, born)
            run = known.runs.get(key)
            if run is None:
                run = known.runs[key] = Run(
                    instance, host, int(pid), float(born), version=int(version)
                )  # fmt: skip
            run.take(float(time), word, int(number))
        return sorted(known.runs.values(), key=lambda run: run.born)

    def forget(self, process: str, before: float) -> None:
        """Drop the judged runs, whose last line is older than a time."""
        known = self._files.get(process)
        if known is not None:
            known.runs = {key: run for key, run in known.runs.items() if run.word_at >= before}
