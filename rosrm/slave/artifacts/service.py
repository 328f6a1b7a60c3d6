"""Preparation of the artifacts of an instance, before it starts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.artifacts.cache import ArtifactCache
from rosrm.errors import Refused, describe_fault
from rosrm.model.artifacts import Artifact
from rosrm.model.values import Assignment, InstanceId
from rosrm.ros.slave.artifacts import ArtifactEndpoint
from rosrm.runtime.worker import Worker
from rosrm.slave.artifacts.fetch import Fetch
from rosrm.wording import size as sized

_log = logging.getLogger("rosrm.slave")

#: Fetches at a time.
_MOST_FETCHES: Final = 2
#: Seconds between two reports of the progress.
_REPORT_PERIOD: Final = 1.0

#: Takes an assignment whose artifacts are here, or the reason why they are not; "": they are.
Done = Callable[[Assignment, str], None]


@dataclass(slots=True)
class _Preparation:
    """Artifacts that an instance waits for.

    Attributes:
        missing: artifacts that are not here; None: the cache was not searched yet.
        fetched: digests of those that were fetched for it.
    """

    assignment: Assignment
    done: Done
    missing: list[Artifact] | None = None
    fetched: set[str] = field(default_factory=set)
    reported_at: float = field(default_factory=clocks.boot_time)


class ArtifactService:
    """Artifacts of the instances of one host.

    Args:
        root: directory of the cache.
        max_size: most bytes of the cache.
        post: schedules a call in the loop; may be called from any thread.
        used: returns the artifacts of the instances that have not ended.
        has_master: returns True while a master has registered this host.
        report: reports to the master why an instance does not run yet.
    """

    def __init__(
        self, root: Path, max_size: int, endpoint: ArtifactEndpoint, *,
        post: Callable[[Callable[[], None]], None],
        used: Callable[[], list[tuple[Artifact, ...]]], has_master: Callable[[], bool],
        report: Callable[[InstanceId, str], None],
    ) -> None:  # fmt: skip
        self.root = root
        self._endpoint = endpoint
        self._cache = ArtifactCache(root, max_size)
        self._worker = Worker("artifacts", post)
        self._used = used
        self._has_master = has_master
        self._report = report
        self._preparing: dict[InstanceId, _Preparation] = {}
        self._fetches: dict[str, Fetch] = {}

    def prepare(self, assignment: Assignment, done: Done) -> None:
        """Fetch the artifacts of an instance that are not here, then call `done`."""
        self._preparing[assignment.instance] = _Preparation(assignment, done)
        self._look(assignment.instance)

    def is_preparing(self, instance: InstanceId) -> bool:
        """Return True if the start of an instance waits for artifacts."""
        return instance in self._preparing

    def forget(self, instance: InstanceId) -> None:
        """Cancel the preparation of an instance, and fetches that no other one waits for."""
        if self._preparing.pop(instance, None) is None:
            return
        wanted = {
            one.digest for waits in self._preparing.values() for one in waits.missing or ()
        }  # fmt: skip
        for digest in [digest for digest in self._fetches if digest not in wanted]:
            self._fetches.pop(digest).cancel()
        self._begin_fetches()  # of others, which waited for one of these to end

    def tick(self, now: float) -> None:
        """Continue all fetches, and report their progress; called several times a second."""
        self._endpoint.expire(now)
        for fetch in list(self._fetches.values()):
            fetch.advance(now)
        for waits in list(self._preparing.values()):
            if waits.missing and now - waits.reported_at >= _REPORT_PERIOD:
                waits.reported_at = now
                self._report(waits.assignment.instance, self._progress(waits, now))

    def leave_out(self, seconds: float) -> None:
        """Prolong all fetches by a suspend of this machine."""
        for fetch in self._fetches.values():
            fetch.leave_out(seconds)

    def _progress(self, waits: _Preparation, now: float) -> str:
        artifacts = {one.digest: one.size for one in waits.assignment.spec.artifacts}
        left, stalls = 0, set()
        for one in waits.missing or ():
            fetch = self._fetches.get(one.digest)
            left += one.size - (fetch.offset if fetch is not None else 0)
            stalls.add(fetch.stalled(now) if fetch is not None else "")
        whole = sum(artifacts.values())
        why = "; ".join(sorted(stalls - {""}))
        return f"fetches artifacts, {sized(whole - left)} of {sized(whole)}" + (
            f": {why}" if why else ""
        )

    # --- preparation ---------------------------------------------------------------------

    def _look(self, instance: InstanceId) -> None:
        """Search the cache for the artifacts of an instance."""
        waits = self._preparing[instance]
        artifacts = waits.assignment.spec.artifacts
        others = list(self._used())
        if artifacts in others:
            others.remove(artifacts)  # its own
        self._worker.run(
            partial(self._cache.missing, artifacts, others),
            partial(self._looked, instance), partial(self._fail, instance),
        )  # fmt: skip

    def _looked(self, instance: InstanceId, missing: list[Artifact]) -> None:
        waits = self._preparing.get(instance)
        if waits is None:
            return
        waits.missing = missing
        again = [one.name for one in missing if one.digest in waits.fetched]
        if again:
            self._finish(instance, f"artifact {again[0]!r} was changed or removed as it arrived")
        elif missing:
            self._begin_fetches()
        else:
            self._assemble(instance, waits.assignment.spec.artifacts)

    def _assemble(self, instance: InstanceId, artifacts: tuple[Artifact, ...]) -> None:
        self._worker.run(
            partial(self._cache.assemble, artifacts),
            lambda _: self._finish(instance, ""), partial(self._fail, instance),
        )  # fmt: skip

    def _begin_fetches(self) -> None:
        for waits in list(self._preparing.values()):
            for one in waits.missing or ():
                if len(self._fetches) >= _MOST_FETCHES:
                    return
                if one.digest not in self._fetches:
                    self._fetches[one.digest] = Fetch(
                        one, self._endpoint, self._cache, self._worker, used=self._used(),
                        has_master=self._has_master, ended=partial(self._fetched, one),
                    )  # fmt: skip

    def _fetched(self, artifact: Artifact, fault: str) -> None:
        del self._fetches[artifact.digest]
        if not fault:
            _log.info("artifact %s was fetched (%s)", artifact.name, sized(artifact.size))
        for instance, waits in list(self._preparing.items()):
            left = [one for one in waits.missing or () if one.digest != artifact.digest]
            if left == (waits.missing or []):
                continue
            waits.missing = left
            waits.fetched.add(artifact.digest)
            if fault:
                self._finish(instance, fault)
            elif not left:
                self._look(instance)
        self._begin_fetches()

    def _fail(self, instance: InstanceId, error: Exception) -> None:
        refused = isinstance(error, Refused)
        cannot = "the artifacts cannot be used here: "
        self._finish(instance, str(error) if refused else cannot + describe_fault(error))

    def _finish(self, instance: InstanceId, fault: str) -> None:
        waits = self._preparing.pop(instance, None)
        if waits is not None:
            waits.done(waits.assignment, fault)
