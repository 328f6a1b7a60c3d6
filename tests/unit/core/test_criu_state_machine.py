"""Moves by `criu` with random loss, rejoin and departure of hosts: `host_loss` applies.

The wires are prompt except for the cuts; the master can be killed in any turn of its own.
"""

from __future__ import annotations

import os

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rosrm.core.master import events as happened
from rosrm.core.master.state.hosts import HostCondition
from rosrm_criu.plans import AWAIT_RESTORED, CHECKPOINT, END, FETCH, GO_ON, INTRODUCE, JOIN
from tests.unit.core.cluster import Cluster
from tests.unit.core.portable import Portable
from tests.unit.core.test_checkpoints import Killed, kill_at
from tests.unit.core.test_criu_host_loss import (
    LEASE,
    POLICIES,
    active_in_contact,
    host,
    nothing_else,
    runs_alone,
    story,
    wait,
)

HOSTS = ["a", "b", "c"]
STEPS = [INTRODUCE, CHECKPOINT, GO_ON, FETCH, AWAIT_RESTORED, JOIN, END]
hosts, chance = st.sampled_from(HOSTS), st.booleans()


class GivenUp:
    """Instances that may still run on lost hosts, unaware of their successors."""

    def __init__(self, cluster: Cluster) -> None:
        self._records = cluster.records

    def __contains__(self, number: int) -> bool:
        kinds = [
            record.kind for record in self._records
            if record.kind in ("given_up", "readopted") and record.facts["number"] == number
        ]  # fmt: skip
        return kinds[-1:] == ["given_up"]


class Life(RuleBasedStateMachine):
    """Rules of the state machine; p starts from nothing again only where its memory is lost."""

    @initialize(
        then=st.sampled_from([*POLICIES, "elsewhere"]), delay=st.sampled_from([0.0, 0.0, 20.0])
    )
    def begin(self, then: str, delay: float) -> None:
        self.cluster = story(then, delay=delay)
        self.cluster.air.left = GivenUp(self.cluster)  # type: ignore[assignment]
        self.patience = LEASE + delay + 25.0
        self.may_restart = then != "wait"
        self.begun: set[int] = set()
        self.changed_at = self.cluster.now

    @property
    def machines(self) -> list[Portable]:
        return [host(self.cluster, name) for name in HOSTS]

    # --- moves ---------------------------------------------------------------------------

    @rule(
        at=st.sampled_from(STEPS), roles=st.sampled_from(["source", "destination", "both"]),
        answered=chance, room=chance, power=chance, seconds=st.sampled_from([1.0, 12.0, 80.0]),
    )  # fmt: skip
    def move_and_lose(
        self, at: str, roles: str, answered: bool, room: bool, power: bool, seconds: float
    ) -> None:
        """Lose hosts of a move just before an executor does its work."""
        for machine in self.machines:
            machine.befalls[at] = lambda: self.lose_hosts_of_the_move(roles, room, power)
            machine.mute |= set() if answered else {at}
        self.cluster.migrate("p")
        wait(self.cluster, seconds)
        for machine in self.machines:
            machine.befalls.clear()
            machine.mute.clear()

    def lose_hosts_of_the_move(self, roles: str, room: bool, power: bool) -> None:
        run = self.cluster.state.migrations.get("p")
        if run is None:
            return
        both = {"source": run.source_host.name, "destination": run.destination_host.name}
        lost = {name for role, name in both.items() if roles in (role, "both")}
        for machine in self.machines:
            if machine.name in lost:
                self.lose(machine, power)
            elif not room:
                self.cluster.ask(happened.HostStateRequested, machine.name, "cordon", settle=False)

    @rule(seconds=st.sampled_from([1.0, 20.0]))
    def move(self, seconds: float) -> None:
        self.cluster.migrate("p")
        wait(self.cluster, seconds)

    # --- hosts ---------------------------------------------------------------------------

    @rule(name=hosts, power=chance, seconds=st.sampled_from([1.0, 12.0]))
    def host_is_lost(self, name: str, power: bool, seconds: float) -> None:
        self.lose(host(self.cluster, name), power)
        wait(self.cluster, seconds)

    def lose(self, machine: Portable, power: bool) -> None:
        if machine.connected and power:
            machine.lose_power(self.cluster.now)
            self.may_restart = True
        machine.connected = False
        self.changed_at = self.cluster.now

    @rule(name=hosts)
    def host_is_back(self, name: str) -> None:
        machine = host(self.cluster, name)
        wait(self.cluster, 1.5)  # the name is blocked until its former run is silent
        machine.connected = True
        assert self.cluster.register(machine).accepted
        wait(self.cluster, 2.0)
        self.changed_at = self.cluster.now

    @rule(name=hosts)
    def slave_stops(self, name: str) -> None:
        """Stop a slave: it ends its processes, and another slave starts later."""
        machine = host(self.cluster, name)
        if machine.connected:
            self.cluster.leave(name)
            self.lose(machine, power=True)
            wait(self.cluster, 1.0)

    @rule(name=hosts)
    def slave_is_killed(self, name: str) -> None:
        """Kill a slave; its processes keep running under the next one."""
        machine = host(self.cluster, name)
        if machine.connected:
            machine.connected = False
            wait(self.cluster, 1.5)
            machine.restart_slave(self.cluster.now)
            self.host_is_back(name)

    @rule(name=hosts, action=st.sampled_from(["cordon", "uncordon"]))
    def host_is_closed_or_opened(self, name: str, action: str) -> None:
        self.cluster.set_host(name, action)

    # --- time and the master -------------------------------------------------------------

    @rule(seconds=st.sampled_from([1.0, 12.0, 80.0]))
    def time_passes(self, seconds: float) -> None:
        wait(self.cluster, seconds)

    @rule(turn=st.integers(1, 60), durable=chance, at=st.sampled_from(["", "", *STEPS]),
          roles=st.sampled_from(["source", "destination", "both"]))  # fmt: skip
    def master_is_killed(self, turn: int, durable: bool, at: str, roles: str) -> None:
        """Kill the master while a move begins or while it loses a host."""
        live = kill_at(self.cluster, turn, durable=durable)
        try:
            if at:
                self.move_and_lose(at, roles, answered=False, room=True, power=False, seconds=20.0)
            else:
                self.move(seconds=2.0)
        except Killed:
            pass
        finally:
            live()
            for machine in self.machines:
                machine.befalls.clear()
                machine.mute.clear()
        self.cluster.restart_master()
        wait(self.cluster, 2.0)
        self.changed_at = self.cluster.now

    @precondition(lambda self: self.cluster["p"].phase.is_terminal)
    @rule()
    def begins_again(self) -> None:
        self.cluster.restart("p")
        wait(self.cluster, 1.0)

    # --- invariants ----------------------------------------------------------------------

    @invariant()
    def one_node_is_active(self) -> None:
        assert len(active_in_contact(self.cluster)) <= 1

    @invariant()
    def its_memory_is_not_given_up_for_nothing(self) -> None:
        """Check that with the policy `wait` p starts again only after a power loss."""
        for machine in self.machines:
            for instance, program in machine.programs.items():
                self.begun |= set() if program.assignment.restored else {instance.number}
        assert self.may_restart or len(self.begun) == 1, self.begun

    @invariant()
    def its_policy_is_followed(self) -> None:
        """Check that no plan waits for a lost host, unless the policy is `wait`."""
        process = self.cluster["p"]
        calm = self.cluster.now - self.changed_at > self.patience
        if calm and self.up() and process.spec.host_loss.then != "wait":
            assert "p" not in self.cluster.state.migrations, process.reason
            owner = self.cluster.state.instances.get(process.owner)
            assert owner is None or owner.host.name in self.up()

    def up(self) -> list[str]:
        table = self.cluster.state.hosts
        return [name for name in HOSTS
                if table.condition_of(table.by_name[name]) is HostCondition.UP]  # fmt: skip

    def teardown(self) -> None:
        """Check that p, without further faults, runs on one host or has failed by its policy."""
        for name in HOSTS:
            self.host_is_back(name)
            self.cluster.set_host(name, "uncordon")
        wait(self.cluster, self.patience)
        if self.cluster.phase("p") == "failed":
            assert self.cluster["p"].spec.host_loss.then == "stop"
            assert self.cluster.where("p") == []
            self.begins_again()
        runs_alone(self.cluster, *HOSTS)
        nothing_else(self.cluster)


TestLife = Life.TestCase
if os.environ.get("ROSRM_PLAY") != "long":  # each step is some seconds of the play
    TestLife.settings = settings(max_examples=30, stateful_step_count=20)
