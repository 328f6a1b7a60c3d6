"""`InputReplay`: the pace of the further work by which a successor starts."""

from __future__ import annotations

import threading

import pytest

from rosrm.node.handoff import replay as module
from rosrm.node.handoff.replay import InputReplay


@pytest.fixture
def begun(stage, monkeypatch):
    """Return a function that begins three steps with a time without cycles; and the steps done."""
    done = []

    def step():
        if len(done) < 3:
            done.append(len(done))
            return True
        return False

    def begin(idle):
        monkeypatch.setattr(module, "_IDLE", idle)
        replay = InputReplay(stage.plain, threading.RLock(), lambda: False)
        replay.begin(step)
        return replay

    return begin, done


def test_a_node_with_cycles_starts_by_one_step_after_each(stage, begun):
    """A step never runs between two messages, where it would delay the next one."""
    begin, done = begun
    replay = begin(60.0)
    stage.spin_until(lambda: done and not replay.is_on, "the first step")
    for many in (1, 2, 3):
        assert done == list(range(many))
        replay.after_cycle()
    assert done == [0, 1, 2]


def test_an_idle_node_starts_without_cycles(stage, begun):
    """The services of a node without inputs open soon."""
    begin, done = begun
    replay = begin(0.001)
    stage.spin_until(lambda: done == [0, 1, 2] and not replay.is_on, "all steps")
