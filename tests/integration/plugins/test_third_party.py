"""A third party's probe and migration strategy, installed by pip and selected by name."""

from __future__ import annotations

import json
import shutil

from tests.pip_environments import ROOT

PACKAGES = ROOT / "examples" / "plugins"


def install(environment, *names):
    for name in names:
        shutil.copytree(PACKAGES / name, environment.folder / name)  # pip builds beside the sources
        done = environment.shell(f"pip install --quiet ./{name}")
        assert done.returncode == 0, done.stderr


def write(environment, name, text):
    (environment.folder / name).write_text(text, encoding="utf-8")


def test_a_probe_is_installed_and_chosen_by_name(environment):
    install(environment, "thermometer")
    rows = json.loads(environment.shell("rosrm plugins --local --json").stdout)
    (row,) = [row for row in rows if row["name"] == "heat"]
    assert (row["kind"], row["distribution"]) == ("probe", "rosrm-thermometer 2.1")

    write(environment, "sensor", "47500\n")
    write(environment, "host.yaml", "host: h\nprobes: {heat: {sensor: ./sensor, hottest: 95}}\n")
    said = environment.shell("rosrm config check host.yaml")
    assert said.stdout == "host.yaml: ok, a host: h, probes heat\n", said.stderr

    code = (
        "from pathlib import Path\n"
        "from rosrm.config.host import load_host\n"
        "from rosrm.config.settings import HostConfig\n"
        "from rosrm.extensions.registry import Registry\n"
        "from rosrm.testing import probe_context\n"
        "registry = Registry.discover()\n"
        "config = HostConfig.from_json(load_host('host.yaml', registry).to_json())\n"
        "(made,) = registry.probes(config.probes, probe_context()).made\n"
        "print(made.name, made.period, *made.probe.read())\n"
        "absent = registry.probes({'heat': {'sensor': '/nowhere'}}, probe_context()).absent\n"
        "print(absent['heat'])\n"
    )
    lines = environment.python(code).splitlines()
    assert lines == ["heat 1.0 Reading(resource='heat', usage=0.5)", "no sensor at /nowhere"]


def test_a_wrong_option_of_a_probe_is_refused_by_its_own_rules(environment):
    install(environment, "thermometer")
    write(environment, "host.yaml", "host: h\nprobes:\n  heat: {hottest: 200, sensr: x}\n")
    done = environment.shell("rosrm config check host.yaml")
    assert done.returncode == 2
    title = "options of probe 'heat'"
    assert f"host.yaml:3:19: {title}: hottest: 200 is not at most 150" in done.stderr
    assert f"host.yaml:3:24: unknown key 'sensr' in {title}; did you mean 'sensor'?" in done.stderr


def test_a_migration_strategy_is_installed_and_chosen_by_name(environment):
    install(environment, "teleport")
    write(environment, "cluster.yaml", "migration: {strategies: {teleport: {patience: 5s}}}\n")
    write(environment, "work.yaml", "processes: [{name: a, command: x, migration: teleport}]\n")
    said = environment.shell("rosrm config check cluster.yaml work.yaml")
    assert said.stdout.splitlines() == [
        "cluster.yaml: ok, a cluster: scoring weighted, migration teleport, checkpoint other-host",
        "work.yaml: ok, work: 1 service",
    ], said.stderr

    code = (
        "from rosrm.config.cluster import load_cluster\n"
        "from rosrm.config.settings import ClusterConfig\n"
        "from rosrm.model.plan import plan_fault\n"
        "from rosrm.extensions.registry import Registry\n"
        "from rosrm.testing import MigrationContract\n"
        "registry = Registry.discover()\n"
        "config = ClusterConfig.from_json(load_cluster('cluster.yaml', registry).to_json())\n"
        "strategy = registry.migrations(config.migration.strategies)['teleport']\n"
        "contract = MigrationContract()\n"
        "contract.offer = registry.offer('migration', 'teleport')\n"
        "contract.options = config.migration.strategies['teleport']\n"
        "move = contract.moves()[0]\n"
        "plan = strategy.propose(move)\n"
        "print([type(step).__name__ for step in plan.steps], plan.steps[0].timeout)\n"
        "print(repr(plan_fault(plan, move)))\n"
        "print(registry.executors()['teleport.announce'].call({'who': 'a'}))\n"
    )
    assert environment.python(code).splitlines() == [
        "['Execute', 'Stop', 'Start', 'AwaitReady', 'Commit'] 5.0",
        "''",
        "{'announced': 'a'}",
    ]
