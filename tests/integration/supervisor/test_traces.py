"""Trace of a start in the log of its process."""

from __future__ import annotations

import os

from rosrm.model.start_trace import LINE, VARIABLE
from rosrm.model.values import RestartPolicy

_TRACED = {**os.environ, VARIABLE: "slave_received=1"}
_ADDED = ["slave_received", "launch_sent", "supervisor_received", "recorded", "spawned"]


def traces(host, name: str) -> list[dict[str, int]]:
    """Return the traces in the log of a process."""
    lines = host.log(name).read_text().splitlines()
    words = [line.removeprefix(LINE).split() for line in lines if line.startswith(LINE)]
    return [{key: int(at) for key, _, at in (word.partition("=") for word in one)} for one in words]


def test_the_log_of_a_traced_process_has_the_stamps_in_order(host):
    """Slave and supervisor add theirs to those that came with the order."""
    client = host.connect()
    host.run(client, host.order("traced", "true", environment=_TRACED))
    (trace,) = traces(host, "traced")
    assert list(trace) == _ADDED
    assert list(trace.values()) == sorted(trace.values())


def test_only_the_first_start_of_an_instance_is_traced(host):
    """A restart was not handed over by the master, so its log line would be wrong."""
    client = host.connect()
    twice = RestartPolicy("on-failure", delay=0.01, attempts=1)
    host.run(client, host.order("failing", "false", environment=_TRACED, restart=twice))
    assert len(traces(host, "failing")) == 1


def test_a_process_without_a_trace_has_no_line_in_its_log(host):
    """Not even after a traced one, whose environment was sent first."""
    client = host.connect()
    host.run(client, host.order("traced", "true", environment=_TRACED))
    host.run(client, host.order("plain", "true"))
    assert host.log("plain").read_text() == ""
