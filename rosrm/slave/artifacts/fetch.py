"""Transfer of one artifact from the master to this host."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from rosrm import clocks
from rosrm.artifacts.cache import ArtifactCache, Incoming, Used
from rosrm.errors import Refused, describe_fault
from rosrm.model.artifacts import Artifact
from rosrm.ros.slave.artifacts import ArtifactEndpoint, ArtifactPart
from rosrm.runtime.worker import Worker
from rosrm.wording import duration

#: Seconds for one answer; then the part is requested again.
_ANSWER: Final = 3.0
#: Seconds without a new part, in contact with the master, after which the fetch has failed.
PATIENCE: Final = 60.0
#: Most parts that wait for the disk.
_MOST_WAITING: Final = 4
#: Refusals after which the part is requested again: the master has restarted, or is busy.
_AGAIN: Final = frozenset({"stale", "busy"})


class Fetch:
    """Transfer of one artifact to this host.

    Args:
        worker: the thread that uses the cache.
        used: the artifacts of all processes here.
        has_master: returns True while a master has registered this host.
        ended: called once, with the reason of a failure; "": the artifact is here.

    Attributes:
        artifact: the fetched artifact.
        offset: bytes that have arrived.
    """

    def __init__(
        self, artifact: Artifact, endpoint: ArtifactEndpoint, cache: ArtifactCache, worker: Worker,
        *, used: Used, has_master: Callable[[], bool], ended: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.artifact = artifact
        self.offset = 0
        self._endpoint = endpoint
        self._cache = cache
        self._worker = worker
        self._has_master = has_master
        self._ended = ended
        self._has_ended = self._waits = False
        self._writing = 0
        self._incoming: Incoming | None = None
        self._progress_at = clocks.boot_time()
        self._silence = "the master's service was not found"
        worker.run(partial(cache.begin, artifact, used), self._begun, self._failed)

    def cancel(self) -> None:
        """Request no further part; `ended` is not called."""
        self._has_ended = True
        self._drop()

    def leave_out(self, seconds: float) -> None:
        """Do not count the seconds of a suspend of this machine."""
        self._progress_at += seconds

    def advance(self, now: float) -> None:
        """Request the next part, unless an answer or the disk is awaited."""
        if self._has_ended or self._incoming is None or self._is_complete:
            return
        if not self._has_master():  # it cannot choose another host
            self._progress_at = now
        if not self._waits and now - self._progress_at >= PATIENCE:
            none = f"no part of it came from the master within {PATIENCE:g} s"
            self._end(self._not_fetched(f"{none} ({self._silence})"))
        elif self._may_ask and self._endpoint.finds_master(now):
            self._waits = True
            self._endpoint.ask(self.artifact.digest, self.offset, now + _ANSWER, self._answered)

    @property
    def _may_ask(self) -> bool:
        return not self._waits and self._writing < _MOST_WAITING

    @property
    def _is_complete(self) -> bool:
        return self.offset >= self.artifact.size

    def _begun(self, incoming: Incoming) -> None:
        self._incoming = incoming
        if self._has_ended:
            self._drop()
        self.advance(clocks.boot_time())

    def _answered(self, part: ArtifactPart | Refused | None) -> None:
        if self._has_ended:
            return
        self._waits = False
        if part is None:
            self._silence = "the master does not answer"
        elif isinstance(part, Refused) and part.code in _AGAIN:
            self._silence = str(part)
            self._progress_at = clocks.boot_time()  # the master is alive
        elif isinstance(part, Refused):
            self._end(self._not_fetched(str(part)))
        elif part.size != self.artifact.size or not part.data:
            self._end(self._not_fetched(
                f"the master's archive with this digest has {part.size} bytes, but the process "
                f"names {self.artifact.size}"
            ))  # fmt: skip
        else:
            self._write(part.data)

    def _write(self, data: bytes) -> None:
        incoming, now = self._incoming, clocks.boot_time()
        assert incoming is not None, "no part is requested before the archive is open"
        self.offset += len(data)
        self._progress_at = now
        self._writing += 1
        self._worker.run(partial(incoming.write, data), self._written, self._failed)
        if self._is_complete:
            self._worker.run(partial(self._cache.finish, incoming), self._finished, self._failed)
        self.advance(now)

    def _written(self, _: None) -> None:
        self._writing -= 1
        self.advance(clocks.boot_time())

    def _finished(self, _: None) -> None:
        self._incoming = None
        if not self._has_ended:
            self._end("")

    def _failed(self, error: Exception) -> None:
        if not self._has_ended:
            refused = isinstance(error, Refused)  # its text names the artifact
            why = str(error) if refused else self._not_fetched(describe_fault(error))
            self._end(why)

    def _not_fetched(self, why: str) -> str:
        return f"artifact {self.artifact.name!r} was not fetched: {why}"

    def stalled(self, now: float) -> str:
        """Return why a fetch stalls, once a request has no answer in time; "": it does not."""
        waits = now - self._progress_at
        return f"{self._silence} ({duration(waits)})" if waits > _ANSWER else ""

    def _end(self, fault: str) -> None:
        self._has_ended = True
        self._drop()
        self._ended(fault)

    def _drop(self) -> None:
        """Delete what has arrived."""
        incoming, self._incoming = self._incoming, None
        if incoming is not None:
            drop = partial(self._cache.drop, incoming)
            self._worker.run(drop, lambda _: None, lambda _: None)
