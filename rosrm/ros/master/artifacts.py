"""Services of the master for the contents of artifacts: clients send them, slaves fetch them.

A thread reads and writes the files, so that the loop never waits for the disk. A part goes through
the loop, and the loop sends at most `max_rate` bytes a second, so that it has time for readings.
"""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from functools import partial
from typing import Any, Final

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
#: Most requests of slaves that wait for the rate.
_MOST_WAITING: Final = 4096
_NONE: Final[AbstractSet[str]] = frozenset()


class ArtifactServices:
    """The services `store_artifact` and `read_artifact`.

    Args:
        worker: the thread that uses the store.
        keep: returns the digests that processes refer to.
        max_rate: highest rate of sending, in bytes a second.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], store: ArtifactStore, worker: Worker,
        *, keep: Callable[[], AbstractSet[str]], max_rate: float,
    ) -> None:  # fmt: skip
        self._store = store
        self._worker = worker
        self._keep = keep
        self._rate = max_rate
        self._budget, self._budget_at = max_rate / 10.0, time.monotonic()
        self._waiting: deque[tuple[Any, SealedRequest]] = deque()
        path = names.Names(endpoints.participant.settings.namespace)
        endpoints.serve(srv.StoreArtifact, path(names.STORE_ARTIFACT), self._take_part)
        endpoints.serve(srv.ReadArtifact, path(names.READ_ARTIFACT), self._take_read)

    # --- from clients --------------------------------------------------------------------

    def _take_part(self, request: srv.StoreArtifact.Request, opened: SealedRequest) -> None:
        fault = version_refusal(request.protocol_version, "a client")
        if fault:
            opened.answer(srv.StoreArtifact.Response(answer=refused("version", fault)))
            return
        sender = f"{opened.peer.grant.principal} {opened.run.hex()}"
        keep = _NONE if request.data else self._keep()
        take = partial(
            self._store.take, sender, request.digest, request.size, request.offset,
            bytes(request.data), keep=keep,
        )  # fmt: skip

        def taken(next_offset: int) -> None:
            opened.answer(srv.StoreArtifact.Response(answer=accepted(), next_offset=next_offset))

        self._worker.run(take, taken, partial(_refuse, srv.StoreArtifact, opened))

    # --- to slaves -----------------------------------------------------------------------

    def _take_read(self, request: srv.ReadArtifact.Request, opened: SealedRequest) -> None:
        fault = version_refusal(request.protocol_version, "a slave")
        code = "version"
        if not fault and len(self._waiting) >= _MOST_WAITING:
            fault, code = f"{_MOST_WAITING} other requests wait", "busy"
        if fault:
            opened.answer(srv.ReadArtifact.Response(answer=refused(code, fault)))
            return
        self._waiting.append((request, opened))
        self.advance(time.monotonic())

    def advance(self, now: float) -> None:
        """Read the parts that the rate allows; called several times a second."""
        most = self._rate / 10.0
        self._budget = min(most, self._budget + self._rate * (now - self._budget_at))
        self._budget_at = now
        while self._waiting and self._budget > 0.0:
            request, opened = self._waiting.popleft()
            size = min(request.max_bytes or MOST, MOST)
            self._budget -= size
            self._worker.run(
                partial(self._store.read, request.digest, request.offset, size),
                partial(_send, opened), partial(_refuse, srv.ReadArtifact, opened),
            )  # fmt: skip


def _send(opened: SealedRequest, part: tuple[int, bytes]) -> None:
    size, data = part
    response = srv.ReadArtifact.Response(answer=accepted(), size=size, data=array("B", data))
    opened.answer(response)


def _refuse(kind: Any, opened: SealedRequest, error: Exception) -> None:
    code, message = "failed", describe_fault(error)
    if isinstance(error, Refused):
        code, message = error.code, str(error)
    opened.answer(kind.Response(answer=refused(code, message)))
