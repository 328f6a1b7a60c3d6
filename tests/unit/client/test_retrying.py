"""Requests that are repeated until the master answers."""

from __future__ import annotations

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
