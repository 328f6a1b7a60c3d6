"""Answers of nodes in the handoff protocol, without faults.

The channel between source and destination is not modelled, only its effect: which node is active,
and that the destination then continues the source's work.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import Event, HandoffReported
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.values import InstanceId
from rosrm_simulate.agenda import Agenda
from rosrm_simulate.machine import Machine
from rosrm_simulate.workload import Model


class Nodes:
    """All nodes of the cluster, as far as handoffs are concerned."""

    def __init__(
        self, agenda: Agenda, model: Model, machines: Mapping[str, Machine],
        deliver: Callable[[Event], object],
    ) -> None:  # fmt: skip
        self._agenda = agenda
        self._model = model
        self._machines = machines
        self._deliver = deliver

    def handle(self, config: PublishStateConfig) -> None:
        """Process a phase of a handoff; the named node answers."""
        if config.phase is HandoffPhase.SHADOW:
            seconds = self._model.ready + self._model.handoff
            self._later(seconds, config, config.destination, ReportPhase.READY)
        elif config.phase in (HandoffPhase.SWITCH, HandoffPhase.TAKE_OVER):
            self._agenda.after(2 * self._model.wire, partial(self._switch, config))
        elif config.phase is HandoffPhase.ABORT:
            self._later(0.0, config, config.destination, ReportPhase.ABORTED)
        elif config.phase is HandoffPhase.RESUME:
            self._later(0.0, config, config.source, ReportPhase.RESUMED)

    def _later(
        self, seconds: float, config: PublishStateConfig, number: int, phase: ReportPhase
    ) -> None:
        report = partial(self._report, config, number, phase)
        self._agenda.after(seconds + 2 * self._model.wire, report)

    def _report(self, config: PublishStateConfig, number: int, phase: ReportPhase) -> None:
        if self._host_of(config, number) is not None:
            self._deliver(HandoffReported(config.process, config.destination, number, phase))

    def _host_of(self, config: PublishStateConfig, number: int) -> Machine | None:
        instance = InstanceId(config.process, number)
        return next((one for one in self._machines.values() if instance in one.programs), None)

    def _switch(self, config: PublishStateConfig) -> None:
        """Let the source end its output, and the destination continue its work."""
        there = self._host_of(config, config.destination)
        here = self._host_of(config, config.source)
        if there is None:
            return
        if here is not None:
            now = self._agenda.now
            here.changed(now)
            there.changed(now)
            source = here.programs[InstanceId(config.process, config.source)]
            destination = there.programs[InstanceId(config.process, config.destination)]
            destination.work, destination.begun = source.work, source.begun
            there.changed(now)
            self._report(config, config.source, ReportPhase.RELEASED)
        self._report(config, config.destination, ReportPhase.ACTIVE)
