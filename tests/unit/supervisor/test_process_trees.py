"""Process trees of instances, with real processes."""

from __future__ import annotations

import selectors
import subprocess

from rosrm.core.supervisor.events import SpawnFailed
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import RestartRule, StopRule
from rosrm.supervisor import procfs, takeover
from rosrm.supervisor.instance_record import Recorded
from rosrm.supervisor.process_tree import ProcessTrees, mark
from rosrm.supervisor.procfs import Stat

TALKER = ("talker", 7)


def ended_leader() -> Stat:
    """Return the last known state of a session leader that has ended since."""
    process = subprocess.Popen(["true"], start_new_session=True)
    stat = procfs.read_stat(process.pid)
    process.wait()
    assert stat is not None
    return stat._replace(group=process.pid, session=process.pid, state="S")


def trees(state: str, events: list[object]) -> ProcessTrees:
    return ProcessTrees(state, selectors.DefaultSelector(), events.append)


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
