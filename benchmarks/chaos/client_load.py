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
class ClientRequest:
    """One request.

    Attributes:
        persistent: it is repeated until the master accepts it.
        done: called by `ClientLoad.collect` when it was answered.
        answer: the last one.
        unsure: it was sent more than once because an answer was lost.
    """

    request: Mapping[str, Any]
    persistent: bool = True
    done: Callable[[ClientRequest], None] | None = None
    answer: dict[str, Any] = field(default_factory=dict)
    unsure: bool = False


class ClientLoad:
    """A client on the master's host of a lab, and its thread."""

    def __init__(self, lab: Lab, log: Path, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._queue: queue.Queue[ClientRequest | None] = queue.Queue()
        self._answered: queue.SimpleQueue[ClientRequest] = queue.SimpleQueue()
        self._open = 0
        self._leaving = False
        self._lab = lab
        self._log = log
        self._client = self._start_client()
        self._thread = threading.Thread(target=self._serve, name="client load", daemon=True)
        self._thread.start()

    def _start_client(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as sink:
            return self._lab.popen(
                DESK, [sys.executable, "-m", "benchmarks.chaos.client_process"], cwd=str(ROOT),
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
        self._client.kill()
        self._thread.join(10.0)
        self._client.communicate()

    def send(self, client_request: ClientRequest) -> ClientRequest:
        """Queue a request behind those sent before."""
        self._open += 1
        self._queue.put(client_request)
        return client_request

    def collect(self) -> bool:
        """Call `done` for each answered request; return True if no request is open."""
        while not self._answered.empty():
            client_request = self._answered.get()
            self._open -= 1
            if client_request.done is not None:
                client_request.done(client_request)
        return self._open == 0

    def _serve(self) -> None:
        while (client_request := self._queue.get()) is not None:
            self._run(client_request)
            self._answered.put(client_request)

    def _run(self, client_request: ClientRequest) -> None:
        while not self._leaving:
            client_request.answer = self._ask(client_request.request)
            if not client_request.persistent or _accepted(client_request):
                return
            client_request.unsure = client_request.unsure or _may_have_been_accepted(
                client_request.answer
            )
            self._tell(f"{client_request.request['do']} is retried: {client_request.answer}")
            time.sleep(_PAUSE)  # no master, or no room at the master: the client retries

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        to, source = self._client.stdin, self._client.stdout
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
        ended = self._client
        ended.communicate()
        if not self._leaving:
            self._client = self._start_client()
        return {"no_master": f"the client ended with {ended.returncode}, see {self._log}"}


def _may_have_been_accepted(answer: Mapping[str, Any]) -> bool:
    """Return True if the master may have accepted a request whose answer was lost.

    The client retries such a request, and the retry may come too late.
    """
    refusal = answer.get("refused", "")
    return "no_master" in answer or any(words in refusal for words in _UNKNOWN)


def _accepted(client_request: ClientRequest) -> bool:
    if client_request.unsure and _KNOWN in client_request.answer.get("refused", ""):
        return True
    return client_request.answer.keys().isdisjoint({"refused", "no_master"})
