"""A third party's strategy gets what its capabilities say, whatever its name is."""

from __future__ import annotations

from types import SimpleNamespace

import rosrm_scoring.plugin
from rosrm.extensions.contracts import Capabilities, CheckpointChoice, MigrationOffer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.registry import Registry
from rosrm.model.orders import ReplicateSnapshot
from rosrm.model.plan import Execute
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    Readiness,
    RestartPolicy,
    StandbyPolicy,
)
from tests.unit.core.cluster import Cluster, HandOver, process
from tests.unit.core.machine import Machine
from tests.unit.core.test_periodic import Pacing
from tests.unit.core.test_replication import Asked, assigned, keep, others, where

TELEPORT = MigrationPolicy("teleport")


class Teleport(HandOver):
    """Moves as `handoff` does, and dumps a process every 5 s."""

    discard = "teleport.sweep"

    def checkpoint_every(self, spec):
        return 5.0

    def periodic(self, spec, instance, host, now):
        return Execute("teleport.dump", host, {"number": instance.number}, 10.0)


def teleported(**fields):
    return process("p", ros=True, readiness=Readiness("running"), migration=TELEPORT, **fields)


def cluster_with(capabilities: Capabilities, *machines: str | Machine) -> Cluster:
    offer = MigrationOffer("teleport", lambda _: Teleport(), capabilities=capabilities)
    hook = hookimpl(specname="register_migration_strategies")(lambda: [offer])
    theirs = SimpleNamespace(register_migration_strategies=hook)
    registry = Registry.of(theirs=theirs, scoring=rosrm_scoring.plugin)
    declared = registry.declared({"teleport": {}})
    return Cluster(*machines, strategies={"teleport": Teleport()}, declared=declared)


def test_a_state_on_topics_has_snapshots():
    """The slave keeps them, the master orders replicas, and the next start gets the newest."""
    policy = Asked()
    cluster = cluster_with(Capabilities(state="topics"), "a", "b", "c")
    cluster.state.replication.policy, cluster.state.replication.policy_name = policy, "asked"
    cluster.submit(teleported(host_loss=HostLossPolicy("elsewhere")))
    cluster.wait(1.0)
    assert assigned(cluster).has_snapshots
    keep(cluster, where(cluster), ("p", cluster["p"].owner, 4))
    other = others(cluster)[0]
    policy.answer = CheckpointChoice((other,))
    cluster.wait(3.0)
    assert cluster.orders(ReplicateSnapshot)[-1].hosts == (other,)
    keep(cluster, other, ("p", cluster["p"].owner, 4))
    cluster.machines[where(cluster)].connected = False
    cluster.wait(12.0)
    assert assigned(cluster).snapshot_hosts == (other,)


def test_a_strategy_that_can_shadow_has_standbys():
    """As of any strategy that declares it; otherwise the submission is refused."""
    spec = teleported(standby=StandbyPolicy(wanted=True))
    cluster = cluster_with(Capabilities(state="topics", shadow=True), "a", "b")
    cluster.submit(spec)
    cluster.wait(11.0)
    assert (cluster.where("p"), cluster.active()) == (["a", "b"], ["a"])
    refusal = cluster_with(Capabilities(state="topics"), "a").submit(spec)
    assert not refusal.accepted
    assert "teleport has no standby: install a strategy with standbys" in refusal.message


def test_a_strategy_that_restarts_from_images_has_periodic_checkpoints():
    """At the pace that the strategy names; without the capability it is not asked for one."""
    for able in (True, False):
        dumps = []
        executors = {"teleport.dump": lambda a, dumps=dumps: dumps.append(a) or {"size": 1}}
        executors["teleport.sweep"] = lambda _: {}
        machine = Machine("a", executors=executors)
        cluster = cluster_with(Capabilities(state="memory", restart_from_image=able), machine)
        cluster.state.replication.policy, cluster.state.replication.policy_name = Pacing(), "pacing"
        cluster.submit(process("p", migration=TELEPORT, restart=RestartPolicy("on-failure")))
        cluster.wait(13.0)
        assert len(dumps) == 2 * able


def test_a_refused_checkpoint_names_a_strategy_that_makes_images():
    """By the word for the cluster's file."""
    cluster = cluster_with(Capabilities(state="memory"), "a")
    cluster.submit(process("p"))
    cluster.wait(1.0)
    assert "can checkpoint p: name `teleport` below" in cluster.checkpoint("p").message
