"""The run of a log collection outlives refusals and silences of the master."""

from __future__ import annotations

import threading

import pytest

from rosrm.cli.collecting import Collecting
from rosrm.errors import NoMaster, Refused


class Collector:
    """A collector that the master refuses, then does not answer, then serves."""

    def __init__(self, stop: threading.Event) -> None:
        self.faults = [Refused("busy", "busy"), NoMaster("no master answers"), None]
        self.stop = stop

    def look(self, _master) -> None:
        fault = self.faults.pop(0)
        if fault is not None:
            raise fault
        self.stop.set()


class Master:
    """A connection."""

    def close(self) -> None:
        """Leave nothing."""


def test_a_refusal_is_retried_as_a_silence_is(tmp_path, capsys):
    """A collection that has run for days must not end because a master was busy for a moment."""
    stop = threading.Event()
    Collecting(Collector(stop), tmp_path, stop, Master).run(0.01)
    said = capsys.readouterr().err
    assert "rosrm: busy" in said
    assert "collecting logs into" in said


def test_a_refusal_of_the_first_connection_ends_the_command(tmp_path):
    """The command ends, because the user can read the refusal, e.g. of another version."""

    def refuse():
        raise Refused("another version", "version")

    with pytest.raises(Refused, match="another version"):
        Collecting(Collector(threading.Event()), tmp_path, threading.Event(), refuse).run(0.01)
