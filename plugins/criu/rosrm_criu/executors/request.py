"""What an executor of `criu` is asked, and what all of them need."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rosrm.errors import CriuError
from rosrm_criu.engine import process_tree

#: CRIU's logs go with the image; what matters of them is in the message.
_LOG: Final = re.compile(r" \((its )?log: [^)]*\)")

_turned_back: Final[set[str]] = set()
_turning: Final = threading.Lock()


@dataclass(frozen=True)
class Asked:
    """What every step is told.

    Attributes:
        process: name of it.
        source, destination: numbers of its instances.
        attempt: of the plan, also in what the node is asked.
        timeout: seconds for this step.
        host: name of this one.
        state: directory of its slave.
        pids: of the leaders of the instances that run here, by `process#number`.
        instances: so named, all that have not ended here.
        results: what the executors of earlier steps have answered, by their names.
        arguments: all that was told.
    """

    process: str
    source: int
    destination: int
    attempt: str
    timeout: float
    host: str
    state: Path
    pids: Mapping[str, int]
    instances: Sequence[str]
    results: Mapping[str, Any]
    arguments: Mapping[str, Any]

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Asked:
        """From what the slave has handed over."""
        here = arguments["here"]
        return cls(
            str(arguments["process"]), int(arguments["source"]), int(arguments["destination"]),
            str(arguments["attempt"]), float(arguments["timeout"]), str(here["host"]),
            Path(here["state"]), here["pids"], here["instances"], arguments.get("results", {}),
            arguments,
        )  # fmt: skip

    def pid(self, number: int) -> int:
        """Of the leader of an instance that lives here; 0: none does."""
        pid = self.pids.get(f"{self.process}#{number}", 0)
        return pid if pid and process_tree.is_alive(pid) else 0

    def leader(self, number: int) -> int:
        """As `pid`; raises `CriuError` where there is none."""
        pid = self.pid(number)
        if not pid:
            raise CriuError(f"{self.process}#{number} does not run on {self.host}")
        return pid


def turn_back(attempt: str) -> None:
    """The master has given an attempt up: what is under way for it goes no further."""
    with _turning:
        _turned_back.add(attempt)


def check_wanted(attempt: str) -> None:
    """Raise `CriuError` where an attempt was given up meanwhile."""
    with _turning:
        if attempt in _turned_back:
            raise CriuError("the move was undone")


@contextlib.contextmanager
def without_log_names() -> Iterator[None]:
    """What CRIU says goes to people without the names of its logs, which go with the image."""
    try:
        yield
    except CriuError as error:
        raise CriuError(_LOG.sub("", str(error))) from None
