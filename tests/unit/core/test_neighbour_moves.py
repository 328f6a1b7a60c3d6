"""Neighbours under random submissions, moves, drains, losses and ends: the rules hold throughout.

Hypothesis plays users and hosts. The truth is what really runs on the machines.
"""

from __future__ import annotations

from itertools import permutations

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosrm.core.master.invariants import check
from rosrm.model.values import HostLossPolicy, NeighbourRule
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process

RACKS = {"a": "1", "b": "1", "c": "2", "d": "2"}
NAMES = [f"p{number}" for number in range(5)]

names = st.sampled_from(NAMES)
hosts = st.sampled_from(sorted(RACKS))
labels = st.sampled_from(["", "", "rack"])
preferred = st.sampled_from([False, False, False, True])
relations = st.sampled_from(["near", "apart"])
rules = st.one_of(
    st.builds(NeighbourRule, relations, st.tuples(names), by=labels, prefer=preferred),
    st.builds(NeighbourRule, st.just("apart"), group=st.just("g"), by=labels),
)
chance = st.booleans()


class Neighbours(RuleBasedStateMachine):
    """Users submit, cancel and move processes with rules; hosts are drained, lost and return."""

    @initialize(backfill=chance)
    def begin(self, *, backfill: bool) -> None:
        machines = [
            Machine(name, memory=1000 * MIB, labels={"rack": rack})
            for name, rack in RACKS.items()
        ]  # fmt: skip
        self.cluster = Cluster(
            *machines, backfill=backfill, settle=1.0, suspect=1.0, lease=2.0, cooldown=1.0
        )
        self.was_lost = False

    @rule(
        name=names, found=st.lists(rules, max_size=2), movable_one=chance,
        memory=st.sampled_from([0, 100, 300]), loss=st.sampled_from(["wait", "elsewhere"]),
        priority=st.integers(0, 1),
    )  # fmt: skip
    def submit(
        self, name: str, found: list[NeighbourRule], *, movable_one: bool, memory: int, loss: str,
        priority: int,
    ) -> None:  # fmt: skip
        make = movable if movable_one else process
        self.cluster.submit(
            make(
                name, memory=memory, neighbours=tuple(found), priority=priority,
                host_loss=HostLossPolicy(loss),
            )
        )  # fmt: skip

    @rule(name=names)
    def cancel(self, name: str) -> None:
        self.cluster.cancel(name)

    @rule(name=names, host=hosts | st.none())
    def migrate(self, name: str, host: str | None) -> None:
        self.cluster.migrate(name, host)

    @rule(host=hosts, action=st.sampled_from(["drain", "cordon", "uncordon", "uncordon"]))
    def set_host(self, host: str, action: str) -> None:
        self.cluster.set_host(host, action)

    @rule(host=hosts)
    def lose(self, host: str) -> None:
        if self.cluster.machines[host].connected:
            self.was_lost = True
            self.cluster.cut(host, seconds=4.0)

    @rule(host=hosts)
    def rejoin(self, host: str) -> None:
        if not self.cluster.machines[host].connected:
            self.cluster.rejoin(host)

    @rule(name=names)
    def finish(self, name: str) -> None:
        for host in self.cluster.where(name)[:1]:
            if self.cluster.machines[host].connected:
                self.cluster.finish(name, host, code=1)

    @rule()
    def restart_master(self) -> None:
        self.cluster.restart_master()

    @rule(seconds=st.sampled_from([0.3, 3.0]))
    def wait(self, seconds: float) -> None:
        self.cluster.wait(seconds)

    @invariant()
    def processes_run_apart(self) -> None:
        for one, other in permutations(self.live(), 2):
            for found in self.cluster[one].spec.neighbours:
                named = other in found.processes or (found.group and self.in_group(other))
                if found.relation == "apart" and not found.prefer and named:
                    here = {place(host, found.by) for host in self.cluster.where(one)}
                    assert here.isdisjoint(
                        place(host, found.by) for host in self.cluster.where(other)
                    )

    @invariant()
    def processes_run_near(self) -> None:
        """A process that is separated from another one is recorded, and not without a cause."""
        separated = self.cluster.state.neighbours.separated
        for one in self.live():
            for found in self.cluster[one].spec.neighbours:
                if found.relation == "near" and not found.prefer:
                    apart = [name for name in found.processes if self.is_apart(one, name, found.by)]
                    assert not apart or self.was_lost
                    assert not apart or self.is_recent() or one in separated
        if self.cluster.recorded("separated"):
            assert self.was_lost

    @invariant()
    def state_is_sound(self) -> None:
        check(self.cluster.state)

    def live(self) -> list[str]:
        known = self.cluster.state.processes.values()
        return [one.name for one in known if not one.phase.is_terminal]

    def in_group(self, name: str) -> bool:
        return any(found.group for found in self.cluster[name].spec.neighbours)

    def is_apart(self, one: str, other: str, by: str) -> bool:
        """Return True if two processes stay on hosts in two places."""
        state, owners = self.cluster.state, []
        for name in (one, other):
            known = state.processes.get(name)
            owner = None if known is None else state.instances.get(known.owner)
            if owner is None or name in state.migrations or known.wanted != "run":
                return False
            owners.append(place(owner.host.name, by))
        return owners[0] != owners[1]

    def is_recent(self) -> bool:
        """Let the master review its processes; return False."""
        self.cluster.wait(0.3)
        return False


def place(host: str, by: str) -> str:
    return RACKS[host] if by else host


TestNeighbours = Neighbours.TestCase
TestNeighbours.settings = settings(stateful_step_count=25)
