"""`rosrm config check`."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest

from rosrm.errors import SkipPlugin
from rosrm.extensions import installed
from rosrm.extensions.contracts import CheckpointOffer, MigrationOffer, ProbeOffer, ScoringOffer
from rosrm.extensions.registry import Registry
from rosrm.testing import FakeProbe
from tests.plugin_kit import plugin

from .test_runtimes import OURS


@pytest.fixture(autouse=True)
def install(monkeypatch):
    """Install the plugins of `rosrm master`; the function installs offers in their place."""

    def install(ours):
        monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=ours))

    install(OURS)
    return lambda *offers: install(plugin(*offers))


@pytest.fixture
def file(tmp_path):
    def write(text, name="f.yaml"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


@pytest.fixture
def check(rosrm, file):
    """Return a function that checks a file of a text."""
    return lambda text, *options: rosrm("config", "check", *options, file(text))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scoring: {policy: weighted}",
         "ok, a cluster: scoring weighted, migration relaunch, checkpoint none\n"),
        ("host: h1\nros: {domain: 1}", "ok, a host: h1, probes cpu\n"),
        ("processes: [{name: a, command: x, kind: job}]", "ok, work: 1 job\n"),
        ("app: nav\nprocesses: [{name: a, command: x}]", "ok, the application nav: 1 service\n"),
        ("defaults: {kind: job}\nprocesses: [{name: a, command: x}]", "ok, work: 1 job\n"),
    ],
)  # fmt: skip
def test_the_kind_of_a_right_file_is_known_by_its_keys(check, text, said):
    result = check(text)
    assert result.code == 0
    assert f"f.yaml: {said}" in result.out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("processes: [{name: a, command: x, kind: job}]", "-: ok, work: 1 job\n"),
        ("host: h1", "-: ok, a host: h1, probes cpu\n"),
        ("scoring: {policy: weighted}", "-: ok, a cluster: scoring weighted,"),
    ],
)
def test_the_standard_input_is_checked(rosrm, monkeypatch, text, said):
    """One read must do for the kind of the file and for its content."""
    stdin = SimpleNamespace(buffer=io.BytesIO(text.encode()))
    monkeypatch.setattr("rosrm.config.documents.sys", SimpleNamespace(stdin=stdin))
    assert said in rosrm("config", "check", "-").out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ros: {domain: 1}", "its keys fit a cluster and a host file alike; choose one with --kin"),
        ("", "it has no key of a cluster, host, work, modes or simulation file; choose"),
        ("proceses: []", "simulation file, and 'proceses': did you mean 'processes'? Choose one"),
        ("- {name: a}", "it is no mapping; in a work file the list is under `processes:`"),
    ],
)
def test_a_file_that_may_be_either_wants_the_kind(check, text, said):
    result = check(text)
    assert (result.code, said in result.err) == (2, True), result.err
    if text.startswith("ros"):
        assert check(text, "--kind", "cluster").code == 0


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
def test_the_file_name_decides_the_kind_where_the_keys_do_not(rosrm, file, name, text, said):
    result = rosrm("config", "check", file(text, name))
    assert (result.code, result.err, said in result.out) == (0, "", True)


HOST = "host: desk\nscope: slice\nbudget: {memory: 1GiB, cpu: 1}\nlimts: {cpu: 1}"
WORK = "processes: [{name: a, command: x}]"


def test_the_check_of_a_simulation_names_its_distribution(rosrm, file, monkeypatch):
    """Without `rosrm-simulate` the keys tell the kind, and the error names the package."""
    monkeypatch.setattr(installed, "installed_plugins", lambda group: [])
    path = file(f"seed: 1\n{SIMULATION}")
    result = rosrm("config", "check", path)
    said = "the check of a simulation file comes with `pip install rosrm-simulate`"
    assert (result.code, result.err) == (2, f"rosrm: {path}: {said}\n")


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
    assert (result.code, len(result.err.splitlines())) == (2, 1)
    assert said in result.err


def test_every_wrong_file_is_reported(rosrm, file):
    texts = {
        "a.yaml": "scoring: {policy: wieghted}", "b.yaml": "host: h1",
        "c.yaml": "host: h1\nprobes: [lidar]",
        "d.yaml": "processes: [{name: a, command: x, migration: criu}]",
    }  # fmt: skip
    result = rosrm("config", "check", *(file(text, name) for name, text in texts.items()))
    assert result.code == 2
    assert "b.yaml: ok" in result.out
    assert "a.yaml:1:11: unknown scoring policy 'wieghted'; did you mean 'weighted'?" in result.err
    assert "c.yaml:2:10: unknown probe 'lidar'. Installed: cpu." in result.err
    assert "d.yaml:1:46: unknown migration strategy 'criu'. Installed: relaunch." in result.err


def fails(*_):
    raise KeyError("bus")


def test_plugins_that_cannot_be_made_are_found(check, install):
    """The check makes all plugins of a cluster; errors name their place in the file."""
    misspelt = MigrationOffer("m", lambda options: SimpleNamespace(proposes=1))
    second = MigrationOffer("n", lambda options: SimpleNamespace(purposes=1))
    install(ScoringOffer("s", fails), CheckpointOffer("c", lambda options: None), misspelt, second)
    text = "scoring: {policy: s}\nmigration: {strategies: [m, n]}\ncheckpoint: {policy: c}\n"
    result = check(text)
    assert result.code == 2
    assert "f.yaml: scoring: scoring policy 's' of plugin 'ours': `create` (" in result.err
    assert "raised KeyError: 'bus'" in result.err
    assert "which has no `propose`; is its `proposes` misspelt?" in result.err
    assert "is its `purposes` misspelt?" in result.err
    assert "made None; an object with `choose` is required" in result.err
    assert "test_config_check.py:" in result.err


NAMESAKES = """
defaults: {package: p, executable: e}
processes: [{name: a}, {name: b, arguments: [--ros-args, -r, '__node:=a']}]
"""


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        ("processes: [{name: a, command: x, needs: {cpus: 1}}]",
         ":1:43: warning: needs: no probe reads 'cpus'; did you mean 'cpu'?"),
        (NAMESAKES,
         ": warning: a and b put the node /a into the ROS graph; give each node its own name"),
    ],
)  # fmt: skip
def test_what_may_be_a_mistake_is_a_warning(check, tmp_path, text, warning):
    result = check(text)
    assert (result.code, result.err.count("\n")) == (0, 1)
    assert result.err.startswith(f"{tmp_path / 'f.yaml'}{warning}")


def test_warnings_are_given_along_with_errors(check):
    """The output lists all problems at once."""
    result = check("defaults: {needs: {cpus: 1}}\nprocesses: [{name: a, comand: x}]")
    assert result.code == 2
    assert "f.yaml:1:20: warning: needs: no probe reads 'cpus'; did you mean" in result.err
    assert "f.yaml:2:23: unknown key 'comand'" in result.err


def test_an_unknown_kind_is_refused_with_those_there_are(check):
    result = check("name: a", "--kind", "robot")
    assert result.code == 2
    assert "Invalid value for '--kind': 'robot' is not one of 'cluster', 'host'," in result.err


def test_a_resource_in_needs_is_compared_with_all_that_probes_read(check, install):
    """The name of the resource counts, not that of its probe."""
    install(ProbeOffer("thermal", fails, resources=("temperature",)))
    result = check("processes: [{name: a, command: x, needs: {temprature: 1}}]")
    assert result.code == 0
    assert "needs: no probe reads 'temprature'; did you mean 'temperature'?" in result.err


def test_probes_that_cannot_be_made_are_found_and_absent_ones_are_none_of_them(check, install):
    """Only probes that report absence are absent: the file may be for a host with the hardware."""
    made = FakeProbe(fine=0.5)

    def is_absent(options, context):
        raise SkipPlugin("no bus")

    install(
        ProbeOffer("fine", lambda *_: made), ProbeOffer("gone", is_absent),
        ProbeOffer("wrong", fails), ProbeOffer("none", lambda *_: None),
    )  # fmt: skip
    assert check("host: h\nprobes: [fine, gone]").code == 0
    result = check("host: h\nprobes: [fine, gone, wrong, none]")
    assert result.code == 2
    line = fails.__code__.co_firstlineno + 1
    assert "f.yaml: probes: wrong: plugin 'ours': `create` (" in result.err
    assert f"raised KeyError: 'bus' ({__file__}:{line})" in result.err
    assert "f.yaml: probes: none: plugin 'ours': `create` (" in result.err
    assert "made None; an object with `resources` and `read` and `close`" in result.err
    assert made.closed == 2


def test_a_resource_that_no_probe_here_measures_is_no_mistake(check):
    assert check("processes: [{name: a, command: x, needs: {gpu_memory: 1}}]").err == ""


@pytest.mark.parametrize(
    ("command", "directory", "said"),
    [
        ("[python3, ./x.py]", "", "runs in a directory of its host; with `working_directory: .`"),
        ("bash conf/run.sh", "/usr", "runs in /usr; with `working_directory: .` it runs in the"),
        ("bash conf/run.sh", ".", ""),
        ("[python3, ./none.py]", "", ""),
    ],
)
def test_a_file_that_only_the_folder_of_the_work_file_has_is_a_warning(
    rosrm, client, check, file, tmp_path, command, directory, said
):
    """The same warning comes before the submission."""
    (tmp_path / "conf").mkdir()
    file("", "x.py"), file("", "conf/run.sh")
    given = f", working_directory: {directory}" if directory else ""
    text = f"processes: [{{name: a, command: {command}{given}}}]"
    for result in (check(text), rosrm("submit", file(text))):
        assert result.code == 0
        assert (said in result.err and "warning: a: '" in result.err) if said else not result.err


def test_a_dependency_that_is_not_in_the_file_is_a_warning(check):
    """The master may know the process; a misspelt name is found before the submission."""
    result = check(
        "processes: [{name: camera, command: x}, {name: a, command: x, after: [camra, camera]}]"
    )
    assert result.code == 0
    assert "warning: a: after: no process 'camra' in this file; did you mean 'camera'?" in (
        result.err
    )
