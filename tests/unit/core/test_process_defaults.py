"""The cluster's defaults for the fields that a submitted process leaves out."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.core.master.process_defaults import with_defaults
from rosrm.model.values import (
    Health,
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    StandbyPolicy,
)
from tests.unit.core.cluster import Cluster, job, node, process


def defaults(*given: str, **fields: Any) -> ProcessSpec:
    """Return defaults as the loader of cluster.yaml does: a placeholder with given fields."""
    return ProcessSpec("default", package="any", executable="any", given=given, **fields)


ALWAYS = defaults(
    "restart.when", "restart.delay", restart=RestartPolicy("always", delay=7.0, max_delay=9.0)
)


def test_only_given_fields_of_the_default_replace_fields_that_are_left_out() -> None:
    """`max_delay` is not among the given fields of the default."""
    spec, filled = with_defaults(process("p"), ALWAYS)
    assert spec.restart == RestartPolicy("always", delay=7.0)
    assert filled == ("restart.when", "restart.delay")


def test_a_given_field_counts_even_if_it_equals_the_built_in_default() -> None:
    """Only the paths that the submitter named can tell the two cases apart."""
    spec, filled = with_defaults(process("p", given=("name", "restart.when")), ALWAYS)
    assert (spec.restart.when, spec.restart.delay) == ("never", 7.0)
    assert filled == ("restart.delay",)
    spec, filled = with_defaults(process("p", given=("name", "restart")), ALWAYS)
    assert (spec.restart, filled) == (RestartPolicy(), ())


def test_a_spec_without_paths_gives_the_fields_that_differ() -> None:
    """A client that builds specs itself need not name what it gives."""
    spec, filled = with_defaults(process("p", restart=RestartPolicy("on-failure")), ALWAYS)
    assert (spec.restart.when, filled) == ("on-failure", ("restart.delay",))


def test_mappings_are_merged_and_the_entries_of_the_process_count() -> None:
    both = defaults("environment", environment={"A": "cluster", "B": "cluster"})
    spec, filled = with_defaults(process("p", environment={"A": "own"}), both)
    assert spec.environment == {"A": "own", "B": "cluster"}
    assert filled == ("environment",)


def test_a_process_sets_each_variable_in_one_way() -> None:
    """A variable or secret of a process replaces defaults of the same name in both mappings."""
    given = defaults("environment", environment={"A": "cluster", "B": "cluster"})
    spec, _ = with_defaults(process("p", secrets={"A": "/own"}), given)
    assert (spec.environment, spec.secrets) == ({"B": "cluster"}, {"A": "/own"})
    given = defaults("secrets", secrets={"A": "/cluster", "B": "/cluster"})
    spec, _ = with_defaults(process("p", environment={"A": "own"}), given)
    assert (spec.environment, spec.secrets) == ({"A": "own"}, {"B": "/cluster"})


def test_identity_and_program_have_no_default() -> None:
    """The placeholder's name and program are of no meaning."""
    own = process("p")
    assert with_defaults(own, defaults("name", "package", "executable")) == (own, ())


def test_options_of_a_strategy_apply_with_that_strategy_only() -> None:
    moved = defaults(
        "migration.strategy", "migration.options",
        migration=MigrationPolicy("handoff", options={"x": 1}),
    )  # fmt: skip
    spec, filled = with_defaults(process("p"), moved)
    assert (spec.migration.strategy, spec.migration.options) == ("handoff", {"x": 1})
    assert filled == ("migration.strategy", "migration.options")
    own, filled = with_defaults(process("p", migration=MigrationPolicy("relaunch")), moved)
    assert (own.migration.options, filled) == ({}, ())


def test_a_process_gets_no_defaults_that_only_another_kind_can_have() -> None:
    """Plain programs have no parameters or health of a node; jobs have no standby."""
    of_nodes = defaults(
        "parameters", "health.topic", "health.rate", "readiness.kind", "standby.wanted",
        "restart.when", parameters={"use_sim_time": True}, health=Health("/scan", 5.0),
        readiness=Readiness("graph"), standby=StandbyPolicy(wanted=True),
        restart=RestartPolicy("always"),
    )  # fmt: skip
    _, of_a_node = with_defaults(node("n"), of_nodes)
    assert {"parameters", "health.topic", "readiness.kind", "standby.wanted"} <= set(of_a_node)
    _, of_a_program = with_defaults(process("p"), of_nodes)
    assert of_a_program == ("restart.when", "standby.wanted")
    assert with_defaults(job("j"), of_nodes)[1] == ()


def test_a_submission_gets_the_defaults_whichever_client_sends_it() -> None:
    """The explanation, also of a restarted master, names them and their values."""
    given = defaults(
        "host_loss.then", "environment", host_loss=HostLossPolicy("elsewhere"),
        environment={"TOKEN": "secret"},
    )  # fmt: skip
    cluster = Cluster("a", process_defaults=given).with_processes(process("p"))
    assert cluster["p"].spec.host_loss.then == "elsewhere"
    expected = {"environment": None, "host_loss.then": "elsewhere"}
    assert cluster.explain("p")["defaults"] == expected
    cluster.restart_master()
    assert cluster.explain("p")["defaults"] == expected


@pytest.mark.parametrize("strategy", ["teleport", "relaunch"])
def test_a_refusal_names_the_default_that_caused_it(strategy: str) -> None:
    """The strategy is unknown, or it cannot shadow for a standby."""
    given = defaults(
        "migration.strategy", "standby.wanted", migration=MigrationPolicy(strategy),
        standby=StandbyPolicy(wanted=True),
    )  # fmt: skip
    reply = Cluster("a", process_defaults=given).submit(process("p"))
    assert not reply.accepted
    assert (
        "(migration.strategy and standby.wanted are given by `defaults.process` of the cluster)"
        in reply.message
    )
