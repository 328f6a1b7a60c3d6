"""Judge of a lab by its live processes and their output; imports nothing from rosrm.

`Oracle.deviations` returns the deviations at this moment. `Oracle.history` (by `rules`) returns
those since the last time that there was none.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from benchmarks.chaos import rules
from benchmarks.chaos.allowances import Disturbance, Guarantees
from benchmarks.chaos.outputs import Outputs
from benchmarks.chaos.reality import Member, members
from benchmarks.chaos.rules import Judgement

#: Seconds: a process with an "active" line younger than this is active, on a busy machine.
FRESH: Final = 1.0


@dataclass
class Versions:
    """The versions of the application between two judgements.

    Attributes:
        processes: names of its processes.
        former: that ran before.
        newest: that was requested.
        returned: why the application returned to `former`, as it reports; "": it did not.
        repeated: the request was sent twice, so the application may have returned in between.
    """

    processes: tuple[str, ...] = ()
    former: int = 0
    newest: int = 0
    returned: str = ""
    repeated: bool = False

    @property
    def expected(self) -> int:
        """Return the version that all processes have in the end."""
        return self.former if self.returned else self.newest


@dataclass
class AcceptedRequests:
    """The accepted requests.

    Attributes:
        versions: of the application.
        services: guarantees by name.
        jobs: by name, the time of their acceptance.
        line: jobs that run one after the other, in the order of submission.
        canaries: by host, the job that only it can run, submitted after all faults were undone.
    """

    services: dict[str, Guarantees] = field(default_factory=dict)
    jobs: dict[str, float] = field(default_factory=dict)
    line: list[str] = field(default_factory=list)
    canaries: dict[str, str] = field(default_factory=dict)
    versions: Versions = field(default_factory=Versions)


@dataclass(frozen=True)
class Deviation:
    """A deviation at this moment."""

    kind: str
    name: str
    text: str


class Oracle:
    """Observer of the processes and outputs of a lab.

    Args:
        lab: its name.
        folder: of the lines.
        accepted: the accepted requests; the caller changes them.

    Attributes:
        counts: number of live processes, at each look.
    """

    def __init__(self, lab: str, folder: Path, accepted: AcceptedRequests) -> None:
        self._lab = lab
        self._outputs = Outputs(folder)
        self._accepted = accepted
        self._done: set[str] = set()
        self.counts: list[int] = []

    def look(self) -> list[Member]:
        """Return every live process of the workload, and append their number to `counts`."""
        found = members(self._lab)
        self.counts.append(len(found))
        return found

    # --- at this moment -----------------------------------------------------------------------

    def deviations(self) -> list[Deviation]:
        """Return the deviations at this moment; empty: there is none."""
        now = time.monotonic()
        there: dict[str, list[Member]] = {}
        for member in self.look():
            there.setdefault(member.process, []).append(member)
        found: list[Deviation] = []
        for name, guarantees in self._accepted.services.items():
            found += self._about_service(name, guarantees, there.pop(name, []), now)
        for name in self._accepted.jobs:
            found += self._about_job(name, there.pop(name, []))
        found += [
            Deviation("orphans", name, f"{name} was not requested, and runs: {_listed(left)}")
            for name, left in there.items()
        ]
        found += self._about_versions(now)
        return found

    def _about_versions(self, now: float) -> Iterator[Deviation]:
        versions = self._accepted.versions
        for name in versions.processes:
            for run in self._outputs.read(name):
                if run.last > now - FRESH and run.version != versions.expected:
                    why = f"returned: {versions.returned}" if versions.returned else "not returned"
                    text = f"{name} is not at version {versions.expected} ({why}): {run}"
                    yield Deviation("versions", name, text)

    def _about_service(
        self, name: str, guarantees: Guarantees, there: list[Member], now: float
    ) -> Iterator[Deviation]:
        fresh = [run for run in self._outputs.read(name) if run.word_at > now - FRESH]
        runs = [run for run in fresh if run.last > now - FRESH]
        owners = {run.instance for run in runs}
        if not runs:
            yield Deviation("lost", name, f"{name}: no instance is active; there: {_listed(there)}")
        elif len(runs) > 1:
            active = "; ".join(map(str, runs))
            yield Deviation("doubled", name, f"{name}: more than one is active: {active}")
        sizes = Counter(one.instance for one in there)
        extra = {instance for instance in sizes if instance not in owners}
        allowed = int(guarantees.standby)
        if len(extra) > allowed:
            yield Deviation(
                "orphans", name, f"{name}: instances beside its owner: {_listed(there)}"
            )
        elif len(extra) < allowed:
            yield Deviation("standby", name, f"{name} has no standby: {_listed(there)}")
        elif guarantees.standby and len({one.host for one in there}) < 2:
            yield Deviation("standby", name, f"{name}: its standby is on the same host")
        elif guarantees.standby and "restored" not in [run.word for run in fresh]:
            yield Deviation("standby", name, f"{name}: its standby receives no state")
        if any(size != guarantees.members for size in sizes.values()):
            text = (
                f"{name}: an instance has {guarantees.members} processes; there: {_listed(there)}"
            )
            yield Deviation("orphans", name, text)

    def _about_job(self, name: str, there: list[Member]) -> Iterator[Deviation]:
        if name not in self._done and any(run.word == "done" for run in self._outputs.read(name)):
            self._done.add(name)
        if name not in self._done:
            yield Deviation("lost", name, f"the job {name} is not done; there: {_listed(there)}")
        elif there:
            yield Deviation("orphans", name, f"the job {name} is done, and runs: {_listed(there)}")

    def left(self) -> list[Deviation]:
        """Return the processes that still run after everything was ended."""
        found: dict[str, list[Member]] = {}
        for member in members(self._lab):
            found.setdefault(member.process, []).append(member)
        return [
            Deviation("orphans", name, f"{name} runs on after the end: {_listed(those)}")
            for name, those in found.items()
        ]

    # --- since the last time ------------------------------------------------------------------

    def history(self, disturbances: list[Disturbance]) -> Judgement:
        """Judge the time since the last call; to be called while there is no deviation.

        Args:
            disturbances: of the lab in that time.
        """
        judged, versions = Judgement(), self._accepted.versions
        reached = {
            host: runs[0].born
            for host, name in self._accepted.canaries.items()
            if (runs := self._outputs.read(name))
        }
        for name, guarantees in self._accepted.services.items():
            chain = rules.chain(self._outputs.read(name))
            judged.add(rules.judge_service(name, guarantees, chain, disturbances, reached))
            if name in versions.processes:
                judged.violations += rules.judge_versions(
                    name, chain, versions.former, versions.newest,
                    may_return=bool(versions.returned) or versions.repeated,
                )  # fmt: skip
            if chain:
                self._outputs.forget(name, before=chain[-1].word_at)
        for name, accepted in self._accepted.jobs.items():
            judged.add(rules.judge_job(name, accepted, self._outputs.read(name), disturbances))
        judged.violations += rules.judge_line(
            {name: self._outputs.read(name) for name in self._accepted.line}
        )
        self._forget_jobs()
        return judged

    def _forget_jobs(self) -> None:
        """Forget the judged jobs; a process of theirs that still appears is an orphan."""
        self._accepted.jobs.clear()
        self._accepted.line.clear()
        self._accepted.canaries.clear()

    def newest_runs(self, names: list[str]) -> Mapping[str, list[str]]:
        """Return the newest runs of some processes as text."""
        return {name: [str(run) for run in self._outputs.read(name)[-6:]] for name in names}


def _listed(there: list[Member]) -> str:
    return ", ".join(f"{one.instance} ({one.pid} on {one.host}, {one.state})" for one in there) or (
        "no process"
    )
