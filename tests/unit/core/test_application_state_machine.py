"""Applications and modes under random requests and faults: nothing is lost, partial or too early.

The wires are prompt except for hosts that are cut off; the master can be killed at each rule.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rosrm.core.master import events as happened
from rosrm.core.master.applications.listing import application_rows
from rosrm.core.master.commands import Assign, Command
from rosrm.core.master.invariants import check
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.applications import Action, RolloutPolicy, Target
from rosrm.model.modes import Mode
from rosrm.model.values import HostLossPolicy, Kind, MigrationPolicy, ProcessSpec, StartOrder
from tests.unit.core.cluster import Cluster, Machine, process

NAMES = {"nav": ["n0", "n1", "n2", "n3"], "map": ["m0", "m1", "m2"]}
ALL = [name for names in NAMES.values() for name in names]
HOSTS = ["a", "b", "c"]
STRATEGIES = {
    "none": MigrationPolicy(), "relaunch": MigrationPolicy("relaunch"),
    "stop first": MigrationPolicy("relaunch", overlap=False), "handoff": MigrationPolicy("handoff"),
}  # fmt: skip
#: A process is never started elsewhere while its host is away, so two instances are a fault.
WAIT = HostLossPolicy("wait")


@st.composite
def files(draw: st.DrawFn, application: str) -> Target:
    """Draw the file of an application; a process may start after those before it."""
    specs: list[ProcessSpec] = []
    for name in NAMES[application]:
        if not draw(st.integers(0, 4)):
            continue
        kind = draw(st.sampled_from([Kind.SERVICE, Kind.SERVICE, Kind.JOB]))
        before = [one.name for one in specs]
        after: dict[str, Any] = {}
        if before and not draw(st.integers(0, 2)):
            dependency = draw(st.sampled_from(before))
            is_job = next(one for one in specs if one.name == dependency).kind is Kind.JOB
            after[dependency] = "finished" if is_job else "ready"
        together = draw(st.sampled_from(["", "", "", "pair"])) if not after else ""
        specs.append(
            process(
                name,
                draw(st.sampled_from([10.0, 600.0, 3_000.0, 40_000.0])),
                kind=kind,
                command=(draw(st.sampled_from(["one", "two"])),),
                host_loss=WAIT,
                migration=STRATEGIES[draw(st.sampled_from(sorted(STRATEGIES)))],
                priority=draw(st.integers(0, 2)),
                start_order=StartOrder(after),
                together=together,
                application=application,
            )
        )
    if not specs:
        specs = [process(NAMES[application][0], 10.0, application=application, host_loss=WAIT)]
    rollout = RolloutPolicy(
        draw(st.integers(1, 3)), draw(st.sampled_from([0.0, 2.0])),
        draw(st.sampled_from(["return", "return", "pause"])),
    )  # fmt: skip
    return Target(application, tuple(specs), rollout=rollout)


APPLICATIONS = st.sampled_from(sorted(NAMES))
FILES = APPLICATIONS.flatmap(files)


class Applications(RuleBasedStateMachine):
    """Rules of the state machine: what users request, and what hosts and processes do."""

    @initialize()
    def begin(self) -> None:
        self.cluster = Cluster(*(Machine(name) for name in HOSTS), progress_deadline=10.0)
        self.cluster.watch = self.judge

    # --- requests ------------------------------------------------------------------------

    def request(self, *targets: Target, plan: bool = False) -> Any:
        return self.cluster.ask(happened.ApplicationsRequested, targets, plan)

    @rule(file=FILES)
    def apply(self, file: Target) -> None:
        self.request(file)

    @rule(first=files("nav"), second=files("map"))
    def apply_both(self, first: Target, second: Target) -> None:
        self.request(first, second)

    @rule(name=APPLICATIONS, number=st.integers(1, 6))
    def revert(self, name: str, number: int) -> None:
        self.request(Target(name, version=number))

    @rule(name=APPLICATIONS)
    def cancel_application(self, name: str) -> None:
        self.request(Target(name))

    @rule(day=st.lists(FILES, max_size=2), night=st.lists(FILES, max_size=1))
    def load_modes(self, day: list[Target], night: list[Target]) -> None:
        modes = [
            Mode(name, tuple({one.application: one for one in targets}.values()))
            for name, targets in (("day", day), ("night", night))
        ]
        self.cluster.ask(happened.ModesLoaded, tuple(modes))

    @rule(mode=st.sampled_from(["day", "night"]))
    def switch(self, mode: str) -> None:
        self.cluster.ask(happened.ModeRequested, mode)

    @rule(file=FILES)
    def plan(self, file: Target) -> None:
        """Check that a plan changes nothing."""
        before = {table: dict(rows) for table, rows in self.cluster.intents.items()}
        self.request(file, plan=True)
        assert before == {table: dict(rows) for table, rows in self.cluster.intents.items()}

    @precondition(lambda self: self.is_calm())
    @rule(file=FILES)
    def plan_and_apply(self, file: Target) -> None:
        """Check that an apply does what its plan says, if nothing else happens."""
        for machine in self.cluster.machines.values():
            machine.refuses.clear()  # no plan knows that a host will refuse a process
        planned = self.request(file, plan=True)
        applied = self.request(file)
        assert planned.accepted == applied.accepted
        if not planned.accepted or "would return" in planned.message:
            return
        hosts = {
            one.process: one.host for one in planned.actions
            if one.host and not one.waits and one.application == file.application
        }  # fmt: skip
        self.cluster.wait(20.0, tick=0.5)
        for name, host in hosts.items():
            assert self.cluster.where(name) == [host], (name, host, planned.actions)
        stopped = [one.process for one in planned.actions if one.action is Action.STOP]
        for name in stopped:
            assert not self.cluster.where(name), name

    def is_calm(self) -> bool:
        """Return True if nothing is under way, and all hosts are here."""
        state = self.cluster.state
        return (
            all(machine.connected for machine in self.cluster.machines.values())
            and not (state.migrations or state.queue or state.set_aside or state.modes.switching)
            and not any(one.tasks for one in state.applications.values())
            and all(one.phase is not ProcessPhase.STOPPING for one in state.processes.values())
        )

    @rule(name=st.sampled_from(ALL))
    def cancel(self, name: str) -> None:
        self.cluster.cancel(name)

    @rule(name=st.sampled_from(ALL))
    def restart(self, name: str) -> None:
        self.cluster.restart(name)

    @rule()
    def prune(self) -> None:
        self.cluster.ask(happened.PruneRequested, (), ())

    # --- hosts and processes -------------------------------------------------------------

    @rule(name=st.sampled_from(ALL), code=st.sampled_from([0, 1]))
    def end(self, name: str, code: int) -> None:
        found = self.cluster.where(name)
        if found and self.cluster.machines[found[0]].connected:
            self.cluster.finish(name, on=found[0], code=code)

    @rule(host=st.sampled_from(HOSTS), seconds=st.sampled_from([0.5, 15.0]))
    def cut_for_a_while(self, host: str, seconds: float) -> None:
        self.cluster.cut(host, seconds=seconds)
        self.cluster.rejoin(host)

    @rule(host=st.sampled_from(HOSTS), name=st.sampled_from(ALL))
    def refuse(self, host: str, name: str) -> None:
        """Let a host lack the program of a process, until the next rule of this kind."""
        self.cluster.machines[host].refuses.clear()
        self.cluster.machines[host].refuses[name] = "no such program"

    @rule(alone=st.sampled_from([0.0, 0.5]))
    def kill_master(self, alone: float) -> None:
        self.cluster.kill_master()
        self.cluster.wait(alone)
        for machine in self.cluster.machines.values():
            self.cluster.register(machine)

    @rule(seconds=st.sampled_from([0.5, 3.0, 12.0]))
    def wait(self, seconds: float) -> None:
        self.cluster.wait(seconds, tick=0.5)

    # --- invariants ----------------------------------------------------------------------

    def judge(self, commands: Sequence[Command]) -> None:
        """Check each assignment: its dependencies hold, and its gang is complete."""
        state = self.cluster.state
        for command in commands:
            if isinstance(command, Assign):
                assigned = state.processes[command.assignment.instance.process]
                self.check_dependencies(assigned)
                self.check_gang(assigned)

    def check_dependencies(self, assigned: Process) -> None:
        for name, condition in assigned.spec.start_order.after.items():
            phase = self.cluster.state.processes[name].phase
            ready = (ProcessPhase.RUNNING, ProcessPhase.FINISHED)
            allowed = ready if condition == "ready" else (ProcessPhase.FINISHED,)
            assert phase in allowed, (assigned.name, name, phase)

    def check_gang(self, assigned: Process) -> None:
        if assigned.awaits_gang:
            names = self.cluster.state.gangs.members[assigned.gang]
            phases = {self.cluster.state.processes[name].phase for name in names}
            assert phases == {ProcessPhase.ASSIGNED}, (assigned.name, phases)

    @invariant()
    def the_state_is_sound(self) -> None:
        check(self.cluster.state)

    @invariant()
    def no_process_runs_twice(self) -> None:
        """Check that there are two programs of a process only while it is replaced or moved."""
        for name in ALL:
            if name not in self.cluster.state.migrations:
                assert len(self.cluster.where(name)) <= 1, name

    @invariant()
    def a_settled_application_has_one_version(self) -> None:
        """Check that an application that reports `running` runs the programs of its version."""
        state = self.cluster.state
        for row in application_rows(state):
            specs = state.applications[row.name].specs
            for name, spec in specs.items() if row.state == "running" else ():
                known = state.processes.get(name)
                if known is None or known.phase is not ProcessPhase.RUNNING:
                    continue
                owner = state.instances[known.owner]
                program = self.cluster.machines[owner.host.name].programs.get(owner.id)
                assert program is None or program.assignment.spec.command == spec.command, name

    @invariant()
    def no_desired_process_is_forgotten(self) -> None:
        """Check that a desired process exists, or that its application is at work on it."""
        for application in self.cluster.state.applications.values():
            for name in application.specs:
                known = self.cluster.state.processes.get(name)
                own = known is not None and known.spec.application == application.name
                assert (
                    own
                    or name in application.tasks
                    or application.paused
                    or (self.was_pruned(name))
                ), name

    def was_pruned(self, name: str) -> bool:
        """Return True if an ended process of this name was removed by a request."""
        return any(record.kind == "pruned" for record in self.cluster.records)

    def teardown(self) -> None:
        """Check that everything comes to rest without further faults."""
        for machine in self.cluster.machines.values():
            machine.refuses.clear()
        for _ in range(6):
            self.cluster.wait(20.0, tick=0.5)
            self.the_state_is_sound()
        state = self.cluster.state
        assert not state.migrations
        for application in state.applications.values():
            for name, task in application.tasks.items() if not application.paused else ():
                known = state.processes.get(name)
                waits = task.reason or task.fault or (known is not None and known.reason)
                assert waits, (application.name, name)
            for name in state.names_of(application.name):
                if name not in application.specs and not application.paused:
                    assert state.processes[name].phase.is_terminal, name


TestApplications = Applications.TestCase
if os.environ.get("ROSRM_PLAY") != "long":  # each step is some seconds of the play
    TestApplications.settings = settings(max_examples=15, stateful_step_count=20)
