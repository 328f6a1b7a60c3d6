"""A strategy whose `capabilities` do not answer: unknown is never taken for "keeps no state"."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest

import rosrm_scoring.plugin
from rosrm.core.master.applications.replacement import try_replace
from rosrm.core.master.commands import Assign
from rosrm.core.master.outcomes import Rejected
from rosrm.extensions.contracts import Capabilities, MigrationOffer
from rosrm.extensions.declared_fields import Declared, UnknownCapabilities
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.registry import Registry
from rosrm.model.values import (
    Container,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    StandbyPolicy,
)
from tests.unit.core.cluster import Cluster, HandOver, process


@dataclass(frozen=True)
class Options:
    """Of the strategy `late`."""

    plain: bool = False


class Late:
    """A strategy whose `capabilities` depend on the options, and fail while it is `late`."""

    def __init__(self) -> None:
        self.late = False
        self.calls = 0
        hook = hookimpl(specname="register_migration_strategies")(lambda: [self.offer])
        self.offer = MigrationOffer(
            "late", lambda _: HandOver(), Options, capabilities=self.capabilities
        )
        plugin = SimpleNamespace(register_migration_strategies=hook)
        self.registry = Registry.of(late=plugin, scoring=rosrm_scoring.plugin)

    def capabilities(self, options: Options) -> Capabilities:
        self.calls += 1
        if self.late:
            raise TimeoutError("busy")
        return Capabilities() if options.plain else Capabilities("topics", shadow=True)

    def declared(self) -> Declared:
        """Return the declarations for a new master."""
        return self.registry.declared({"late": {}})

    def cluster(self, *machines: str) -> Cluster:
        return Cluster(*machines, strategies={"late": HandOver()}, declared=self.declared())


def spec(name: str = "p", *, plain: bool | None = None, **fields: Any) -> ProcessSpec:
    options = {} if plain is None else {"plain": plain}
    fields.setdefault("ros", True)
    fields.setdefault("readiness", Readiness("running"))
    return process(name, migration=MigrationPolicy("late", options=options), **fields)


def restart_late(late: Late, cluster: Cluster) -> None:
    """Start a new master, whose strategy has not answered yet."""
    late.late, cluster.declared = True, late.declared()
    cluster.restart_master()


def test_an_answer_is_remembered_for_its_options_alone() -> None:
    """The answer about other options says nothing about these."""
    late = Late()
    known = late.registry.capabilities_of()
    assert known(spec(plain=True)) == Capabilities()
    late.late = True
    assert known(spec(plain=True)) == Capabilities()
    unknown = known(spec())
    assert isinstance(unknown, UnknownCapabilities)
    assert "'late'" in unknown.reason
    assert "busy" in unknown.reason
    late.late = False
    assert known(spec()) == Capabilities("topics", shadow=True)


def test_a_known_answer_is_not_asked_for_again() -> None:
    """It is a pure function of the options, and thousands of processes may have the same."""
    late = Late()
    known = late.registry.capabilities_of()
    for _ in range(3):
        known(spec("a"))
        known(spec("b", plain=True))
    assert late.calls == 2


def test_the_answers_in_memory_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user may submit processes with ever other options."""
    monkeypatch.setattr("rosrm.extensions.registry._MOST_ANSWERS", 2)
    late = Late()
    known = late.registry.capabilities_of()
    for options in ({}, {"plain": True}, {"plain": False}, {}):
        known(ProcessSpec("p", migration=MigrationPolicy("late", options=options)))
    assert late.calls == 4


def test_a_strategy_that_is_not_installed_is_unknown() -> None:
    """A process without a strategy has no state; one of a removed strategy may have some."""
    known = Late().registry.capabilities_of()
    assert known(process("p")) == Capabilities()
    unknown = known(process("p", migration=MigrationPolicy("gone")))
    assert isinstance(unknown, UnknownCapabilities)
    assert "'gone' is not installed" in unknown.reason


def test_a_queued_process_waits_for_the_capabilities_in_a_new_master() -> None:
    """It starts with its state when the strategy answers; others are not held back."""
    late = Late()
    cluster = late.cluster()
    cluster.submit(spec(), process("other"))
    restart_late(late, cluster)
    cluster.add("a")
    cluster.wait(3.0)
    assert cluster.where("other") == ["a"]
    assert cluster["p"].phase.value == "queued"
    assert "waits: the capabilities of its migration strategy 'late'" in cluster["p"].reason
    assert "busy" in cluster["p"].reason
    late.late = False
    cluster.wait(3.0)
    assert cluster.where("p") == ["a"]
    assigned = [one.assignment for one in cluster.carried if isinstance(one, Assign)]
    assert [one.has_snapshots for one in assigned if one.instance.process == "p"] == [True]


def test_a_gang_waits_for_the_capabilities_of_each_of_its_processes() -> None:
    late = Late()
    cluster = late.cluster()
    cluster.submit(spec(together="g"), process("other", together="g"))
    restart_late(late, cluster)
    cluster.add("a")
    cluster.wait(3.0)
    assert not cluster.where("p")
    assert not cluster.where("other")
    assert "p of its gang g waits" in cluster["other"].reason
    late.late = False
    cluster.wait(3.0)
    assert cluster.where("p") == cluster.where("other") == ["a"]


def test_a_changed_spec_waits_for_its_capabilities() -> None:
    """The options in the queue may change in place."""
    late = Late()
    cluster = late.cluster()
    cluster.apply("app", spec(plain=True))
    late.late = True
    cluster.apply("app", spec(plain=False))
    cluster.add("a")
    cluster.wait(3.0)
    assert "capabilities" in cluster["p"].reason
    assert not cluster.where("p")


def test_a_repeated_assignment_has_the_snapshots_of_an_unknown_strategy() -> None:
    """The order is out already; snapshots that do not exist do no harm."""
    late = Late()
    cluster = late.cluster()
    cluster.submit(spec())
    restart_late(late, cluster)
    instance = cluster.state.new_instance_id(cluster["p"])
    assert cluster.state.assignment(instance, spec()).has_snapshots
    assert not cluster.state.assignment(instance, spec(ros=False)).has_snapshots


def test_a_removed_process_of_an_unknown_strategy_counts_as_stateful() -> None:
    """A host may return with its replica, which would stay for ever."""
    late = Late()
    cluster = late.cluster("a")
    cluster.submit(spec())
    cluster.cancel("p")
    restart_late(late, cluster)
    cluster.state.settings = replace(cluster.state.settings, keep_ended=0)
    cluster.wait(3.0)
    assert "p" not in cluster.state.processes
    assert "p" in cluster.intents["removed"]


def test_a_new_version_of_an_unknown_strategy_replaces_nothing_yet() -> None:
    """A stateful process would be stopped, instead of handing its state over."""
    late = Late()
    cluster = late.cluster("a", "b")
    cluster.submit(spec())
    late.late = True
    new = spec(plain=False, command=("y",))
    refusal = try_replace(cluster.state, cluster["p"], new, "version 2", cluster.now)
    assert isinstance(refusal, Rejected)
    assert "capabilities" in refusal.reason
    assert cluster["p"].phase.value == "running"


def test_requests_that_depend_on_unknown_capabilities_are_refused() -> None:
    """With the reason, instead of "has no standby"."""
    late = Late()
    cluster = late.cluster("a", "b")
    cluster.submit(spec())
    restart_late(late, cluster)
    cluster.wait(3.0)
    said = cluster.checkpoint("p").message
    assert "p cannot be checkpointed: the capabilities of its migration strategy 'late'" in said
    for fields in ({"standby": StandbyPolicy(wanted=True)}, {"container": Container("img")}):
        refusal = cluster.submit(spec("q", **fields))
        assert not refusal.accepted
        assert "q: the capabilities of its migration strategy 'late'" in refusal.message
