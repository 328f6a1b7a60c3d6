"""The strategy `handoff`: alias, options of a process, and the protocol of the paper."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.model.plan import AwaitReleased, Configure, Execute, Move, Plan, Start, Stop
from rosrm.model.values import InstanceId, MigrationPolicy, ProcessSpec, StopPolicy
from rosrm.testing import with_options
from rosrm_migration.handoff import Handoff, HandoffOptions, alias_of
from rosrm_migration.plugin import register_migration_strategies
from tests.unit.core.cluster import Cluster, process

OFFER = next(one for one in register_migration_strategies() if one.name == "handoff")
PAPER = {"protocol": "paper", "state": "/counter/state", "type": "std_msgs/msg/Int64"}


def move(name: str = "counter", source_node: str = "counter", **options: Any) -> Move:
    """Return the move of a node from a to b."""
    spec = ProcessSpec(
        name, command=("run",), ros=True, migration=MigrationPolicy("handoff", options=options),
        stop=StopPolicy(1.0, 2.0),
    )  # fmt: skip
    numbered = [InstanceId(name, number) for number in (1, 2, 3)]
    one = Move(spec, numbered[0], "a", numbered[1], "b", numbered[2], 1_700_000_000, source_node)
    return with_options(one, OFFER)


def of_kind(plan: Plan, kind: type) -> Any:
    """Return the only step of a kind."""
    (step,) = (step for step in plan.steps if isinstance(step, kind))
    return step


@pytest.mark.parametrize(
    ("name", "source", "alias"),
    [
        ("counter", "counter", "counter_1700000000"),
        ("counter", "counter_1700000000", "counter_1700000001"),  # two handoffs within a second
        ("n_1700000000", "n_1700000000", "n_1700000000_1700000000"),
        ("n" * 255, "counter", f"{'n' * 244}_1700000000"),  # the greatest length in ROS 2
    ],
)
def test_the_alias_has_the_time_as_its_suffix(name, source, alias) -> None:
    """The suffix is that of the paper; the alias differs from the name of the source."""
    assert alias_of(move(name, source)) == alias


def test_options_of_a_process_go_over_those_of_the_cluster() -> None:
    """The other options keep the cluster's values."""
    asked = with_options(move(ready_timeout=60.0), OFFER, start_timeout=3.0, ready_timeout=4.0)
    plan = Handoff(HandoffOptions()).propose(asked)
    waits = {step.phase.name: step.timeout for step in plan.steps if isinstance(step, Configure)}
    assert waits == {"SHADOW": 60.0, "SWITCH": 10.0, "DONE": 3.0}
    assert of_kind(plan, Start).timeout == 3.0
    assert of_kind(plan, Stop).timeout == 8.0


def test_the_papers_protocol_listens_and_declares_its_overlap() -> None:
    """The destination's slave watches for a second publisher; no node is asked to fall silent."""
    plan = Handoff(HandoffOptions()).propose(move(**PAPER))
    listen = of_kind(plan, Execute)
    assert (listen.executor, listen.host) == ("handoff_watch", "b")
    assert listen.arguments == {
        "state": "/counter/state", "type": "std_msgs/msg/Int64", "timeout": 30.0,
        "source": "counter", "destination": "counter_1700000000",
    }  # fmt: skip
    assert listen.timeout > 30.0
    assert plan.overlap == listen.timeout + 8.0
    phases = [step.phase.name for step in plan.steps if isinstance(step, Configure)]
    assert phases == ["SHADOW", "DONE"]
    assert not [step for step in plan.steps if isinstance(step, AwaitReleased)]


def test_a_state_below_the_nodes_own_name_stays_there_under_the_alias() -> None:
    """Other topics keep their names."""
    plan = Handoff(HandoffOptions()).propose(move(**PAPER))
    assert of_kind(plan, Start).remappings == {"~/state": "/counter/state"}
    elsewhere = Handoff(HandoffOptions()).propose(move(**{**PAPER, "state": "/other/state"}))
    assert of_kind(elsewhere, Start).remappings == {}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"fast": True}, "unknown fast"),
        ({"ready_timeout": -1.0}, "ready_timeout: -1.0 is not greater than 0"),
        ({"ready_timeout": "soon"}, "ready_timeout: 'soon' is not a number, or text"),
        ({"protocol": "mine"}, "protocol 'mine'; allowed: rosrm, paper"),
        ({"protocol": "paper"}, "names the topic"),
        ({**PAPER, "state": "counter/state"}, "state is 'counter/state'"),
        ({**PAPER, "type": "Int64"}, "type is 'Int64'"),
        ({"type": "std_msgs/msg/Int64"}, "go with `protocol: paper`"),
    ],
)
def test_nonsense_is_refused_when_the_process_is_submitted(given: Any, said: str) -> None:
    """The master merges the options and refuses them, before it calls the strategy."""
    cluster = Cluster("a", strategies={"handoff": Handoff(HandoffOptions())})
    policy = MigrationPolicy("handoff", options=given)
    reply = cluster.submit(process("counter", ros=True, migration=policy))
    assert not reply.accepted
    assert reply.message.startswith("counter: migration by 'handoff': ")
    assert said in reply.message


def test_a_process_that_handoff_cannot_move_is_refused() -> None:
    """A process needs a node, and for the paper's protocol it may overlap."""
    strategy, spec = Handoff(HandoffOptions()), move(**PAPER).spec
    assert "set `ros: true`" in strategy.spec_fault(replace(move().spec, ros=False))
    alone = replace(spec, migration=replace(spec.migration, overlap=False))
    assert "`overlap: false`" in strategy.spec_fault(alone)
