"""Last log line of a slave: each process that may still run is named."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import pytest

from rosrm.core.slave import commands
from rosrm.core.slave.state import HeldInstance, SlaveState
from rosrm.model.durations import LONGEST_STOP
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus, ProcessSpec, StopPolicy
from rosrm.slave import shutdown
from rosrm.slave.shutdown import Shutdown

STOP = StopPolicy(interrupt_grace=1.0, terminate_grace=1.0)


class Slave:
    """End of a slave with two processes and a supervisor controlled by the test."""

    def __init__(self, log) -> None:
        self.now, self.log = 100.0, log
        self.when_stopped = lambda: None
        self.carried_out = []
        self.endpoint = SimpleNamespace(
            failure="", leave=lambda done, _running: done(),
            wait_until_received=lambda: None,
        )  # fmt: skip
        self.state = SlaveState()
        for name in "pq":
            self.report(name, InstanceState.RUNNING)
        self.ending = Shutdown(
            SimpleNamespace(host="h0", on_stop="stop"), self.state,
            SimpleNamespace(close=lambda: None, has_begun=lambda _instance: True),
            SimpleNamespace(pid=7, shut_down=self.shut_down, carry_out=self.carried_out.append),
            self.endpoint, serve=self.serve,
        )  # fmt: skip

    def serve(self, goes_on) -> None:
        while goes_on():
            self.now += 1.0

    @property
    def said(self) -> list[str]:
        return [one.getMessage() for one in self.log.records if one.levelno == logging.INFO]

    def shut_down(self) -> None:
        self.when_stopped()

    def report(self, name: str, state: InstanceState) -> None:
        instance = InstanceId(name, 1)
        spec = ProcessSpec(name, command=("sleep",), stop=STOP)
        self.state.hold(instance, HeldInstance(InstanceStatus(instance, state), spec))

    def end_supervisor(self) -> None:
        """End all processes and then the supervisor."""
        for name in "pq":
            self.report(name, InstanceState.EXITED)
        self.ending.note_supervisor_left("")

    def end(self) -> int:
        return self.ending.carry_out("SIGINT")


@pytest.fixture
def slave(monkeypatch, caplog) -> Slave:
    caplog.set_level(logging.INFO)
    slave = Slave(caplog)
    monkeypatch.setattr(
        shutdown,
        "clocks",
        SimpleNamespace(boot_time=lambda: slave.now, awake_time=lambda: slave.now),
    )
    return slave


@pytest.mark.parametrize("failure", ["a live slave has the name 'h0' already", "another version"])
def test_a_refused_slave_keeps_its_processes(slave, caplog, failure) -> None:
    """Another may have taken its name: fences end what may have a successor, and nothing else."""
    slave.endpoint.failure = failure
    slave.when_stopped = lambda: pytest.fail("the processes were stopped")
    assert slave.ending.carry_out("") == 1
    assert failure in caplog.text
    assert "2 processes keep running, those with a fence until it expires" in caplog.text


def test_an_order_to_stop_that_was_not_taken_is_no_stop(slave, caplog) -> None:
    """If the supervisor hangs, the line names the running processes and the way to stop them."""
    slave.when_stopped = lambda: slave.report("q", InstanceState.STOPPING)
    assert slave.end() == 1
    assert "(pid 7) still stops q#1 and has not begun to stop p#1. Stop them by" in caplog.text


def test_what_is_still_being_stopped_is_named(slave, caplog) -> None:
    """The line names processes that need longer than their `stop` allows."""
    slave.when_stopped = lambda: [slave.report(name, InstanceState.STOPPING) for name in "pq"]
    assert slave.end() == 1
    assert f"not ended within {STOP.timeout:g} s: the supervisor (pid 7) still stops" in caplog.text
    assert "p#1 and q#1" in caplog.text


def test_a_supervisor_that_is_gone_has_stopped_nothing(slave, caplog) -> None:
    """After a kill of the supervisor the slave does not claim "2 processes were stopped"."""
    slave.when_stopped = lambda: slave.ending.note_supervisor_left("the supervisor is gone")
    assert slave.end() == 1
    assert "p#1 and q#1 may still run: the supervisor is gone" in caplog.text
    (said,) = slave.said
    assert said.startswith("stopping 2 processes (SIGINT)")


def test_a_slave_whose_supervisor_ended_before_names_its_processes(slave, caplog) -> None:
    """The slave does not claim "no process is left running" if nothing stopped them."""
    slave.ending.note_supervisor_left("the supervisor is gone")
    assert slave.end() == 1
    assert "p#1 and q#1 may still run" in caplog.text
    assert not slave.said


def test_a_second_signal_is_answered_with_what_is_left_and_until_when(slave) -> None:
    """The first line has the time as well; before the end has begun there is nothing to log."""

    def stop() -> None:
        slave.report("p", InstanceState.EXITED)
        slave.now += 1.5
        slave.ending.log_progress()
        slave.now += 1.0
        slave.ending.log_progress()
        slave.end_supervisor()

    slave.when_stopped = stop
    slave.ending.log_progress()
    assert slave.end() == 0
    assert slave.said == [
        "stopping 2 processes (SIGINT); processes that run after 2 s are killed (SIGKILL)",
        "still stopping q#1; processes that run after 1 s are killed (SIGKILL)",
        "still stopping q#1",
        "slave of h0 ended; 2 processes were stopped",
    ]


def test_a_time_that_is_not_known_is_not_claimed(slave) -> None:
    """This run of the slave does not know the `stop` of a re-adopted process."""
    slave.state.held[InstanceId("q", 1)].spec = None
    slave.when_stopped = slave.end_supervisor
    assert slave.end() == 0
    assert slave.said[0] == "stopping 2 processes (SIGINT)"


def test_a_process_that_the_supervisor_could_not_kill_was_not_stopped(slave, caplog) -> None:
    """A shutdown of the supervisor does not wait for a process that is stuck in the kernel."""

    def stop() -> None:
        slave.report("p", InstanceState.EXITED)
        slave.report("q", InstanceState.STOPPING)
        slave.ending.note_supervisor_left("")

    slave.when_stopped = stop
    assert slave.end() == 1
    assert "q#1 may still run: SIGKILL has not ended" in caplog.text
    assert len(slave.said) == 1


def test_a_stop_ends_by_a_kill_whatever_the_graces_are(slave, caplog) -> None:
    """A process of an earlier release may have graces of thousands of hours."""
    endless = StopPolicy(interrupt_grace=7_200_000.0, terminate_grace=7_200_000.0)
    instance = InstanceId("endless", 1)
    status = InstanceStatus(instance, InstanceState.STOPPING)
    spec = ProcessSpec("endless", command=("sleep",), stop=endless)
    slave.state.hold(instance, HeldInstance(status, spec))
    began = slave.now
    assert slave.end() == 1
    assert slave.now - began < 2 * LONGEST_STOP
    assert commands.Fence(instance) in slave.carried_out
    assert "killing (SIGKILL)" in caplog.text


def test_a_master_that_cannot_be_informed_keeps_no_process_running(slave, monkeypatch) -> None:
    """ROS may be gone, or no file can be opened; the processes are stopped all the same."""
    stopped = []

    def fail(*_):
        raise RuntimeError("failed to send request")

    def stop():
        stopped.append(True)
        slave.ending.note_supervisor_left("")

    slave.report("a", InstanceState.RUNNING)
    monkeypatch.setattr(slave.endpoint, "leave", fail)
    slave.when_stopped = stop
    slave.end()
    assert stopped == [True]
    assert "the master was not informed that this slave ends: RuntimeError" in slave.log.text
