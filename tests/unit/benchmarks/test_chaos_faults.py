"""Fault injector of the chaos benchmark: its faults depend on the seed alone."""

from __future__ import annotations

import itertools

from benchmarks.chaos.fault_injector import FaultInjector
from benchmarks.chaos.faults import KINDS, MASTER, draw

HOSTS, PROCESSES = ("host1", "host2"), ("a", "b", "c")


def drawn(seed, count):
    return list(itertools.islice(draw(seed, HOSTS, PROCESSES, PROCESSES[:1]), count))


def test_the_same_seed_draws_the_same_faults():
    assert drawn(1, 50) == drawn(1, 50)
    assert drawn(1, 50) != drawn(2, 50)


def test_faults_are_numbered_and_each_has_a_target_of_its_own():
    """Two at once on one target would undo each other; every kind occurs."""
    rounds = drawn(3, 500)
    faults = [fault for one in rounds for fault in one.faults]
    assert [fault.number for fault in faults] == list(range(1, len(faults) + 1))
    assert {fault.kind for fault in faults} == {*KINDS}
    for one in rounds:
        targets = [fault.target for fault in one.faults]
        assert len(set(targets)) == len(targets) > 0
        assert set(targets) <= {MASTER, *HOSTS, *PROCESSES}
        assert [fault.at for fault in one.faults] == sorted(fault.at for fault in one.faults)
    assert all(bool(fault.lasts) == KINDS[fault.kind].lasts for fault in faults)


def test_every_kind_can_be_done():
    """The fault injector has an action for each kind, and no other one."""
    assert FaultInjector.ACTIONS.keys() == KINDS.keys()
