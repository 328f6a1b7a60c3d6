"""Checkpoints and restores with random kills, cuts and failures: one copy of the memory.

The wires are prompt except for the cuts; the master can be killed in any turn of its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.unit.core.cluster import Machine, process
from tests.unit.core.shelf import Shelf
from tests.unit.core.test_checkpoints import Killed, kill_at

STEPS = ["freeze", "thaw", "kill", "take", "put_back", "await"]
ACTIONS = st.sampled_from(["checkpoint", "restore"])


class Life(RuleBasedStateMachine):
    """Rules of the state machine; p has started once, and must never start from nothing again."""

    @initialize()
    def begin(self) -> None:
        self.shelf = Shelf("a")
        self.shelf.passing = True
        self.cluster = self.shelf.play("b")
        self.cluster.machines["b"].connected = False
        self.cluster.submit(process("p"))
        assert self.cluster.where("p") == ["a"]
        self.first = self.cluster["p"].owner

    @property
    def machine(self) -> Machine:
        return self.shelf.machine

    # --- faults and requests -------------------------------------------------------------

    @rule(action=ACTIONS)
    def ask(self, action: str) -> None:
        getattr(self.cluster, action)("p")

    @rule(action=ACTIONS, turn=st.integers(1, 12), durable=st.booleans())
    def ask_and_kill(self, action: str, turn: int, durable: bool) -> None:
        self.killed_in(turn, durable, lambda: getattr(self.cluster, action)("p"))

    @rule(turn=st.integers(1, 12), durable=st.booleans())
    def wait_and_kill(self, turn: int, durable: bool) -> None:
        self.killed_in(turn, durable, lambda: self.cluster.wait(1.0))

    def killed_in(self, turn: int, durable: bool, what: Callable[[], object]) -> None:
        live = kill_at(self.cluster, turn, durable=durable)
        try:
            what()
        except Killed:
            pass
        else:
            return
        finally:
            live()
        self.cluster.restart_master()
        self.cluster.wait(0.5)

    @rule(step=st.sampled_from(STEPS))
    def fail(self, step: str) -> None:
        self.shelf.trouble[step] = "it fails"

    @rule(step=st.sampled_from(STEPS))
    def fail_afterwards(self, step: str) -> None:
        self.shelf.mute.add(step)

    @rule(seconds=st.sampled_from([0.5, 3.0, 60.0]), action=st.one_of(st.none(), ACTIONS))
    def cut_for_a_while(self, seconds: float, action: str | None) -> None:
        """Cut the host off before the requested action has arrived."""
        self.machine.connected = False
        if action is not None:
            getattr(self.cluster, action)("p")
        self.cluster.wait(seconds, tick=0.5)
        self.machine.connected = True
        self.cluster.register(self.machine)
        self.cluster.wait(0.5)

    @rule()
    def restart_slave(self) -> None:
        self.machine.connected = False
        self.cluster.wait(1.5)  # the name is blocked until its former run is silent
        self.machine.restart_slave(self.cluster.now)
        self.machine.connected = True
        assert self.cluster.register(self.machine).accepted

    @rule(seconds=st.sampled_from([0.5, 3.0, 12.0]))
    def wait(self, seconds: float) -> None:
        self.cluster.wait(seconds)

    # --- invariants ----------------------------------------------------------------------

    @invariant()
    def its_memory_is_in_one_place(self) -> None:
        """Check that the memory is in one running process, or else in one image."""
        shelf = self.shelf
        numbers = {one.number for one in self.machine.programs}
        holds = set(shelf.taken)
        whole = (numbers - shelf.frozen - holds) & (shelf.alive | {self.first})
        assert numbers - shelf.frozen - holds == whole, "the process began again"
        assert len(whole) <= 1, "it is there twice"
        copies = len(shelf.images) + len(shelf.taken)
        assert len(whole) + copies == 1, f"awake {whole}, images {shelf.images}, {shelf.taken}"

    @invariant()
    def it_is_neither_queued_nor_over(self) -> None:
        """Check that p is neither queued nor terminal, because its memory still exists."""
        assert not self.cluster.queue()
        assert not self.cluster["p"].phase.is_terminal

    def teardown(self) -> None:
        """Check that p comes to rest without faults and accepts the opposite request."""
        self.shelf.trouble.clear()
        self.shelf.mute.clear()
        for wanted, action in (("checkpointed", "checkpoint"), ("running", "restore")):
            for _ in range(90):
                self.cluster.wait(1.0, tick=0.5)
                if "p" not in self.cluster.state.migrations and self.cluster.phase("p") == wanted:
                    break
                getattr(self.cluster, action)("p")
            assert self.cluster.phase("p") == wanted, self.cluster["p"].reason
            self.its_memory_is_in_one_place()


TestLife = Life.TestCase
if os.environ.get("ROSRM_PLAY") != "long":  # each step is some seconds of the play
    TestLife.settings = settings(max_examples=25, stateful_step_count=25)
