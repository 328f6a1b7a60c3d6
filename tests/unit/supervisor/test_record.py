"""Durable record of the supervisor: content, compaction, and a full disk."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import threading
import time

import pytest

from rosrm.core.supervisor import events
from rosrm.core.supervisor.instance import EXITED, Instance
from rosrm.core.supervisor.reducer import MOST_TOMBSTONES, SupervisorState
from rosrm.core.supervisor.rules import LimitRule, RestartRule, RunLimits, StopRule
from rosrm.runtime.file_thread import FileThread
from rosrm.supervisor import instance_record as rc
from rosrm.supervisor import takeover
from rosrm.supervisor.messages import Amend, Launch
from tests.limits import no_more_files
from tests.waiting import PATIENCE, wait_until

DISK = FileThread("the state directory", patience=PATIENCE)
TALKER = ("talker", 7)
LAUNCH = Launch(TALKER, ("sleep", "1"), "base", {}, None, RestartRule(), StopRule(), "memo")


@pytest.fixture
def core():
    core = SupervisorState()
    core.handle(events.StartOrdered(TALKER, RestartRule("always"), StopRule(1.0, 2.0)), 0.0)
    core.handle(events.Spawned(TALKER, 100), 0.0)
    return core


@pytest.fixture
def record(tmp_path, core):
    record = rc.InstanceRecord(str(tmp_path), DISK)
    record.rewrite(core, {TALKER: LAUNCH}, {"base": {"A": "1"}}, lambda key: 55)
    return record


def test_an_instance_is_restored_in_every_field(tmp_path, core, record):
    """State, launch, environment and start time of its leader are restored in every field."""
    recorded = rc.read(str(tmp_path))
    back, instance = recorded.instances[TALKER], core.instances[TALKER]
    assert {name: getattr(back, name) for name in Instance.__slots__} == {
        name: getattr(instance, name) for name in Instance.__slots__
    }
    assert recorded.launches == {TALKER: LAUNCH}
    assert recorded.environments == {"base": {"A": "1"}}
    assert recorded.births == {TALKER: 55}
    assert recorded.same_boot
    assert not recorded.notes


def test_the_kills_before_a_run_are_restored(tmp_path, core, record):
    """A record of an earlier version has none."""
    record.state(core.instances[TALKER], 55, 3)
    record.flush()
    assert rc.read(str(tmp_path)).kills == {TALKER: 3}
    record.rewrite(core, {}, {}, lambda key: 55, lambda key: 4)
    assert rc.read(str(tmp_path)).kills == {TALKER: 4}
    path = tmp_path / "instances.jsonl"
    path.write_text(path.read_text().replace(',"oom_kills":4', ""))
    recorded = rc.read(str(tmp_path))
    assert (recorded.kills, recorded.notes) == ({TALKER: 0}, [])


def test_an_amendment_counts_from_then_on(tmp_path, core, record):
    """A confirmed shadow has another policy, environment and limits, also after compaction."""
    policy, limits = RestartRule("on-failure"), RunLimits(5e8, 0.0, 1.5, required=False)
    amended = LAUNCH.amended(Amend(TALKER, policy, {"ROSRM_SHADOW": None}, limits))
    core.handle(events.AmendOrdered(TALKER, policy), 1.0)
    record.launch(amended)
    record.state(core.instances[TALKER], 55)
    record.flush()
    for _ in range(2):
        recorded = rc.read(str(tmp_path))
        assert recorded.launches == {TALKER: amended}
        assert recorded.launches[TALKER].changes == {"ROSRM_SHADOW": None}
        assert recorded.launches[TALKER].limits == LimitRule(memory=5e8, cpu=1.5)
        assert recorded.launches[TALKER].memo == "memo"
        assert recorded.instances[TALKER].restart.when == "on-failure"
        record.rewrite(core, {TALKER: amended}, {"base": {}}, lambda key: 55)


def test_an_environment_that_is_known_is_kept(tmp_path, core, record):
    """A client sends it once; launches after a compaction refer to it."""
    record.rewrite(core, {}, {"base": {"A": "1"}}, lambda key: 55)
    record.launch(LAUNCH)
    record.flush()
    assert rc.read(str(tmp_path)).environments == {"base": {"A": "1"}}


def test_a_launch_without_its_environment_is_compacted(tmp_path, core, record):
    """The line that held the environment was damaged."""
    record.rewrite(core, {TALKER: LAUNCH}, {}, lambda key: 55)
    recorded = rc.read(str(tmp_path))
    assert recorded.launches == {TALKER: LAUNCH}
    assert not recorded.environments


def test_a_record_of_before_protocol_2_is_read(tmp_path, core):
    """Launches of that version had no memo, and instances no fault."""
    instance = core.instances[TALKER]
    state = {name: getattr(instance, name) for name in Instance.__slots__ if name != "fault"}
    lines = [
        {"record": "header", "version": 1, "boot": "another"},
        {"record": "environment", "id": "base", "variables": {"A": "1"}},
        {
            "record": "order", "instance": ["talker", 7], "argv": ["sleep", "1"],
            "environment": "base", "changes": {"A": None}, "directory": None,
            "restart": ["always", 1.0, 30.0, 2.0, 5, 300.0], "stop": [1.0, 2.0],
        },
        {"record": "state", "birth": 55, **state},
    ]  # fmt: skip
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "instances.jsonl").write_text(text)
    recorded = rc.read(str(tmp_path))
    assert not recorded.notes
    assert recorded.launches[TALKER].restart.when == "always"
    assert recorded.launches[TALKER].memo == ""


@pytest.mark.parametrize(
    "line", ["[" * 100_000, '{"record": "dead", "process": "p", "number": 1e999, "key": ["p", 1]}']
)
def test_a_line_that_no_reader_expects_is_left_out_with_a_note(tmp_path, line):
    """A successor that failed at a line would fail at each of its starts."""
    (tmp_path / "instances.jsonl").write_text(f"{line}\n")
    assert ":1: left out, it cannot be read" in rc.read(str(tmp_path)).notes[0]


def test_the_last_line_counts(tmp_path, core, record):
    """Later states replace earlier ones; an ended instance needs its launch no more."""
    core.handle(events.StopOrdered(TALKER), 1.0)
    core.handle(events.Exited(TALKER, signal=2), 2.0)
    record.state(core.instances[TALKER], 0)
    record.flush()
    recorded = rc.read(str(tmp_path))
    assert recorded.instances[TALKER].phase == EXITED
    assert recorded.launches == {}


def test_the_number_of_a_forgotten_instance_is_kept(tmp_path, record):
    """Only the number of a forgotten instance is kept, through a compaction, too."""
    record.dead(TALKER, 7)
    record.flush()
    recorded = rc.read(str(tmp_path))
    assert recorded.instances == {}
    assert recorded.dead == {"talker": 7}
    core = SupervisorState()
    core.dead.update(recorded.dead)
    record.rewrite(core, {}, {}, lambda key: 0)
    assert rc.read(str(tmp_path)).dead == {"talker": 7}


def test_the_numbers_that_are_taken_over_are_bounded(tmp_path, record):
    """A record between two compactions may have more of them than a supervisor keeps."""
    for number in range(MOST_TOMBSTONES + 10):
        record.dead((f"p{number}", 1), 1)
    assert record.flush()
    core = SupervisorState()
    takeover.restore(str(tmp_path), core, trees=None)  # none of its leaders runs
    assert len(core.dead) == MOST_TOMBSTONES
    assert f"p{MOST_TOMBSTONES + 9}" in core.dead


def test_another_boot_is_noticed(tmp_path, record, monkeypatch):
    """After a reboot of the machine the recorded pids are meaningless."""
    monkeypatch.setattr(rc.procfs, "boot_id", lambda: "another")
    assert not rc.read(str(tmp_path)).same_boot


def test_no_record_is_an_empty_one(tmp_path):
    """A host has no record before its first start."""
    recorded = rc.read(str(tmp_path))
    assert not recorded.instances
    assert not recorded.notes


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_delays_the_record_and_is_reported(tmp_path, core, record, monkeypatch):
    """Unwritten lines wait, and are written once there is room again."""
    core.handle(events.Exited(TALKER, 3), 2.0)
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        record.state(core.instances[TALKER], 0)
        assert not record.flush()
        assert "instances.jsonl cannot be written: No space left" in record.trouble
    assert record.flush()
    assert record.trouble == ""
    assert rc.read(str(tmp_path)).instances[TALKER].exit_code == 3


def test_a_write_in_part_is_finished_later(tmp_path, core, record, monkeypatch):
    """The disk took half a line: the other half follows, and the line is whole."""
    core.handle(events.Exited(TALKER, 3), 2.0)
    write = os.write
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", lambda file, data: write(file, data[:10]))
        record.state(core.instances[TALKER], 0)
        assert not record.flush()
    assert record.flush()
    recorded = rc.read(str(tmp_path))
    assert recorded.instances[TALKER].exit_code == 3
    assert not recorded.notes


def test_a_compaction_without_room_keeps_the_old_record(tmp_path, core, record, monkeypatch):
    """The old file stays, and pending lines are still appended to it."""
    core.handle(events.Exited(TALKER, 3), 2.0)
    record.state(core.instances[TALKER], 0)
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        record.rewrite(core, {}, {}, lambda key: 0)
        assert record.trouble
    assert record.flush()
    assert rc.read(str(tmp_path)).instances[TALKER].exit_code == 3


def test_a_record_that_begins_on_a_full_disk_gets_its_header_later(tmp_path, core, monkeypatch):
    """Without it, the next supervisor would take what runs for processes of another boot."""
    record = rc.InstanceRecord(str(tmp_path), DISK)
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        record.rewrite(core, {TALKER: LAUNCH}, {"base": {}}, lambda key: 0)
        assert not record.flush()
    record.state(core.instances[TALKER], 55)
    assert record.flush()
    recorded = rc.read(str(tmp_path))
    assert recorded.same_boot
    assert recorded.instances[TALKER].pid == 100


def test_it_is_compacted_when_it_has_grown(tmp_path, core, record):
    """Thousands of changes of one instance leave one line."""
    while not record.is_large():
        record.state(core.instances[TALKER], 55)
        record.flush()
    record.rewrite(core, {}, {}, lambda key: 55)
    assert not record.is_large()
    assert (tmp_path / "instances.jsonl").stat().st_size < 2000
    assert TALKER in rc.read(str(tmp_path)).instances


def test_a_compaction_without_room_leaves_no_part_of_itself(tmp_path, core, record, monkeypatch):
    """A part would take the room that the lines of the old record need."""
    write = os.write

    def write_a_part(file, data):
        if len(data) < 20:
            full()
        return write(file, data[:-10])

    monkeypatch.setattr(os, "write", write_a_part)
    record.rewrite(core, {}, {}, lambda key: 0)
    assert "No space left" in record.trouble
    assert [path.name for path in tmp_path.iterdir()] == ["instances.jsonl"]


@pytest.fixture
def stuck():
    """Return a thread whose calls wait, and a function that ends the wait."""
    disk, gate = FileThread("the state directory", patience=0.1), threading.Event()

    def hang() -> None:
        disk.begin(gate.wait)

    yield disk, hang, gate.set
    gate.set()


def test_a_disk_without_an_answer_delays_the_record_and_is_reported(tmp_path, core, stuck):
    """The loop waits once, and the lines are in the file when the disk answers again."""
    disk, hang, go_on = stuck
    record = rc.InstanceRecord(str(tmp_path), disk)
    record.rewrite(core, {TALKER: LAUNCH}, {}, lambda key: 55)
    hang()
    began = time.monotonic()
    for second in range(100):
        core.handle(events.Exited(TALKER, 3), float(second))
        record.state(core.instances[TALKER], 0)
        assert not record.flush()
    assert time.monotonic() - began < 5.0
    assert "instances.jsonl cannot be written: it does not answer" in record.trouble
    go_on()
    wait_until(record.flush, "the record is written")
    assert record.trouble == ""
    assert rc.read(str(tmp_path)).instances[TALKER].exit_code == 3


@pytest.mark.parametrize("fails", [False, True])
def test_lines_that_wait_for_a_disk_are_bounded(tmp_path, core, stuck, monkeypatch, fails):
    """The state replaces many lines, and later the file, also if the late write fails."""
    disk, hang, go_on = stuck
    monkeypatch.setattr(rc, "COMPACT_BYTES", 1 << 14)
    record = rc.InstanceRecord(str(tmp_path), disk)
    core.handle(events.StartOrdered(("other", 1), RestartRule(), StopRule()), 0.0)
    record.rewrite(core, {TALKER: LAUNCH}, {}, lambda key: 55)
    hang()
    record.flush()
    del core.instances["other", 1]
    core.dead["other"] = 1
    record.dead(("other", 1), 1)
    for _ in range(1000):
        record.state(core.instances[TALKER], 0)
        assert not record.flush()
        if record.is_large():
            record.rewrite(core, {TALKER: LAUNCH}, {}, lambda key: 55)
    assert sum(map(len, record._waiting)) < 1 << 17
    core.handle(events.Exited(TALKER, 3), 2.0)
    record.state(core.instances[TALKER], 0)
    with monkeypatch.context() as patched:
        if fails:
            patched.setattr(os, "write", full)
        go_on()
        wait_until(lambda: not disk.is_late, "the disk answers")
        record.flush()
    wait_until(record.flush, "the record is written")
    recorded = rc.read(str(tmp_path))
    assert list(recorded.instances) == [TALKER]
    assert recorded.instances[TALKER].exit_code == 3


@pytest.mark.parametrize("fault", [MemoryError(), OSError()])
def test_no_fault_of_a_write_loses_a_line(tmp_path, core, record, monkeypatch, fault):
    """After a fault without a text or number is over, all lines are written."""
    record.state(core.instances[TALKER], 77)

    def fails(*_):
        raise fault

    with monkeypatch.context() as now:
        now.setattr(rc, "open_private", fails)
        now.setattr(os, "write", fails)
        assert not record.flush()
        assert not record.flush()
    assert type(fault).__name__ in record.trouble
    assert record.flush()
    assert rc.read(str(tmp_path)).births == {TALKER: 77}


@pytest.mark.parametrize("fault", [None, OSError(errno.EMFILE, "Too many open files")])
def test_a_compaction_without_descriptors_loses_no_line(tmp_path, core, record, fault):
    """A compaction opens no file before it writes, and one that fails leaves the waiting lines."""
    record.state(core.instances[TALKER], 77)

    def birth(_: object) -> int:
        if fault:
            raise fault
        return 77

    with no_more_files(), contextlib.suppress(OSError):
        record.rewrite(core, {}, {}, birth)
    wait_until(record.flush, "the record is written")
    assert rc.read(str(tmp_path)).births == {TALKER: 77}
