"""The model of one host: usage and CPU time of its programs, on virtual time.

A host has CPU time to share: while its processes want more cores than there are, each gets the same
part of its demand, and one with work to do takes so much longer. Memory is the sum over the
processes; there is no out-of-memory kill, so that overload shows in the limits alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf

from rosrm.core.master import events as happened
from rosrm.core.master.commands import SendOrder
from rosrm.core.slave.events import SeenInGraph
from rosrm.model.values import EMPTY, Assignment, InstanceId, InstanceState, RestartPolicy
from rosrm_simulate.agenda import Agenda, Entry
from rosrm_simulate.host import Host, Program, SimulatedReading
from rosrm_simulate.workload import Model, ProcessPlan, SimulatedHost

#: Seconds of work left that count as none, because sums of fractions are not exact.
_NONE_LEFT = 1e-9


@dataclass(slots=True, kw_only=True)
class Work(Program):
    """One instance on a host.

    Attributes:
        begun: time at which it began to run; None: it is starting.
        work: seconds of its duration that it has done.
    """

    plan: ProcessPlan
    begun: float | None = None
    work: float = 0.0
    peak: float = 0.0


class Machine(Host[Work]):
    """One host of a simulation.

    Args:
        plan: of the host.
        incarnation: of its slave.
        agenda: time.
        model: of the hosts.
        processes: plans by process name.
        deliver: sends an event to the master.

    Attributes:
        up: it runs; a host that is down neither receives nor sends anything.
        stopping: its slave is shutting down, and the host goes with its last process.
        asked: it has requested work.
        published_usage: usages that the master knows.
    """

    def __init__(
        self, plan: SimulatedHost, incarnation: int, agenda: Agenda, model: Model,
        processes: Mapping[str, ProcessPlan], deliver: Callable[[happened.Event], object],
    ) -> None:  # fmt: skip
        super().__init__(
            plan.name, resources=plan.resources, limits=plan.limits, labels=plan.labels,
            devices=plan.devices, max_processes=plan.max_processes, busy=plan.busy,
            period=model.period,
            start_time=model.start, stop_time=model.stop, incarnation=incarnation,
        )  # fmt: skip
        self.up = True
        self.stopping = False
        self.asked = False
        self.published_usage: tuple[tuple[int, float, float], ...] = ()
        self._agenda = agenda
        self._model = model
        self._processes = processes
        self._deliver = deliver
        self._capacity = plan.capacity("cpu")
        self._cores = self._capacity * (1.0 - plan.busy.get("cpu", 0.0))
        self._worked_until = 0.0
        self._rate = 1.0
        self._level_from = 0.0
        self._reading: SimulatedReading | None = None
        self._end_of_work: Entry | None = None

    # --- messages, on virtual time ---------------------------------------------------------

    def later(self, seconds: float, _now: float, action: Callable[[float], None]) -> None:
        """Plan an action."""
        self._agenda.after(seconds, lambda: action(self._agenda.now))

    def say(self, event: happened.Event) -> None:
        """Send an event to the master, unless the host is gone at the time of its arrival."""

        def arrive() -> None:
            if self.up or self.stopping:
                self._deliver(event)

        self._agenda.after(self._model.wire, arrive)

    def receive(self, sent: SendOrder) -> None:
        """Carry out an order, and send the answer to the master."""
        self.say(self.obey(sent, self._agenda.now))

    def lose(self) -> None:
        """Drop the host at once, with everything on it; it sends no message."""
        self.up = False
        self.programs.clear()
        self._agenda.call_off(self._end_of_work)

    def shut_down(self, now: float) -> None:
        """Shut down the slave, with all its processes."""
        self.stopping = True
        super().shut_down(now)
        self._close()

    def _close(self) -> None:
        if self.stopping and not self.programs:
            self.up = False

    # --- programs --------------------------------------------------------------------------

    def make_program(self, assignment: Assignment, restart: RestartPolicy) -> Work:
        """Return the program of a new instance."""
        plan = self._processes[assignment.instance.process]
        return Work(plan=plan, assignment=assignment, restart=restart, pid=self.next_pid())

    def run_begins(self, program: Work, now: float) -> None:
        """Begin with the work of an instance; a ROS node is seen in the graph later."""
        program.begun = now
        self.changed(now)
        if program.assignment.spec.awaits_graph:
            seen = partial(self._seen, program.assignment.instance, program.run)
            self.later(self._model.ready, now, seen)

    def run_begins_again(self, program: Work, now: float) -> None:
        """Drop the work of the earlier run."""
        self._account(now)
        program.begun, program.work = None, 0.0
        self.changed(now)

    def _seen(self, instance: InstanceId, run: int, now: float) -> None:
        program = self.programs.get(instance)
        if program is not None and program.run == run:
            self.tell(SeenInGraph(instance), now)

    def _stop(self, instance: InstanceId, now: float) -> None:
        super()._stop(instance, now)
        self._plan_end()

    def spent(self, program: Work, now: float) -> tuple[float, float, float]:
        """Return run time, peak memory and CPU time of an instance that ends."""
        self._account(now)
        run_time = 0.0 if program.begun is None else now - program.begun
        peak = max(program.peak, self.memory_of(program, now))
        return run_time, peak, program.plan.cpu * program.work

    def run_ended(self, now: float) -> None:
        """Share the CPU time among the rest; a host that shuts down goes with its last program."""
        self.changed(now)
        self._close()

    # --- work ------------------------------------------------------------------------------

    def changed(self, now: float) -> None:
        """Apply a change of the programs, and plan the next end of work again."""
        self._account(now)
        self._plan_end()

    def _account(self, now: float) -> None:
        """Account past work at the old CPU rate; further work is at the new one."""
        self._work_until(now)
        running = self._running()
        wanted = sum(one.plan.cpu for one in running)
        self._rate = 1.0 if wanted <= self._cores or not self._capacity else self._cores / wanted
        self._level_from = max((_level_from(one) for one in running), default=0.0)
        self._reading = None

    def _running(self) -> list[Work]:
        return [one for one in self.programs.values() if one.begun is not None]

    def _work_until(self, now: float) -> None:
        for program in self._running():
            assert program.begun is not None
            since = max(self._worked_until, program.begun)
            program.work += max(0.0, now - since) * self._rate_of(program)
            program.peak = max(program.peak, self.memory_of(program, now))
        self._worked_until = now

    def _rate_of(self, program: Work) -> float:
        return self._rate if program.plan.cpu > 0.0 else 1.0

    def _plan_end(self) -> None:
        """Plan the next end of work."""
        self._agenda.call_off(self._end_of_work)
        time = min((self._end_of(one) for one in self._running()), default=inf)
        self._end_of_work = self._agenda.at(time, self._work_done) if time < inf else None

    def _end_of(self, program: Work) -> float:
        rate = self._rate_of(program)
        stopping = program.state is InstanceState.STOPPING
        if program.plan.duration == inf or stopping or rate <= 0.0:
            return inf
        return self._worked_until + max(0.0, program.plan.duration - program.work) / rate

    def _work_done(self) -> None:
        now = self._agenda.now
        self._work_until(now)
        done = [
            instance
            for instance, one in self.programs.items()
            if one.begun is not None and one.state is not InstanceState.STOPPING
            and one.work >= one.plan.duration - _NONE_LEFT
        ]  # fmt: skip
        for instance in done:
            self._end(instance, InstanceState.EXITED, now)
        self._plan_end()

    # --- readings and usages ---------------------------------------------------------------

    def memory_of(self, program: Work, now: float) -> float:
        """Return the bytes that an instance holds."""
        return 0.0 if program.begun is None else program.plan.memory.at(now - program.begun)

    def used_by(self, program: Work, now: float) -> Mapping[str, float]:
        """Return the base units of each resource that an instance uses."""
        if program.begun is None:
            return EMPTY
        plan = program.plan
        memory = self.memory_of(program, now)
        return {"memory": memory, "cpu": plan.cpu * self._rate, "disk": plan.disk}

    def grows(self, now: float) -> bool:
        """Return True if the memory of a process is still changing."""
        return now < self._level_from

    def reading(self, now: float) -> SimulatedReading:
        """Return the slave's reading, which changes only with its programs."""
        if self._reading is None or self.grows(self._reading.at):
            self._reading = super().reading(now)
        return self._reading._replace(accepts=False) if self.stopping else self._reading


def _level_from(program: Work) -> float:
    """Return the time from which the memory of an instance stays constant."""
    assert program.begun is not None
    return program.begun + program.plan.memory.level_from
