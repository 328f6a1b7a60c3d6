"""Guard of plugin calls in the core: failures counted, located, and recorded on change."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.extensions.plugin_calls import (
    RECORD_PERIOD,
    WORKS_AFTER,
    Failing,
    Plugin,
    PluginCalls,
    required,
)
from rosrm.model.values import EMPTY, MigrationPolicy, Readiness
from tests.unit.core.cluster import Cluster, Eq1, StartFirstOrStopFirst, process


class Moody:
    """Scoring policy that fails on demand of a test."""

    def __init__(self) -> None:
        self.fails = False

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        if self.fails:
            return self._trouble()
        return Eq1().score(hosts, process)

    def _trouble(self) -> Scores:
        raise KeyError("prefix")


def submitted(cluster: Cluster, number: int) -> None:
    cluster.submit(process(f"p{number}", memory=number))  # each process has a ranking of its own


def test_a_failing_plugin_is_recorded_once_and_again_when_it_works() -> None:
    """Further failures are counted; the plugin works again after a while without failures."""
    policy = Moody()
    cluster = Cluster("a", policy=policy)
    policy.fails = True
    for number in range(1, 4):
        submitted(cluster, number)
    (message,) = cluster.recorded("plugin_failed")
    assert message.startswith("the scoring policy 'eq1' fails: score: KeyError: 'prefix' (")
    reason = cluster.state.plugins.failing["scoring", "eq1"].reason(cluster.now)
    assert reason.startswith("score: KeyError: 'prefix' (")
    assert "; 3 failures so far, the last " in reason
    policy.fails = False
    submitted(cluster, 4)
    assert ("scoring", "eq1") in cluster.state.plugins.failing
    cluster.wait(WORKS_AFTER + 1.0)
    submitted(cluster, 5)
    assert cluster.recorded("plugin_works") == ["the scoring policy 'eq1' works again"]
    assert cluster.state.plugins.failing == {}


def test_the_place_is_the_plugin_s_own_innermost_frame() -> None:
    """The place is neither a frame of a library that the plugin called nor one of rosrm."""

    def sorts() -> None:
        sorted([1, 2], key=lambda _: sys.intern(3))  # type: ignore[arg-type]

    with pytest.raises(PluginError, match=rf"\({__file__}:{sorts.__code__.co_firstlineno + 1}\)"):
        PluginCalls().ask("scoring", "x", "score", sorts)


def test_an_error_of_rosrm_s_own_check_has_no_place() -> None:
    """The message about the answer is sufficient; no line of code is involved."""
    with pytest.raises(PluginError, match=r"^answered None; Scores is required$"):
        PluginCalls().ask("scoring", "x", "score", lambda: required(None, Scores))


class Silent:
    """Scoring policy that lacks a `return`."""

    def score(self, hosts: Any, process: Any) -> Any:
        """Return nothing."""


class Refusing:
    """Scoring policy that vetoes each host without a reason."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        veto = np.ones(len(hosts.names), np.bool_)
        return Scores(np.zeros(len(veto)), veto, veto_reason=self.why)

    def why(self, row: int) -> Any:
        """Return nothing."""


def test_a_wrong_answer_is_named_with_the_place_of_the_method() -> None:
    """No exception shows the place, so the text has file and line of the definition."""
    cluster = Cluster("a", policy=Silent())
    submitted(cluster, 1)
    (message,) = cluster.recorded("plugin_failed")
    place = f"{__file__}:{Silent.score.__code__.co_firstlineno}"
    assert message.endswith(f"score: answered None; Scores is required ({place})")


def test_a_reason_that_is_no_text_is_named_with_the_place_of_the_method() -> None:
    """A veto without a reason does not become the word None."""
    cluster = Cluster("a", policy=Refusing())
    submitted(cluster, 1)
    (host,) = cluster.explain("p1")["decision"]["hosts"]
    place = f"{__file__}:{Refusing.why.__code__.co_firstlineno}"
    assert f"answered None; str is required ({place})" in host["reason"]


def test_a_call_within_a_call_of_the_same_plugin_has_no_time_out_of_its_own() -> None:
    """The time-out of the outer call covers the inner one, also after a failure.

    Another plugin has its own time-out.
    """
    limited: list[Plugin] = []

    def limit(plugin: Plugin, call: Callable[[], Any]) -> Any:
        limited.append(plugin)
        return call()

    calls = PluginCalls(limit)

    def outer() -> int:
        with pytest.raises(PluginError):
            calls.ask("scoring", "x", "reason", lambda: 1 // 0)
        calls.ask("filter", "y", "mask", lambda: 1)
        return calls.ask("scoring", "x", "veto_reason", lambda: 2)

    for _ in range(2):
        assert calls.ask("scoring", "x", "score", outer) == 2
    assert limited == [("scoring", "x"), ("filter", "y")] * 2


class Wordless(Exception):
    """Exception whose text raises, too."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    "fault", [SystemExit(3), GeneratorExit(), ZeroDivisionError(), Wordless()], ids=repr
)
def test_nothing_that_a_plugin_raises_ends_its_caller(fault: BaseException) -> None:
    """The guard catches exceptions that `except Exception` lets pass, too."""

    def call() -> Any:
        raise fault

    with pytest.raises(PluginError, match=type(fault).__name__):
        PluginCalls().ask("scoring", "x", "score", call)


def test_ctrl_c_passes_the_guard() -> None:
    """Ctrl-C ends a simulation; a master's own handler raises nothing."""

    def call() -> Any:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        PluginCalls().ask("scoring", "x", "score", call)


def test_a_probe_that_fails_is_recorded_when_that_changes() -> None:
    """A slave reports all failing probes, so a probe missing in the next report works again."""
    cluster = Cluster("a")
    for failing in ({"lidar": "no such sensor"}, {"lidar": "no such sensor"}, {}):
        fails_there(cluster, failing)
    assert cluster.recorded("plugin_failed") == ["the probe of lidar on a fails: no such sensor"]
    assert cluster.recorded("plugin_works") == ["the probe of lidar on a works again"]


def test_a_strategy_whose_executors_fail_is_recorded_with_its_host() -> None:
    """The slave that runs the executors reports the failures."""
    cluster = Cluster("a")
    for failing in ({"acme": "executor rest raised OSError: no arm"}, {}):
        fails_there(cluster, {}, failing)
    said = "the migration strategy 'acme' on a"
    assert cluster.recorded("plugin_failed") == [
        f"{said} fails: executor rest raised OSError: no arm"
    ]
    assert cluster.recorded("plugin_works") == [f"{said} works again"]


def fails_there(cluster: Cluster, probes: dict[str, str], strategies: Any = EMPTY) -> None:
    """Let the slave of `a` report its failing probes and strategies."""
    cluster.report("a", failing=probes, failing_strategies=strategies)


def test_another_error_of_a_failing_plugin_is_recorded_once_a_minute() -> None:
    """An error may name the process, and so differ in each call."""
    cluster = Cluster("a")
    for error in ("unplugged", "no permission", "too hot"):
        fails_there(cluster, {"lidar": error})
    assert cluster.state.hosts.by_name["a"].failing["probe", "lidar"].error == "too hot"
    cluster.wait(RECORD_PERIOD + 1.0)
    fails_there(cluster, {"lidar": "too cold"})
    said = "the probe of lidar on a fails: "
    assert cluster.recorded("plugin_failed") == [f"{said}unplugged", f"{said}too cold"]


#: Capability of a strategy whose processes ask for periodic checkpoints.
PERIODIC = {
    "checkpoint_every": lambda *_: 10.0, "periodic": lambda *_: None, "discard": "sweep",
}  # fmt: skip


def leave(_plugin: object) -> Any:
    raise SystemExit("no driver")


@pytest.mark.parametrize(
    "members",
    ["propose", "spec_fault", "host_check host_fault", "checkpoint restore",
     "checkpoint_every periodic discard", "pace"],
)  # fmt: skip
def test_a_property_of_a_plugin_that_raises_costs_one_decision(members: str) -> None:
    """The core looks up the members of a plugin inside the guard only."""
    raising = {name: property(leave) for name in members.split()}
    strategy = type("Strategy", (StartFirstOrStopFirst,), dict(PERIODIC | raising))()
    cluster = Cluster("a", "b", strategies={"criu": strategy})
    cluster.state.replication.policy = type("Policy", (), dict(raising))()
    migration = MigrationPolicy("criu", options={"checkpoint_every": 10.0})
    cluster.submit(process("p", ros=True, readiness=Readiness("running"), migration=migration))
    cluster.wait(2.0)
    if "p" in cluster.state.processes:
        cluster.checkpoint("p")
        cluster.migrate("p")
    assert "SystemExit: no driver" in cluster.recorded("plugin_failed")[0]


def test_an_answer_that_arrives_while_the_failure_ends_leaves_no_trace() -> None:
    """Threads note answers of launchers while the loop of the slave takes the changes."""
    calls, plugin = PluginCalls(), ("launcher", "box")

    class Crossed(dict[Plugin, Failing]):
        def __contains__(self, key: object) -> bool:
            known = super().__contains__(key)
            calls.changes(100.0)  # of the loop, between the two steps of the thread
            return known

        def get(self, key: Any, default: Any = None) -> Any:
            known = super().get(key, default)
            calls.changes(100.0)
            return known

    calls.note(plugin, "prepare", "no")
    calls.changes(0.0)
    calls.note(plugin, "prepare")
    calls.changes(1.0)
    known, calls.failing = calls.failing, Crossed(calls.failing)
    calls.note(plugin, "prepare")
    calls.failing = dict(calls.failing)
    assert plugin in known
    calls.note(("launcher", "other"), "prepare", "no")
    assert calls.changes(101.0) == [(("launcher", "other"), "no")]


def test_a_plugin_fails_until_the_method_that_failed_succeeds() -> None:
    """Otherwise a policy with one broken method would be said to work by its other methods."""
    calls, plugin = PluginCalls(), ("scoring", "x")
    calls.note(plugin, "score", "score: no")
    calls.changes(0.0)
    calls.note(plugin, "rank")
    assert calls.changes(WORKS_AFTER) == []
    calls.note(plugin, "score")
    assert calls.changes(WORKS_AFTER) == [(plugin, "")]


def test_any_success_ends_the_failure_of_a_call_that_is_not_known() -> None:
    """A former process ended in this call, so the method may be unknown."""
    calls, plugin = PluginCalls(), ("scoring", "x")
    calls.note(plugin, "", "the process has ended in a call of it")
    calls.changes(0.0)
    calls.note(plugin, "score")
    assert calls.changes(WORKS_AFTER) == [(plugin, "")]
