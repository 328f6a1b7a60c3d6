"""Slaves of a simulation: their cores decide, and the machines carry out the commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from rosrm.core.master import events as happened
from rosrm.core.master.commands import OrderId, SendOrder
from rosrm.core.slave import commands, events, reducer
from rosrm.core.slave.orders import event_of
from rosrm.core.slave.state import awaits_graph
from rosrm.model.orders import DropReplica, ReplicateSnapshot, RunExecutor, SetRestartPolicy
from rosrm.model.values import Assignment, InstanceId, InstanceState, InstanceStatus, RestartPolicy
from rosrm_simulate.agenda import Agenda, Entry
from rosrm_simulate.machine import Machine, Program
from rosrm_simulate.workload import Model, ProcessPlan

#: The signal that ends a stopped instance: SIGINT.
_INTERRUPTED = 2


class Hosting:
    """An executor of the commands of all slaves' cores.

    Args:
        agenda: time.
        model: of the hosts.
        plans: by process name.
        tell: sends an event to the master.

    Attributes:
        where: number of an instance to the machine that has it.
    """

    def __init__(
        self, agenda: Agenda, model: Model, plans: Mapping[str, ProcessPlan],
        tell: Callable[[happened.Event], None],
    ) -> None:  # fmt: skip
        self._agenda = agenda
        self._model = model
        self._plans = plans
        self._tell = tell
        self.where: dict[int, Machine] = {}
        self._ends: dict[str, Entry] = {}
        self._settling: dict[tuple[InstanceId, RestartPolicy], OrderId] = {}

    # --- events of a slave -----------------------------------------------------------------

    def hear(self, machine: Machine, event: events.Event) -> None:
        """Process an event in a slave's core, and carry out its commands."""
        for command in reducer.step(machine.slave, event, self._agenda.now):
            self._carry_out(machine, command)

    def _carry_out(self, machine: Machine, command: commands.Command) -> None:
        if isinstance(command, commands.Report):
            machine.batches += 1
            report = happened.StatusesReceived(
                machine.host_id, machine.incarnation, machine.batches, command.complete,
                command.statuses,
            )  # fmt: skip
            self._say(machine, report)
        elif isinstance(command, commands.Launch):
            for assignment in command.assignments:
                self._launch(machine, assignment)
        elif isinstance(command, commands.Stop | commands.Fence):
            self._stop(machine, command.instance)
        elif isinstance(command, commands.Restart):
            self._restart(machine, command.instance)
        elif isinstance(command, commands.Amend):
            machine.programs[command.instance].restart = command.restart
            self.hear(machine, events.RestartPolicyRecorded(command.instance, command.restart))
        elif isinstance(command, commands.Settle):
            self._settle(machine, command)

    def _say(self, machine: Machine, event: happened.Event) -> None:
        """Send an event to the master, unless the host is gone at the time of its arrival."""

        def arrive() -> None:
            if machine.up or machine.stopping:
                self._tell(event)

        self._agenda.after(self._model.wire, arrive)

    def _supervisor_says(self, machine: Machine, status: InstanceStatus) -> None:
        self.hear(machine, events.SupervisorReported((status,)))

    # --- programs --------------------------------------------------------------------------

    def _launch(self, machine: Machine, assignment: Assignment) -> None:
        instance = assignment.instance
        restart = RestartPolicy() if assignment.shadow else assignment.spec.restart
        plan = self._plans[instance.process]
        machine.programs[instance] = Program(plan, assignment, restart)
        self.where[instance.number] = machine
        self._agenda.after(self._model.start, partial(self._started, machine, instance, 0))

    def _started(self, machine: Machine, instance: InstanceId, run: int) -> None:
        program = machine.programs.get(instance)
        if program is None or program.run != run or program.stopping or not machine.up:
            return
        machine.begin(instance, self._agenda.now)
        self._plan_end(machine)
        status = InstanceStatus(instance, InstanceState.RUNNING, pid=instance.number)
        self._supervisor_says(machine, status)
        if awaits_graph(program.assignment.spec):
            self._agenda.after(self._model.ready, partial(self._seen, machine, instance, run))

    def _seen(self, machine: Machine, instance: InstanceId, run: int) -> None:
        program = machine.programs.get(instance)
        if program is not None and program.run == run and machine.up:
            self.hear(machine, events.SeenInGraph(instance))

    def _stop(self, machine: Machine, instance: InstanceId) -> None:
        program = machine.programs.get(instance)
        if program is None or program.stopping:
            return
        program.stopping = True
        self._plan_end(machine)
        self._supervisor_says(machine, InstanceStatus(instance, InstanceState.STOPPING))
        self._agenda.after(self._model.stop, partial(self._stopped, machine, instance))

    def _stopped(self, machine: Machine, instance: InstanceId) -> None:
        if instance in machine.programs:
            self._end(machine, instance, signal=_INTERRUPTED)

    def _restart(self, machine: Machine, instance: InstanceId) -> None:
        program = machine.programs[instance]
        machine.changed(self._agenda.now)
        program.begun, program.work = None, 0.0
        program.run += 1
        machine.changed(self._agenda.now)
        self._plan_end(machine)
        self._supervisor_says(machine, InstanceStatus(instance, InstanceState.STOPPING))
        seconds = self._model.stop + self._model.start
        self._agenda.after(seconds, partial(self._started, machine, instance, program.run))

    def _plan_end(self, machine: Machine) -> None:
        """Plan the next end of work on a host."""
        name = machine.plan.name
        self._agenda.call_off(self._ends.pop(name, None))
        time = machine.next_end()
        if time < float("inf"):
            self._ends[name] = self._agenda.at(time, partial(self._work_done, machine))

    def take_over(self, machine: Machine) -> None:
        """Plan the end of work again after an instance has taken over the work of another."""
        machine.changed(self._agenda.now)
        self._plan_end(machine)

    def _work_done(self, machine: Machine) -> None:
        for instance in machine.done(self._agenda.now):
            self._end(machine, instance)
        self._plan_end(machine)

    def _end(self, machine: Machine, instance: InstanceId, *, signal: int = 0) -> None:
        now = self._agenda.now
        program = machine.remove(instance, now)
        del self.where[instance.number]
        self._plan_end(machine)
        self._supervisor_says(machine, machine.end_status(instance, program, now, signal=signal))
        self._close(machine)

    # --- departure of a host ---------------------------------------------------------------

    def stop_all(self, machine: Machine) -> None:
        """Shut down a slave, with all its processes."""
        machine.stopping = True
        for instance in list(machine.slave.held):
            if not machine.slave.held[instance].status.state.ended:
                self.hear(machine, events.StopOrdered(instance))
        self._close(machine)

    def _close(self, machine: Machine) -> None:
        if machine.stopping and not machine.programs:
            machine.up = False

    def lose(self, machine: Machine) -> None:
        """Drop a host at once, with everything on it; it sends no message."""
        machine.up = False
        for instance in machine.programs:
            del self.where[instance.number]
        machine.programs.clear()
        self._agenda.call_off(self._ends.pop(machine.plan.name, None))

    # --- orders --------------------------------------------------------------------------

    def obey(self, machine: Machine, sent: SendOrder) -> None:
        """Carry out an order at a slave, and answer it."""
        order = sent.order
        match order:
            case RunExecutor(executor):
                message = f"the simulation cannot carry out {executor!r}"
                self._say(machine, happened.OrderAnswered(sent.order_id, False, "failed", message))
                return
            case SetRestartPolicy(instance, restart):
                self._settling[instance, restart] = sent.order_id
                self.hear(machine, event_of(order))
                return
            case ReplicateSnapshot() | DropReplica():
                pass  # nodes of a simulation publish no snapshots
            case _:
                self.hear(machine, event_of(order))
        self._say(machine, happened.OrderAnswered(sent.order_id, accepted=True))

    def _settle(self, machine: Machine, command: commands.Settle) -> None:
        order = self._settling.pop((command.instance, command.restart), None)
        if order is not None:
            code = "refused" if command.refusal else ""
            self._say(machine, happened.OrderAnswered(order, not code, code, command.refusal))
