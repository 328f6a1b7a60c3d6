"""Executors: whatever a plugin's function does is an answer to the order, never the slave's end."""

from __future__ import annotations

import json
import sys
from collections import ChainMap
from pathlib import Path
from queue import Queue

import pytest

from rosrm.core.events import BAD_RESULT
from rosrm.errors import CriuError, Refused
from rosrm.slave.executing import Here, execute

HERE = Here("alpha", Path("/state"), {})


def outcome(function) -> tuple[str, str, str]:
    """Code, message and result of an executor."""
    posted, outcomes = Queue(), []
    execute(
        {"wait": function}, "wait", {}, here=HERE, post=posted.put,
        done=lambda *outcome: outcomes.append(outcome),
    )  # fmt: skip
    posted.get(timeout=10.0)()
    return outcomes[0]


@pytest.mark.parametrize(
    ("answer", "said"), [(None, "None"), ([1], "a list"), (3, "a int"), ("{}", "a str")]
)
def test_an_answer_that_is_no_object_is_a_failure_of_its_own(answer, said) -> None:
    """Forgetting `return {}` is the beginner's mistake: the sentence says what is required."""
    code, message, result = outcome(lambda _: answer)
    assert (code, result) == (BAD_RESULT, "")
    assert message == f"wait answered {said}; a JSON object is required"


@pytest.mark.parametrize("answer", [{}, {"a": 1}, ChainMap({"a": 1})])
def test_any_mapping_is_an_answer(answer) -> None:
    """The answer travels as JSON."""
    code, message, result = outcome(lambda _: answer)
    assert (code, message, json.loads(result)) == ("", "", dict(answer))


def exits(_arguments) -> None:
    sys.exit(3)


def test_an_executor_that_exits_fails_with_its_place() -> None:
    """The order is answered at once; it need not wait for its time-out."""
    code, message, _ = outcome(exits)
    line = exits.__code__.co_firstlineno + 1
    assert (code, message) == ("failed", f"wait raised SystemExit: 3 ({__file__}:{line})")


def test_an_error_of_rosrm_is_the_whole_message() -> None:
    """The shipped executors say what a user can do."""

    def fails(_arguments) -> None:
        raise CriuError("no CRIU here: install it")

    assert outcome(fails) == ("failed", "no CRIU here: install it", "")


def test_an_answer_that_json_cannot_hold_is_a_failure() -> None:
    """The thread ends with an outcome, not with an exception that no log shows."""
    code, message, _ = outcome(lambda _: {"x": object()})
    assert (code, "TypeError" in message) == ("failed", True)


def test_an_unknown_executor_is_refused_with_those_that_there_are() -> None:
    """Before anything runs."""
    with pytest.raises(Refused, match=r"no executor 'wit' on alpha; there are: wait"):
        execute({"wait": exits}, "wit", {}, here=HERE, post=lambda _: None, done=lambda *_: None)
