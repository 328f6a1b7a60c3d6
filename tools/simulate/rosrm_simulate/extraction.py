"""Extraction of a workload from a record: arrivals, usages, and hosts with their times.

The usage of a process is known only as far as it ran: its memory by its age, once a second; its CPU
as the mean of the cores that it got, which on a crowded host is less than it needed. Behaviour
that is not in the record (the end of a process that was still running) is not simulated either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign, Command, PublishStateConfig, Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import ProcessPhase
from rosrm.model.codec import from_plain
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Record
from rosrm.model.requester import OPERATOR
from rosrm.model.values import HostDescription, InstanceState, InstanceStatus, ProcessSpec
from rosrm.recording.encoding import Happened
from rosrm.recording.reader import Recording
from rosrm_simulate.workload import Curve, Model, ProcessPlan, SimulatedHost, Workload

#: Points of a memory curve that are kept.
_POINTS: Final = 64
#: Users' requests that are repeated in a simulation. Checkpoints and restores are not: there are no
#: checkpoint images in it. The process's curve shows the time without usage.
_REQUESTS: Final = (
    happened.CancelRequested, happened.RestartRequested, happened.MigrationRequested,
    happened.HostStateRequested,
)  # fmt: skip
#: Scope of a resource whose readings count only the slave's own processes.
_OURS_ALONE: Final = "slice"
_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.READY})


@dataclass(slots=True)
class _Host:
    """The data of one host in a record."""

    description: HostDescription
    joins: float
    leaves: float = inf
    lost: bool = False
    limits: dict[str, float] = field(default_factory=dict)
    others: dict[str, list[float]] = field(default_factory=dict)


@dataclass(slots=True)
class _Process:
    """The data of one process in a record."""

    spec: ProcessSpec
    arrives: float
    samples: list[tuple[float, float]] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    duration: float = inf
    peak: float = 0.0


class Extraction:
    """A builder of a workload from a replay; pass its `watch` to the replay as the watcher."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._started = recording.header.started
        self._hosts: dict[str, _Host] = {}
        self._processes: dict[str, _Process] = {}
        self._requests: list[tuple[float, happened.Event]] = []
        self._assigned: dict[int, float] = {}
        self._runs_since: dict[int, float] = {}
        self._owners: dict[int, _Process] = {}
        self._starts: list[float] = []
        self._readies: list[float] = []
        self._stops: list[float] = []
        self._stops_since: dict[int, float] = {}
        for name, item in recording.header.intents.get("process", {}).items():
            if not ProcessPhase(item["phase"]).is_terminal:  # the master restored it at its start
                self._processes[name] = _Process(from_plain(ProcessSpec, item["spec"]), 0.0)

    def watch(self, state: MasterState, one: Happened, commands: Sequence[Command]) -> None:
        """Process one event of the record, and the commands that followed from it."""
        at = one.now - self._started
        self._take(state, one.event, commands, at)
        for command in commands:
            if isinstance(command, Assign):
                self._assigned[command.assignment.instance.number] = at
            elif isinstance(command, PublishStateConfig):  # it continues at the source's age
                since = self._runs_since.get(command.source, at)
                self._runs_since[command.destination] = since
            elif isinstance(command, Record) and command.kind in (
                EventKind.HOST_LOST,
                EventKind.HOST_BACK,
            ):
                self._take_record(command, at)

    def _take(
        self, state: MasterState, event: happened.Event, commands: Sequence[Command], at: float
    ) -> None:
        if isinstance(event, happened.HostRegistered):
            self._registered(event.description, at)
        elif isinstance(event, happened.SubmissionReceived):
            self._submitted(event, commands, at)
        elif isinstance(event, happened.ReadingsReceived):
            self._read(state, event)
        elif isinstance(event, happened.UsagesReceived):
            self._used(event, at)
        elif isinstance(event, happened.StatusesReceived):
            for status in event.statuses:
                self._status(status, at)
        elif isinstance(event, _REQUESTS):
            # A submission of a workload has no owner, so only an operator may act on its processes.
            if not any(isinstance(one, Reply) and one.code == "denied" for one in commands):
                self._requests.append((at, replace(event, by=OPERATOR)))
        elif isinstance(event, happened.HostLeft):
            host = state.hosts.find(event.host_id, event.incarnation)
            if host is not None and host.name in self._hosts:
                self._hosts[host.name].leaves = at

    def _registered(self, description: HostDescription, at: float) -> None:
        known = self._hosts.get(description.name)
        if known is None:
            self._hosts[description.name] = _Host(description, at)
        else:
            known.leaves, known.lost = inf, False

    def _take_record(self, record: Record, at: float) -> None:
        host = self._hosts.get(record.host)
        if host is not None and host.leaves == inf and record.kind is EventKind.HOST_LOST:
            host.leaves, host.lost = at, True
        elif host is not None and host.lost and record.kind is EventKind.HOST_BACK:
            host.leaves, host.lost = inf, False

    def _submitted(
        self, event: happened.SubmissionReceived, commands: Sequence[Command], at: float
    ) -> None:
        taken = {
            one.process
            for one in commands
            if isinstance(one, Record) and one.kind is EventKind.SUBMITTED
        }
        for spec in event.specs:
            if spec.name in taken:
                self._processes.setdefault(spec.name, _Process(spec, at))

    def _read(self, state: MasterState, event: happened.ReadingsReceived) -> None:
        for number in event.host_id:
            column = int(number) - 1
            if not 0 <= column < len(state.hosts):
                continue
            host = state.hosts.hosts[column]
            seen = self._hosts.get(host.name)
            if seen is None or state.hosts.condition[column] != HostCondition.UP:
                continue
            held = [state.instances[one] for one in host.instances]
            for one in host.description.resources:
                row = state.hosts.resources.index(one.name)
                seen.limits[one.name] = float(state.hosts.limit[row, column])
                if one.scope == _OURS_ALONE or not all(instance.seen for instance in held):
                    continue  # nothing of others is in it, or it cannot be separated yet
                ours = sum(instance.seen.get(one.name, 0.0) for instance in held) / one.capacity
                others = float(state.hosts.usage[row, column]) - ours
                seen.others.setdefault(one.name, []).append(max(0.0, others))

    def _used(self, event: happened.UsagesReceived, at: float) -> None:
        for number, cpu, memory in zip(event.numbers, event.cpu, event.memory, strict=True):
            process = self._owners.get(int(number))
            since = self._runs_since.get(int(number))
            if process is not None and since is not None:
                process.samples.append((at - since, float(memory)))
                process.cpu.append(float(cpu))

    def _status(self, status: InstanceStatus, at: float) -> None:
        number = status.instance.number
        process = self._processes.get(status.instance.process)
        if process is None:
            return
        self._owners[number] = process
        process.peak = max(process.peak, status.peak_memory)
        if status.state in _RUNS and number not in self._runs_since:
            self._runs_since[number] = at
            if number in self._assigned:
                self._starts.append(at - self._assigned[number])
        elif status.state is InstanceState.READY and process.spec.awaits_graph:
            self._readies.append(at - self._runs_since[number])
        elif status.state is InstanceState.STOPPING:
            self._stops_since.setdefault(number, at)
        elif status.state.ended and number in self._stops_since:
            self._stops.append(at - self._stops_since[number])
        elif status.state.ended and not status.exit_signal and status.run_time > 0.0:
            process.duration = status.run_time

    # --- the workload --------------------------------------------------------------------

    def workload(self) -> Workload:
        """Return the workload of the record, up to its end."""
        model = Model(
            period=min((one.description.period for one in self._hosts.values()), default=0.1),
            start=_middle(self._starts, Model().start),
            ready=_middle(self._readies, Model().ready),
            stop=_middle(self._stops, Model().stop),
        )
        return Workload(
            self._recording.name.rpartition("/")[2],
            tuple(_host_plan(one) for one in self._hosts.values()),
            tuple(_process_plan(one) for one in self._processes.values()),
            model, tuple(self._requests), until=self._recording.length,
        )  # fmt: skip


def _middle(values: Sequence[float], default: float) -> float:
    return float(np.median(values)) if values else default


def _host_plan(seen: _Host) -> SimulatedHost:
    described = seen.description
    return SimulatedHost(
        described.name, described.resources, seen.limits, described.labels,
        described.max_processes, {name: _middle(v, 0.0) for name, v in seen.others.items()},
        seen.joins, seen.leaves, seen.lost, devices=described.devices,
    )  # fmt: skip


def _process_plan(seen: _Process) -> ProcessPlan:
    ages = np.array([age for age, _ in seen.samples])
    amounts = np.array([amount for _, amount in seen.samples])
    if len(ages):
        order = np.argsort(ages, kind="stable")
        kept = order[np.unique(np.linspace(0, len(order) - 1, _POINTS).astype(int))]
        ages, amounts = np.maximum.accumulate(ages[kept]), amounts[kept]
        distinct = np.concatenate(([True], np.diff(ages) > 0.0))
        memory = Curve(tuple(ages[distinct]), tuple(amounts[distinct]))
    else:  # it ran for less than the second between two usages, or never
        memory = Curve((0.0,), (seen.peak or seen.spec.needs.get("memory", 0.0),))
    cpu = float(np.mean(seen.cpu)) if seen.cpu else 0.0
    return ProcessPlan(seen.spec, seen.arrives, memory, cpu, duration=seen.duration)
