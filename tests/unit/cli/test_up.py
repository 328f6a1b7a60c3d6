"""`rosrm up`: arguments, shares of the machine, and ROS settings; nothing is started."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from types import SimpleNamespace

import pytest

from rosrm.cli.commands import up
from rosrm.cli.up import session, slices
from rosrm.errors import ConfigError
from rosrm.extensions.contracts import ProbeOffer
from rosrm.extensions.registry import Registry
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import ProcessSpec, Reading, ResourceDescription
from tests.plugin_kit import plugin
from tests.unit.cli.conftest import FakeClient, process


def probe(name, capacity, usage):
    """Return the offer of a default probe of one resource."""
    made = SimpleNamespace(
        resources=[ResourceDescription(name, "B", capacity)],
        read=lambda: [Reading(name, usage)], close=lambda: None,
    )  # fmt: skip
    return ProbeOffer(name, lambda *_: made, default=True)


MACHINE = Registry.of(
    ours=plugin(probe("memory", 8e9, 0.25), probe("cpu", 4.0, 0.9), probe("gpu", 1.0, 0.0))
)


def test_hosts_share_the_free_memory_and_all_cores(tmp_path):
    """Each host gets an equal share of the memory that is free, and of all cores."""
    hosts = slices.slices(3, {}, MACHINE, tmp_path)
    assert [host.host for host in hosts] == ["host-1", "host-2", "host-3"]
    assert all(host.budget == pytest.approx({"memory": 2e9, "cpu": 4 / 3}) for host in hosts)
    assert {host.scope for host in hosts} == {"slice"}


def test_only_the_first_host_measures_what_cannot_be_divided(tmp_path):
    """A GPU is not counted once for each host."""
    first, *others = slices.slices(3, {}, MACHINE, tmp_path)
    assert first.probes is None
    assert [set(host.probes) for host in others] == [{"memory", "cpu"}] * 2


def test_each_host_has_a_label_with_its_name(tmp_path):
    """A process can require one host."""
    hosts = slices.slices(2, {}, MACHINE, tmp_path)
    assert [host.labels for host in hosts] == [{"host": "host-1"}, {"host": "host-2"}]


def test_a_budget_replaces_the_share(tmp_path):
    """`--budget` gives the amount of each host; other resources keep their share."""
    amounts = slices.budget_of(["memory=400MB"])
    (host,) = slices.slices(1, amounts, MACHINE, tmp_path)
    assert host.budget == {"memory": 400e6, "cpu": 4.0}


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("memory", "--budget memory: give RESOURCE=AMOUNT"),
        (
            "memry=1GB",
            "unknown resource 'memry'; did you mean 'memory'? Allowed: memory, cpu, disk",
        ),
        ("memory=1s", "--budget memory: unknown unit 's'"),
        ("cpu=0", "--budget cpu=0: must be above 0"),
    ],
)
def test_a_wrong_budget_is_refused(word, said):
    """The message names the option and what is allowed."""
    with pytest.raises(ConfigError) as refused:
        slices.budget_of([word])
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "environment", "chosen", "expected"),
    [
        (RosSettings(), {}, None, "localhost"),
        (RosSettings(), {}, "subnet", "subnet"),
        (RosSettings(discovery_range="subnet"), {}, None, "subnet"),
        (RosSettings(discovery_range="subnet"), {}, "localhost", "localhost"),
        (RosSettings(), {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, None, ""),
        (RosSettings(discovery_server="a:1"), {}, None, ""),
        (RosSettings(interface="lo"), {}, None, ""),
    ],
)
def test_traffic_stays_here_unless_something_else_is_chosen(
    settings, environment, chosen, expected, monkeypatch
):
    """The default is localhost; an option, the file and the environment replace it."""
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISCOVERY_SERVER", "ROSRM_INTERFACE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert up._local(settings, chosen).discovery_range == expected


def test_a_broken_file_is_refused_before_anything_starts(rosrm, tmp_path, monkeypatch):
    """Work files are read first; the message has file and line."""
    monkeypatch.setattr(session, "serve", lambda *_: pytest.fail("something was started"))
    work = tmp_path / "work.yaml"
    work.write_text("processes:\n  - {nam: x, command: sleep 1}\n", encoding="utf-8")
    result = rosrm("up", work)
    assert result.code == 2
    assert f"{work}:2:" in result.err


def test_after_a_fault_the_first_signal_already_hurries():
    """A signal while the cluster ends because of a fault kills it, as a second one does."""
    with session._Signals() as signals:
        signals.hurry_next()
        with pytest.raises(session._Hurried):
            signals._handle(2, None)
        signals._handle(2, None)  # a third one is ignored


def test_a_missing_temporary_directory_is_said(monkeypatch, tmp_path):
    """If the disk is full or read-only, the message names the option that helps."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=r"no temporary directory for the state: .*--state DIR"):
        up._temporary_directory()


def submitted(cluster, *specs):
    """Return the names that one start of `rosrm up` submits."""
    cluster.client.asked.clear()
    session._submit(cluster, specs)
    return [name for what, *given in cluster.client.asked if what == "submit" for name in given[0]]


@pytest.mark.parametrize(
    ("kind", "state", "again"),
    [
        ("job", "finished", False), ("job", "failed", True), ("job", "cancelled", True),
        ("service", "finished", True), ("job", "queued", False), ("service", "running", False),
    ],
)  # fmt: skip
def test_a_kept_directory_runs_no_finished_job_again(tmp_path, capsys, kind, state, again):
    """As `rosrm apply` does: failed and cancelled processes start again, and changed jobs."""
    cluster = SimpleNamespace(client=FakeClient(processes=[]), directory=tmp_path)
    spec = ProcessSpec("pick", kind=kind, command=("true",))
    assert submitted(cluster, spec) == ["pick"]
    cluster.client.processes = [process("pick", state, kind=kind)]
    assert submitted(cluster, spec) == ["pick"] * again
    if state == "finished" and not again:
        assert "1 process finished already" in capsys.readouterr().out
        changed = replace(spec, command=("false",))
        assert submitted(cluster, changed) == ["pick"]
        assert submitted(cluster, changed) == []


def test_a_record_that_cannot_be_written_ends_no_cluster(tmp_path, capsys):
    """The disk is full, for example: the processes run, and a line says what follows."""
    (tmp_path / "submitted.json.new").mkdir()
    cluster = SimpleNamespace(client=FakeClient(processes=[]), directory=tmp_path)
    assert submitted(cluster, ProcessSpec("pick", command=("true",))) == ["pick"]
    assert "submitted.json cannot be written" in capsys.readouterr().out


def test_a_damaged_record_of_submitted_jobs_is_named(tmp_path):
    """Jobs of unknown entries would run again without a word."""
    (tmp_path / "submitted.json").write_text("[", encoding="utf-8")
    cluster = SimpleNamespace(client=FakeClient(processes=[]), directory=tmp_path)
    with pytest.raises(ConfigError, match=r"submitted\.json: .*; remove the file"):
        submitted(cluster, ProcessSpec("pick", command=("true",)))
