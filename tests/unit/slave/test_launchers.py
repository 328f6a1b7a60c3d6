"""The slave asks the launchers of third parties; one that fails costs a start or an answer."""

from __future__ import annotations

import subprocess
import time
from dataclasses import replace
from typing import Any

import pytest

from rosrm import clocks
from rosrm.errors import CriuError, LaunchError
from rosrm.extensions.contracts import Capabilities, Launch, LauncherOffer, MigrationOffer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.made import MadeLauncher
from rosrm.extensions.plugin_calls import PluginCalls
from rosrm.extensions.plugin_deadline import Deadlines
from rosrm.extensions.registry import Registry
from rosrm.model.values import Assignment, InstanceId, MigrationPolicy, ProcessSpec
from rosrm.slave import sessions
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.sessions import SessionTable
from tests import plugin_kit


class Wrapper:
    """Starts each process by a program of its own."""

    def prepare(self, launch):
        return replace(launch, argv=("wrap", *launch.argv))


class Restorer(Wrapper):
    """Knows images of some instances, and leads a session in which the process is."""

    def __init__(self, *images: int) -> None:
        self.images = set(images)

    def prepare(self, launch):
        known = launch.assignment.instance.number in self.images
        return super().prepare(launch) if known else None

    def discard_images(self, instance):
        self.images.discard(instance.number)

    def leads(self, leader):
        return {10: True, 20: None}.get(leader, False)

    def members(self, leader):
        return [leader, 11, 12]

    def root(self, leader):
        return 11

    def has_departed(self, leader):
        return leader == 10


def out_of_order(*_: Any) -> Any:
    raise RuntimeError("out of order")


class Faulty(Restorer):
    prepare = discard_images = leads = has_departed = out_of_order


def launchers(unusable=None, **made: Any) -> Launchers:
    """The strategy of a process has the name of its launcher."""
    return Launchers(
        {name: MadeLauncher(one, ()) for name, one in made.items()},
        unusable or {},
        lambda spec: Capabilities(launcher=spec.migration.strategy or ""),
    )


def launch(strategy: str | None = None, **fields: Any) -> Launch:
    spec = ProcessSpec("p", command=("x",), migration=MigrationPolicy(strategy))
    return Launch(Assignment(InstanceId("p", 7), spec, 1, "p", **fields), "fleet", ("x",), {})


def test_the_launcher_that_the_strategy_declares_prepares_the_start():
    """Processes of other strategies are started as they are."""
    known = launchers(ours=Wrapper())
    assert known.prepare(launch("ours")).argv == ("wrap", "x")
    assert known.prepare(launch()).argv == ("x",)


def test_a_restored_instance_is_launched_by_the_launcher_that_has_its_image():
    """Whatever strategy its process moves by; without an image it does not start."""
    known = launchers(first=Restorer(), second=Restorer(7))
    assert known.prepare(launch(restored=True)).argv == ("wrap", "x")
    with pytest.raises(LaunchError, match="no launcher here has an image of it"):
        launchers(first=Restorer()).prepare(launch(restored=True))


@pytest.mark.parametrize(
    ("usable", "departed", "members"), [({}, None, None), ({"ours": Restorer()}, False, ())]
)
def test_an_instance_of_an_absent_launcher_is_unknown_to_a_later_run(usable, departed, members):
    """Its program may be missing from another PATH; its containers run on all the same."""
    ours = launchers(ours=Restorer(7)).prepare(launch("ours")).environment
    for environment, answers in ((ours, (departed, members)), ({}, (False, ()))):
        with subprocess.Popen(["/bin/sleep", "1000"], env=dict(environment)) as sleeper:
            pid = sleeper.pid
            later = launchers(unusable={"ours": "absent: no such engine"}, **usable)
            later._began = clocks.boot_time() + 1.0
            seen = later.has_departed(pid), later.members(pid)
            sleeper.kill()
        assert seen == answers


def test_a_missing_launcher_refuses_the_start_with_its_reason():
    """Started by its plain command the process would not be what its strategy expects."""
    with pytest.raises(LaunchError, match="p#7 needs the launcher 'ours', which is not installed"):
        launchers().prepare(launch("ours"))
    with pytest.raises(LaunchError, match="'ours', which is absent: no such engine"):
        launchers(unusable={"ours": "absent: no such engine"}).prepare(launch("ours"))


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (CriuError("the disk is full"), "^p#7: the disk is full$"),
        (
            ZeroDivisionError("a bug"),
            "the launcher 'ours' fails: prepare: ZeroDivisionError: a bug",
        ),
        (SystemExit(3), "SystemExit: 3"),
        ("a text", "answered a str; Launch is required"),
    ],
)
def test_a_launcher_that_cannot_prepare_refuses_the_start(act, said):
    """An error of rosrm is an answer, and everything else a fault of the plugin."""

    class Odd:
        def prepare(self, launch):
            if isinstance(act, BaseException):
                raise act
            return act

    with pytest.raises(LaunchError, match=said):
        launchers(ours=Odd()).prepare(launch("ours"))


@pytest.mark.parametrize("changes", [
    {"argv": ("x" * 60_000,) * 200},
    {"environment": {f"V{at}": "\x01" * 60_000 for at in range(200)}},
])  # fmt: skip
def test_a_launch_that_no_order_can_hold_refuses_the_start(changes):
    """The supervisor ends a connection with a longer order, and the next one, too."""

    class Wordy:
        def prepare(self, launch):
            return replace(launch, **changes)

    with pytest.raises(LaunchError, match=r"have 12\d{6} bytes; allowed: 1048576"):
        launchers(ours=Wordy()).prepare(launch("ours"))


@pytest.mark.parametrize(
    "variables", [{"A=B": "1"}, {"A": "a\0b"}, {"": "1"}, {"A": "x\ud800"}, {"A": 3}]
)
def test_a_launch_that_is_changed_in_its_place_is_checked_as_any_other(variables):
    """The checks compare it with the launch of the slave, which the launcher cannot change."""

    class Changing:
        def prepare(self, launch):
            launch.environment.update(variables)
            return launch

    own = launch("ours")
    with pytest.raises(LaunchError, match=r"NUL|name|UTF-8|is required"):
        launchers(ours=Changing()).prepare(own)
    assert own.environment == {}


def test_a_launcher_cannot_change_the_assignment_of_the_slave():
    """The slave reads it again, for the limits, the health and the end of the process."""

    class Changing:
        def prepare(self, launch):
            launch.assignment.spec.environment["ODD"] = "1"
            launch.assignment.spec.needs.clear()
            return launch

    spec = ProcessSpec(
        "p", command=("x",), environment={"A": "1"}, needs={"cpu": 1.0},
        migration=MigrationPolicy("ours"),
    )  # fmt: skip
    own = launch("ours")
    own = replace(own, assignment=replace(own.assignment, spec=spec))
    launchers(ours=Changing()).prepare(own)
    assert (spec.environment, spec.needs) == ({"A": "1"}, {"cpu": 1.0})


def test_a_prepared_launch_has_no_methods_of_the_plugin():
    """The slave compares and encodes its texts, and sends them to the supervisor."""

    class Equal(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, _other):
            return True

    class Odd:
        def prepare(self, launch):
            return replace(launch, argv=(Equal("y"),), environment={Equal("A"): Equal("1")})

    prepared = launchers(ours=Odd()).prepare(launch("ours"))
    assert {type(one) for one in (*prepared.argv, *prepared.environment)} == {str}
    assert {type(one) for one in prepared.environment.values()} == {str}


def test_a_launcher_that_leads_a_session_names_its_members(tmp_path):
    """They count to the instance, wherever they are; of other sessions the table finds them."""
    known = launchers(ours=Restorer())
    table = SessionTable(tmp_path, lambda pid: pid, known)
    for leader in (10, 30):
        table.add(leader)
    table.refresh(0.0)
    assert (table.members(10), table.members(30)) == ((10, 11, 12), (30,))
    assert (known.root(10), known.root(30)) == (11, 30)
    assert (known.has_departed(10), known.has_departed(30)) == (True, False)


def test_a_launcher_that_fails_leaves_an_instance_as_any_other():
    """The fault of a launcher is recorded once, with its place."""
    known = launchers(ours=Faulty())
    for _ in range(2):
        assert known.members(10) is None
        assert known.root(10) == 10
    with pytest.raises(LaunchError, match="'ours' fails: discard_images: "):
        known.discard_images(InstanceId("p", 7), 10)
    ((plugin, error),) = known.calls.changes(0.0)
    assert plugin == ("launcher", "ours")
    assert f"RuntimeError: out of order ({__file__}:" in error


@pytest.mark.parametrize("method", ["leads", "members"])
def test_a_launcher_that_fails_leaves_the_members_as_it_told_them_last(
    tmp_path, monkeypatch, method
):
    """Otherwise its node would be ended as not ready, and its usage would be that of the leader."""
    launcher = Restorer()
    table = SessionTable(tmp_path, lambda pid: pid, launchers(ours=launcher))
    monkeypatch.setattr(sessions, "inner_pid", lambda pid: pid + 100)
    table.add(10)
    table.refresh(0.0)
    with monkeypatch.context() as fault:
        fault.setattr(launcher, method, out_of_order)
        for now in (1.0, 2.0):
            table.refresh(now)
            assert table.known_as(10) == (10, 11, 12, 110, 111, 112)
    monkeypatch.setattr(launcher, "leads", lambda _leader: False)
    table.refresh(3.0)
    assert table.known_as(10) == (10,)


def test_a_launcher_that_cannot_tell_whether_a_node_has_departed_gives_no_answer():
    """Its node may be out of the graph while its memory is dumped: it is not unhealthy then."""
    calls = PluginCalls(Deadlines(0.05))
    calm = Restorer()

    class Late(Restorer):
        def has_departed(self, leader):
            time.sleep(0.1)
            return False

    late = replace(launchers(late=Late(), calm=calm), calls=calls)
    assert late.has_departed(30) is None, "late"
    assert late.has_departed(30) is None, "paused"
    assert late.has_departed(10) is True, "another launcher knows"
    for wrong in (out_of_order, lambda _leader: None, lambda _leader: "no"):
        faulty = Restorer()
        faulty.has_departed = wrong
        assert launchers(ours=faulty, calm=calm).has_departed(30) is None
    assert launchers(calm=calm).has_departed(30) is False


# --- of plugins ------------------------------------------------------------------------------


def registry(create) -> Registry:
    class Plugin:
        @hookimpl
        def register_launchers(self):
            return [LauncherOffer("ours", create, "wraps", variables=("OURS",))]

        @hookimpl
        def register_migration_strategies(self):
            return [MigrationOffer("moves", lambda options: None, capabilities=self.capabilities)]

        capabilities = Capabilities(launcher="ours")

    return Registry.of(mine=Plugin())


def test_a_plugin_brings_a_launcher_that_its_strategy_declares():
    """The registry lists the launcher like any other offer."""
    known = registry(lambda context: Wrapper())
    made = known.launchers(None).made
    own = Launchers(made, {}, known.capabilities_or_fault())
    assert own.prepare(launch("moves")).argv == ("wrap", "x")
    assert own.variables == ("OURS",)
    assert [(row.name, row.state) for row in known.rows("launcher")] == [("ours", "selected")]


@pytest.mark.parametrize(
    "answers",
    [
        {"register_migration_strategies": OSError("Too many open files")},
        {"register_migration_strategies": [MigrationOffer("moves", None)]},
    ],
)
def test_a_process_does_not_start_without_the_launcher_of_a_strategy_that_does_not_load(answers):
    """By its plain command it would run outside of its sandbox."""
    known = Registry.of(mine=plugin_kit.plugin(**answers))
    assert known.names("migration") == ()
    own = Launchers(capabilities_of=known.capabilities_or_fault())
    with pytest.raises(
        LaunchError, match=r"strategy 'moves' is not known: .* may offer it; .*'mine'"
    ):
        own.prepare(launch("moves"))
    assert own.prepare(launch()).argv == ("x",)


def test_a_host_without_the_plugin_of_a_strategy_has_none_of_its_launchers():
    """Such a process starts by its plain command, as on each host without the plugin."""
    own = Launchers(capabilities_of=Registry.of().capabilities_or_fault())
    assert own.prepare(launch("moves")).argv == ("x",)


def test_a_launcher_that_cannot_be_made_is_named_with_the_reason():
    """The slave starts without it."""
    known = registry(lambda context: None)
    assert "an object with `prepare` is required" in known.launchers(None).broken["ours"]
