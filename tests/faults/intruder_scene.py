"""A cluster with a process that must survive an intruder, and the messages that would harm it."""

from __future__ import annotations

import contextlib
import itertools
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil

from rosrm import clocks
from rosrm.model.orders import FenceInstance, StartInstance, StopInstance
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ResourceDescription,
    SnapshotReport,
)
from rosrm.ros import convert, names
from rosrm.ros.orders import order_to_msg
from rosrm.ros.reading_codec import Reading, encode
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.ros.clusters import Cluster, alive, host, job, service
from tests.waiting import wait_until

HOSTS = ("h0", "h1")
WITNESS = "witness"
#: In the environment and in the log of the witness.
SECRET = "hunter2"


def guarded_hosts(*more: str) -> tuple[Any, ...]:
    """Return the settings of hosts whose label is their name."""
    return tuple(host(name, labels={"who": name}) for name in (*HOSTS, *more))


class Scene:
    """A cluster whose state is checked after each attack.

    Attributes:
        stolen: file that exists if a process of the intruder was started.
        witness: row of the process that must survive.
    """

    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster
        cluster.is_attacked = True
        self.stolen: Path = cluster.directory / "stolen"
        says = "import os, time; print('says', os.environ['TOKEN'], flush=True); time.sleep(999)"
        cluster.submit(
            service(
                WITNESS, sys.executable, "-c", says, environment={"TOKEN": SECRET},
                required_labels={"who": HOSTS[0]},
            )
        )  # fmt: skip
        self.witness = cluster.wait(WITNESS, "running")
        cluster.wait_for_log(WITNESS, SECRET)
        self._jobs = itertools.count()
        self._before = self._facts()

    def _facts(self) -> dict[str, object]:
        view = self.cluster.client.list(hosts=True, processes=True)
        return {
            "pids": [(one.name, one.process.pid, one.process.poll()) for one in self._parts()],
            "supervisors": [(self.cluster.supervisor(name)) for name in HOSTS],
            "hosts": [
                (row.description.name, row.description.incarnation, row.state, row.cordoned,
                 row.draining) for row in view.hosts
            ],
            "processes": [
                (row.name, row.state, row.host, row.number, row.pid, row.restarts)
                for row in view.processes if not row.name.startswith("rightful-")
            ],
        }  # fmt: skip

    def _parts(self) -> list[Any]:
        return self.cluster.parts()

    def remember(self) -> None:
        """Take the present state as the one that must stay, as after a restart of the master."""
        self._before = self._facts()

    def check(self) -> None:
        """Check that nothing has changed, and that each host runs a job of the rightful user."""
        wait_until(
            lambda: self._facts() == self._before, "the state before the attack",
            seen=lambda: f"{self._before}\n{self._facts()}", pause=self.cluster.client.spin,
        )  # fmt: skip
        assert alive(self.witness.pid)
        assert not self.stolen.exists()
        self.run_jobs()

    def run_jobs(self, **environment: str) -> None:
        """Run a job of the rightful user on each host."""
        number = next(self._jobs)
        done = self.cluster.run(
            *(job(f"rightful-{name}-{number}", "true", required_labels={"who": name},
                  environment=environment) for name in HOSTS)
        )  # fmt: skip
        assert [row.state for row in done] == ["finished", "finished"]

    def records(self) -> list[Any]:
        """Return the records about refused messages."""
        return self.cluster.events("peer_refused", newest=10_000)

    def refused(self) -> int:
        """Return the number of messages without a valid key that the master has counted."""
        words = self.cluster.client.list().strangers.split()
        return int(words[0].replace(",", "")) if words else 0

    def memory(self) -> dict[str, int]:
        """Return the resident bytes of master and slaves."""
        return {
            one.name: psutil.Process(one.process.pid).memory_info().rss for one in self._parts()
        }

    # --- what would harm it ----------------------------------------------------------------

    def host(self, name: str) -> Any:
        return self.cluster.host(name)

    def requests(self, as_host: str = HOSTS[0]) -> Iterator[tuple[str, Any]]:
        """Yield a harmful or curious request for each service of the master.

        Args:
            as_host: for which a slave would send the requests of slaves.
        """
        row = self.host(HOSTS[0] if as_host not in HOSTS else as_host)
        ours = {"host_id": row.host_id, "incarnation": row.description.incarnation}
        version = {"protocol_version": PROTOCOL_VERSION}
        yield names.SUBMIT, srv.Submit.Request(processes=[convert.spec_to_msg(theft(self.stolen))])
        for name, kind in ((names.CANCEL, srv.Cancel), (names.RESTART, srv.Restart)):
            yield name, kind.Request(processes=[WITNESS])
        yield names.MIGRATE, srv.Migrate.Request(process=WITNESS, host=HOSTS[1])
        yield names.CHECKPOINT, srv.Checkpoint.Request(process=WITNESS)
        yield names.RESTORE, srv.Restore.Request(process=WITNESS)
        for action in ("drain", "cordon"):
            yield names.SET_HOST_STATE, srv.SetHostState.Request(host=HOSTS[0], action=action)
        yield names.PRUNE, srv.Prune.Request()
        yield names.REBALANCE, srv.Rebalance.Request()
        yield names.RELOAD, srv.Reload.Request()
        yield names.LIST, srv.List.Request(hosts=True, processes=True, events=True, **version)
        yield names.EXPLAIN, srv.Explain.Request(process=WITNESS, **version)
        for wanted in (names.READ_LOG, names.STORE_REPLICA, names.READ_SNAPSHOT):
            yield (
                names.INTRODUCE,
                srv.Introduce.Request(host=HOSTS[0], service=wanted, process=WITNESS, **version),
            )
        yield names.REGISTER_HOST, registration(as_host)
        yield names.LEAVE, srv.Leave.Request(**ours)
        yield names.REQUEST_PROCESS, srv.RequestProcess.Request(**ours)

    def messages(self, of: str) -> Iterator[tuple[str, Any]]:
        """Yield false messages about a host, by topic; readings are serialised."""
        row = self.host(of)
        ours = {
            "protocol_version": PROTOCOL_VERSION, "host_id": row.host_id,
            "incarnation": row.description.incarnation,
        }  # fmt: skip
        instance = InstanceId(WITNESS, self.witness.number)
        failed = InstanceStatus(instance, InstanceState.FAILED, message="forged")
        yield (
            names.PROCESS_STATUS,
            msg.ProcessStatusBatch(
                **ours, sequence=2**62, complete=True, statuses=[convert.status_to_msg(failed)]
            ),
        )
        yield (
            names.PROCESS_USAGE,
            msg.ProcessUsage(**ours, numbers=[instance.number], cpu=[900.0], memory=[2**50]),
        )
        snapshots = [convert.snapshot_to_msg(SnapshotReport(instance, 2**52, 9))]
        yield names.SNAPSHOT_REPORTS, msg.SnapshotReports(**ours, snapshots=snapshots)
        yield names.RESOURCE_INFO, reading(**ours)

    def orders(self) -> Iterator[Any]:
        """Yield orders of a master that would start, stop and kill."""
        yield order_to_msg(order_of_theft(self.stolen))
        for kind in (StopInstance, FenceInstance):
            yield order_to_msg(kind(InstanceId(WITNESS, self.witness.number)))


def theft(stolen: Path) -> Any:
    """Return a job that leaves a file on the host that runs it."""
    return job("theft", "touch", str(stolen))


def order_of_theft(stolen: Path) -> StartInstance:
    """Return the order to start this job."""
    return StartInstance(Assignment(InstanceId("theft", 10**6), theft(stolen), 2**62, "theft"))


def registration(name: str) -> srv.RegisterHost.Request:
    """Return the request of a new run of a slave."""
    memory = ResourceDescription("memory", "B", 1e12)
    description = HostDescription(name, 4242, resources=(memory,), labels={"who": name}, period=0.1)
    return srv.RegisterHost.Request(host=convert.host_to_msg(description))


def reading(**fields: int) -> bytes:
    """Return a reading of a host that is full."""
    record = Reading(
        sequence=2**62, beat=clocks.boot_time_ns(), present=0b11, flags=1,
        usage=RESOURCE_SLOTS * (0.99,), limit=RESOURCE_SLOTS * (1.0,),
    )  # fmt: skip
    return encode(replace(record, **fields))


def bytes_below(directory: Path) -> int:
    """Return the size of the files in a directory tree."""
    total = 0
    for one in directory.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            total += one.stat().st_size if one.is_file() else 0
    return total
