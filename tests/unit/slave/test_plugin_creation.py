"""Creation of probes and launchers at the start of a slave: none of them holds the slave."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rosrm import threads
from rosrm.errors import ConfigError, SkipPlugin
from rosrm.extensions.contracts import LauncherContext, LauncherOffer, ProbeOffer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.made import FailedProbe, Probes
from rosrm.extensions.registry import Registry
from rosrm.slave import plugin_creation
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.plugin_creation import PluginCreation
from rosrm.testing import FakeProbe, probe_context
from tests.waiting import PATIENCE, wait_until


@pytest.fixture(autouse=True)
def budget(monkeypatch) -> None:
    monkeypatch.setattr(plugin_creation, "BUDGET", 0.2)


class Gate:
    """A `create` that blocks until the test opens it, and then returns or raises the outcome."""

    def __init__(self, outcome: object) -> None:
        self.outcome, self.is_open = outcome, threading.Event()

    def __call__(self, *_: object) -> Any:
        assert self.is_open.wait(PATIENCE)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def creation(*offers: ProbeOffer | LauncherOffer) -> PluginCreation:
    class Plugin:
        @hookimpl
        def register_probes(self):
            return [one for one in offers if isinstance(one, ProbeOffer)]

        @hookimpl
        def register_launchers(self):
            return [one for one in offers if isinstance(one, LauncherOffer)]

    registry = Registry.of(ours=Plugin())
    chosen = {name: {} for name in registry.names("probe")}
    launchers = Launchers(awaited=frozenset(registry.names("launcher")))
    context = LauncherContext(Path("/nowhere"), "python", 1)
    return PluginCreation(registry, chosen, probe_context(), context, launchers)


def probe(name: str, create: Any = None, *, reads: tuple[str, ...] = ()) -> ProbeOffer:
    resources = reads or (name,)
    made = create or (lambda _options, _context: FakeProbe(**dict.fromkeys(resources, 0.5)))
    return ProbeOffer(name, made, resources=resources)


def wait(one: PluginCreation) -> int:
    """Wait as a starting slave does; return the number of calls during the wait."""
    calls: list[None] = []
    one.wait(lambda: calls.append(None), lambda: False)
    return len(calls)


def take_late(one: PluginCreation) -> None:
    wait_until(one.take_late, "the late plugin is taken over")


def state_of(probes: Probes) -> dict[str, str]:
    """Return the name of each probe to the reason why it is none; "": it is one."""
    return {
        one.name: one.probe.reason if isinstance(one.probe, FailedProbe) else ""
        for one in probes.made
    }


def test_a_probe_that_hangs_in_create_holds_no_slave_and_is_read_when_it_is_created(caplog) -> None:
    """Until then its resources are stale; the fences are renewed while the slave waits."""
    slow = Gate(FakeProbe(slow=0.1))
    one = creation(probe("slow", slow), probe("quick"))
    assert wait(one) >= 1
    assert "probe 'slow': not created within 0.2 s; the slave starts" in caplog.text
    before = one.probes
    found = state_of(before)
    assert found["quick"] == ""
    assert found["slow"].endswith("has not returned yet")
    assert [(made.name, len(made.resources)) for made in before.made] == [("quick", 1), ("slow", 1)]
    assert not one.take_late()
    slow.is_open.set()
    take_late(one)
    assert state_of(one.probes) == {"quick": "", "slow": ""}
    assert one.probes.made[0] is before.made[0], "the other probe is read on"
    assert not one.take_late()


def test_nothing_waits_for_plugins_that_are_created() -> None:
    """The budget is the longest time, not a delay of each start."""
    one = creation(probe("quick"), LauncherOffer("ours", lambda _: SimpleNamespace(prepare=None)))
    wait(one)
    assert state_of(one.probes) == {"quick": ""}


def test_a_stop_ends_the_wait() -> None:
    """Ctrl-C does not wait for a plugin."""
    slow = Gate(FakeProbe(slow=0.1))
    one = creation(probe("slow", slow))
    one.wait(lambda: pytest.fail("waits"), lambda: True)
    slow.is_open.set()


@pytest.mark.parametrize(
    ("outcome", "absent", "said"),
    [
        (SkipPlugin("no driver"), {"slow": "no driver"}, None),
        (OSError("no bus"), {}, "raised OSError: no bus"),
        (ConfigError("devices [7] do not exist"), {}, "devices [7] do not exist"),
        (FakeProbe(quick=0.1), {}, "reads 'quick', as 'quick' does already"),
    ],
)
def test_a_probe_that_fails_late_is_as_one_that_fails_at_once(outcome, absent, said) -> None:
    """Only wrong options do not end the slave any more, because it runs already."""
    slow = Gate(outcome)
    one = creation(probe("slow", slow, reads=("slow", "quick")), probe("quick"))
    wait(one)
    slow.is_open.set()
    take_late(one)
    assert one.probes.absent == absent
    assert state_of(one.probes)["quick"] == ""
    if said is not None:
        assert said in state_of(one.probes)["slow"]


def test_wrong_options_end_a_slave_that_starts() -> None:
    """As before: the user corrects the file."""
    wrong = Gate(ConfigError("devices [7] do not exist"))
    wrong.is_open.set()
    with pytest.raises(ConfigError, match=r"devices \[7\] do not exist"):
        wait(creation(probe("wrong", wrong)))


def test_without_another_thread_plugins_are_created_in_this_one(monkeypatch) -> None:
    """The limit of the user on processes may be used up by others."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threads, "start", refuse)
    one = creation(probe("quick"))
    wait(one)
    assert state_of(one.probes) == {"quick": ""}


def test_questions_to_a_launcher_that_is_not_created_have_no_answer() -> None:
    """A former run of the slave may have started an instance by it, which is being moved now."""

    class Ours:
        def prepare(self, launch: Any) -> Any: ...

        def leads(self, leader: int) -> bool:
            return leader == 10

        def members(self, leader: int) -> list[int]:
            return [leader, 11]

        def root(self, leader: int) -> int:
            return 11

        def has_departed(self, leader: int) -> bool:
            return leader == 10

    slow = Gate(Ours())
    one = creation(LauncherOffer("ours", slow))
    launchers = one._launchers
    wait(one)
    assert (launchers.has_departed(10), launchers.members(10)) == (None, None)
    assert launchers.made == {}
    assert launchers.failing == {"ours": "its `create` has not returned yet"}
    slow.is_open.set()
    take_late(one)
    assert launchers.failing == {}
    assert (launchers.has_departed(10), launchers.members(10)) == (True, (10, 11))
    assert (launchers.has_departed(30), launchers.members(30)) == (False, ())


@pytest.mark.parametrize(
    ("outcome", "said", "broken"),
    [(SkipPlugin("no CRIU"), "absent: no CRIU", False), (OSError("no"), "broken: ", True)],
)
@pytest.mark.parametrize("is_late", [True, False])
def test_a_broken_launcher_may_have_started_what_a_former_run_of_the_slave_left(
    outcome, said, broken, is_late
) -> None:
    """Its node may be out of the ROS graph; an absent launcher has started none."""
    gate = Gate(outcome)
    one = creation(LauncherOffer("ours", gate))
    launchers = one._launchers
    if is_late:
        wait(one)
        with sleeping() as since:
            assert (launchers.has_departed(since), launchers.members(since)) == (False, ())
        gate.is_open.set()
        take_late(one)
    else:
        gate.is_open.set()
        wait(one)
    assert launchers.unusable["ours"].startswith(said)
    assert ("ours" in launchers.broken) is broken
    former = os.getpid()
    unknown = (None, None) if broken else (False, ())
    assert (launchers.has_departed(former), launchers.members(former)) == unknown
    with sleeping() as since:
        assert (launchers.has_departed(since), launchers.members(since)) == (False, ())


@contextlib.contextmanager
def sleeping() -> Iterator[int]:
    """Return the pid of a process that starts now."""
    time.sleep(0.02)  # the kernel gives the start of a process in ticks of 0.01 s
    with subprocess.Popen(["sleep", "60"]) as process:
        try:
            yield process.pid
        finally:
            process.kill()
