"""The plans of `criu` for checkpoints and restores: sound, and whose options they are made by."""

from __future__ import annotations

from rosrm.extensions.contracts import Imaging
from rosrm.extensions.plugin_calls import implements
from rosrm.model.plan import Aim, Execute, Move, Plan, Start, plan_fault
from rosrm.model.values import InstanceId, MigrationPolicy, ProcessSpec
from rosrm.testing import with_options
from rosrm_criu.options import CriuOptions
from rosrm_criu.plans import DROP, KEEP
from rosrm_criu.plugin import register_migration_strategies
from rosrm_criu.strategy import Criu

OFFER = next(one for one in register_migration_strategies() if one.name == "criu")
CRIU = Criu(CriuOptions(dump_timeout=7.0))


def move(spec: ProcessSpec, source_node: str = "p") -> Move:
    one, two, three = (InstanceId("p", number) for number in (1, 2, 3))
    asked = Move(spec, one, "a", two, "a", three, 0, source_node)
    return with_options(asked, OFFER, dump_timeout=7.0)


def timeout_of(plan: Plan, executor: str) -> float:
    """Of the executor itself."""
    (step,) = (one for one in plan.steps if isinstance(one, Execute) and one.executor == executor)
    return float(step.arguments["timeout"])


def test_any_process_is_planned_for() -> None:
    """Whether it is a ROS node or not, and however it moves."""
    assert implements(CRIU, Imaging)
    for strategy in (None, "relaunch", "criu"):
        asked = move(ProcessSpec("p", migration=MigrationPolicy(strategy)))
        assert plan_fault(CRIU.checkpoint(asked), asked, Aim.CHECKPOINT) == ""
        assert plan_fault(CRIU.restore(asked), asked, Aim.RESTORE) == ""


def test_the_options_of_a_process_are_its_own_where_it_moves_by_criu() -> None:
    """Those of another strategy would be none of ours."""
    own = MigrationPolicy("criu", options={"dump_timeout": 9.0})
    other = MigrationPolicy("handoff", options={"protocol": "paper"})
    for policy, seconds in ((own, 9.0), (other, 7.0)):
        plan = CRIU.checkpoint(move(ProcessSpec("p", migration=policy)))
        assert timeout_of(plan, KEEP) == seconds


def test_a_node_keeps_its_alias() -> None:
    """It knows itself by no other name."""
    for alias, said in (("p_7", "p_7"), ("p", "")):
        plan = CRIU.restore(move(ProcessSpec("p"), alias))
        (start,) = (step for step in plan.steps if isinstance(step, Start))
        assert (start.node_name, start.restored, start.undo) == (said, True, None)


def test_every_executor_is_there() -> None:
    """Of all that the plans and their undo name, and what removes an image."""
    asked = move(ProcessSpec("p"))
    steps = [*CRIU.checkpoint(asked).steps, *CRIU.restore(asked).steps]
    named = {one.executor for one in steps if isinstance(one, Execute)}
    undone = {one.undo.executor for one in steps if isinstance(one.undo, Execute)}
    assert named | undone | {DROP} <= set(OFFER.executors)
