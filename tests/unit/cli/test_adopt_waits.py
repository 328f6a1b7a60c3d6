"""`rosrm adopt` ends although a host, a process or a file does not answer."""

from __future__ import annotations

import subprocess
import threading

import pytest

from rosrm.cli.adoption import local_host
from rosrm.cli.waiting import answered
from rosrm.errors import Refused, RosrmError
from tests.unit.cli.conftest import process


@pytest.fixture
def sleeper():
    with subprocess.Popen(["sleep", "60"]) as program:
        yield program
        program.kill()


def test_an_adoption_that_does_not_happen_is_waited_for_in_vain_only_so_long(
    rosrm, client, sleeper, monkeypatch
):
    """The host may be silent; the command says what it has waited for, and why."""
    monkeypatch.setattr("rosrm.client.waiting.PERIOD", 0.01)
    monkeypatch.setattr(local_host, "_is_here", lambda row: row.description.name == "alpha")
    monkeypatch.setattr(local_host, "environment_on", lambda *_: {})
    client.processes = [process("mine", "queued", "", reason="alpha is silent")]
    result = rosrm("adopt", str(sleeper.pid), "--name", "mine", "--timeout", "50ms")
    assert result.code == 1
    assert "--timeout has passed; still waiting for mine (alpha is silent)" in result.err


def test_a_look_that_the_kernel_holds_is_left_to_itself():
    """A process or a file on a dead disk blocks the command only for its time-out."""
    held = threading.Event()
    with pytest.raises(
        RosrmError, match=r"the inspection of process 7 has not ended within 0\.05 s"
    ):
        answered(held.wait, "the inspection of process 7", 0.05)
    held.set()


def test_a_refusal_reaches_the_caller_of_a_bounded_look():
    """The caller gets an error of the call, as without the time-out."""

    def refuse():
        raise Refused("no process 7 runs")

    with pytest.raises(Refused, match="no process 7"):
        answered(refuse, "the look")
