"""Executors: every outcome of a plugin's function answers the order, and none ends the slave."""

from __future__ import annotations

import json
import re
import sys
import threading
from collections import ChainMap
from queue import Queue

import pytest

from rosrm.core.master.events import BAD_RESULT
from rosrm.errors import CriuError, Refused
from rosrm.extensions.made import OfferedExecutor
from rosrm.extensions.plugin_calls import WORKS_AFTER
from rosrm.slave.executors import MOST_LATE, Executors
from rosrm.testing import FakeClock
from tests.waiting import PATIENCE

HERE = {"host": "alpha"}


class Rig:
    """The executor `wait` of the strategy `acme`, run as in the slave's loop."""

    def __init__(self, function) -> None:
        self.posted, self.said, self.clock = Queue(), [], FakeClock()
        self.executors = Executors(
            {"wait": OfferedExecutor("acme", function)}, {},
            post=self.posted.put, changed=self.said.append, clock=self.clock,
        )  # fmt: skip

    def run(self, timeout=60.0) -> list[tuple[str, str, str]]:
        """Run the executor until it calls the loop back; return the settled results."""
        outcomes = []
        self.executors.execute("wait", {}, timeout, here=HERE, done=outcomes.append)
        self.posted.get(timeout=PATIENCE)()
        return outcomes


def outcome(function) -> tuple[str, str, str]:
    """Return code, message and result of an executor."""
    return Rig(function).run()[0]


@pytest.mark.parametrize(
    ("answer", "said"), [(None, "None"), ([1], "a list"), (3, "a int"), ("{}", "a str")]
)
def test_an_answer_that_is_no_object_is_a_failure_of_its_own(answer, said) -> None:
    """A missing `return {}` is a common mistake, so the message says what is required."""
    code, message, result = outcome(lambda _: answer)
    assert (code, result) == (BAD_RESULT, "")
    assert message == f"wait answered {said}; a JSON object is required"


def test_a_repeated_order_does_not_run_an_executor_beside_itself() -> None:
    """A restarted master repeats the order of its step: one call answers both orders."""
    goes_on, calls, outcomes = threading.Event(), [], []

    def dump(given):
        calls.append(given["of"])
        assert goes_on.wait(PATIENCE)
        return {"made": given["of"]}

    rig = Rig(dump)
    for number in (1, 1, 2):
        rig.executors.execute("wait", {"of": number}, 60.0, here=HERE, done=outcomes.append)
    goes_on.set()
    for _ in range(2):
        rig.posted.get(timeout=PATIENCE)()
    assert sorted(calls) == [1, 2]
    assert sorted(one.result for one in outcomes) == [
        '{"made": 1}', '{"made": 1}', '{"made": 2}',
    ]  # fmt: skip
    rig.executors.execute("wait", {"of": 1}, 60.0, here=HERE, done=outcomes.append)
    rig.posted.get(timeout=PATIENCE)()
    assert sorted(calls) == [1, 1, 2]


def test_an_executor_gets_its_host_with_the_options_of_its_strategy() -> None:
    rig, seen = Rig(lambda _: {}), []
    offered = OfferedExecutor("acme", lambda given: seen.append(given) or {}, {"as_root": True})
    rig.executors = Executors({"wait": offered}, {}, post=rig.posted.put, changed=rig.said.append)
    rig.run()
    assert seen == [{"here": {"host": "alpha", "options": {"as_root": True}}}]


@pytest.mark.parametrize("answer", [{}, {"a": 1}, ChainMap({"a": 1})])
def test_any_mapping_is_an_answer(answer) -> None:
    """The answer is sent as JSON."""
    code, message, result = outcome(lambda _: answer)
    assert (code, message, json.loads(result)) == ("", "", dict(answer))


def exits(_arguments) -> None:
    sys.exit(3)


def test_an_executor_that_exits_fails_with_its_place() -> None:
    """The order is answered at once, without waiting for its time-out."""
    code, message, _ = outcome(exits)
    line = exits.__code__.co_firstlineno + 1
    assert (code, message) == ("failed", f"wait raised SystemExit: 3 ({__file__}:{line})")


def test_an_error_of_rosrm_is_the_whole_message() -> None:
    """The errors of the shipped executors say what a user can do."""

    def fails(_arguments) -> None:
        raise CriuError("no CRIU here: install it")

    assert outcome(fails) == ("unable", "no CRIU here: install it", "")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"x": object()}, "x: object"),
        ({"fine": [1, "a", None, 0.5], "pose": {"at": [0.0, {1}]}}, "pose.at[1]: set"),
        ({(1, 2): 3}, "the key (1, 2): tuple"),
        ({"speed": [0.5, float("nan")]}, "speed[1]: nan"),
    ],
)
def test_an_answer_that_json_cannot_hold_is_named_by_its_key_and_type(answer, said) -> None:
    """A retry would return the same answer, as for an answer that is no object."""
    expected = f"wait answered something that is no JSON: {said}"
    assert outcome(lambda _: answer) == (BAD_RESULT, expected, "")


def raises(_arguments) -> None:
    raise OSError("no arm")


def hangs(_arguments) -> None:
    threading.Event().wait()


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda _: None, r"executor wait answered None; a JSON object is required \(.*:\d+\)"),
        (lambda _: {"x": {1}}, r"executor wait answered something .* x: set \(.*:\d+\)"),
        (raises, r"executor wait raised OSError: no arm \(.*:\d+\)"),
        (exits, r"executor wait raised SystemExit: 3 \(.*:\d+\)"),
        (hangs, r"executor wait did not return within 0.05 s \(.*:\d+\)"),
    ],
)
def test_an_executor_that_fails_makes_its_strategy_failing(function, said) -> None:
    """The report has executor, error and place, once as long as the error stays."""
    rig = Rig(function)
    for _ in range(2):
        rig.run(0.05 if function is hangs else 60.0)
    ((strategy, error),) = rig.executors.failing.items()
    assert strategy == "acme"
    assert re.fullmatch(said, error)
    assert __file__ in error
    assert rig.said == [f"migration strategy acme fails: {error}"]


@pytest.mark.parametrize("answer", [ValueError("arm is in use"), CriuError("no CRIU here")])
def test_a_refusal_by_an_executor_is_an_answer_and_no_failure(answer) -> None:
    """A `ValueError`, as in `propose`, and an error of rosrm are refusals."""

    def refuses(_arguments) -> None:
        raise answer

    rig = Rig(refuses)
    ((code, message, _),) = rig.run()
    assert (code, str(answer) in message) == ("unable", True)
    assert rig.executors.failing == {}


def test_a_strategy_works_again_with_a_good_answer_after_a_while() -> None:
    """One success is too few: an executor that fails every second time would fill the record."""
    rig = Rig(lambda arguments: {} if good else None)
    good = False
    rig.run()
    good = True
    for _ in range(2):
        rig.run()
        assert rig.executors.failing["acme"].count("; it has succeeded since") == 1
    rig.clock.advance(WORKS_AFTER)
    rig.run()
    assert rig.executors.failing == {}
    assert rig.said[1:] == [
        "migration strategy acme has succeeded since its last failure",
        "migration strategy acme works again",
    ]


def test_an_unknown_executor_is_refused_with_those_that_there_are() -> None:
    """The refusal comes before any executor runs."""
    with pytest.raises(Refused, match=r"no executor 'wit' on alpha; there are: wait"):
        Rig(exits).executors.execute("wit", {}, 1.0, here=HERE, done=lambda *_: None)


def test_an_executor_that_never_returns_costs_few_threads() -> None:
    """Repeated checks of a host that hang keep only a bounded number of threads."""
    released = threading.Event()
    rig = Rig(lambda _: released.wait() and {})
    before = threading.active_count()
    for _ in range(MOST_LATE):
        rig.run(0.01)
    for _ in range(30):
        with pytest.raises(Refused, match=f"{MOST_LATE} earlier calls of it have not returned"):
            rig.run(0.01)
    assert threading.active_count() - before <= MOST_LATE
    released.set()
    for _ in range(MOST_LATE):
        rig.posted.get(timeout=PATIENCE)()
    assert rig.run()[0][0] == ""
