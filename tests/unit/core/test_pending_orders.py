"""The table of pending orders: numbers, purposes, answers."""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.core.master.state.pending_orders import (
    CapabilityQuery,
    MigrationStep,
    PendingOrders,
    PeriodicCheckpoint,
    Replication,
)
from tests.unit.core.cluster import Cluster, Machine, job


def test_optional_plugins_do_not_shift_the_numbers_of_other_orders():
    """A recording that is replayed without these plugins gives the other orders the same ids."""
    orders, fewer = PendingOrders(), PendingOrders()
    orders.add(Replication("p"))
    orders.add(CapabilityQuery("criu", "a"))
    orders.add(PeriodicCheckpoint(1))
    assert orders.add(MigrationStep("p")) == fewer.add(MigrationStep("p"))
    assert orders.add() == fewer.add()
    assert orders.add(Replication("q")) == ("replication", 2)
    assert fewer.add(CapabilityQuery("criu", "a")) == ("capability", 1)


def test_an_answered_order_is_removed():
    orders = PendingOrders()
    order = orders.add(MigrationStep("p"))
    assert orders.pop(order) == MigrationStep("p")
    assert orders.pop(order) is None


def test_an_answer_to_an_order_of_a_former_master_is_ignored():
    """The orders of a former run have no purpose here, whatever their numbers."""
    cluster = Cluster(Machine("a")).with_processes(job("p"))
    for order in (1000, ("capability", 1000)):
        assert cluster.decide(happened.OrderAnswered(order, accepted=False, code="failed")) == []
