"""The blackout in the record of a migration: how long no instance was active."""

from __future__ import annotations

import pytest

from tests.unit.core import test_handoffs as handoffs
from tests.unit.core import test_migrations as migrations


def blackout(cluster):
    """Return the blackout of the only migration; None: it is not known."""
    (facts,) = [record.facts for record in cluster.records if record.kind == "migrated"]
    return facts.get("blackout")


def test_an_overlapping_move_has_no_blackout():
    """The source ends after the destination is ready."""
    cluster = migrations.two_hosts()
    cluster.migrate("p")
    cluster.discover("p", "b")
    cluster.wait(2.0)

    assert blackout(cluster) == 0.0


@pytest.mark.parametrize("restarted", [False, True])
def test_a_stop_first_is_a_blackout_until_the_destination_is_ready(restarted):
    """The blackout begins at the order to stop, whose time a restarted master does not know."""
    cluster = migrations.two_hosts(overlap=False)
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    cluster.wait(3.0)
    if restarted:
        cluster.restart_master()
    cluster.let_go("p")
    cluster.wait(2.0)
    cluster.discover("p", "b")
    cluster.wait(1.0)

    assert cluster.where("p") == ["b"]
    assert blackout(cluster) == (None if restarted else pytest.approx(5.0, abs=0.5))


def test_the_blackout_of_a_handoff_is_between_the_reports_of_both_nodes():
    """The commit comes later; in the simulation both reports come at once."""
    cluster = handoffs.two_hosts()
    cluster.migrate("p", "b")
    cluster.wait(3.0)

    assert blackout(cluster) == 0.0


def test_a_source_that_died_has_no_known_blackout():
    """The master does not know since when the source had been silent."""
    cluster = handoffs.two_hosts()
    handoffs.quirk(cluster, "a", "never silent")
    cluster.migrate("p", "b")
    cluster.finish("p", code=3)

    assert (cluster.where("p"), blackout(cluster)) == (["b"], None)
