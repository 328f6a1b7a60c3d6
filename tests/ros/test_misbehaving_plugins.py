"""Third-party plugins that misbehave beside innocent processes, which run on as before."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.config.settings import MigrationSettings
from rosrm.errors import RosrmError
from rosrm.model.values import HostLossPolicy, MigrationPolicy, ProcessSpec
from tests.ros.clusters import Cluster, Make, alive, host, job, service
from tests.waiting import PATIENCE, wait_until

PLUGIN = """
import ctypes, os, signal, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
import numpy as np
from rosrm import (
    Capabilities, FilterOffer, Launch, LauncherOffer, MigrationOffer, ProbeOffer, Reading,
    ResourceDescription, hookimpl,
)

class Base(BaseException): pass
def base(launch): raise Base("no")
def interrupt(launch): raise KeyboardInterrupt
def hang(launch): time.sleep(1000)
def unlike(launch, **fields): return replace(launch, **fields)
ACTS = {
    "base": base, "interrupt": interrupt, "hang": hang,
    "empty": lambda launch: unlike(launch, argv=()),
    "numbers": lambda launch: unlike(launch, argv=(1, 2)),
    "none": lambda launch: unlike(launch, argv=None, environment=None),
    "number_variable": lambda launch: unlike(launch, environment={"A": 1}),
    "nul": lambda launch: unlike(launch, argv=("a\\0b",)),
    "surrogate": lambda launch: unlike(launch, argv=("\\ud800",)),
}
def tree(act):
    def call(leader): return act()
    return call
def endless():
    while True: pass
TREES = {
    "bad_members": lambda: ["a"], "many": lambda: range(10**7), "endless": endless,
    "root": lambda: base(0),
}

class Launcher:
    def __init__(self, act): self.act = act
    def prepare(self, launch): return self.act(launch)
class Tree(Launcher):
    def __init__(self, name, act): self.name, self.say = name, act
    def prepare(self, launch):
        return replace(launch, environment={**launch.environment, "TREE": self.name})
    def leads(self, leader):
        with open(f"/proc/{leader}/environ") as file:
            return f"TREE={self.name}" in file.read().split("\\0")
    def members(self, leader): return self.say()
    def root(self, leader): return self.say()

@hookimpl
def register_launchers():
    own = [LauncherOffer(name, lambda c, act=act: Launcher(act)) for name, act in ACTS.items()]
    return own + [
        LauncherOffer(name, lambda c, name=name, act=act: Tree(name, act))
        for name, act in TREES.items()
    ]

class Strategy:
    def propose(self, move): raise ValueError("no")
def hang_in_capabilities(options):
    while True:
        try: time.sleep(1000)
        except BaseException: pass
def raise_in_capabilities(options): raise Base("no")
@hookimpl
def register_migration_strategies():
    able = {name: Capabilities(launcher=name) for name in (*ACTS, *TREES)}
    able |= {"hanging": hang_in_capabilities, "raising": raise_in_capabilities}
    return [
        MigrationOffer(name, lambda o: Strategy(), capabilities=it) for name, it in able.items()
    ]

class Probe:
    def __init__(self, name, act):
        self.resources, self.name, self.act = [ResourceDescription(name, "1", 1.0)], name, act
    def read(self):
        act, self.act = self.act, lambda: None
        act()
        return [Reading(self.name, 0.5)]
    def close(self): pass
def sets_environment(): os.environ["CUDA_VISIBLE_DEVICES"] = "of the probe"
def joins_ros():
    import rclpy
    rclpy.init()
    rclpy.create_node("probe_of_a_robot")
def leaves_threads():
    threading.Thread(target=time.sleep, args=(1000,)).start()
    ThreadPoolExecutor(1).submit(time.sleep, 1000)
def leaves_fork():
    if os.fork() == 0:
        try: os.setsid(); time.sleep(60)
        finally: os._exit(0)
def takes_signals():
    import logging
    logging.disable(logging.CRITICAL)
    os.chdir("/"); os.umask(0)
PROBES = {
    "joins_ros": joins_ros, "leaves_threads": leaves_threads, "leaves_fork": leaves_fork,
    "takes_signals": takes_signals, "sets_environment": sets_environment,
}
def create_late(options, context):
    while os.path.exists(__file__ + ".hold"): time.sleep(0.05)
    return Probe("late", lambda: None)
@hookimpl
def register_probes():
    return [ProbeOffer("late", create_late)] + [
        ProbeOffer(name, lambda o, c, name=name, act=act: Probe(name, act))
        for name, act in PROBES.items()
    ]

class Filter:
    def __init__(self, act): self.act = act
    def mask(self, hosts, process):
        if process.spec.priority == 7: self.act()
        return np.ones(len(hosts.names), bool)
    def reason(self, hosts, process, row): return "no"
@hookimpl
def register_filters():
    acts = {"exits": lambda: os._exit(3), "crashes": lambda: ctypes.string_at(0)}
    return [FilterOffer(name, lambda o, act=act: Filter(act)) for name, act in acts.items()]
"""


@pytest.fixture(scope="module", autouse=True)
def guest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a folder as pip would create it, with a module and its entry point."""
    site = tmp_path_factory.mktemp("site")
    (site / "guest_plugin.py").write_text(PLUGIN)
    info = site / "guest_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: guest-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rosrm]\nguest = guest_plugin\n")
    before = os.environ.get("PYTHONPATH", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(site), *([before] if before else [])]))
        patch.syspath_prepend(site)
        yield site


#: Names of launchers and strategies, by what is wrong with them.
ACTS = ("base", "interrupt", "empty", "numbers", "none", "number_variable", "nul", "surrogate")
TREES = ("bad_members", "many", "endless", "root")
CAPABILITIES = ("hanging", "raising")


def failing(cluster: Cluster) -> set[tuple[str, str]]:
    rows = cluster.client.list(plugins="failing").plugins
    return {(row.kind, row.name) for row in rows}


# --- launchers --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster(make_shared: Make) -> Cluster:
    """Return a cluster with an innocent process, which the tests of launchers share."""
    strategies = {name: {} for name in (*ACTS, "hang", *TREES, *CAPABILITIES)}
    chosen = MigrationSettings(strategies)
    shared = make_shared(host("h0", max_processes=64), migration=chosen)
    shared.submit(service("innocent"))
    shared.wait("innocent", "running")
    return shared


@pytest.fixture
def innocent(cluster: Cluster) -> Iterator[None]:
    """Compare the slave and the innocent process before and after a test."""
    before = (cluster.process("innocent").pid, cluster.host("h0").description.incarnation)
    yield
    row = cluster.process("innocent")
    assert (row.pid, cluster.host("h0").description.incarnation) == before
    assert row.state == "running"
    assert alive(row.pid)


def _moving(name: str, strategy: str) -> ProcessSpec:
    return job(name, "true", migration=MigrationPolicy(strategy))


@pytest.mark.usefixtures("innocent")
@pytest.mark.parametrize("act", ACTS)
def test_a_launcher_that_raises_or_answers_nonsense_costs_a_start(
    cluster: Cluster, act: str
) -> None:
    """The start is refused with the launcher's name, and the launcher is listed as failing."""
    name = f"start_{act}"
    cluster.submit(_moving(name, act))
    wait_until(lambda: repr(act) in str(cluster.client.explain(name)), f"{act} is named")
    wait_until(lambda: ("launcher", act) in failing(cluster), f"{act} is failing")
    cluster.cancel(name)


@pytest.mark.usefixtures("innocent")
def test_a_launcher_that_hangs_delays_no_other_start(cluster: Cluster) -> None:
    """Other processes start and end, also while the launcher has not returned."""
    cluster.submit(_moving("hung", "hang"))
    cluster.wait("hung", "starting")
    cluster.submit(job("meanwhile", "true"))
    assert cluster.ended("meanwhile").state == "finished"
    wait_until(lambda: "took longer" in str(cluster.client.explain("hung")), "it is named")
    cluster.cancel("hung")


@pytest.mark.usefixtures("innocent")
@pytest.mark.parametrize("act", TREES)
def test_a_launcher_with_a_bad_process_tree_costs_its_own_instances(
    cluster: Cluster, act: str
) -> None:
    """The process runs, the launcher is failing, and the slave measures the other processes."""
    name = f"tree_{act}"
    cluster.submit(service(name, migration=MigrationPolicy(act)))
    cluster.wait(name, "running")
    wait_until(lambda: ("launcher", act) in failing(cluster), f"{act} is failing")
    cluster.cancel(name)


@pytest.mark.usefixtures("innocent")
@pytest.mark.parametrize("act", CAPABILITIES)
def test_capabilities_that_cannot_be_read_cost_a_start(cluster: Cluster, act: str) -> None:
    """Neither master nor slave is held, and the process does not start without its launcher."""
    name = f"able_{act}"
    cluster.submit(_moving(name, act))
    cluster.submit(job(f"beside_{act}", "true"))
    assert cluster.ended(f"beside_{act}").state == "finished"
    wait_until(lambda: ("migration", act) in failing(cluster), f"{act} is failing")
    assert cluster.process(name).state != "finished"
    cluster.cancel(name)


# --- what a plugin leaves in its process --------------------------------------------------------


def _with_probe(make: Make, probe: str, **options: object) -> Cluster:
    cluster = make(host("h0", probes={"memory": {}, "cpu": {}, probe: {}}, **options))
    cluster.submit(service("innocent"))
    cluster.wait("innocent", "running")
    wait_until(
        lambda: any(one.name == probe for one in cluster.host("h0").resources), "the probe is read"
    )
    return cluster


@pytest.mark.parametrize("probe", ["joins_ros", "leaves_threads", "takes_signals"])
def test_a_slave_with_such_a_probe_ends_in_order(make_cluster: Make, probe: str) -> None:
    """At SIGINT the slave stops its processes, says so, and ends with its exit code."""
    cluster = _with_probe(make_cluster, probe, on_stop="stop")
    pid = cluster.process("innocent").pid
    part = cluster.slaves["h0"]
    part.end(signal.SIGINT)
    assert part.process.wait(PATIENCE) == 0
    wait_until(lambda: not alive(pid), "the process ends")
    assert "Traceback" not in cluster.log_of("h0")
    assert "slave of h0 ended" in cluster.log_of("h0")


def test_the_environment_of_a_plugin_reaches_no_process(make_cluster: Make) -> None:
    """Neither the supervisor nor a process of another owner gets a variable of a probe."""
    cluster = _with_probe(make_cluster, "sets_environment")
    variables = Path(f"/proc/{cluster.process('innocent').pid}/environ").read_bytes()
    assert b"ROSRM_PROCESS=innocent" in variables
    assert b"CUDA_VISIBLE_DEVICES" not in variables


def test_a_fork_of_a_plugin_holds_no_lock(make_cluster: Make) -> None:
    """A slave that was killed starts again, although a child of its probe runs on."""
    cluster = _with_probe(make_cluster, "leaves_fork")
    pid = cluster.process("innocent").pid
    cluster.end(cluster.slaves["h0"], signal.SIGKILL)
    cluster.start_slave_again("h0")
    cluster.wait("innocent", "running")
    assert cluster.process("innocent").pid == pid


def test_a_probe_that_hangs_at_a_restart_of_its_slave_ends_no_process(
    make_cluster: Make, guest: Path
) -> None:
    """The slave renews the fences, starts without it, and reads it once it is created."""
    cluster = _with_probe(make_cluster, "late", limits={"memory": 0.9, "late": 0.9})
    cluster.submit(service("kept", host_loss=HostLossPolicy("elsewhere")))
    before = cluster.wait("kept", "running")
    hold = guest / "guest_plugin.py.hold"
    hold.touch()
    try:
        cluster.end(cluster.slaves["h0"], signal.SIGKILL)
        cluster.start_slave_again("h0")
        wait_until(
            lambda: [one.name for one in cluster.host("h0").resources if one.stale] == ["late"],
            "its resource is stale",
        )
        assert "probe 'late': not created within 4 s" in cluster.log_of("h0")
    finally:
        hold.unlink()
    cluster.wait_for_event("host_changed", "h0 has other resources", host="h0")
    wait_until(
        lambda: not any(one.stale for one in cluster.host("h0").resources), "the probe is read"
    )
    assert ("probe", "late") not in failing(cluster)
    after = cluster.wait("kept", "running")
    assert (after.pid, after.restarts) == (before.pid, 0)
    assert alive(before.pid)
    assert not cluster.events("given_up")


@pytest.mark.parametrize("name", ["exits", "crashes"])
def test_a_plugin_that_ends_the_master_is_named_and_then_left_out(
    make_cluster: Make, name: str
) -> None:
    """The next start names the plugin; after the second end the master no longer calls it."""
    cluster = make_cluster(host("h0"), filters={name: {}})
    cluster.submit(service("innocent"))
    cluster.wait("innocent", "running")
    pid = cluster.process("innocent").pid
    for _ in range(2):
        with contextlib.suppress(RosrmError):  # the master ends while it decides
            cluster.submit(service("fatal", priority=7))
        assert cluster.master is not None
        cluster.master.process.wait(PATIENCE)
        cluster.start_master()
        cluster.reconnect()
    wait_until(lambda: ("filter", name) in failing(cluster), "the filter is listed")
    assert f"filter {name!r}: this process ended" in cluster.log_of("master")
    cluster.wait("innocent", "running")
    assert cluster.process("innocent").pid == pid
