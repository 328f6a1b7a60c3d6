"""Kills of the master at random instants, during submissions, assignments and migrations.

`ROSRM_KILLS` instants are drawn (default 6) from the seed `ROSRM_SEED` (default 1).
"""

from __future__ import annotations

import os
import random
import signal
import threading
from collections import Counter
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings, MigrationSettings
from rosrm.errors import NoMaster, Refused
from rosrm.model.values import MigrationPolicy, RestartPolicy
from tests.ros.clusters import Cluster, alive, host, job, pids_of, python
from tests.waiting import PATIENCE, wait_until

KILLS = int(os.environ.get("ROSRM_KILLS", "6"))
SEED = int(os.environ.get("ROSRM_SEED", "1"))
SERVICES = ("s0", "s1", "s2")
JOBS = 10
#: Seconds after the first request of a round, within which the master is killed.
SPAN = 0.5

#: Logs its start: "alone", or "beside another" if another instance holds the lock of the name.
HOLDER = """
import fcntl, os, sys, time
folder, name = sys.argv[1:]
lock = open(os.path.join(folder, name + ".lock"), "a")
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    word = "alone"
except BlockingIOError:
    word = "beside another"
with open(os.path.join(folder, name), "a") as log:
    log.write(word + "\\n")
time.sleep(1000)
"""


class Round:
    """Consecutive requests, until the master is killed during one of them.

    Attributes:
        answered: jobs whose submission was answered.
        sent: all submitted jobs, answered or not.
    """

    def __init__(self, cluster: Cluster, number: int, ran: Path) -> None:
        self._cluster = cluster
        self._number = number
        self._ran = ran
        self._dead = threading.Event()
        self.answered: list[str] = []
        self.sent: list[str] = []

    def run(self, delay: float) -> None:
        """Send requests, and kill the master `delay` seconds after the first one."""
        client = self._cluster.client
        timer = threading.Timer(delay, self._kill)
        timer.start()
        try:
            for number in range(JOBS):
                if self._dead.is_set():
                    break
                self._submit(client, f"r{self._number:02}-{number}")
                self._move(client, SERVICES[number % len(SERVICES)])
        except (NoMaster, Refused):
            assert self._dead.wait(PATIENCE), "a master that lives did not answer"
        timer.join()

    def _submit(self, client, name: str) -> None:
        client._timeout = 1.0  # seconds; a dead master does not answer
        self.sent.append(name)
        client.submit([job(name, "sh", "-c", f"echo {name} >> {self._ran}")])
        self.answered.append(name)

    def _move(self, client, name: str) -> None:
        rows = {row.name: row for row in client.list(processes=True).processes}
        if rows[name].state == "running":
            client.migrate(name, {"h0": "h1", "h1": "h0"}[rows[name].host])

    def _kill(self) -> None:
        process = self._cluster.master.process
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        self._dead.set()


@pytest.mark.timeout(120 + 20 * KILLS)
def test_whenever_it_is_killed(make_cluster) -> None:
    """Nothing runs twice, no answered request is forgotten, and the queue keeps its order.

    The processes are the evidence: each job logs its run, each service logs that it runs alone.
    """
    print(f"ROSRM_SEED={SEED} ROSRM_KILLS={KILLS}")
    drawn = random.Random(SEED)
    cluster = make_cluster(
        host("h0", max_processes=4), host("h1", max_processes=4),
        migration=MigrationSettings(automatic=False),
        liveness=LivenessSettings(suspect=5.0, lease=60.0),
    )  # fmt: skip
    ran = cluster.directory / "ran"
    stops_first = MigrationPolicy("relaunch", overlap=False)
    cluster.submit(
        *(
            python(
                name, HOLDER, arguments=(str(cluster.directory), name), migration=stops_first,
                restart=RestartPolicy("on-failure", delay=0.1, attempts=100),
            )
            for name in SERVICES
        )
    )  # fmt: skip
    for name in SERVICES:
        cluster.wait(name, "running")
    rounds = []
    for number in range(KILLS):
        one = Round(cluster, number, ran)
        one.run(drawn.uniform(0.0, SPAN))
        rounds.append(one)
        cluster.reconnect()
        cluster.start_master()
        cluster.wait_for_hosts()

    answered = [name for one in rounds for name in one.answered]
    sent = [name for one in rounds for name in one.sent]
    for name in answered:
        assert cluster.ended(name, timeout=60.0).state == "finished"
    known = [row.name for row in cluster.client.list(processes=True).processes]
    for name in sent:
        if name in known:
            cluster.ended(name, timeout=60.0)
    times = Counter(ran.read_text().split())
    assert not [name for name in answered if times[name] != 1]
    assert set(times) <= set(sent)
    assert max(times.values()) == 1
    assert_in_order([event.process for event in cluster.events("assigned")], sent)
    for name in SERVICES:
        row = cluster.wait(name, "running", timeout=60.0)
        said = (cluster.directory / name).read_text().split("\n")[:-1]
        assert set(said) == {"alone"}, f"{name} ran twice: {said}"
        assert running(cluster, name) == {row.pid}


def assert_in_order(assigned: list[str], sent: list[str]) -> None:
    """Check that each job was first assigned after those submitted before it."""
    first = list(dict.fromkeys(name for name in assigned if name not in SERVICES))
    assert first == [name for name in sent if name in set(first)]


def running(cluster: Cluster, name: str) -> set[int]:
    """Return the pids of all running processes under a name."""

    def found() -> set[int]:
        lines = pids_of(cluster.directory).items()
        end = f"{cluster.directory} {name} "
        return {pid for pid, line in lines if line.endswith(end) and alive(pid)}

    wait_until(lambda: len(found()) == 1, f"one {name}", seen=found)
    return found()
