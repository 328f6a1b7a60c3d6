"""`rosrm master` and `rosrm slave`: checks, start message and exec of the runtime."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from rosrm.cli.commands import runtimes
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.extensions.contracts import MigrationOffer, ProbeOffer, ScoringOffer
from rosrm.extensions.installed import installed_plugins
from rosrm.extensions.registry import Registry
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.records import Intent
from rosrm.runtime.bootstrap import take_over
from rosrm.runtime.settings_check import SettingsSource
from rosrm.runtime.state_lock import only_one
from rosrm.testing import FakeProbe
from tests.plugin_kit import plugin

OURS = plugin(
    ProbeOffer("cpu", lambda *_: FakeProbe(cpu=0.5), default=True),
    ScoringOffer("weighted", lambda options: SimpleNamespace(score=None)),
    MigrationOffer("relaunch", lambda options: SimpleNamespace(propose=None)),
)


@pytest.fixture
def becomes(monkeypatch, tmp_path):
    """Record the runtime and settings of the exec, instead of the exec."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    seen = []
    monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=OURS))
    monkeypatch.setattr(
        runtimes, "become", lambda module, settings, source: seen.append((module, settings, source))
    )
    return seen


@pytest.fixture
def cluster_file(tmp_path):
    (tmp_path / "c.yaml").write_text("name: lab\nstate: s\n", encoding="utf-8")
    return tmp_path / "c.yaml"


def test_a_master_starts_with_the_settings_of_its_file(rosrm, becomes, cluster_file, tmp_path):
    result = rosrm("master", "--config", cluster_file, "--domain", 7)
    assert result.code == 0
    assert result.err.startswith("master 'lab': domain 7, ")
    assert f"scoring weighted; migration relaunch; state in {tmp_path / 's'}" in result.err
    ((module, settings, source),) = becomes
    assert module == "rosrm.master"
    assert source == SettingsSource("master", str(cluster_file), 7)
    config = ClusterConfig.from_json(settings)
    assert (config.name, config.ros.domain) == ("lab", 7)


def test_a_slave_starts_with_the_settings_of_its_file(rosrm, becomes, tmp_path):
    (tmp_path / "h.yaml").write_text("host: h1\nlimits: {cpu: 0.7}\n", encoding="utf-8")
    result = rosrm("slave", "--config", tmp_path / "h.yaml")
    assert result.code == 0
    assert "slave of 'h1': domain " in result.err
    assert "limits memory 80%, cpu 70%, disk 90%" in result.err
    ((module, settings, source),) = becomes
    assert module == "rosrm.slave"
    assert source == SettingsSource("slave", str(tmp_path / "h.yaml"), None)
    assert HostConfig.from_json(settings).host == "h1"


def test_both_start_with_the_defaults_too(rosrm, becomes):
    assert rosrm("master").code == 0
    assert rosrm("slave").code == 0
    assert [module for module, *_ in becomes] == ["rosrm.master", "rosrm.slave"]


@pytest.mark.parametrize(
    ("command", "name", "said"),
    [
        ("master", "c.yaml", ":1:11: unknown scoring policy 'weihgted'; did you mean 'weighted'?"),
        ("slave", "none.yaml", ": cannot be read: No such file or directory"),
    ],
)
def test_a_wrong_file_or_unknown_plugin_starts_nothing(
    rosrm, becomes, tmp_path, command, name, said
):
    (tmp_path / "c.yaml").write_text("scoring: {policy: weihgted}\n", encoding="utf-8")
    result = rosrm(command, "--config", tmp_path / name)
    assert (result.code, becomes) == (2, [])
    assert f"{name}{said}" in result.err


def test_the_runtime_inherits_the_settings_and_where_the_plugins_are(monkeypatch):
    """The settings are on a descriptor that outlives the exec."""
    seen = {}

    def execv(program, words):
        seen["words"] = words
        seen["inherited"] = os.get_inheritable(int(words[-1]))
        seen["handover"] = take_over(words[-2:])

    monkeypatch.setattr(os, "execv", execv)
    source = SettingsSource("slave", "/etc/rosrm/host.yaml", 7)
    runtimes.become("rosrm.slave", '{"host": "h"}', source)
    assert seen["words"][-4:-1] == ["-m", "rosrm.slave", "--settings-fd"]
    assert (seen["inherited"], seen["handover"].settings) == (True, '{"host": "h"}')
    assert list(seen["handover"].plugins) == installed_plugins()
    assert seen["handover"].source == source


def test_a_damaged_journal_is_recovered_before_the_master_starts(rosrm, becomes, cluster_file):
    path = cluster_file.parent / "s" / "journal.sqlite"
    command = ("master", "--config", cluster_file, "--recover")

    none = rosrm(*command)
    assert (none.code, becomes) == (1, [])
    assert f"there is no journal to recover: {path}" in none.err

    journal = SqliteJournal(path)
    for number in range(100):
        journal.write([], [Intent("process", f"p{number}", {"x": "y" * 500})], 0.0)
    journal.close()
    whole = rosrm(*command)
    assert (whole.code, becomes) == (1, [])
    assert "is not damaged: start without" in whole.err

    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) - 2 * 4096])
    result = rosrm(*command)
    assert result.code == 0
    assert "the journal was recovered" in result.err
    assert [module for module, *_ in becomes] == ["rosrm.master"]
    SqliteJournal(path).close()


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["master"], "Stop it first, or give this one another `state:`"),
        (["slave"], "Stop it first, or give this one another `host:` and `state:`"),
        (["slave", "--stop-all"], "Stop it first"),
    ],
)
def test_beside_a_running_one_nothing_starts(rosrm, becomes, words, remedy):
    """Only the refusal is printed."""
    settings = ClusterConfig() if words == ["master"] else HostConfig()
    (settings.state / "supervisor").mkdir(parents=True)
    with only_one(settings.state, words[0], code="", remedy=""):
        result = rosrm(*words)
    assert (result.code, becomes) == (1, [])
    assert result.err == (
        f"rosrm: a {words[0]} runs already on {settings.state}: pid {os.getpid()}. {remedy}\n"
    )
