"""The migration contract, for every shipped strategy, as for a third party's."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest

from rosrm.extensions.contracts import MigrationOffer
from rosrm.extensions.units import PositiveSeconds
from rosrm.model.plan import (
    AwaitReady,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Plan,
    SetLifecycle,
    SetRestart,
    Start,
    Stop,
)
from rosrm.model.values import LifecyclePolicy, ProcessSpec, RestartPolicy
from rosrm.testing import MigrationContract
from rosrm_criu import plugin as criu
from rosrm_migration import plugin

OFFERS = {
    offer.name: offer
    for shipped in (plugin, criu)
    for offer in shipped.register_migration_strategies()
}


class TestRelaunch(MigrationContract):
    offer = OFFERS["relaunch"]


class TestLifecycleNode(MigrationContract):
    offer = OFFERS["lifecycle_node"]
    spec = ProcessSpec("p", command=("true",), ros=True, lifecycle=LifecyclePolicy("active"))

    def test_the_source_is_inactive_before_the_destination_is_active(self):
        """On the way back the destination ends before the source is activated again."""
        move = self.moves()[0]
        plan = self.offer.create(self.offer.options()).propose(move)
        off, on = (step for step in plan.steps if isinstance(step, SetLifecycle))
        assert (off.instance, off.state, off.undo.state) == (move.source, "inactive", "active")
        assert (on.instance, on.state) == (move.destination, "active")
        assert isinstance(on.undo, Stop)
        assert on.undo.instance == move.destination
        assert plan.overlap == 0.0

    @pytest.mark.parametrize("autostart", ["inactive", "unmanaged"])
    def test_a_node_that_its_host_does_not_activate_is_refused(self, autostart):
        """Another program would activate the node during the move."""
        spec = replace(self.spec, lifecycle=LifecyclePolicy(autostart))
        strategy = self.offer.create(self.offer.options())
        assert "set `lifecycle: active`" in strategy.spec_fault(spec)
        with pytest.raises(ValueError, match="set `lifecycle: active`"):
            strategy.propose(replace(self.moves()[0], spec=spec))


class TestHandoff(MigrationContract):
    offer = OFFERS["handoff"]
    spec = ProcessSpec("p", command=("true",), ros=True, restart=RestartPolicy("on-failure"))


class TestHandoffAsInThePaper(MigrationContract):
    offer = OFFERS["handoff"]
    options: ClassVar = {"protocol": "paper", "state": "/p/state", "type": "std_msgs/msg/Int64"}
    spec = ProcessSpec("p", command=("true",), ros=True)
    not_called: ClassVar = {"handoff_watch": "needs a ROS graph: tests/ros/test_handoff_watch.py"}

    def moves(self):
        """Return moves of processes that may overlap: both instances are briefly active."""
        return [move for move in super().moves() if move.spec.migration.overlap]


class TestCriu(MigrationContract):
    offer = OFFERS["criu"]
    not_called: ClassVar = dict.fromkeys(offer.executors, "needs CRIU: tests/ros/test_criu_moves")
    spec = ProcessSpec("p", command=("true",), ros=True, restart=RestartPolicy("on-failure"))

    def test_nothing_joins_before_the_commit(self):
        """The source ends after the commit; if an earlier step fails, the source resumes."""
        plan = self.offer.create(self.offer.options()).propose(self.moves()[0])
        at = {one.executor: n for n, one in enumerate(plan.steps) if isinstance(one, Execute)}
        commit = next(n for n, one in enumerate(plan.steps) if isinstance(one, Commit))
        assert at["criu_await_restored"] < commit < at["criu_join"] < at["criu_end"]
        assert plan.steps[at["criu_checkpoint"]].undo.executor == "criu_go_on"
        assert at["criu_introduce"] < at["criu_checkpoint"] < at["criu_fetch"]
        assert plan.overlap == 0.0

    def test_a_host_of_an_older_version_needs_no_executor_of_the_copy(self):
        """The plan then has all other steps; a copy is all steps or none."""
        move, strategy = self.moves()[0], self.offer.create(self.offer.options())
        whole, less = (
            [one.executor for one in strategy.propose(given).steps if isinstance(one, Execute)]
            for given in (move, replace(move, lacking=frozenset({"criu_copy_changes"})))
        )
        copy = [name for name in whole if name not in less]
        assert len(copy) == 6
        assert [name for name in whole if name in less] == less
        assert "criu_remove_copy" not in str(strategy.propose(replace(move, lacking={*copy})))


def test_each_shipped_strategy_is_here():
    """Each strategy in the plugin must have a contract class in this file."""
    held = {contract.offer.name for contract in MigrationContract.__subclasses__()}
    assert set(OFFERS) <= held


def _sound(move):
    """Return a sound plan: start on the destination, wait, stop the source, each with its undo."""
    source = Stop(move.source, move.source_host, 10.0)
    there = (move.destination, move.destination_host)
    start = Start(*there, 10.0, undo=Stop(*there, 10.0))
    return Plan((start, AwaitReady(*there, 30.0), Commit(), source), overlap=20.0)


def _changed(**change):
    """Return a strategy that proposes the sound plan with one step changed."""

    def propose(move):
        plan = _sound(move)
        return replace(plan, steps=(replace(plan.steps[0], **change), *plan.steps[1:]))

    return propose


def _handing_over(
    *, aborts=True, resumes=True, releases=True, gives_back=True, alias="p_1",
    phase=HandoffPhase.SWITCH,
):  # fmt: skip
    """Return a strategy that proposes a handoff with one fault."""

    def propose(move):
        give_back = SetRestart(move.source, move.source_host, move.spec.restart, 5.0)
        release = SetRestart(move.destination, move.destination_host, move.spec.restart, 5.0)
        stop = Stop(move.destination, move.destination_host, 10.0)
        start = Start(move.destination, move.destination_host, 10.0, alias, undo=stop, shadow=True)
        suspend = SetRestart(move.source, move.source_host, RestartPolicy(), 5.0)
        resume, abort = (Configure(p, 5.0) for p in (HandoffPhase.RESUME, HandoffPhase.ABORT))
        return Plan(
            (
                start,
                replace(suspend, undo=give_back if gives_back else None),
                Configure(HandoffPhase.SHADOW, 5.0, undo=resume if resumes else None),
                Configure(phase, 5.0, undo=abort if aborts else None),
                Commit(),
                *([release] if releases else []),
                Stop(move.source, move.source_host, 10.0),
            )
        )

    return propose


@pytest.mark.parametrize(
    ("propose", "test"),
    [
        (lambda move: replace(_sound(move), steps=_sound(move).steps[:2]), "test_plan_is_sound"),
        (_changed(timeout=0.0), "test_plan_is_sound"),
        (_changed(host="elsewhere"), "test_plan_is_sound"),
        (_changed(undo=None), "test_can_be_undone_before_the_commit"),
        (lambda move: replace(_sound(move), overlap=0.0), "test_an_overlap_is_declared"),
        (_handing_over(aborts=False), "test_plan_is_sound"),
        (_handing_over(phase=HandoffPhase.TAKE_OVER), "test_plan_is_sound"),
        (_handing_over(alias="p"), "test_plan_is_sound"),
        (_handing_over(resumes=False), "test_a_silent_source_resumes_only_when"),
        (_handing_over(releases=False), "test_a_shadow_is_released_after"),
        (_handing_over(gives_back=False), "test_a_source_that_is_not_restarted"),
        (_changed(timeout=object()), "test_survives_the_journal"),
        (_sound, "test_an_overlap_is_declared"),  # the plan overlaps although the process may not
        (lambda move: Plan((Execute("unknown", "a", {}, 1.0), Commit())), "test_executors_are_its"),
    ],
)
def test_contract_catches(propose, test):
    """A strategy that breaks the contract fails the test of that clause."""
    contract = MigrationContract()
    strategy = type("Strategy", (), {"propose": staticmethod(propose)})
    contract.offer = MigrationOffer("bad", lambda options: strategy())
    (named,) = (name for name in dir(contract) if name.startswith(test))
    with pytest.raises((AssertionError, TypeError)):
        getattr(contract, named)()


@dataclass(frozen=True)
class _Options:
    pause: PositiveSeconds = 2.0


class _Sleepy:
    """A strategy that executes a step on the source, then moves.

    Args:
        raw: read the options of the process as text.
    """

    def __init__(self, *, raw=False):
        self._raw = raw

    def propose(self, move):
        pause = move.options.pause
        if self._raw:
            pause = float(move.spec.migration.options.get("pause", 2.0))
        plan = _sound(move) if move.spec.migration.overlap else _stop_first(move)
        wait = Execute("sleepy.wait", move.source_host, {"seconds": pause}, pause + 5.0)
        return replace(plan, steps=(wait, *plan.steps))


def _stop_first(move):
    undo = Start(move.fallback, move.source_host, 10.0)
    stop = Stop(move.source, move.source_host, 10.0, undo=undo)
    return Plan((stop, *_sound(move).steps[:3]))


def _sleepy(answer, **how):
    contract = MigrationContract()
    contract.offer = MigrationOffer(
        "sleepy", lambda options: _Sleepy(**how), _Options, executors={"sleepy.wait": answer}
    )
    return contract


@pytest.mark.parametrize("answer", [None, 5, ["a"], {1: 2}, {"a": object()}, {"a": float("nan")}])
def test_an_executor_that_answers_no_json_object_is_caught(answer, tmp_path):
    """An executor that returns None fails the contract, too."""
    with pytest.raises((AssertionError, TypeError, ValueError)):
        _sleepy(lambda _: answer).test_executors_answer_with_json_objects(tmp_path)


def test_an_executor_gets_what_a_slave_gives_it(tmp_path):
    """The executor gets its arguments, the results of earlier executors, and its host."""
    seen = []
    contract = _sleepy(lambda told: seen.append(told) or {})
    contract.test_executors_answer_with_json_objects(tmp_path)
    assert seen[0]["seconds"] == 2.0
    assert seen[0]["results"] == {}
    assert seen[0]["here"]["host"] == "a"
    assert list(seen[0]["here"]["pids"]) == seen[0]["here"]["instances"] == ["p#1"]


def test_a_strategy_that_reads_a_processs_options_as_text_is_caught():
    """The work file contains "2s"; the checked options contain 2.0."""
    _sleepy(dict).test_options_of_a_process_are_read_from_the_move()
    with pytest.raises(ValueError, match=r"'2\.0s'"):
        _sleepy(dict, raw=True).test_options_of_a_process_are_read_from_the_move()


class _Checking(_Sleepy):
    """A strategy that checks a process with the given answer."""

    def __init__(self, answer):
        super().__init__()
        self._answer = answer

    def spec_fault(self, spec):
        return self._answer


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (None, r"spec_fault: answered None; str is required \(.*test_migrations\.py:\d+\)"),
        ("it has no camera", "refuses the `spec` of the test class: it has no camera"),
    ],
)
def test_a_strategy_that_refuses_its_own_process_is_caught(answer, why):
    """The check of a submitted process returns a text, and accepts the process of the contract."""
    contract = MigrationContract()
    contract.offer = MigrationOffer("checking", lambda options: _Checking(answer), _Options)
    with pytest.raises(AssertionError, match=why):
        contract.test_accepts_its_process()


def test_the_place_of_a_method_with_a_wrong_answer_is_named():
    """The failure has file and line of `propose`, because no exception shows them."""
    contract = MigrationContract()
    strategy = type("Strategy", (), {"propose": lambda self, move: None})
    contract.offer = MigrationOffer("bad", lambda options: strategy())
    with pytest.raises(AssertionError, match=r"answered None; Plan .*test_migrations\.py:\d+\)"):
        contract.test_plan_is_sound()
