"""`rosrm config check`."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.errors import SkipPlugin
from rosrm.extensions import installed
from rosrm.extensions.contracts import CheckpointOffer, MigrationOffer, ProbeOffer, ScoringOffer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.registry import Registry
from rosrm.testing import FakeProbe

from .test_start import OURS


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=OURS))


@pytest.fixture
def file(tmp_path):
    def write(text, name="f.yaml"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "scoring: {policy: weighted}",
            "ok, a cluster: scoring weighted, migration relaunch, checkpoint none\n",
        ),
        ("host: h1\nros: {domain: 1}", "ok, a host: h1, probes cpu\n"),
        ("processes: [{name: a, command: x, kind: job}]", "ok, work: 1 job\n"),
        ("defaults: {kind: job}\nprocesses: [{name: a, command: x}]", "ok, work: 1 job\n"),
    ],
)
def test_the_kind_of_a_right_file_is_known_by_its_keys(rosrm, file, text, said):
    result = rosrm("config", "check", file(text))
    assert result.code == 0
    assert f"f.yaml: {said}" in result.out


def test_a_file_that_may_be_either_wants_the_kind(rosrm, file):
    result = rosrm("config", "check", file("ros: {domain: 1}"))
    assert result.code == 2
    assert "its keys fit a cluster and a host file alike; choose one with --kind" in result.err
    assert rosrm("config", "check", "--kind", "cluster", file("ros: {domain: 1}")).code == 0
    result = rosrm("config", "check", file(""))
    assert "it has no key of a cluster, host, work or simulation file; choose" in result.err
    result = rosrm("config", "check", file("proceses: []"))
    assert "simulation file, and 'proceses': did you mean 'processes'? Choose one" in result.err
    result = rosrm("config", "check", file("- {name: a}"))
    assert "it is no mapping; in a work file the list is under `processes:`" in result.err


SIMULATION = "hosts: [{name: a, memory: 1GiB, cpu: 1}]\nprocesses: [{name: p, duration: 1s}]"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("cluster.yaml", "ros: {domain: 1}", "ok, a cluster"),
        ("lab.cluster.yaml", "ros: {domain: 1}", "ok, a cluster"),
        ("host.yaml", "ros: {domain: 1}", "ok, a host"),
        ("evening.sim.yaml", SIMULATION, "ok, a simulation: 1 host, 1 process\n"),
        ("f.yaml", f"name: evening\nseed: 1\n{SIMULATION}", "ok, a simulation"),
    ],
)
def test_the_name_tells_the_kind_where_the_keys_do_not(rosrm, file, name, text, said):
    result = rosrm("config", "check", file(text, name))
    assert (result.code, result.err) == (0, "")
    assert said in result.out


HOST = "host: desk\nscope: slice\nbudget: {memory: 1GiB, cpu: 1}\nlimts: {cpu: 1}"
WORK = "processes: [{name: a, command: x}]"


def test_the_check_of_a_simulation_names_its_distribution(rosrm, file, monkeypatch):
    """Without `rosrm-simulate` the keys tell the kind, and the error names the package."""
    monkeypatch.setattr(installed, "installed_plugins", lambda group: [])
    path = file(f"seed: 1\n{SIMULATION}")

    result = rosrm("config", "check", path)

    assert (result.code, result.err) == (
        2,
        f"rosrm: {path}: the check of a simulation file comes with `pip install rosrm-simulate`\n",
    )


@pytest.mark.parametrize(
    ("command", "text", "said"),
    [
        (["submit"], HOST, "a work file is required, and this is a host file, by its keys host, "),
        (["submit"], f"seed: 1\n{SIMULATION}", "is a simulation file, by its keys seed, hosts"),
        (["simulate"], WORK, "a simulation file is required, and this is a work file"),
        (["master", "--config"], HOST, "a cluster file is required, and this is a host file"),
        (["slave", "--config"], "name: x\nscoring: {}", "it is for `rosrm master --config "),
    ],
)
def test_a_file_of_another_kind_is_named_once(rosrm, file, command, text, said):
    """The error does not list each key."""
    result = rosrm(*command, file(text))
    assert result.code == 2
    assert said in result.err
    assert len(result.err.splitlines()) == 1


def test_every_wrong_file_is_said_and_nothing_else_is_lost(rosrm, file):
    result = rosrm(
        "config",
        "check",
        file("scoring: {policy: wieghted}", "a.yaml"),
        file("host: h1", "b.yaml"),
        file("host: h1\nprobes: [lidar]", "c.yaml"),
        file("processes: [{name: a, command: x, migration: criu}]", "d.yaml"),
    )
    assert result.code == 2
    assert "b.yaml: ok" in result.out
    assert "a.yaml:1:11: unknown scoring policy 'wieghted'; did you mean 'weighted'?" in result.err
    assert "c.yaml:2:10: unknown probe 'lidar'. Installed: cpu." in result.err
    assert "d.yaml:1:46: unknown migration strategy 'criu'. Installed: relaunch." in result.err


def test_plugins_that_cannot_be_made_are_found(rosrm, file, monkeypatch):
    """The check makes all plugins of a cluster; errors name their place in the file."""

    def fails(options):
        raise KeyError("weight")

    @hookimpl
    def register_scoring_policies():
        return [ScoringOffer("s", fails)]

    @hookimpl
    def register_checkpoint_policies():
        return [CheckpointOffer("c", lambda options: None)]

    @hookimpl
    def register_migration_strategies():
        return [MigrationOffer("m", lambda options: SimpleNamespace(proposes=1))]

    ours = SimpleNamespace(
        register_scoring_policies=register_scoring_policies,
        register_checkpoint_policies=register_checkpoint_policies,
        register_migration_strategies=register_migration_strategies,
    )
    monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=ours))
    text = "scoring: {policy: s}\nmigration: {strategies: [m]}\ncheckpoint: {policy: c}\n"
    result = rosrm("config", "check", file(text))
    assert result.code == 2
    assert "f.yaml: scoring: scoring policy 's' of plugin 'ours': `create` (" in result.err
    assert "raised KeyError: 'weight'" in result.err
    assert "which has no `propose`; is its `proposes` misspelt?" in result.err
    assert "made None; an object with `choose` is required" in result.err
    assert "test_config_check.py:" in result.err


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        (
            "processes: [{name: a, command: x, needs: {cpus: 1}}]",
            ":1:43: warning: needs: no probe reads 'cpus'; did you mean 'cpu'?",
        ),
        (
            """
            defaults: {package: p, executable: e}
            processes: [{name: a}, {name: b, arguments: [--ros-args, -r, '__node:=a']}]
            """,
            ": warning: a and b put the node /a into the ROS graph; give each node a name of",
        ),
    ],
)
def test_what_may_be_a_mistake_is_a_warning(rosrm, tmp_path, text, warning):
    file = tmp_path / "w.yaml"
    file.write_text(text, encoding="utf-8")
    result = rosrm("config", "check", file)
    assert result.code == 0
    assert result.err.startswith(f"{file}{warning}")
    assert result.err.count("\n") == 1


def test_warnings_are_given_along_with_errors(rosrm, file):
    """The output lists all problems at once."""
    text = "defaults: {needs: {cpus: 1}}\nprocesses: [{name: a, comand: x}]"
    result = rosrm("config", "check", file(text))
    assert result.code == 2
    assert "f.yaml:1:20: warning: needs: no probe reads 'cpus'; did you mean" in result.err
    assert "f.yaml:2:23: unknown key 'comand'" in result.err


def test_an_unknown_kind_is_refused_with_those_there_are(rosrm, file):
    result = rosrm("config", "check", "--kind", "robot", file("name: a"))
    assert result.code == 2
    assert "Invalid value for '--kind': 'robot' is not one of 'cluster', 'host'," in result.err


def test_a_resource_in_needs_is_compared_with_all_that_probes_read(rosrm, file, monkeypatch):
    """The name of the resource counts, not that of its probe."""
    use_probes(monkeypatch, ProbeOffer("thermal", fails, resources=("temperature",)))
    text = "processes: [{name: a, command: x, needs: {temprature: 1}}]"
    result = rosrm("config", "check", file(text))
    assert result.code == 0
    assert "needs: no probe reads 'temprature'; did you mean 'temperature'?" in result.err


def fails(options, context):
    raise KeyError("bus")


def is_absent(options, context):
    raise SkipPlugin("no bus")


def use_probes(monkeypatch, *offers):
    """Install only these probes."""

    @hookimpl
    def register_probes():
        return list(offers)

    ours = SimpleNamespace(register_probes=register_probes)
    monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=ours))


def test_probes_that_cannot_be_made_are_found_and_absent_ones_are_none_of_them(
    rosrm, file, monkeypatch
):
    """Only probes that report absence are absent: the file may be for a host with the hardware."""
    made = FakeProbe(fine=0.5)
    use_probes(
        monkeypatch, ProbeOffer("fine", lambda options, context: made),
        ProbeOffer("gone", is_absent), ProbeOffer("wrong", fails),
        ProbeOffer("none", lambda options, context: None),
    )  # fmt: skip
    assert rosrm("config", "check", file("host: h\nprobes: [fine, gone]")).code == 0
    result = rosrm("config", "check", file("host: h\nprobes: [fine, gone, wrong, none]"))
    assert result.code == 2
    line = fails.__code__.co_firstlineno + 1
    assert "f.yaml: probes: wrong: plugin 'ours': `create` (" in result.err
    assert f"raised KeyError: 'bus' ({__file__}:{line})" in result.err
    assert "f.yaml: probes: none: plugin 'ours': `create` (" in result.err
    assert "made None; an object with `resources` and `read` and `close`" in result.err
    assert made.closed == 2


def test_a_resource_that_no_probe_here_measures_is_no_mistake(rosrm, tmp_path):
    file = tmp_path / "w.yaml"
    file.write_text("processes: [{name: a, command: x, needs: {gpu_memory: 1}}]", encoding="utf-8")
    assert rosrm("config", "check", file).err == ""
