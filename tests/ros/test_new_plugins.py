"""New plugins of each kind: written by rosrm, installed by pip, selected by a live master."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess

import pytest

from rosrm.cli.commands.plugin import Kind
from rosrm.testing.local_cluster import claim_domain
from tests.pip_environments import Environment, pip_environment
from tests.waiting import wait_until

#: Hosts that the other processes of this machine do not fill.
SLICE = "scope: slice\nbudget: {memory: 400MB, cpu: 2.0, disk: 1GB}\n"
#: Seconds for the start of a part, or for a command, on a busy machine.
PATIENCE = 60.0


@pytest.fixture
def environment(tmp_path):
    domain, claim = claim_domain()
    here = pip_environment(tmp_path)
    here.more.update(
        ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", ROSRM_SECURITY="none"
    )
    with contextlib.closing(claim):
        yield here


@contextlib.contextmanager
def running(environment: Environment, *words: str):
    """Run a part of rosrm in the background, and end it by SIGINT."""
    log = environment.folder / f"{words[-1]}.log"
    with log.open("wb") as file:
        part = subprocess.Popen(
            [environment.bin / "rosrm", *words], cwd=environment.folder,
            env=environment.variables(), stdout=file, stderr=subprocess.STDOUT,
        )  # fmt: skip
    try:
        yield part
    finally:
        part.send_signal(signal.SIGINT)
        part.wait(PATIENCE)


def done(environment: Environment, line: str, folder=None) -> str:
    """Run a command that must succeed, and return its output."""
    result = environment.shell(line, folder)
    assert result.returncode == 0, f"$ {line}\n{result.stdout}{result.stderr}"
    return result.stdout


def answered(environment: Environment, line: str):
    """Return the JSON that a command prints; None if it fails."""
    result = environment.shell(f"rosrm {line} --json")
    return json.loads(result.stdout) if result.returncode == 0 else None


def labels_of(environment: Environment, host: str) -> dict[str, str]:
    return {row["name"]: row["labels"] for row in answered(environment, "hosts")}[host]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_new_plugins_of_all_kinds_work_on_a_live_cluster(environment):
    """From an empty folder: write, install, test and check each, then run a master with all."""
    settings, state = environment.folder, environment.folder / "state"
    (settings / "cluster.yaml").write_text(f"state: {state / 'master'}\n", encoding="utf-8")
    packages = [f"rosrm-my-{kind.value}" for kind in Kind]
    for kind in Kind:
        done(environment, f"rosrm plugin new {kind.value} my-{kind.value}")
    folders = " ".join(f"./{one}" for one in packages)
    done(environment, f"pip install --quiet {folders}")
    done(environment, f"python -m pytest -q --import-mode=importlib {folders}")
    for package in (environment.folder / one for one in packages):
        files = sorted(path.name for path in package.glob("*.yaml"))
        done(environment, f"rosrm config check {' '.join(files)}", package)
        for path in package.glob("cluster.yaml"):
            text = path.read_text(encoding="utf-8")
            with (settings / "cluster.yaml").open("a", encoding="utf-8") as file:
                file.write(text)
    probes = (environment.folder / "rosrm-my-probe/host.yaml").read_text(encoding="utf-8")
    for host in "ab":
        text = f"host: {host}\nstate: {state / host}\n{SLICE}{probes}"
        (settings / f"{host}.yaml").write_text(text, encoding="utf-8")

    with (
        running(environment, "master", "--config", "cluster.yaml"),
        running(environment, "slave", "--config", "a.yaml"),
        running(environment, "slave", "--config", "b.yaml"),
    ):

        def hosts_are_up():
            return [row["state"] for row in answered(environment, "hosts") or ()] == ["up", "up"]

        wait_until(hosts_are_up, "two hosts are up", PATIENCE)
        rows = answered(environment, "plugins")
        states = {(row["kind"], row["name"]): row["state"] for row in rows}
        assert {
            kind.value: states[kind.value, f"my-{kind.value}"] for kind in Kind
        } == dict.fromkeys([kind.value for kind in Kind], "selected")
        labels = labels_of(environment, "a")
        assert list(labels) == ["my-probe.kernel"]
        with (settings / "a.yaml").open("a", encoding="utf-8") as file:
            file.write('labels: {floor: "2"}\n')
        done(environment, "rosrm reload")
        assert labels_of(environment, "a") == {**labels, "floor": "2"}

        submit = "rosrm submit --wait --timeout 60s rosrm-my-migration/work.yaml"
        done(environment, f"{submit} || {{ rosrm explain sleeper; false; }}")
        explained = answered(environment, "explain sleeper")
        assert explained["decision"]["policy"] == "my-scoring"
        done(environment, "rosrm migrate sleeper --wait --timeout 60s")
        (row,) = answered(environment, "ps")
        assert (row["state"], row["migrations"]) == ("running", 1)
        done(environment, "rosrm cancel sleeper --wait")
