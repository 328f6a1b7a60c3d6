"""Plans of `criu` for checkpoints and restores, their options and their executors."""

from __future__ import annotations

from rosrm.extensions.contracts import Imaging
from rosrm.extensions.plugin_calls import implements
from rosrm.model.plan import Aim, Execute, Move, Plan, Start, plan_fault
from rosrm.model.values import InstanceId, MigrationPolicy, ProcessSpec
from rosrm.testing import with_options
from rosrm_criu.options import CriuOptions
from rosrm_criu.plans import DROP, KEEP
from rosrm_criu.plugin import EXECUTORS, executor, register_migration_strategies
from rosrm_criu.strategy import Criu

OFFER = next(one for one in register_migration_strategies() if one.name == "criu")
CRIU = Criu(CriuOptions(dump_timeout=7.0))


def request(spec: ProcessSpec, source_node: str = "p") -> Move:
    one, two, three = (InstanceId("p", number) for number in (1, 2, 3))
    move = Move(spec, one, "a", two, "a", three, 0, source_node)
    return with_options(move, OFFER, dump_timeout=7.0)


def timeout_of(plan: Plan, executor: str) -> float:
    """Return the timeout of the executor itself, in seconds."""
    (step,) = (one for one in plan.steps if isinstance(one, Execute) and one.executor == executor)
    return float(step.arguments["timeout"])


def test_any_process_is_planned_for() -> None:
    """A process may be a ROS node or not, and migrate by another strategy."""
    assert implements(CRIU, Imaging)
    for strategy in (None, "relaunch", "criu"):
        move = request(ProcessSpec("p", migration=MigrationPolicy(strategy)))
        assert plan_fault(CRIU.checkpoint(move), move, Aim.CHECKPOINT) == ""
        assert plan_fault(CRIU.restore(move), move, Aim.RESTORE) == ""


def test_the_options_of_a_process_are_its_own_where_it_moves_by_criu() -> None:
    """Options of another strategy do not count."""
    own = MigrationPolicy("criu", options={"dump_timeout": 9.0})
    other = MigrationPolicy("handoff", options={"protocol": "paper"})
    for policy, seconds in ((own, 9.0), (other, 7.0)):
        plan = CRIU.checkpoint(request(ProcessSpec("p", migration=policy)))
        assert timeout_of(plan, KEEP) == seconds


def test_a_node_keeps_its_alias() -> None:
    """The restored node still has the name under which it was started."""
    for alias, said in (("p_7", "p_7"), ("p", "")):
        plan = CRIU.restore(request(ProcessSpec("p"), alias))
        (start,) = (step for step in plan.steps if isinstance(step, Start))
        assert (start.node_name, start.restored, start.undo) == (said, True, None)


def test_every_step_of_a_plan_has_an_executor() -> None:
    """The steps of the plans and their undo, the one that drops an image, and no other one."""
    move = request(ProcessSpec("p", ros=True, migration=MigrationPolicy("criu")))
    plans = (CRIU.checkpoint(move), CRIU.restore(move), CRIU.propose(move))
    steps = [each for plan in plans for step in plan.steps for each in (step, step.undo)]
    named = {one.executor for one in steps if isinstance(one, Execute)}
    periodic = CRIU.periodic(move.spec, move.source, "a", 0)
    assert {*named, DROP, periodic.executor, CRIU.discard, CRIU.host_check} == set(EXECUTORS)
    assert set(OFFER.executors) == set(EXECUTORS)
    assert all(callable(executor(step)) for step in EXECUTORS)  # their modules are loaded late
