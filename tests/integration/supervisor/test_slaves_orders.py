"""The slave makes the orders for its supervisor while a path that a process names hangs."""

from __future__ import annotations

import os
import queue
import threading
import time
from types import SimpleNamespace

import pytest

from rosrm.config.settings import HostConfig
from rosrm.core.slave import commands, events
from rosrm.core.slave.state import SlaveState
from rosrm.model.parameters import merged_parameters  # noqa: F401 - loaded before the mount hangs
from rosrm.model.values import (
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ParameterSource,
    ProcessSpec,
)
from rosrm.runtime.path_calls import PathCalls
from rosrm.runtime.worker import Worker
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.launch.starter import Starter
from tests.hung_files import hung_files
from tests.waiting import PATIENCE


class Slave:
    """The starter of a slave with a supervisor that only lists the orders."""

    def __init__(self, state) -> None:
        self.posted: queue.Queue = queue.Queue()
        self.started: list[str] = []
        self.refused: dict[str, str] = {}
        self.paths = PathCalls("test", self.posted.put)
        self.state = SlaveState(max_processes=100, max_starting=100, max_age=1.0)
        nothing = SimpleNamespace(
            is_preparing=lambda _: False, forget=lambda _: None, prepare=lambda *_: True,
            root=state / "artifacts", ended=lambda _: None,
        )  # fmt: skip
        supervisor = SimpleNamespace(
            state=state, adopts=True, reads_secrets=True, writes_files=True,
            start=lambda orders: self.started.extend(one.instance.process for one in orders),
        )  # fmt: skip
        endpoint = SimpleNamespace(
            cluster="c", description=SimpleNamespace(devices=()),
            publish_statuses=lambda statuses, complete: None,
        )  # fmt: skip
        self.starter = Starter(
            HostConfig(host="a", state=state), state / "kept", self.state, supervisor, endpoint,
            nothing, nothing, SimpleNamespace(endpoints=lambda _: frozenset()), None, Launchers(),
            None, self.paths, take=self.take,
        )  # fmt: skip

    def take(self, event: events.Event) -> None:
        assert isinstance(event, events.LaunchRefused)
        self.refused[event.instance.process] = event.reason

    def launch(self, *specs: ProcessSpec) -> None:
        assignments = []
        for spec in specs:
            one = Assignment(InstanceId(spec.name, 1), spec, epoch=1, node_name=spec.node)
            status = InstanceStatus(one.instance, InstanceState.STARTING)
            held = SimpleNamespace(status=status, awaited=None, memo=None, amended=None)
            self.state.held[one.instance] = held
            assignments.append(one)
        self.starter.launch(assignments)

    def wait(self, condition) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, (self.started, self.refused)
            self.paths.look()
            try:
                self.posted.get(timeout=0.05)()
            except queue.Empty:
                continue


@pytest.fixture
def slave(tmp_path, monkeypatch):
    monkeypatch.setattr("rosrm.slave.launch.starter.to_memo", lambda _: "")
    return Slave(tmp_path / "state")


@pytest.fixture
def hung(tmp_path):
    with hung_files(
        tmp_path / "hung", {"parameters.yaml": b"/**: {ros__parameters: {a: 1}}"}
    ) as it:
        it.hang()
        yield it


def spec_of(kind: str, place) -> ProcessSpec:
    """Return a process that names a path on a file system."""
    if kind == "parameters":
        sources = (ParameterSource(file=f"{place}/parameters.yaml"),)
        return ProcessSpec("waits", command=("true",), ros=True, parameter_sources=sources)
    if kind == "secret":
        return ProcessSpec("waits", command=("true",), secrets={"A": f"{place}/secret"})
    variables = {"AMENT_PREFIX_PATH": str(place)}
    if kind == "package":
        return ProcessSpec("waits", package="p", executable="e", environment=variables)
    text = "$(find-pkg-share p)/file"
    return ProcessSpec("waits", command=("cat", text), environment=variables)


@pytest.mark.parametrize("kind", ["parameters", "secret", "package", "find-pkg-share"])
def test_a_path_that_hangs_refuses_one_process(slave, hung, kind):
    """The others of the same batch and later ones are started."""
    place = hung.place
    first, beside = (ProcessSpec(name, command=("true",)) for name in ("first", "beside"))
    slave.launch(first, spec_of(kind, place), beside)
    slave.launch(ProcessSpec("behind", command=("true",)))
    slave.wait(lambda: {"first", "beside", "behind"} <= set(slave.started))
    assert not slave.refused
    slave.wait(lambda: slave.refused)
    assert str(place) in slave.refused["waits"]
    assert "does not answer" in slave.refused["waits"]


def test_a_start_that_waits_for_a_path_is_called_off(slave, hung):
    """The start is cancelled at once, and the later outcome of its thread is ignored."""
    slave.launch(spec_of("parameters", hung.place))
    assert [one.instance.process for one in slave.starter.preparing()] == ["waits"]
    assert slave.starter.call_off(commands.Stop(InstanceId("waits", 1)))
    assert slave.refused == {"waits": "it was stopped before it was started"}
    assert not slave.starter.preparing()


def test_a_fifo_is_no_parameter_file(slave, tmp_path):
    """A FIFO is refused, because a read would wait for a writer, perhaps for ever."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    sources = (ParameterSource(file=str(fifo)),)
    slave.launch(ProcessSpec("p", command=("true",), ros=True, parameter_sources=sources))
    slave.wait(lambda: slave.refused)
    assert f"parameters file '{fifo}': it is no regular file" in slave.refused["p"]


def test_a_start_for_which_no_thread_is_left_is_refused(slave, monkeypatch):
    """A start without a thread must neither wait for ever nor be tried again without a pause."""
    with monkeypatch.context() as without:
        without.setattr("rosrm.runtime.path_calls.MOST_LATE", 0)
        slave.launch(ProcessSpec("late", command=("true",)))
        slave.wait(lambda: "late" in slave.refused)
    with monkeypatch.context() as without:
        without.setattr(threading.Thread, "start", no_thread)
        slave.launch(ProcessSpec("none", command=("true",)))
        slave.wait(lambda: "none" in slave.refused)
    slave.launch(ProcessSpec("next", command=("true",)))
    slave.wait(lambda: slave.started == ["next"])


def test_a_file_operation_without_a_thread_fails(monkeypatch):
    """Later operations get their thread, and do not wait behind the failed one."""
    posted: queue.Queue = queue.Queue()
    worker, seen = Worker("test", posted.put), []
    with monkeypatch.context() as without:
        without.setattr(threading.Thread, "start", no_thread)
        worker.run(lambda: 1, seen.append, lambda error: seen.append(str(error)))
    posted.get(timeout=PATIENCE)()
    worker.run(lambda: 2, seen.append, lambda error: seen.append(str(error)))
    posted.get(timeout=PATIENCE)()
    assert seen == ["can't start new thread", 2]


def no_thread(_) -> None:
    """Fail as where the limit of the processes is reached."""
    raise RuntimeError("can't start new thread")


def test_a_start_whose_order_is_made_at_the_end_of_the_slave_has_not_begun(slave):
    """Otherwise the slave would say at its end that the process may still run."""
    slave.launch(ProcessSpec("late", command=("true",)))
    slave.starter.close()
    slave.posted.get(timeout=PATIENCE)()
    assert slave.started == []
    assert not slave.starter.has_begun(InstanceId("late", 1))
