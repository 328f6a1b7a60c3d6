"""Each system call of a start, a restart and a stop fails once: no process is left unwatched."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rosrm.core.supervisor import events
from rosrm.core.supervisor.rules import LimitRule, RestartRule, StopRule
from rosrm.runtime.file_thread import FileThread
from rosrm.supervisor import confinement, endpoint, group_trees, messages, procfs, server
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.spawn_into import fork_into
from tests.failing_calls import nth_call_fails, uncounted
from tests.waiting import PATIENCE

KEY = ("a", 1)
#: More calls than a run has.
MOST_CALLS = 2000


class Scene:
    """A supervisor without a client, whose loop the test turns in this thread."""

    def __init__(self, state: Path) -> None:
        self.state = str(state)
        self.listener = endpoint.listen(self.state)
        self.server = server.Server(self.state, self.listener, LogLimits())
        self.server._take_over()
        self.server._environments["base"] = {"PATH": os.environ["PATH"]}

    def close(self) -> None:
        for pid in self.pids():
            os.kill(pid, signal.SIGKILL)
        self.server._groups.close()
        self.server._selector.close()
        self.listener.close()
        endpoint.release_lock()
        os.close(self.server._null)

    def start(self, *argv: str, restart: str = "always", nice: int = 0) -> None:
        rule, stop = RestartRule(restart, 0.0, 0.0, 1.0, 100, 300.0), StopRule(0.1, 0.1)
        limits = LimitRule(nice=nice)
        order = messages.Launch(KEY, argv, "base", {}, None, rule, stop, limits=limits)
        server._guarded(self.server._start, order)

    def service(self) -> None:
        """End the first run of a service by a signal from outside, and stop the second one."""
        self.start("sleep", "1000")
        first = self.runs()
        os.kill(first, signal.SIGKILL)
        self.turn_until(lambda: self.instance.pid != first, "the end of the first run")
        self.runs()
        self.server._happened(events.StopOrdered(KEY))
        self.turn_until(lambda: self.instance.ended, "the end")

    def job(self) -> None:
        """Run a job that ends at once."""
        self.start("false", restart="never")
        self.turn_until(lambda: self.instance.ended, "the end")
        assert self.instance.begun is None or self.instance.exit_code == 1

    def remove_groups(self) -> None:
        self.turn_until(lambda: self.server._groups.deadline() is None, "the removals")

    @property
    def instance(self):
        return self.server._core.instances[KEY]

    def runs(self) -> int:
        self.turn_until(lambda: self.instance.phase == "running", "a run")
        assert self.pids() == [self.instance.pid]
        return self.instance.pid

    def pids(self) -> list[int]:
        """Return the living processes of the instance."""
        with uncounted():
            return [stat.pid for stat in procfs.find_marked(self.state).get("a#1", [])]

    def turn_until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            seen = f"{self.instance.phase} {self.instance.message}"
            assert time.monotonic() < deadline, f"not within {PATIENCE:g} s: {what}: {seen}"
            server._guarded(self.server._round)
            self.server._take_in(0.01)
            server._guarded(self.server._trees.reap)


def own_groups() -> str:
    return Path("/proc/thread-self/cgroup").read_text()


@pytest.mark.parametrize(
    ("number", "groups"), [(errno.ENOMEM, True), (errno.EMFILE, False), (errno.EIO, False)]
)
@pytest.mark.parametrize("life", [Scene.service, Scene.job])
def test_a_process_is_watched_or_gone_whichever_call_fails(
    tmp_path, monkeypatch, life, number, groups
):
    """Nothing is left of it at the end, and the supervisor is in its own control groups."""
    monkeypatch.setattr(FileThread, "_starts_thread", lambda self: False)  # so its calls count
    monkeypatch.setattr(server, "PAUSE_AFTER_FAULT", 0.0)
    if not groups:
        monkeypatch.setattr(group_trees, "find", lambda state: ((), {}))
    home, failed = own_groups(), []
    for n in range(MOST_CALLS):
        scene = Scene(tmp_path / str(n))
        try:
            with nth_call_fails(n, number, also=[fork_into]) as count:
                life(scene)
            scene.remove_groups()
            assert (scene.pids(), own_groups()) == ([], home)
        except BaseException as fault:
            fault.add_note(f"call {n}: {count.failed}")
            raise
        finally:
            scene.close()
        if not count.failed:
            break
        failed.append(count.failed)
    assert any(call.startswith("register in ") for call in failed)


def test_a_start_that_fails_after_its_exec_leaves_no_process(tmp_path, monkeypatch):
    """The process exists, and no part has taken it yet."""
    scene, lacks = Scene(tmp_path), [MemoryError]

    def fail(*_):
        if lacks:
            raise lacks.pop()
        return {}

    monkeypatch.setattr(confinement, "_nice_fault", fail)
    scene.start("sleep", "1000", nice=1)
    scene.runs()
    scene.close()
