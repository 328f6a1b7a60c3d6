"""Requests that are repeated until the master answers."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise

import pytest

from rosrm.client import retrying
from rosrm.errors import NoMaster, Refused


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrying, "PERIOD", 0.01)


@pytest.mark.parametrize(
    "fault", [NoMaster("silence"), Refused("no memory", "failed"), Refused("full", "journal")]
)
def test_what_may_pass_is_waited_for(fault: Exception) -> None:
    """`rosrm run` continues while the state of its job cannot be listed for a moment."""
    faults, said = [fault, fault], []

    def look(_: object) -> str:
        if faults:
            raise faults.pop()
        return "answer"

    assert retrying.ask_until_answered(look, said.append) == "answer"
    assert str(fault) in said[0]


def test_a_refusal_of_the_request_itself_is_final() -> None:
    def look(_: object) -> str:
        raise Refused("no such process", "unknown")

    with pytest.raises(Refused, match="no such process"):
        retrying.ask_until_answered(look, lambda _: None)


def test_a_long_silence_is_noted_again_and_ends_at_the_deadline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each request fails after 10 s; the clock moves only here."""
    now, said = [0.0], []
    monkeypatch.setattr(retrying.clocks, "boot_time", lambda: now[0])
    monkeypatch.setattr(retrying.time, "sleep", lambda seconds: now.append(now.pop() + seconds))

    def look(on_wait: Callable[[float], None]) -> str:
        for second in range(11):
            on_wait(float(second))
        now.append(now.pop() + 10.0)
        raise NoMaster("no answer.")

    with pytest.raises(NoMaster):
        retrying.ask_until_answered(look, said.append, deadline=100.0)
    assert said[1].startswith("no answer. Asking again")
    silences = [int(re.findall(r"for (\d+) s", one)[0]) for one in [said[0], *said[2:]]]
    assert silences[0] == 2
    assert all(30 <= later - one < 42 for one, later in pairwise([10, *silences[1:]]))
    assert 100 <= now[0] < 120
