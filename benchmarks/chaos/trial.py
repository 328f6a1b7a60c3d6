"""The loop: do a round of faults, undo them, wait for recovery, judge the round."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.chaos import work
from benchmarks.chaos.allowances import MOVES, Disturbance, Guarantees
from benchmarks.chaos.client_load import ClientLoad, ClientRequest
from benchmarks.chaos.cluster import HOSTS, LEASE_S, Cluster
from benchmarks.chaos.event_log import EventLog
from benchmarks.chaos.fault_injector import FaultInjector
from benchmarks.chaos.faults import Fault, Move, Round
from benchmarks.chaos.oracle import AcceptedRequests, Deviation, Oracle
from benchmarks.chaos.rollout import Rollout
from benchmarks.chaos.rules import Violation
from benchmarks.chaos.stalls import StallWatch, before_fences, confirmed, read_fences
from benchmarks.machine import say
from rosrm.extensions.registry import Registry
from rosrm_simulate.runs import checked, load_record, replay_record

#: Seconds after the last fault was undone within which all must be well.
SETTLE_S: Final = 60.0
#: The same for the beginning: everything starts at once, on few cores.
_BEGIN_S: Final = 180.0
#: Seconds between two looks.
_LOOK: Final = 0.1
_LOOK_AT_ALL: Final = 0.3
#: Looks in a row at which all must be well.
_STEADY: Final = 2
#: Seconds within which a requested migration has ended.
_MOVE: Final = 30.0
#: Processes of a violation whose events are printed, at most.
_EXPLAINED: Final = 3
#: Seconds of a canary: a job that only shows that its host accepts work.
_CANARY: Final = 0.1


class Stuck(Exception):
    """The deviations have lasted too long: this lab is of no more use."""


@dataclass
class Tally:
    """The totals of a benchmark.

    Attributes:
        by_kind: faults that were done.
        missed: skipped faults (no target to strike), by kind and reason.
        violations: by kind.
        allowed: deviations within the guarantees, by title.
        parted: seconds for which a former owner was active after the partition was healed.
        recovery: seconds from the undoing of the last fault of a round until all was well, by kind
            of the fault, or "burst" for rounds of several kinds.
        whole: the same, from the first fault on.
        applied: versions of the application: "good" and "faulty" ones, and those that it
            "returned" from.
        in_apply: faults that were done while a version was being applied, by kind.
        loads: load average of the machine at the end of each round.
        counts: live processes at each look, from the first round on.
        overloaded: rounds with a stall in which the master recorded the host as silent, or the host
            recorded a fence.
    """

    by_kind: Counter[str] = field(default_factory=Counter)
    missed: Counter[str] = field(default_factory=Counter)
    violations: Counter[str] = field(default_factory=Counter)
    allowed: Counter[str] = field(default_factory=Counter)
    parted: list[float] = field(default_factory=list)
    applied: Counter[str] = field(default_factory=Counter)
    in_apply: Counter[str] = field(default_factory=Counter)
    recovery: dict[str, list[float]] = field(default_factory=dict)
    whole: dict[str, list[float]] = field(default_factory=dict)
    loads: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    overloaded: int = 0
    rounds: int = 0

    @property
    def faults(self) -> int:
        """Return the number of faults that were done."""
        return self.by_kind.total()


class Trial:
    """A cluster, its workload, and its judge.

    Args:
        cluster: that was just started.
        lines: folder for the lines of the workload, empty.
        out: folder for violations.
        tally: counted in.
        stall_watch: of the master and the slaves of the cluster.
    """

    def __init__(
        self, cluster: Cluster, client_load: ClientLoad, lines: Path, out: Path,
        event_log: EventLog,
        tally: Tally, *, stall_watch: StallWatch,
    ) -> None:  # fmt: skip
        self._cluster = cluster
        self._client_load = client_load
        self._lines = lines
        self._out = out
        self._event_log = event_log
        self._tally = tally
        self._stall_watch = stall_watch
        self._accepted = AcceptedRequests()
        self._fault_injector = FaultInjector(cluster)
        self._oracle = Oracle(cluster.lab.name, lines, self._accepted)
        self._disturbances: list[Disturbance] = []
        self._services = {one.name: one for one in (*work.services(), *work.rolled())}
        self._rollout = Rollout(
            client_load, cluster.folder, lines, self._accepted.versions, event_log.add
        )
        self._guests = self._works = 0

    # --- begin and end ------------------------------------------------------------------------

    def begin(self) -> None:
        """Submit the services, apply the application, and wait until all is well."""
        entries = [one.entry(self._lines) for one in work.services()]
        guarantees = {name: guarantees_of(service) for name, service in self._services.items()}
        self._submit(entries, lambda _: self._accepted.services.update(guarantees))
        self._rollout.apply(faulty=False)
        self._await_well(0, "the beginning", _BEGIN_S)
        self._oracle.history([])
        self._rollout.close()
        self._stall_watch.take()
        self._oracle.counts = self._tally.counts

    def end(self) -> None:
        """Cancel everything, stop the slaves, and check for orphans and broken invariants."""
        names = list(self._accepted.services)
        self._accepted.services.clear()
        self._oracle.counts = []
        self._client_load.send(ClientRequest({"do": "cancel", "names": names}))
        self._await_well(0, "everything was cancelled", SETTLE_S)
        self._cluster.shut_down()
        if left := self._oracle.left():
            self._violated(0, [Violation(one.kind, one.name, one.text) for one in left])
        if broken := list(_broken_invariants(self._cluster.records)):
            self._violated(0, broken)

    # --- a round ------------------------------------------------------------------------------

    def round(self, drawn: Round) -> None:
        """Do the faults of a round, undo them, and judge.

        Raises:
            Stuck: a deviation has lasted too long; it was reported.
        """
        self._tally.rounds += 1
        self._submit_jobs(drawn)
        if drawn.renews:
            self._renew()
        if drawn.version:
            self._apply(drawn.version)
        number, begun = drawn.faults[-1].number, time.monotonic() + drawn.lead
        done = self._do(drawn, begun)
        self._submit_canaries(drawn.number)
        healed = time.monotonic()
        well = self._await_well(number, f"fault {number} was undone", SETTLE_S)
        self._disturbances += self._fault_injector.take_done()
        self._note_stalls()
        judged = self._oracle.history(self._disturbances)
        self._tally.applied["returned"] += bool(self._accepted.versions.returned)
        self._rollout.close()
        # A migration may outlast its round.
        recent = time.monotonic() - _MOVE
        self._disturbances = [
            disturbance
            for disturbance in self._disturbances
            if disturbance.kind in MOVES and disturbance.begun > recent
        ]
        self._tally.allowed += judged.allowed
        self._tally.parted += judged.parted
        if judged.violations:
            self._violated(number, judged.violations)
        if kinds := sorted(fault.kind for fault in done):
            word = kinds[0] if len(set(kinds)) == 1 else "burst"
            self._tally.recovery.setdefault(word, []).append(well - healed)
            self._tally.whole.setdefault(word, []).append(well - begun)
            took = well - healed
            say(f"{self._tally.faults} faults; {', '.join(kinds)}: recovered after {took:.1f} s")

    def _note_stalls(self) -> None:
        """Record the load, and as disturbances the stalls that silenced a host, by a record too."""
        self._tally.loads.append(os.getloadavg()[0])
        measured = self._stall_watch.take()
        if not measured:
            return
        since_boot = time.time() - time.monotonic()
        silent = self._ask_master({"do": "look"}).get("silent", [])
        moments = [(wall_time - since_boot, host) for wall_time, host in silent]
        stalls = confirmed(measured, moments, LEASE_S)
        fences = [
            fence
            for host in HOSTS
            for fence in read_fences(host, self._cluster.instance_record(host))
        ]
        fenced = before_fences(measured, fences)
        self._tally.overloaded += bool(stalls or fenced)
        self._disturbances += stalls + fenced
        for stall in measured:
            part = "the master" if "*" in stall.hosts else f"the slave of {', '.join(stall.hosts)}"
            remark = "; the master recorded it as silent" if stall in stalls else ""
            seconds = stall.ended - stall.begun
            self._event_log.add(f"{part} waited {seconds:.1f} s for a core{remark}")
        for stall in fenced:
            seconds = stall.ended - stall.begun
            self._event_log.add(f"{stall.instance} was fenced: {seconds:.1f} s without a core")

    def _do(self, drawn: Round, begun: float) -> list[Fault]:
        """Do everything of a round at its time; return the faults that were done."""
        done: list[Fault] = []

        def begin(fault: Fault) -> None:
            why_not = self._fault_injector.begin(fault)
            self._event_log.add(f"{fault}{': not done, ' + why_not if why_not else ''}")
            if why_not:
                self._tally.missed[f"{fault.kind}: {why_not}"] += 1
                return
            self._tally.by_kind[fault.kind] += 1
            self._tally.in_apply[fault.kind] += not self._rollout.is_settled
            done.append(fault)
            due.append((begun + fault.at + fault.lasts, lambda: end(fault)))

        def end(fault: Fault) -> None:
            if self._fault_injector.end(fault):
                self._event_log.add(f"fault {fault.number} was undone")
            else:
                due.append((time.monotonic() + _LOOK, lambda: end(fault)))

        until = drawn.lead + max(fault.at + fault.lasts for fault in drawn.faults)
        due: list[tuple[float, Callable[[], object]]] = [
            *((time.monotonic() + second, self._look) for second in range(int(until) + 1)),
            *((begun + one.at, lambda one=one: begin(one)) for one in drawn.faults),
            *((begun + one.at, lambda one=one: self._move(one)) for one in drawn.moves),
        ]
        while due:
            self._tend()
            due.sort(key=lambda one: one[0])
            if due[0][0] <= time.monotonic():
                due.pop(0)[1]()
            else:
                time.sleep(min(_LOOK, max(0.0, due[0][0] - time.monotonic())))
        return done

    def _look(self) -> None:
        self._oracle.look()
        self._rollout.look()

    def _tend(self) -> bool:
        self._cluster.tend()
        return self._client_load.collect()

    def _await_well(self, number: int, what: str, timeout: float) -> float:
        """Wait until all is well; return the time since which it has been."""
        deadline, since, steady = time.monotonic() + timeout, 0.0, 0
        while steady < _STEADY:
            answered = self._tend() and self._rollout.is_settled
            self._rollout.look()
            looked = time.monotonic()
            deviations = self._oracle.deviations()
            if answered and not deviations:
                since = since or looked
                steady += 1
            else:
                since, steady = 0.0, 0
                if looked >= deadline:
                    self._stuck(number, what, timeout, deviations, answered=answered)
            time.sleep(_LOOK_AT_ALL)
        return since

    # --- requests -------------------------------------------------------------------------

    def _submit(
        self, entries: list[dict[str, Any]], accepted: Callable[[ClientRequest], None]
    ) -> None:
        self._works += 1
        # Not on the disk of the desk, which may be full.
        work_file = self._cluster.folder / f"work{self._works}.yaml"
        work_file.write_text(json.dumps({"processes": entries}))  # JSON is YAML too
        self._client_load.send(
            ClientRequest({"do": "submit", "work": str(work_file)}, done=accepted)
        )

    def _submit_jobs(self, drawn: Round) -> None:
        jobs = [
            work.job(f"job{drawn.number}_{place}", self._lines, seconds)
            for place, seconds in enumerate(drawn.jobs)
        ]
        line = [
            work.line_job(f"line{drawn.number}_{place}", self._lines, min(1.0, seconds))
            for place, seconds in enumerate(drawn.line)
        ]
        self._submit(jobs + line, self._accept([*jobs, *line], line))

    def _submit_canaries(self, number: int) -> None:
        """Submit one job for each host, which shows that the host accepts work again."""
        entries = [
            work.job(f"canary{number}_{host}", self._lines, _CANARY, host=host) for host in HOSTS
        ]
        self._accepted.canaries.update(
            {host: entry["name"] for host, entry in zip(HOSTS, entries, strict=True)}
        )
        self._submit(entries, self._accept(entries, []))

    def _renew(self) -> None:
        """Cancel the guest, and submit the next one."""
        if self._guests:
            old = work.guest(self._guests).name
            self._event_log.add(f"{old} is cancelled")

            def cancelled(_: ClientRequest) -> None:
                self._accepted.services.pop(old)

            self._client_load.send(ClientRequest({"do": "cancel", "names": [old]}, done=cancelled))
        self._guests += 1
        service = work.guest(self._guests)
        guarantees = {service.name: guarantees_of(service)}
        self._submit(
            [service.entry(self._lines)], lambda _: self._accepted.services.update(guarantees)
        )

    def _accept(
        self, jobs: list[dict[str, Any]], line: list[dict[str, Any]]
    ) -> Callable[[ClientRequest], None]:
        sent = time.monotonic()

        def accept(client_request: ClientRequest) -> None:
            for job in jobs:
                self._accepted.jobs[job["name"]] = sent
                if (
                    client_request.unsure
                ):  # a master that did not answer may have accepted them earlier
                    self._disturbances.append(
                        Disturbance("unsure", sent, time.monotonic(), process=job["name"])
                    )
            self._accepted.line += [job["name"] for job in line]

        return accept

    def _apply(self, version: str) -> None:
        self._tally.applied[version] += 1
        self._disturbances += [_replacement(one) for one in work.rolled()]
        self._rollout.apply(faulty=version == "faulty")

    def _move(self, move: Move) -> None:
        self._disturbances.append(_replacement(self._services[move.process]))
        self._event_log.add(f"{move.process} is requested to migrate to {move.host}")

        def answered(client_request: ClientRequest) -> None:
            self._event_log.add(f"migration of {move.process}: {client_request.answer}")

        request = {"do": "migrate", "process": move.process, "host": move.host}
        self._client_load.send(ClientRequest(request, persistent=False, done=answered))

    # --- violations -----------------------------------------------------------------------

    def _stuck(
        self, number: int, what: str, timeout: float, deviations: list[Deviation], *, answered: bool
    ) -> None:
        words = f"not within {timeout:g} s after {what}"
        violations = [
            Violation(one.kind, one.name, f"{one.text} ({words})") for one in deviations
        ] or [Violation("lost", "", f"a request is not answered or carried out, {words}")]
        if answered or deviations:
            self._event_log.add(f"stuck: {words}")
        self._violated(number, violations)
        raise Stuck(words)

    def _violated(self, number: int, violations: list[Violation]) -> None:
        for one in violations:
            self._tally.violations[one.kind] += 1
            self._event_log.add(f"VIOLATION ({one.kind}): {one.text}", aloud=True)
        folder = self._out / f"violation-{number}-{self._tally.violations.total()}"
        names = list(dict.fromkeys(one.name for one in violations if one.name))
        for name in names[:_EXPLAINED]:
            answer = self._ask_master({"do": "events", "process": name})
            for line in answer.get("events", [str(answer)]):
                self._event_log.add(f"master: {line}", aloud=True)
        seen: Mapping[str, Any] = {
            "runs": self._oracle.newest_runs(names),
            "disturbances": [_plain(disturbance) for disturbance in self._disturbances],
            "application": self._rollout.state,
            "master": self._ask_master({"do": "look"}),
        }  # fmt: skip
        self._event_log.keep(folder, self._cluster, [asdict(one) for one in violations], seen)
        say(f"logs: {folder}")

    def _ask_master(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the master's view or events, for the log and to confirm stalls."""
        answers: list[ClientRequest] = []
        self._client_load.send(ClientRequest(request, persistent=False, done=answers.append))
        deadline = time.monotonic() + 20.0
        while not answers and time.monotonic() < deadline:
            self._tend()
            time.sleep(_LOOK)
        return answers[0].answer if answers else {"no_master": "no answer in 20 s"}


def _broken_invariants(records: Path) -> Iterator[Violation]:
    """Replay each run of the master, and yield the first invariant that did not hold in it."""
    registry = Registry.discover()
    for path in sorted(records.iterdir()):
        try:
            replay_record(load_record(path, cut=True), registry, watcher=checked)
        except AssertionError as fault:
            yield Violation("state", "", f"{path.name}: {fault}")


def guarantees_of(service: work.Service) -> Guarantees:
    """Return the guarantees by which the oracle judges a service."""
    sort = service.sort
    return Guarantees(
        sort.members, sort.stateful, sort.standby, service.elsewhere, service.isolated,
        kept=sort.stateful, copied=work.COPIED if sort.stateful else 0,
    )  # fmt: skip


def _replacement(service: work.Service) -> Disturbance:
    """Return the disturbance of a process by a migration or a new version, requested now."""
    now = time.monotonic()
    kind = "overlap" if service.sort.strategy == "relaunch" else "move"
    return Disturbance(kind, now, now, process=service.name)


def _plain(disturbance: Disturbance) -> dict[str, Any]:
    return {**asdict(disturbance), "hosts": sorted(disturbance.hosts)}
