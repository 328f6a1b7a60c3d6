"""A real cluster whose writes are recorded, with the answers that its user gets."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.crash.recording import Recording
from benchmarks.hosts import with_journal
from rosrm import clocks
from rosrm.client.client import Client
from rosrm.client.waiting import Until
from rosrm.config.settings import HostConfig
from rosrm.config.work import processes_of
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.testing.local_cluster import LocalCluster

#: Names of the hosts; the second one joins after the steps that need a single host.
HOSTS: Final = ("host0", "host1")
#: Name of the process that has a state and replicas of its snapshots.
COUNTER: Final = "counter"
_ROOT: Final = Path(__file__).resolve().parents[2]
_PATIENCE: Final = 120.0
#: Cycles of the counter between two looks at its replica.
_CYCLES: Final = 8
APPLICATION: Final = "map"
_PARTS: Final = ("planner", "driver")
_QUICK: Final = RolloutPolicy(healthy_for=0.5)
#: Program of each process but the counter. It appends checksums of its files to the effects; a
#: service then keeps running.
_PROGRAM: Final = """#!/bin/sh
name=${ROSRM_INSTANCE%%#*} then=$1 effects=$2 artifact=$3
while [ $# -gt 0 ]; do [ "$1" = --params-file ] && parameters=$2; shift; done
sums="$(cat $parameters /dev/null | cksum) $(cat $artifact /dev/null | cksum)"
echo "$name" "$then" $sums >> "$effects"
for n in 1 2 3; do seq -f "line %g of $name" 150; sleep 0.1; done
[ "$then" = end ] && exit 0
exec sleep 1000
"""
#: The counter, with 5 cycles a second.
_COUNTER: Final = f"""
echo {COUNTER} counts >> "$0" && cd '{_ROOT}' &&
exec '{sys.executable}' -m benchmarks.handoff_nodes count --rate 5 "$@"
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
                one.terminate()  # a process in the background ignores SIGINT

    def _play(self) -> None:
        self._keys()
        self._jobs(1)  # from which the master learns that they are short
        self._jobs(8)  # of which the host holds one ahead
        self._nodes()
        self._versions()
        self._restarts()
        self._moves()
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
            options = {"ros": True, "readiness": "running", "parameters": {"version": version}}
            parts = (
                self._places.process(name, then=f"run-{version}", **options) for name in _PARTS
            )
            specs = (
                replace(spec, application=APPLICATION)
                for part in parts for spec in processes_of(part)
            )  # fmt: skip
            self._client.apply_targets([Target(APPLICATION, tuple(specs), rollout=_QUICK)])
            self._recording.mark(f"applied {version}")
            if not self._client.wait_for_applications(APPLICATION, timeout=_PATIENCE):
                raise RuntimeError(f"version {version}: {self._client.list_applications()}")
            self._recording.mark(f"reached {version}")

    def _restarts(self) -> None:
        master = self._cluster.master
        assert master is not None
        master.end(signal.SIGKILL)
        master.process.wait(_PATIENCE)
        self._cluster.start_master()
        self._cluster.wait_for_hosts(_PATIENCE)
        self._submit([self._places.process("late", then="end")])
        self._wait("late", "ended")
        slave = self._cluster.slaves[HOSTS[0]]
        slave.end(signal.SIGKILL)
        slave.process.wait(_PATIENCE)
        self._cluster.start_slave(host_config(HOSTS[0]))
        self._cluster.wait_for_hosts(_PATIENCE)
        self._submit([self._places.process("later", then="end")])
        self._wait("later", "ended")

    def _moves(self) -> None:
        """Move a process with a state from host to host, and back, with replicas on the other."""
        self._cluster.start_slave(host_config(HOSTS[1]))
        self._cluster.wait_for_hosts(_PATIENCE)
        counter = {
            "name": COUNTER, "command": ["sh", "-c", _COUNTER, str(self._places.effects)],
            "ros": True, "migration": {"strategy": "handoff"},
        }  # fmt: skip
        self._submit([counter])
        self._wait(COUNTER, "runs")
        for _ in HOSTS:
            self._await_replicas()
            source = self._client.get_process(COUNTER).host
            destination = next(name for name in HOSTS if name != source)
            since = self._client.list().last_sequence
            self._recording.mark(f"moving {COUNTER} {destination}")
            self._client.migrate(COUNTER, destination)
            if not self._client.wait_for_migration(COUNTER, after=since, timeout=_PATIENCE):
                raise RuntimeError(f"no move: {self._client.explain(COUNTER)}")
            self._recording.mark(f"moved {COUNTER} {destination}")
        self._await_replicas()
        self._recording.mark(f"cancelling {COUNTER}")
        self._client.cancel(COUNTER)
        self._wait(COUNTER, "ended")

    def _await_replicas(self) -> None:
        """Wait until the other host has reported two replicas, at least `_CYCLES` cycles apart."""
        newest, deadline = 0, clocks.boot_time() + _PATIENCE
        for _ in range(2):
            while not (found := self._replica(newest + _CYCLES)):
                if clocks.boot_time() >= deadline:
                    raise RuntimeError(f"no replica within {_PATIENCE:g} s: {self._replica(0)}")
                time.sleep(0.1)
            newest = found[1]
            self._recording.mark(f"kept {' '.join(map(str, found))}")

    def _replica(self, sequence: int) -> tuple[int, int, str] | None:
        """Return number, sequence and host of the counter's replica from a sequence on."""
        home = self._client.get_process(COUNTER).host
        for one in self._client.explain(COUNTER)["kept"]:
            if one["host"] != home and one["sequence"] >= sequence:
                return one["number"], one["sequence"], one["host"]
        return None

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


def host_config(name: str) -> HostConfig:
    """Return the settings of a host."""
    return HostConfig(
        host=name, scope="slice", max_processes=5,
        budget={"memory": 2.0**34, "cpu": 64.0}, probes={"memory": {}, "cpu": {}},
    )  # fmt: skip


def record(folder: Path) -> tuple[Recording, Path]:
    """Play the scenario in a new folder; return its recording, and the file of the effects."""
    recording, places = Recording(folder / "disk", folder), Places.make(folder)
    logs = [f"cluster/{name}.log" for name in ("master", *HOSTS)]
    recording.make("cluster/", *logs)  # for their output
    keys = {"ROSRM_KEYS": str(recording.root / "keys")}
    directory, settings = recording.root / "cluster", with_journal("full")
    with (
        _variables({**recording.environment, **keys}),
        LocalCluster(directory, cluster=settings, hosts=[host_config(HOSTS[0])]) as cluster,
    ):
        cluster.wait_for_hosts(_PATIENCE)
        Scenario(recording, cluster, places).play()
    recording.end()
    return recording, places.effects
