"""The slave's connection to its supervisor: the loop never blocks, no order is lost."""

from __future__ import annotations

import logging
import os
import queue
import signal
import threading

import pytest

from rosrm import clocks
from rosrm.component.link import FAILED, FAULT
from rosrm.config.settings import LogSettings
from rosrm.core.slave import commands, events
from rosrm.errors import SupervisorError
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus, RestartPolicy
from rosrm.slave.supervisor_client import SupervisorLink
from rosrm.supervisor import send_buffer
from rosrm.supervisor.client import SupervisorClient
from tests.hung_files import hung_files
from tests.waiting import PATIENCE, wait_gone, wait_until

#: Together more than a socket buffer holds.
COUNT, LARGE = 10, "x" * 100_000
MANY = tuple(InstanceId(f"p{number}", 1) for number in range(COUNT))


class Loop:
    """The event loop of a slave: it runs posted functions one after the other."""

    def __init__(self, host, log) -> None:
        self.posted: queue.Queue = queue.Queue()
        self.events: list[events.Event] = []
        self.ended: list[str] = []
        self.host, self.log = host, log
        self.link = SupervisorLink(
            host.state, LogSettings(), post=self.posted.put, take=self.events.append,
            follow=lambda status: None, ended=self.ended.append,
        )  # fmt: skip
        self.pid = self.supervisor()
        self.link.take_over()
        self.link.listen()

    def supervisor(self) -> int:
        pid = int((self.host.state / "supervisor.lock").read_text())
        self.host.pids.add(pid)
        return pid

    def wait(self, condition, what: str) -> None:
        deadline = clocks.boot_time() + PATIENCE
        while not condition():
            left = deadline - clocks.boot_time()
            assert left > 0, f"not within {PATIENCE} s: {what}; {self.log.messages}, {self.ended}"
            try:
                self.posted.get(timeout=min(left, 0.1))()
            except queue.Empty:
                continue

    def replaced(self) -> list[events.SupervisorReplaced]:
        return [one for one in self.events if isinstance(one, events.SupervisorReplaced)]

    def started(self) -> set[InstanceId]:
        told = [one for one in self.events if isinstance(one, events.SupervisorReported)]
        return {status.instance for one in told for status in one.statuses if status.pid}

    def message(self, name: str) -> str:
        """Return the message of the end of an instance; "": it has not ended."""
        told = [one for one in self.events if isinstance(one, events.SupervisorReported)]
        ended = [one for it in told for one in it.statuses if one.state.ended]
        return "".join(one.message for one in ended if one.instance.process == name)

    def start_many(self) -> None:
        for instance in MANY:
            self.link.start([self.host.order(instance.process, "sleep", "1000", memo=LARGE)])


@pytest.fixture
def loop(host, caplog):
    caplog.set_level(logging.INFO)
    loop = Loop(host, caplog)
    yield loop
    loop.link.close()


def test_a_killed_supervisor_is_replaced_without_the_loop(loop, monkeypatch) -> None:
    """The new supervisor starts in another thread, because the slave must keep its lease."""
    by: list[threading.Thread] = []
    connect = SupervisorClient.connect

    def noted(*args, **options):
        by.append(threading.current_thread())
        return connect(*args, **options)

    monkeypatch.setattr(SupervisorClient, "connect", noted)
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    loop.wait(loop.started, "it runs")
    os.kill(loop.pid, signal.SIGKILL)
    wait_gone(loop.pid)
    loop.wait(lambda: len(loop.replaced()) == 2, "another one has taken over")
    next_pid = loop.supervisor()
    assert next_pid != loop.pid
    assert [status.instance.process for status in loop.replaced()[1].statuses] == ["one"]
    assert loop.log.messages[-1] == f"a new supervisor (pid {next_pid}) manages 1 process"
    assert by
    assert threading.current_thread() not in by
    loop.link.carry_out(commands.Stop(InstanceId("one", 1)))
    loop.wait(lambda: not loop.host.alive(), "the next one takes orders")


def test_a_supervisor_that_was_ended_by_another_is_replaced(loop) -> None:
    """After a SIGTERM the slave reports the stopped processes, and the next supervisor works."""
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    loop.wait(loop.started, "it runs")
    os.kill(loop.pid, signal.SIGTERM)
    loop.wait(lambda: len(loop.replaced()) == 2, "another one has taken over")
    next_pid = loop.supervisor()
    assert loop.log.messages[-1] == f"a new supervisor (pid {next_pid}) manages no processes"
    assert not loop.ended
    (status,) = loop.replaced()[1].statuses
    assert status.state is InstanceState.WITHDRAWN
    loop.link.start([loop.host.order("two", "sleep", "1000")])
    loop.wait(lambda: InstanceId("two", 1) in loop.started(), "the next one starts processes")


def test_supervisors_that_end_again_and_again_are_reported_and_slowed(loop) -> None:
    """The slave names the last one, when the next one starts, and the log that has the reason."""
    pid = loop.pid
    for number in (2, 3, 4):
        assert loop.link.trouble(clocks.boot_time()) == ""
        os.kill(pid, signal.SIGKILL)
        wait_gone(pid)
        if number < 4:
            loop.wait(lambda number=number: len(loop.replaced()) == number, "the next one")
            pid = loop.supervisor()
    loop.wait(lambda: loop.link.trouble(clocks.boot_time()), "the slave reports them")
    said = loop.link.trouble(clocks.boot_time())
    assert said.startswith("3 supervisors in a row have ended within 10 s of their start")
    assert f"(pid {pid})" in said
    assert "the next one starts in 1 s" in said
    loop.wait(lambda: len(loop.replaced()) == 4, "the next one starts after the pause")
    loop.supervisor()


def test_a_supervisor_that_cannot_start_does_not_end_the_slave(loop, monkeypatch) -> None:
    """The slave says why, refuses starts, and tries again until one starts."""
    connect, faults = SupervisorClient.connect, ["no room", "no room"]

    def hindered(*args, **options):
        if faults:
            raise SupervisorError(faults[0])
        return connect(*args, **options)

    monkeypatch.setattr(SupervisorClient, "connect", hindered)
    os.kill(loop.pid, signal.SIGKILL)
    wait_gone(loop.pid)
    loop.wait(lambda: loop.link.absence, "no supervisor can be started")
    assert loop.link.trouble(clocks.boot_time()) == "no room"
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    assert loop.events[-1] == events.LaunchRefused(InstanceId("one", 1), "no room")
    faults.clear()
    loop.wait(lambda: len(loop.replaced()) == 2, "another one has started")
    loop.supervisor()
    assert (loop.ended, loop.link.absence) == ([], "")
    loop.link.start([loop.host.order("two", "sleep", "1000")])
    loop.wait(lambda: InstanceId("two", 1) in loop.started(), "the next one starts processes")


def test_a_start_that_the_former_supervisor_may_have_begun_is_not_refused(
    loop, monkeypatch
) -> None:
    """The process may run, so the slave reports that its start takes long."""

    def fail(*_args, **_options):
        raise SupervisorError("no room")

    monkeypatch.setattr(SupervisorClient, "connect", fail)
    os.kill(loop.pid, signal.SIGSTOP)
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    os.kill(loop.pid, signal.SIGKILL)
    wait_gone(loop.pid)
    delayed = events.StartDelayed(InstanceId("one", 1), "no room")
    loop.wait(lambda: delayed in loop.events, "its start is reported as delayed")


def test_orders_to_a_stopped_supervisor_wait_for_it(loop) -> None:
    """Orders beyond the socket's buffer do not block the loop, and all arrive in order."""
    os.kill(loop.pid, signal.SIGSTOP)
    loop.start_many()
    loop.link.carry_out(commands.Fence(MANY[-1]))
    loop.link.carry_out(commands.Renew(clocks.boot_time(), clocks.boot_time()))
    os.kill(loop.pid, signal.SIGCONT)
    loop.wait(lambda: loop.started() >= set(MANY[:-1]), "all of them run")
    loop.wait(lambda: len(loop.host.alive()) == COUNT - 1, "the last one was fenced")
    assert len(loop.replaced()) == 1
    assert not loop.ended


def test_a_supervisor_that_reads_no_orders_is_reconnected(loop, monkeypatch) -> None:
    """The slave reconnects and repeats the orders that were not read: each process runs, once."""
    monkeypatch.setattr(send_buffer, "MOST_UNSENT", 300_000)
    os.kill(loop.pid, signal.SIGSTOP)
    loop.start_many()
    loop.wait(
        lambda: any("takes no orders" in one for one in loop.log.messages), "a log line about it"
    )
    os.kill(loop.pid, signal.SIGCONT)
    loop.wait(lambda: len(loop.replaced()) == 2, "a second connection")
    assert {status.instance for status in loop.replaced()[1].statuses} == set(MANY)
    assert loop.supervisor() == loop.pid
    loop.wait(lambda: len(loop.host.alive()) == COUNT, "each runs, once")
    assert not loop.ended


def test_a_launch_that_comes_between_two_supervisors_is_not_lost(loop) -> None:
    """A launch stopped before the next supervisor received it is not started."""
    os.kill(loop.pid, signal.SIGKILL)
    wait_gone(loop.pid)
    stopped = InstanceId("stopped", 1)
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    loop.link.start([loop.host.order("stopped", "sleep", "1000")])
    loop.link.carry_out(commands.Stop(stopped))
    loop.wait(lambda: len(loop.replaced()) == 2, "another one has taken over")
    loop.supervisor()
    (status,) = loop.replaced()[1].statuses
    assert status == InstanceStatus(InstanceId("one", 1), InstanceState.STARTING)
    loop.wait(lambda: loop.started() == {status.instance}, "it runs")


def test_the_shutdown_reaches_one_that_is_just_taking_over(loop) -> None:
    """A shutdown during the take-over reaches the next supervisor."""
    loop.link.start([loop.host.order("one", "sleep", "1000")])
    loop.wait(loop.started, "it runs")
    os.kill(loop.pid, signal.SIGKILL)
    wait_gone(loop.pid)
    loop.wait(lambda: any("connecting" in one for one in loop.log.messages), "its end is noticed")
    loop.link.shut_down()
    loop.wait(lambda: loop.ended, "the next one has stopped everything")
    assert loop.ended == [""]
    assert not loop.host.alive()


def test_a_slave_that_can_receive_no_more_ends_with_the_reason(loop, monkeypatch) -> None:
    """After a fault in its receiving thread, a slave would get no reports of any process."""

    def fail(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr(SupervisorClient, "connect", fail)
    os.kill(loop.pid, signal.SIGKILL)
    loop.wait(lambda: loop.ended, "the end of the slave")
    assert "RuntimeError: a bug" in loop.ended[0]


def test_the_reason_in_a_log_is_reported_unless_its_disk_hangs(host, caplog, tmp_path) -> None:
    """The status of a component's process waits for its log only a moment."""
    script = f"exec < {tmp_path}/go; echo '{FAULT}no such plugin'; read line; exit {FAILED}"
    os.mkfifo(tmp_path / "go")
    go = os.open(tmp_path / "go", os.O_RDWR)
    host.state.mkdir(mode=0o700)
    with hung_files(tmp_path / "hung") as hung:
        (host.state / "logs").symlink_to(hung.place)
        loop = Loop(host, caplog)
        for name in ("first", "second"):
            order = host.order(name, "sh", "-c", script, restart=RestartPolicy("never"))
            loop.link.start([order])
            loop.wait(lambda name=name: InstanceId(name, 1) in loop.started(), "it runs")
            wait_until(lambda name=name: FAULT in host.log(name).read_text(), "its output")
            if name == "second":
                hung.hang()
            os.write(go, b"\n")
            loop.wait(lambda name=name: loop.message(name), "its end")
            assert ("no such plugin" in loop.message(name)) == (name == "first")
        hung.answer()
        loop.link.close()
    os.close(go)
