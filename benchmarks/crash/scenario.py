"""A real cluster whose writes are recorded, with the answers that its user gets."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.crash.recording import Recording
from benchmarks.hosts import with_journal
from rosrm.client.client import Client
from rosrm.client.waiting import Until
from rosrm.config.settings import HostConfig
from rosrm.config.work import processes_of
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.testing.local_cluster import LocalCluster

HOST: Final = "host0"
_PATIENCE: Final = 120.0
_APPLICATION: Final = "map"
_QUICK: Final = RolloutPolicy(healthy_for=0.5)
#: Program of each process: it tells what it found, and a service runs on.
_PROGRAM: Final = """#!/bin/sh
name=${ROSRM_INSTANCE%%#*} then=$1 effects=$2 artifact=$3
while [ $# -gt 0 ]; do [ "$1" = --params-file ] && parameters=$2; shift; done
echo "$name" $(cat $parameters /dev/null | cksum) $(cat $artifact /dev/null | cksum) >> "$effects"
for n in 1 2 3; do seq -f "line %g of $name" 150; sleep 0.1; done
[ "$then" = end ] && exit 0
exec sleep 1000
"""


@dataclass(frozen=True, slots=True)
class Places:
    """Files of a scenario outside of what is recorded.

    Attributes:
        program: of each process.
        effects: file to which each process adds a line when it starts.
        artifact: file that is sent.
    """

    program: Path
    effects: Path
    artifact: Path

    @classmethod
    def make(cls, folder: Path) -> Places:
        """Make them in a folder."""
        made = cls(folder / "program.sh", folder / "effects", folder / "model.txt")
        made.program.write_text(_PROGRAM)
        made.program.chmod(0o755)
        made.effects.touch()
        made.artifact.write_text("weights " * 900)
        return made

    def process(self, name: str, *, then: str, **options: Any) -> dict[str, Any]:
        """Return a process of a work file."""
        artifact = "{artifacts}/model.txt" if "artifacts" in options else ""
        return {
            "name": name, "command": [str(self.program), then, str(self.effects), artifact],
            "kind": "job" if then == "end" else "service", **options,
        }  # fmt: skip


class Scenario:
    """Steps of a user; each one marks its answer."""

    def __init__(self, recording: Recording, cluster: LocalCluster, places: Places) -> None:
        self._recording = recording
        self._cluster = cluster
        self._places = places
        self._host = cluster.hosts[0]
        self._client = Client(connection=cluster.client)
        self._archive = recording.root / "archive"

    def play(self) -> None:
        """Play all steps."""
        with self._collecting():
            self._play()

    @contextmanager
    def _collecting(self) -> Iterator[None]:
        words = [sys.executable, "-m", "rosrm.cli", "collect-logs", str(self._archive)]
        with subprocess.Popen(words, env={**os.environ, **self._cluster.ros.environment()}) as one:
            try:
                yield
            finally:
                one.send_signal(signal.SIGINT)

    def _play(self) -> None:
        self._keys()
        self._jobs(1)  # from which the master learns that they are short
        self._jobs(8)  # of which the host holds one ahead
        self._nodes()
        self._versions()
        self._restarts()
        self._stops()

    def _keys(self) -> None:
        for number in range(3):
            name = f"host:robot-{number}"
            out = self._cluster.directory / f"robot-{number}.key"
            self._command("key", "add", name, "--out", str(out))
            self._recording.mark(f"added {name}")
        self._recording.mark("revoking host:robot-1")
        self._command("key", "revoke", "host:robot-1")
        self._recording.mark("revoked host:robot-1")

    def _jobs(self, count: int) -> None:
        jobs = [self._places.process(f"job{count}_{n}", then="end") for n in range(count)]
        self._submit(jobs)
        for job in jobs:
            self._wait(job["name"], "ended")

    def _nodes(self) -> None:
        files = {"artifacts": {"model.txt": str(self._places.artifact)}}
        ros = {"ros": True, "readiness": "running", "parameters": {"rate": 5, "frame": "map"}}
        nodes = [self._places.process(f"node{n}", then="run", **ros, **files) for n in range(2)]
        self._submit(nodes)
        for node in nodes:
            self._wait(node["name"], "runs")

    def _versions(self) -> None:
        for version in (1, 2):
            (spec,) = processes_of(self._places.process("planner", then=f"run-{version}"))
            spec = replace(spec, application=_APPLICATION)
            self._client.apply_targets([Target(_APPLICATION, (spec,), rollout=_QUICK)])
            self._recording.mark(f"applied {version}")
            self._client.wait_for_applications(_APPLICATION, timeout=_PATIENCE)

    def _restarts(self) -> None:
        master = self._cluster.master
        assert master is not None
        master.end(signal.SIGKILL)
        master.process.wait(_PATIENCE)
        self._cluster.start_master()
        self._cluster.wait_for_hosts(_PATIENCE)
        self._submit([self._places.process("late", then="end")])
        self._wait("late", "ended")
        slave = self._cluster.slaves[HOST]
        slave.end(signal.SIGKILL)
        slave.process.wait(_PATIENCE)
        self._cluster.start_slave(self._host)
        self._cluster.wait_for_hosts(_PATIENCE)
        self._submit([self._places.process("later", then="end")])
        self._wait("later", "ended")

    def _stops(self) -> None:
        self._client.cancel("node1")
        self._wait("node1", "ended")

    def _submit(self, work: Sequence[dict[str, Any]]) -> None:
        self._client.submit(work)
        for one in work:
            self._recording.mark(f"submitted {one['name']}")

    def _wait(self, name: str, told: str) -> None:
        until: Until = "settled" if told == "runs" else "ended"
        if not self._client.wait(name, until=until, timeout=_PATIENCE):
            raise RuntimeError(f"{name}: {self._client.get_process(name)}")
        self._recording.mark(f"{told} {name}")

    def _command(self, *words: str) -> None:
        subprocess.run(
            [sys.executable, "-m", "rosrm.cli", *words], check=True, stdout=subprocess.DEVNULL
        )


@contextmanager
def _variables(variables: dict[str, str]) -> Iterator[None]:
    """Give variables to the processes that are started in this context."""
    former = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in former.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def record(folder: Path) -> tuple[Recording, Path]:
    """Play the scenario in a new folder; return its recording, and the file of the effects."""
    recording, places = Recording(folder / "disk", folder), Places.make(folder)
    recording.make("cluster/", "cluster/master.log", f"cluster/{HOST}.log")  # for their output
    keys = {"ROSRM_KEYS": str(recording.root / "keys")}
    hosts = [
        HostConfig(
            host=HOST, scope="slice", max_processes=4,
            budget={"memory": 2.0**34, "cpu": 64.0}, probes={"memory": {}, "cpu": {}},
        )
    ]  # fmt: skip
    with (
        _variables({**recording.environment, **keys}),
        LocalCluster(
            recording.root / "cluster", cluster=with_journal("full"), hosts=hosts
        ) as cluster,
    ):
        cluster.wait_for_hosts(_PATIENCE)
        Scenario(recording, cluster, places).play()
    recording.end()
    return recording, places.effects
