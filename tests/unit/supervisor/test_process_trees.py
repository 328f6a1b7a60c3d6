"""Process trees of instances, with real processes."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import signal
import subprocess

import pytest

from rosrm.core.supervisor.events import Exited, SessionEnded, SpawnFailed
from rosrm.core.supervisor.instance import UNKNOWN_EXIT, Instance
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import RestartRule, StopRule
from rosrm.supervisor import descriptors, procfs, takeover
from rosrm.supervisor.group_trees import Tree
from rosrm.supervisor.instance_groups import InstanceGroups, group_name
from rosrm.supervisor.instance_record import Recorded
from rosrm.supervisor.process_tree import ProcessTrees, mark
from rosrm.supervisor.procfs import Stat
from tests.limits import no_more_files

TALKER = ("talker", 7)


def ended_leader() -> Stat:
    """Return the last known state of a session leader that has ended since."""
    process = subprocess.Popen(["true"], start_new_session=True)
    stat = procfs.read_stat(process.pid)
    process.wait()
    assert stat is not None
    return stat._replace(group=process.pid, session=process.pid, state="S")


def trees(state: str, events: list[object]) -> ProcessTrees:
    none = InstanceGroups()
    return ProcessTrees(state, selectors.DefaultSelector(), events.append, none, lambda _: None)


def test_a_leader_that_ends_during_the_take_over_is_not_taken_over(tmp_path):
    """The new supervisor then treats the instance like one whose leader had ended before."""
    happened: list[object] = []
    its = trees(str(tmp_path), happened)
    assert not its.take_over(TALKER, ended_leader())
    assert its.birth(TALKER) == 0


def test_a_start_whose_process_ends_during_the_take_over_failed(tmp_path, monkeypatch):
    """The process was found by its marks, and ended before the new supervisor could watch it."""
    core, recorded = SupervisorState(), Recorded()
    core.restore(Instance(TALKER, RestartRule(), StopRule()))
    recorded.spawning.add(TALKER)
    monkeypatch.setattr(procfs, "find_marked", lambda _: {mark(TALKER): [ended_leader()]})
    its = trees(str(tmp_path), [])
    (event,) = takeover.what_happened(recorded, str(tmp_path), core, its)
    assert isinstance(event, SpawnFailed)
    assert event.transient


def test_leaders_without_a_free_descriptor_are_taken_over(tmp_path, monkeypatch):
    """A supervisor may have started more of them than a process may have open descriptors."""
    monkeypatch.setattr(descriptors, "most_watched", lambda: 1)
    happened: list[object] = []
    its = trees(str(tmp_path), happened)
    sleepers = [subprocess.Popen(["sleep", "100"], start_new_session=True) for _ in range(3)]
    try:
        for number, sleeper in enumerate(sleepers):
            assert its.take_over(("sleep", number), procfs.read_stat(sleeper.pid))
        assert len(its._selector.get_map()) == 1
        its.look(1.0)
        assert happened == []
        its.signal(("sleep", 2), signal.SIGKILL)
        sleepers[2].wait()
        assert its.deadline() == 2.0
        its.look(1.9)
        assert happened == []
        its.look(2.0)
        assert happened == [Exited(("sleep", 2), UNKNOWN_EXIT)]
    finally:
        for sleeper in sleepers:
            sleeper.kill()
            sleeper.wait()
    its.look(3.0)
    assert [one.instance for one in happened] == [("sleep", 2), ("sleep", 1)]
    assert its.deadline() is None


def test_a_process_that_cannot_be_looked_at_now_has_not_ended(tmp_path, monkeypatch):
    """Processes are looked at only where descriptors are short; a false end would restart them."""
    monkeypatch.setattr(descriptors, "most_watched", lambda: 0)
    happened: list[object] = []
    its = trees(str(tmp_path), happened)
    with subprocess.Popen(["sleep", "100"], start_new_session=True) as sleeper:
        try:
            assert its.take_over(TALKER, procfs.read_stat(sleeper.pid))
            with no_more_files(), pytest.raises(OSError, match="Too many open files"):
                its.look(1.0)
            its.look(2.0)
            assert happened == []
        finally:
            sleeper.kill()
    its.look(3.0)
    assert happened == [Exited(TALKER, UNKNOWN_EXIT)]


def test_without_a_look_for_others_the_known_processes_get_a_signal(tmp_path, monkeypatch):
    """A SIGKILL that reaches none of them would not be sent again."""
    its = trees(str(tmp_path), [])
    with subprocess.Popen(["sleep", "100"]) as adopted, subprocess.Popen(["sleep", "100"]) as stray:
        try:
            assert its.take_over(TALKER, procfs.read_stat(adopted.pid))
            its.watch_strays(TALKER, [procfs.read_stat(stray.pid)])
            with no_more_files(), pytest.raises(OSError, match="Too many open files"):
                its.signal(TALKER, signal.SIGKILL)
            assert adopted.wait(timeout=20.0) == -signal.SIGKILL
        finally:
            adopted.kill()
            stray.kill()


def test_strays_beyond_the_descriptors_are_found_when_a_watched_one_ends(tmp_path, monkeypatch):
    """So no instance counts as ended before its last process."""
    monkeypatch.setattr(descriptors, "most_watched", lambda: 0)
    happened: list[object] = []
    its = trees(str(tmp_path), happened)
    sleepers = [subprocess.Popen(["sleep", "100"]) for _ in range(2)]
    stats = [procfs.read_stat(one.pid) for one in sleepers]
    monkeypatch.setattr(its, "_find", lambda _: stats[1:])
    its.watch_strays(TALKER, stats)
    for sleeper in sleepers:
        assert happened == []
        ((key, _),) = its._selector.select(0.0) or ((None, None),)
        assert key is None
        sleeper.kill()
        sleeper.wait()
        ((key, _),) = its._selector.select(5.0)
        key.data()
    assert happened == [SessionEnded(TALKER)]


def test_the_end_of_a_process_that_the_selector_refuses_is_found(tmp_path, monkeypatch):
    """The system bounds the descriptors that all selectors of a user may watch."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    happened: list[object] = []
    its = trees(str(tmp_path), happened)
    monkeypatch.setattr(its._selector, "register", refuse)
    other = ("other", 1)
    with subprocess.Popen(["sleep", "100"]) as stray, subprocess.Popen(["sleep", "100"]) as leader:
        its.watch_strays(TALKER, [procfs.read_stat(stray.pid)])
        assert its.take_over(other, procfs.read_stat(leader.pid))
        stray.kill()
        leader.kill()
    its.look(1.0)
    assert set(happened) == {SessionEnded(TALKER), Exited(other, UNKNOWN_EXIT)}


def test_a_thread_that_ends_meanwhile_hides_no_children_of_the_others(monkeypatch):
    """An adopted process may have many threads; a child that is not found would outlive it."""
    listed = os.listdir
    ended = str(2**22 + 1)  # above the largest pid of the kernel
    monkeypatch.setattr(os, "listdir", lambda path: [ended, *listed(path)])
    child = subprocess.Popen(["sleep", "100"])
    try:
        assert child.pid in procfs.descendants(os.getpid())
    finally:
        child.kill()
        child.wait()


def test_a_signal_reaches_an_adopted_process_and_no_other_with_its_pid(tmp_path, monkeypatch):
    """Its parent may reap it at any time, so a signal to the pid could end another process."""
    by_pid: list[int] = []
    its = trees(str(tmp_path), [])
    adopted = subprocess.Popen(["sleep", "100"])
    try:
        stat = procfs.read_stat(adopted.pid)
        assert stat is not None
        assert its.take_over(TALKER, stat)
        with monkeypatch.context() as patched:
            patched.setattr(os, "kill", lambda pid, _: by_pid.append(pid))
            its.signal(TALKER, signal.SIGTERM)
        assert by_pid == []
        assert adopted.wait(timeout=20.0) == -signal.SIGTERM
    finally:
        adopted.kill()
        adopted.wait()


def test_a_daemon_of_a_leader_that_is_not_known_yet_is_no_leftover(tmp_path, capfd):
    """Another process ends after the leader's exec, and before the supervisor notices the exec."""
    starting = {1: TALKER}
    its = ProcessTrees(
        str(tmp_path), selectors.DefaultSelector(), lambda _: None, InstanceGroups(),
        lambda _: None, lambda: starting,
    )  # fmt: skip
    marks = {procfs.INSTANCE_MARK: mark(TALKER), procfs.SUPERVISOR_MARK: str(tmp_path)}
    daemon = subprocess.Popen(["sleep", "100"], start_new_session=True, env=marks)
    try:
        end_another(its)
        assert "left over" not in capfd.readouterr().err
        starting.clear()
        end_another(its)
        os.waitid(os.P_PID, daemon.pid, os.WEXITED)
    finally:
        daemon.kill()
        daemon.wait()


def end_another(its: ProcessTrees) -> None:
    """Have the trees reap the leader of another instance."""
    other = subprocess.Popen(["true"], start_new_session=True)
    its.add_child(("other", 1), other.pid, procfs.ticks_now())
    os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
    its.reap()
    other.poll()


def test_a_group_that_cannot_be_read_now_is_not_empty(tmp_path, monkeypatch):
    """Without a free descriptor, the children of an ended leader are found later; none is lost."""
    tree = Tree(2, str(tmp_path), str(tmp_path), ("memory",))
    groups = InstanceGroups((tree,))
    sleeper = subprocess.Popen(["sleep", "100"], start_new_session=True)
    leader = subprocess.Popen(["sh", "-c", "exit 7"], start_new_session=True)
    group = tmp_path / group_name(TALKER)
    group.mkdir()
    (group / "cgroup.procs").write_text(f"{sleeper.pid}\n")
    groups.find_again({TALKER: 0})
    happened: list[object] = []
    its = ProcessTrees(
        str(tmp_path), selectors.DefaultSelector(), happened.append, groups, lambda _: None
    )
    its.add_child(TALKER, leader.pid, procfs.ticks_now())
    content = procfs.content

    def full(path: str) -> bytes:
        if path.startswith(str(tmp_path)):
            raise OSError(errno.ENFILE, "Too many open files in system")
        return content(path)

    try:
        os.waitid(os.P_PID, leader.pid, os.WEXITED | os.WNOWAIT)
        with monkeypatch.context() as now, contextlib.suppress(OSError):
            now.setattr(procfs, "content", full)
            its.reap()
        its.look(1.0)
        (ended,) = happened
        assert (ended.code, ended.leftovers) == (7, True)
    finally:
        sleeper.kill()
        sleeper.wait()
