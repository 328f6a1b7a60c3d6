"""`host.yaml`: every setting is read, and every error has its place."""

from __future__ import annotations

import socket
from dataclasses import dataclass

import pytest

from rosrm.config.host import load_host
from rosrm.config.settings import HostConfig
from rosrm.errors import SkipPlugin
from rosrm.extensions.contracts import MigrationOffer, ProbeOffer
from tests.plugin_kit import registry_of


@dataclass(frozen=True)
class DiskOptions:
    """Options of a probe."""

    path: str = "/"


@dataclass(frozen=True)
class TowOptions:
    """Options of one host for a migration strategy."""

    as_root: bool = False


@pytest.fixture
def registry():
    read = ("disk", "memory", "cpu", "gpu")
    disk = ProbeOffer("disk", lambda *_: None, DiskOptions, default=True, resources=read)
    return registry_of(disk, MigrationOffer("tow", lambda _: None, host_options=TowOptions))


def test_an_empty_file_gives_the_defaults(file):
    config = load_host(file(""))
    assert config == HostConfig()
    assert config.host == socket.gethostname()
    assert config.limits == {"memory": 0.8, "cpu": 0.9, "disk": 0.9}
    assert config.period == pytest.approx(0.1)


def test_every_setting_is_read(file, tmp_path, registry):
    config = load_host(
        file(
            """
            host: robot-1
            ros: {domain: 3}
            state: here
            labels: {camera: front, gpu: true, floor: 2}
            scope: slice
            budget: {memory: 2GiB, cpu: 1.0, disk: 10GB}
            limits: {memory: 0.7, gpu: 0.95}
            rate: 20
            probes: {disk: {path: /data}}
            strategies: {tow: {as_root: true}}
            max_processes: 4
            logs: {max_bytes: 1MB, keep: 1}
            control: {max_age: 8s}
            on_stop: keep
            textfile: metrics
            """
        ),
        registry,
    )
    assert config.textfile == tmp_path / "metrics"
    assert (config.host, config.ros.domain, config.state) == ("robot-1", 3, tmp_path / "here")
    assert config.labels == {"camera": "front", "gpu": "true", "floor": "2"}
    assert (config.scope, config.budget["memory"]) == ("slice", 2.0**31)
    assert config.limits == {"memory": 0.7, "cpu": 0.9, "disk": 0.9, "gpu": 0.95}
    assert (config.rate, config.period) == (20.0, 0.05)
    assert config.probes == {"disk": {"path": "/data"}}
    assert config.strategies == {"tow": {"as_root": True}}
    assert (config.max_processes, config.on_stop) == (4, "keep")
    assert (config.logs.max_bytes, config.logs.keep) == (1_000_000, 1)
    assert config.control.max_age == 8.0
    assert HostConfig.from_json(config.to_json()) == config


def test_probes_may_be_a_list_of_names_or_none_at_all(file, registry):
    assert load_host(file("probes: [disk]"), registry).probes == {"disk": {"path": "/"}}
    assert load_host(file("probes: {}"), registry).probes == {}
    assert load_host(file("probes:"), registry).probes is None


def test_options_of_a_strategy_are_checked(refusal, registry):
    said = refusal(lambda path: load_host(path, registry), "strategies: {tow: {root: true}}")
    assert "'tow'" in said
    assert "root" in said
    said = refusal(lambda path: load_host(path, registry), "strategies: {towing: {}}")
    assert "unknown migration strategy 'towing'; did you mean 'tow'?" in said


def test_a_limit_outside_0_to_1_is_refused(refusal):
    said = refusal(load_host, "limits: {memory: 80, cpu: -0.1}")
    assert "f.yaml:1:18: limits.memory: 80 is not within 0..1 (a fraction: 0.8 means 80 %)" in said
    assert "f.yaml:1:27: limits.cpu: -0.1 is not within 0..1" in said


@pytest.mark.parametrize(
    ("budget", "said"),
    [
        ("", "f.yaml:1:8: scope: a slice needs its budget of memory and cpu"),
        ("budget: {memory: 2GiB}", "f.yaml:2:9: scope: a slice needs its budget of cpu"),
        ("budget: {memory: 0, cpu: 1}", "f.yaml:2:18: budget.memory: must be above 0"),
    ],
)
def test_a_slice_needs_a_budget_above_zero(refusal, budget, said):
    assert said in refusal(load_host, f"scope: slice\n{budget}")


def test_an_unknown_probe_and_a_wrong_option_are_refused_with_their_place(refusal, registry):
    said = refusal(load_host, "probes:\n  disc: {}\n  disk: {paht: 5}\n", registry)
    assert "f.yaml:2:3: unknown probe 'disc'; did you mean 'disk'? Installed: disk." in said
    assert "f.yaml:3:10: unknown key 'paht' in options of probe 'disk'; did you mean 'path'" in said


def test_other_values_are_refused_with_what_is_allowed(refusal):
    said = refusal(
        load_host,
        """
        host: bad/name
        scope: container
        rate: 0
        max_processes: -1
        logs: {max_bytes: 10}
        on_stop: restart
        labels: {a: [1]}
        """,
    )
    for expected in (
        "f.yaml:2:7: 'bad/name' cannot be the name of a host",
        'f.yaml:3:8: scope: "container" is unknown. Allowed: machine, cgroup, slice',
        "f.yaml:4:7: rate: 0 is not within 0.1..1000 (Hz)",
        "f.yaml:5:16: max_processes: -1 is not within 0..",
        "f.yaml:6:19: logs.max_bytes: 10 is not at least 4096",
        'f.yaml:7:10: on_stop: "restart" is unknown. Allowed: stop, keep',
        "f.yaml:8:13: labels.a: text is required, not a list",
    ):
        assert expected in said


@pytest.fixture
def with_fds():
    """Install a probe that is not read by default."""
    disk = ProbeOffer("disk", lambda *_: None, default=True)
    return registry_of(ProbeOffer("fds", lambda *_: None), disk)


@pytest.mark.parametrize("section", ["limits", "budget"])
def test_a_resource_that_no_probe_reads_is_refused_with_the_nearest(refusal, with_fds, section):
    said = refusal(load_host, f"{section}: {{dsik: 0.5}}", with_fds)
    assert said == (
        f"f.yaml:1:{len(section) + 4}: {section}: unknown resource 'dsik'; did you mean 'disk'? "
        "Allowed: disk, fds (resources of the probes that are installed here)"
    )


def test_a_limit_of_a_probe_that_is_not_chosen_is_refused(refusal, file, with_fds):
    """The limit would never apply."""
    said = refusal(load_host, "limits: {fds: 0.9}", with_fds)
    assert "limits: 'fds' is read by the probe 'fds', which is not among `probes`" in said
    assert load_host(file("limits: {fds: 0.9}\nprobes: [fds]"), with_fds).limits["fds"] == 0.9


def test_a_limit_of_a_probe_that_may_be_absent_on_the_host_is_taken(file):
    """The probe is not created: its offer names the resources that it would read."""

    def absent(options, context):
        raise SkipPlugin("no driver")

    gpu = ProbeOffer("gpu", absent, default=True, resources=("gpu", "gpu_memory"))
    registry = registry_of(gpu)
    assert load_host(file("limits: {gpu_memory: 0.9}"), registry).limits["gpu_memory"] == 0.9


@pytest.mark.parametrize("probes", ["[default, fds]", "[fds, default]", "{fds: {}, default: }"])
def test_default_among_the_probes_stands_for_the_default_ones(file, with_fds, probes):
    config = load_host(file(f"probes: {probes}"), with_fds)
    assert config.probes == {"disk": {}, "fds": {}}
    assert HostConfig.from_json(config.to_json()) == config
