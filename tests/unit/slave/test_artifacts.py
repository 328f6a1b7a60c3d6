"""Artifacts at the slave: fetched before a start, with a cache of real files and without ROS."""

from __future__ import annotations

import queue
from dataclasses import replace

import pytest

from rosrm import clocks
from rosrm.artifacts.cache import ArtifactCache, set_directory, without_directories
from rosrm.artifacts.pack import Archive
from rosrm.core.slave import reducer
from rosrm.core.slave.events import SupervisorReplaced, SupervisorReported
from rosrm.core.slave.state import SlaveState
from rosrm.core.slave.watches import Memo
from rosrm.errors import Refused
from rosrm.model.artifacts import Artifact
from rosrm.model.values import (
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
)
from rosrm.ros.slave.artifacts import ArtifactPart
from rosrm.slave.artifacts import fetch
from rosrm.slave.artifacts.service import ArtifactService
from rosrm.slave.launch.artifacts import with_artifacts
from rosrm.slave.memos import from_memo, to_memo

PATIENCE = 20.0


class Source:
    """A master without ROS, which answers at once, unless it is silent."""

    def __init__(self) -> None:
        self.archives: dict[str, bytes] = {}
        self.asked: list[int] = []
        self.is_silent = False
        self.refusals: list[Refused] = []
        self.unanswered: list = []

    def finds_master(self, now: float) -> bool:
        return True

    def ask(self, digest, offset, deadline, done) -> None:
        self.asked.append(offset)
        if self.is_silent:
            self.unanswered.append(done)
        elif self.refusals:
            done(self.refusals.pop())
        elif digest not in self.archives:
            done(Refused("the master does not have it", "unknown"))
        else:
            data = self.archives[digest]
            done(ArtifactPart(len(data), data[offset : offset + 100_000]))

    def expire(self, now: float) -> None:
        unanswered, self.unanswered = self.unanswered, []
        for done in unanswered:
            done(None)


class Host:
    """The loop of a slave: its artifacts, and what it reports."""

    def __init__(self, root, max_size: int = 10**6) -> None:
        self.master = Source()
        self.calls: queue.SimpleQueue = queue.SimpleQueue()
        self.used: list[tuple[Artifact, ...]] = []
        self.ended: dict[InstanceId, str] = {}
        self.reports: list[str] = []
        self.has_master = True
        self.service = ArtifactService(
            root, max_size, self.master, post=self.calls.put, used=lambda: self.used,
            report=lambda _, reason: self.reports.append(reason),
            has_master=lambda: self.has_master,
        )  # fmt: skip

    def prepare(self, number: int, *artifacts: Artifact) -> InstanceId:
        instance = InstanceId("p", number)
        spec = ProcessSpec("p", command=("{artifacts}/x",), artifacts=artifacts)
        self.used.append(artifacts)
        assignment = Assignment(instance, spec, epoch=1, node_name="p")
        self.service.prepare(assignment, self._done)
        return instance

    def _done(self, assignment: Assignment, fault: str) -> None:
        self.ended[assignment.instance] = fault

    def run_until(self, condition, what: str, now: float | None = None) -> None:
        deadline = clocks.boot_time() + PATIENCE
        while not condition():
            assert clocks.boot_time() < deadline, f"{what}; {self.reports}, {self.ended}"
            self.service.tick(clocks.boot_time() if now is None else now)
            try:
                self.calls.get(timeout=0.02)()
            except queue.Empty:
                continue

    def outcome(self, instance: InstanceId) -> str:
        self.run_until(lambda: instance in self.ended, f"{instance} is prepared")
        return self.ended[instance]


@pytest.fixture
def host(tmp_path):
    return Host(tmp_path / "artifacts")


@pytest.fixture
def offered(host, tmp_path):
    """Return a function that gives the master an artifact."""

    def make(name: str, size: int = 300_000) -> Artifact:
        path = tmp_path / name
        path.write_bytes(name.encode() * (size // len(name)))
        archive = Archive(path)
        host.master.archives[archive.digest] = archive.part(0, archive.size)
        return Artifact(name, archive.digest, archive.size)

    return make


def test_artifacts_are_fetched_once_for_all_instances(host, offered):
    """The second instance, and one that waits at the same time, use the cache."""
    one = offered("model")
    first, second = host.prepare(1, one), host.prepare(2, one)
    assert (host.outcome(first), host.outcome(second)) == ("", "")
    asked = len(host.master.asked)
    assert asked == 4
    assert host.outcome(host.prepare(3, one)) == ""
    assert len(host.master.asked) == asked


def test_a_process_gets_the_directory_in_its_texts(host, offered, tmp_path):
    """The placeholder stands for the directory in which the artifacts are."""
    one = offered("x")
    host.outcome(host.prepare(1, one))
    spec = ProcessSpec(
        "p", command=("{artifacts}/x",), arguments=("--in={artifacts}/x",), artifacts=(one,),
        environment={"X": "{artifacts}"}, parameters={"files": ["{artifacts}/x"]},
    )  # fmt: skip
    assignment = Assignment(InstanceId("p", 1), spec, epoch=1, node_name="p")
    filled = with_artifacts(assignment, tmp_path / "artifacts").spec
    directory = filled.environment["X"]
    assert filled.command == (f"{directory}/x",)
    assert filled.arguments == (f"--in={directory}/x",)
    assert filled.parameters == {"files": [f"{directory}/x"]}
    assert (tmp_path / directory / "x").read_bytes().startswith(b"x")


def test_messages_name_the_placeholder_instead_of_the_directory(tmp_path):
    """So the messages of all hosts about one program are equal, and short."""
    directory = set_directory(tmp_path / "host-1" / "artifacts", (Artifact("x", "0" * 64, 5),))
    text = without_directories(f"{directory}/x cannot be started: it is not executable")
    assert text == "{artifacts}/x cannot be started: it is not executable"
    assert without_directories("no executable '/bin/sets/x' exists").endswith("exists")


def test_a_busy_or_restarted_master_is_asked_again(host, offered):
    """The parts that have arrived stay."""
    host.master.refusals = [Refused("busy", "busy"), Refused("another run", "stale")]
    assert host.outcome(host.prepare(1, offered("model"))) == ""


def test_a_master_without_the_contents_is_a_refusal(host, offered):
    """The message names the artifact."""
    one = replace(offered("model"), digest="0" * 64)
    assert "artifact 'model' was not fetched: the master does not" in host.outcome(
        host.prepare(1, one)
    )


def test_wrong_contents_are_a_refusal(host, offered):
    """Contents of another digest are never used."""
    one = offered("model")
    host.master.archives[one.digest] = bytes(one.size)
    assert "does not match its digest" in host.outcome(host.prepare(1, one))


def test_a_full_cache_is_a_refusal(host, offered):
    """The message has the setting."""
    assert "artifacts.max_size" in host.outcome(host.prepare(1, offered("big", 2_000_000)))


def test_a_silent_master_is_a_refusal_in_time(host, offered, monkeypatch, tmp_path):
    """Until then the progress is reported, and nothing is left afterwards."""
    one = offered("model")
    monkeypatch.setattr(fetch, "PATIENCE", 1.5)
    host.master.is_silent = True
    assert (
        "no part of it came from the master within 1.5 s (the master does not answer)"
        in host.outcome(host.prepare(1, one))
    )
    assert host.reports[0] == "fetches artifacts, 0 B of 302 kB"
    host.run_until(lambda: not list((tmp_path / "artifacts/incoming").iterdir()), "removed")


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ("begin", "artifact 'model' was not fetched: PermissionError: [Errno 13] no"),
        ("finish", "artifact 'model' was not fetched: PermissionError: [Errno 13] no"),
        ("missing", "the artifacts cannot be used here: PermissionError: [Errno 13] no"),
        ("assemble", "the artifacts cannot be used here: PermissionError: [Errno 13] no"),
    ],
)
def test_an_error_of_the_disk_says_what_it_has_prevented(host, offered, monkeypatch, call, reason):
    """`rosrm ps` and `explain` show the sentence, which alone would name no artifact."""

    def refuse(*_, **__):
        raise PermissionError(13, "no")

    monkeypatch.setattr(ArtifactCache, call, refuse)
    assert reason in host.outcome(host.prepare(1, offered("model")))


def test_a_fetch_that_stalls_says_what_it_waits_for(host, offered, monkeypatch):
    """The reason names the awaited answer, because the progress alone would not change."""
    monkeypatch.setattr(fetch, "_ANSWER", 0.1)
    host.master.is_silent = True
    host.prepare(1, offered("model"))
    host.run_until(lambda: host.reports, "a report")
    assert "of 302 kB: the master does not answer (1" in host.reports[0]


def test_a_suspend_ends_no_fetch(host, offered, monkeypatch):
    """The time-out of a fetch counts the time in which a part could arrive."""
    host.master.is_silent = True
    instance = host.prepare(1, offered("model"))
    host.run_until(lambda: host.master.asked, "a request")
    slept = 10 * fetch.PATIENCE
    host.service.leave_out(slept)
    host.service.tick(clocks.boot_time() + slept + 1.0)
    assert instance not in host.ended
    host.service.tick(clocks.boot_time() + slept + fetch.PATIENCE + 1.0)
    assert "was not fetched" in host.outcome(instance)


def test_a_host_without_a_master_waits(host, offered, monkeypatch):
    """The fetch continues when the master returns."""
    monkeypatch.setattr(fetch, "PATIENCE", 0.2)
    host.has_master, host.master.is_silent = False, True
    instance = host.prepare(1, offered("model"))
    later = clocks.boot_time() + 0.6
    host.run_until(lambda: clocks.boot_time() >= later, "some time passes")
    host.has_master, host.master.is_silent = True, False
    assert host.outcome(instance) == ""


def test_a_stopped_instance_cancels_its_fetch(host, offered, tmp_path):
    """The fetch continues while another instance waits for it."""
    one = offered("model")
    host.master.is_silent = True
    first, second = host.prepare(1, one), host.prepare(2, one)
    host.run_until(lambda: host.master.asked, "a part is requested")
    host.service.forget(first)
    assert not host.service.is_preparing(first)
    host.master.is_silent = False
    assert host.outcome(second) == ""
    assert first not in host.ended


def test_a_stopped_instance_lets_others_fetch(host, offered):
    """The fetches of the stopped instance had occupied all places."""
    host.master.is_silent = True
    stopped = host.prepare(1, offered("one"), offered("two"))
    host.run_until(lambda: len(host.master.asked) >= 2, "both are fetched")
    waiting = host.prepare(2, offered("three"))
    searched = host.service._preparing[waiting]
    host.run_until(lambda: searched.missing is not None, "the cache was searched")
    host.service.forget(stopped)
    host.master.is_silent = False
    assert host.outcome(waiting) == ""


def test_a_later_run_of_the_slave_knows_the_artifacts_in_use():
    """The supervisor keeps them with the instance."""
    memo = Memo(artifacts=(Artifact("x", "0" * 64, 5),))
    assert from_memo(to_memo(memo)) == memo
    state, instance = SlaveState(), InstanceId("p", 1)
    running = InstanceStatus(instance, InstanceState.RUNNING, pid=5)
    reducer.step(state, SupervisorReplaced((running,), {instance: memo}), 0.0)
    assert state.used_artifacts() == [memo.artifacts]
    ended = replace(running, state=InstanceState.EXITED)
    reducer.step(state, SupervisorReported((ended,)), 1.0)
    assert state.used_artifacts() == []
