"""Requests to the master, by a client on its host.

The client runs in a thread, because the faults of a round have times to keep.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from benchmarks.chaos.cluster import DESK
from benchmarks.chaos.work import ROOT
from rosrm_lab import Lab

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds between two attempts.
_PAUSE: Final = 0.3
#: Part of the master's answer to a submission that it had accepted already.
_KNOWN: Final = "in use already"
#: Parts of the answers to a request that a master may have accepted before it was killed.
_UNKNOWN: Final = ("it is not known whether", "old by this side's clock")


@dataclass
class Errand:
    """One request.

    Attributes:
        persistent: it is repeated until the master accepts it.
        done: called by `Errands.collect` when it was answered.
        answer: the last one.
        unsure: it was sent more than once because an answer was lost.
    """

    request: Mapping[str, Any]
    persistent: bool = True
    done: Callable[[Errand], None] | None = None
    answer: dict[str, Any] = field(default_factory=dict)
    unsure: bool = False


class Errands:
    """A client on the desk (the master's host) of a lab, and its thread."""

    def __init__(self, lab: Lab, log: Path, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._queue: queue.Queue[Errand | None] = queue.Queue()
        self._answered: queue.SimpleQueue[Errand] = queue.SimpleQueue()
        self._open = 0
        self._leaving = False
        self._lab = lab
        self._log = log
        self._desk = self._start_desk()
        self._thread = threading.Thread(target=self._serve, name="errands", daemon=True)
        self._thread.start()

    def _start_desk(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as sink:
            return self._lab.popen(
                DESK, [sys.executable, "-m", "benchmarks.chaos.desk"], cwd=str(ROOT),
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=sink,
            )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leaving = True
        self._queue.put(None)
        self._desk.kill()
        self._thread.join(10.0)
        self._desk.communicate()

    def send(self, errand: Errand) -> Errand:
        """Queue a request behind those sent before."""
        self._open += 1
        self._queue.put(errand)
        return errand

    def collect(self) -> bool:
        """Call `done` for each answered request; return True if no request is open."""
        while not self._answered.empty():
            errand = self._answered.get()
            self._open -= 1
            if errand.done is not None:
                errand.done(errand)
        return self._open == 0

    def _serve(self) -> None:
        while (errand := self._queue.get()) is not None:
            self._run(errand)
            self._answered.put(errand)

    def _run(self, errand: Errand) -> None:
        while not self._leaving:
            errand.answer = self._ask(errand.request)
            if not errand.persistent or _accepted(errand):
                return
            errand.unsure = errand.unsure or _may_have_been_taken(errand.answer)
            self._tell(f"{errand.request['do']} is asked again: {errand.answer}")
            time.sleep(_PAUSE)  # no master, or no room at the master: the client asks again

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        to, source = self._desk.stdin, self._desk.stdout
        assert to is not None
        assert source is not None
        try:
            to.write(json.dumps(request).encode() + b"\n")
            to.flush()
        except BrokenPipeError:
            line = b""
        else:
            line = source.readline()
        if not line:
            return self._ended()
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _ended(self) -> dict[str, Any]:
        """Start another client where this one has ended, unless this object is being closed."""
        ended = self._desk
        ended.communicate()
        if not self._leaving:
            self._desk = self._start_desk()
        return {"no_master": f"the client ended with {ended.returncode}, see {self._log}"}


def _may_have_been_taken(answer: Mapping[str, Any]) -> bool:
    """Return True if the master may have accepted a request whose answer was lost.

    The client retries such a request, and the retry may come too late.
    """
    refusal = answer.get("refused", "")
    return "no_master" in answer or any(words in refusal for words in _UNKNOWN)


def _accepted(errand: Errand) -> bool:
    if errand.unsure and _KNOWN in errand.answer.get("refused", ""):
        return True
    return errand.answer.keys().isdisjoint({"refused", "no_master"})
