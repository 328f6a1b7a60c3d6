"""State machine test of preemption: claims, and the processes that make room, in random events.

Hypothesis plays users, and machines that fall silent or whose processes do not stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from rosrm.core.master.assignment.assign import decide_now
from rosrm.core.master.commands import Assign, Command
from rosrm.core.master.migration.start import moves_under_way
from rosrm.model.records import Record
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process

LOW, URGENT = [f"p{i}" for i in range(6)], ["u0", "u1", "u2"]
#: Sizes of the first processes: urgent ones then need the room of several, or of few large ones.
FILLS = {"small": (100,) * 6, "large": (150, 150, 150, 150, 100, 100)}
HOSTS = {"a": 600, "b": 500, "c": 300}
low, urgent, hosts = st.sampled_from(LOW), st.sampled_from(URGENT), st.sampled_from(list(HOSTS))
chance, seldom = st.booleans(), st.sampled_from([False, False, False, True])
seconds = st.sampled_from([0.5, 1.5, 3.0, 8.0])
#: Seconds after which each claim has ended: 2 minutes for each process that leaves, and a review.
LONGEST = 120.0 * len(LOW + URGENT) + 2.0


class Claims(RuleBasedStateMachine):
    """Rules of the state machine; `look` checks the guarantees after each step of the core."""

    @initialize(
        mode=st.sampled_from(["move", "requeue"]), backfill=chance, most=st.sampled_from([1, 1, 2]),
        fill=st.sampled_from(list(FILLS)),
    )  # fmt: skip
    def begin(self, mode: str, backfill: bool, most: int, fill: str) -> None:
        self.cluster = Cluster(
            preemption=mode, backfill=backfill, max_migrations=most, hysteresis=1.0, cooldown=2.0,
            headroom=0.0, automatic=False,
        )  # fmt: skip
        #: By process name: the claimed column, since when, and since when the process is queued.
        self.claims: dict[str, tuple[int, float, float]] = {}
        self.moving: set[str] = set()
        self.cluster.watch = self.look
        for name, memory in HOSTS.items():
            limits, busy = {"memory": 1.0, "cpu": 1.0}, {"memory": 0.0, "cpu": 0.0}
            self.cluster.add(Machine(name, memory=memory * MIB, cpu=64.0, busy=busy, limits=limits))
        for name, memory in zip(LOW, FILLS[fill], strict=True):
            self.submit(name, memory, 0, moves=True, protect=name == "p5")

    # --- events --------------------------------------------------------------------------

    def submit(self, name: str, memory: int, priority: int, *, moves: bool, protect: bool) -> None:
        make = movable if moves else process
        self.cluster.submit(make(name, memory=memory, priority=priority, protect=protect))

    @rule(
        name=low, memory=st.sampled_from([100, 200, 300]), priority=st.integers(0, 2),
        fixed=seldom, protect=seldom,
    )  # fmt: skip
    def submit_a_low_one(
        self, name: str, memory: int, priority: int, fixed: bool, protect: bool
    ) -> None:  # fmt: skip
        """Submit a process that may have to make room."""
        self.submit(name, memory, priority, moves=not fixed, protect=protect)

    @rule(name=urgent, memory=st.sampled_from([250, 350, 450, 550]), priority=st.integers(1, 4),
          stubborn=chance, time=seconds)  # fmt: skip
    def submit_an_urgent_one(
        self, name: str, memory: int, priority: int, stubborn: bool, time: float
    ) -> None:  # fmt: skip
        """Submit a process that often fits only after others have made room, or that never do."""
        self.do_not_stop(set(LOW), stubborn)
        self.cluster.cancel(name)
        self.submit(name, memory, priority, moves=False, protect=False)
        self.cluster.wait(time, tick=0.5)

    @rule(names=st.sets(low, min_size=1), stubborn=chance)
    def do_not_stop(self, names: set[str], stubborn: bool) -> None:
        """Let processes ignore orders to stop, or obey the next order."""
        for machine in self.cluster.machines.values():
            machine.stubborn |= names
            machine.stubborn -= set() if stubborn else names

    @rule(name=low | urgent)
    def cancel(self, name: str) -> None:
        self.cluster.cancel(name)

    @rule(host=hosts, what=st.sampled_from(["silent", "cordoned", "used by others"]), time=seconds)
    def host_changes_for_a_while(self, host: str, what: str, time: float) -> None:
        machine = self.cluster.machines[host]
        if what == "silent":
            machine.connected = False
        elif what == "cordoned":
            self.cluster.set_host(host, "cordon")
        else:
            machine.busy["memory"] = 0.3
        self.cluster.wait(time, tick=0.5)
        machine.connected, machine.busy["memory"] = True, 0.0
        self.cluster.set_host(host, "uncordon")

    @precondition(lambda self: moves_under_way(self.cluster.state) == 0)
    @rule(name=low)
    def migrate(self, name: str) -> None:
        """Begin another move, which uses up a part of the bound."""
        self.cluster.migrate(name)

    @rule(time=seconds)
    def time_passes(self, time: float) -> None:
        self.cluster.wait(time, tick=0.5)

    @rule()
    def master_restarts(self) -> None:
        """Restart the master; it finds moves and stops under way, and claims their hosts again."""
        self.claims.clear()
        self.cluster.restart_master()

    # --- guarantees ----------------------------------------------------------------------

    def look(self, commands: Sequence[Command]) -> None:
        for command in commands:
            if isinstance(command, Record) and command.kind == "preempted":
                self.look_at_preemption(command)
            elif isinstance(command, Assign):
                name = command.assignment.instance.process
                self.look_at_room(name, command.host_id - 1)
        self.look_at_moves()
        self.look_at_claims()

    def look_at_preemption(self, record: Record) -> None:
        """Check that only a process of a lower priority without protection makes room."""
        state, preemptor = self.cluster.state, record.facts["for"]
        if record.process != preemptor:
            spec = state.processes[record.process].spec
            assert spec.priority < state.processes[preemptor].spec.priority
            assert not spec.protect

    def look_at_room(self, name: str, column: int) -> None:
        """Check that no process takes room that is made for one of a higher priority."""
        claimed = self.cluster.state.hosts.claims.get(column, -inf)
        if any(at == column for at, *_ in self.claims.values()):  # since before this step
            assert self.cluster.state.processes[name].spec.priority >= claimed, "room is taken"

    def look_at_moves(self) -> None:
        state = self.cluster.state
        for name in state.migrations.keys() - self.moving:
            migration = state.migrations[name]
            self.look_at_room(name, migration.destination_host.column)
            if "it makes room for" in migration.cause:
                assert moves_under_way(state) <= state.settings.max_migrations
                assert not state.processes[name].spec.protect
        self.moving = set(state.migrations)

    def look_at_claims(self) -> None:
        """Check that each claim ends, and with a reason unless its process has been placed."""
        state, now = self.cluster.state, self.cluster.now
        made = state.preemption.room_made
        present = {name: room.host.column for name, room in made.items() if room.host is not None}
        for name, (column, since, queued) in list(self.claims.items()):
            if present.get(name) == column:
                assert now - since <= LONGEST, f"{name} claims a host for too long"
                continue
            del self.claims[name]
            if name in state.queue and state.processes[name].since == queued:
                fits = decide_now(state, state.processes[name]).column >= 0
                assert fits or (name in made and made[name].reason), "a claim is lost"
        for name, column in present.items():
            self.claims.setdefault(name, (column, now, state.processes[name].since))

    def teardown(self) -> None:
        """Let time pass: all claims end, although some processes never stop."""
        if not hasattr(self, "cluster"):
            return
        waited = 0.0
        while self.claims:
            self.cluster.wait(10.0, tick=1.0)
            waited += 10.0
            assert waited <= len(HOSTS) * LONGEST, "claims follow each other without an end"


TestClaims = Claims.TestCase
TestClaims.settings = settings(max_examples=50, stateful_step_count=20, deadline=None)
