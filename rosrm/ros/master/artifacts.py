"""Services of the master for the contents of artifacts: clients send them, slaves fetch them.

A thread reads and writes the files, so that the loop never waits for the disk. The parts go through
the loop, at most `max_rate` bytes a second, so that it has time for readings.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from functools import partial
from typing import Any, Final

from rosrm import clocks
from rosrm.artifacts.store import ArtifactStore
from rosrm.errors import Refused, describe_fault
from rosrm.keys.security import Authority
from rosrm.ros import names
from rosrm.ros.control import accepted, refused, version_refusal
from rosrm.ros.sealed import SealedEndpoints, SealedRequest
from rosrm.runtime.worker import Worker
from rosrm_msgs import srv

#: Most bytes of one part.
MOST: Final = 256 << 10
#: Seconds of the rate for which requests may wait. It is less than the time-out of a request, so
#: that no answer comes after the request was sent again.
_LONGEST_WAIT: Final = 2.0
_NONE: Final[AbstractSet[str]] = frozenset()


class ArtifactServices:
    """The services `store_artifact` and `read_artifact`.

    Args:
        worker: the thread that uses the store.
        keep: returns the digests that processes refer to.
        max_rate: highest rate of receiving and sending together, in bytes a second.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], store: ArtifactStore, worker: Worker,
        *, keep: Callable[[], AbstractSet[str]], max_rate: float,
    ) -> None:  # fmt: skip
        self._store = store
        self._worker = worker
        self._keep = keep
        self._rate = max_rate
        self._budget, self._budget_at = max_rate / 10.0, clocks.boot_time()
        #: Bytes and beginning of each part that waits for the rate, and all these bytes.
        self._waiting: deque[tuple[int, Callable[[], None]]] = deque()
        self._queued = 0
        path = names.Names(endpoints.participant.settings.namespace)
        endpoints.serve(srv.StoreArtifact, path(names.STORE_ARTIFACT), self._take_part)
        endpoints.serve(srv.ReadArtifact, path(names.READ_ARTIFACT), self._take_read)

    def _take_part(self, request: srv.StoreArtifact.Request, opened: SealedRequest) -> None:
        sender = f"{opened.peer.grant.principal} {opened.run.hex()}"
        keep = _NONE if request.data else self._keep()
        take = partial(
            self._store.take, sender, request.digest, request.size, request.offset,
            bytes(request.data), keep=keep,
        )  # fmt: skip

        def taken(next_offset: int) -> None:
            opened.answer(srv.StoreArtifact.Response(answer=accepted(), next_offset=next_offset))

        self._queue(srv.StoreArtifact, request, opened, len(request.data), take, taken)

    def _take_read(self, request: srv.ReadArtifact.Request, opened: SealedRequest) -> None:
        most = min(request.max_bytes or MOST, MOST)
        read = partial(self._store.read, request.digest, request.offset, most)

        def done(part: tuple[int, bytes]) -> None:
            answer, data = accepted(), array("B", part[1])
            opened.answer(srv.ReadArtifact.Response(answer=answer, size=part[0], data=data))

        self._queue(srv.ReadArtifact, request, opened, most, read, done)

    def _queue(
        self, kind: Any, request: Any, opened: SealedRequest, size: int,
        work: Callable[[], Any], then: Callable[[Any], None],
    ) -> None:  # fmt: skip
        """Let the thread do the work of a request as soon as the rate allows its bytes."""
        fault = version_refusal(request.protocol_version, str(opened.peer.grant.principal))
        refuse = partial(_refuse, kind, opened)
        if fault:
            refuse(Refused(fault, "version"))
        elif self._queued > _LONGEST_WAIT * self._rate:
            refuse(Refused("other hosts and clients transfer artifacts", "busy"))
        else:
            self._queued += size
            self._waiting.append((size, partial(self._worker.run, work, then, refuse)))
            self.advance(clocks.boot_time())

    def advance(self, now: float) -> None:
        """Begin with the parts that the rate allows; called several times a second."""
        most = self._rate / 10.0
        self._budget = min(most, self._budget + self._rate * (now - self._budget_at))
        self._budget_at = now
        while self._waiting and self._budget > 0.0:
            size, begin = self._waiting.popleft()
            self._budget -= size
            self._queued -= size
            begin()


def _refuse(kind: Any, opened: SealedRequest, error: Exception) -> None:
    code, message = "failed", describe_fault(error)
    if isinstance(error, Refused):
        code, message = error.code, str(error)
    opened.answer(kind.Response(answer=refused(code, message)))
