"""Keys that are given and revoked while master, slaves and users work."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from rosrm.config.settings import ControlSettings, LivenessSettings
from rosrm.errors import NoMaster
from rosrm.keys import key_files
from rosrm.model.values import HostLossPolicy
from rosrm.ros.master_connection import MasterClient
from tests.ros.clusters import host, job, service
from tests.waiting import PATIENCE, wait_until

SOON = {
    "liveness": LivenessSettings(suspect=0.6, lease=2.0),
    "control": ControlSettings(beat_period=0.1),
}


def key(*words: str) -> None:
    """Run a command of `rosrm key`."""
    command = [sys.executable, "-m", "rosrm.cli", "key", *words]
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)


def revoked_at() -> float:
    """Return the unix time at which the grants changed last."""
    return (key_files.key_home() / key_files.GRANTS_FILE).stat().st_mtime


@pytest.fixture
def cluster(make_cluster):
    cluster = make_cluster(host("h0"), **SOON)
    cluster.is_attacked = True  # a sender with a revoked key counts as a stranger
    return cluster


@pytest.fixture
def start_with_key(cluster, monkeypatch, tmp_path: Path):
    """Yield a function that adds a key for host c and starts its slave with it."""

    def start() -> None:
        file = tmp_path / "c.key"
        key("add", "host:c", "--out", str(file))
        monkeypatch.setenv("ROSRM_KEY", str(file))
        cluster.start_slave(host("c", labels={"who": "c"}))
        monkeypatch.delenv("ROSRM_KEY")
        cluster.wait_for_hosts()

    return start


def test_a_revoked_host_is_out_within_a_second(cluster, start_with_key) -> None:
    """The host gets no work, and its processes follow their policy for lost hosts.

    A new key lets the host in again. Neither needs a restart of the master.
    """
    at_c = {"preferred_labels": {"who": "c"}}
    start_with_key()
    cluster.submit(
        service("goes", host_loss=HostLossPolicy("elsewhere"), **at_c), service("waits", **at_c)
    )
    for name in ("goes", "waits"):
        cluster.wait(name, "running", host="c")
    key("revoke", "host:c")
    out = cluster.wait_for_event("peer_refused", "its key was revoked")
    assert out.wall_time - revoked_at() < 1.0
    cluster.submit(job("work", "true", required_labels={"who": "c"}))
    cluster.wait("goes", "running", host="h0")
    assert cluster.wait("waits", "unreachable").host == "c"
    assert cluster.wait("work", "queued", "set_aside").host == ""
    late = [e for e in cluster.events(host="c", after=out.sequence) if e.kind == "host_back"]
    assert not late
    cluster.end(cluster.slaves.pop("c"), 9)
    start_with_key()
    cluster.ended("work")
    assert cluster.wait("waits", "running").host == "c"
    assert cluster.process("goes").host == "h0"


def test_a_revoked_user_is_not_answered(cluster, monkeypatch, tmp_path: Path) -> None:
    """The next request of a connected client has no answer, and changes nothing."""
    file = tmp_path / "ada.key"
    key("add", "user:ada", "--out", str(file))
    monkeypatch.setenv("ROSRM_KEY", str(file))
    ada = MasterClient.connect(cluster.ros, name="ada", timeout=PATIENCE)
    monkeypatch.delenv("ROSRM_KEY")
    with closing(ada):
        ada.submit([service("adas")])
        cluster.wait("adas", "running")
        ada.read_log("h0", "adas")  # by a ticket, which the slave must refuse later
        key("revoke", "user:ada")
        cluster.client.spin(1.0)
        ada._timeout = 2.0
        with pytest.raises(NoMaster):
            ada.cancel(["adas"])
        with pytest.raises(NoMaster):
            ada.read_log("h0", "adas")
    monkeypatch.setenv("ROSRM_KEY", str(file))
    with pytest.raises(NoMaster, match="A master was found there, and did not answer"):
        MasterClient.connect(cluster.ros, name="ada")
    assert cluster.process("adas").state == "running"


def test_a_slave_names_a_replaced_secret_as_the_cause(cluster, tmp_path: Path) -> None:
    """The master is there, and the slave cannot read one message of it."""
    key("rotate", "--out", str(tmp_path / "new"))
    said = "does not answer this slave: probably the key of this host is no longer valid"
    wait_until(lambda: said in cluster.log_of("h0"), "the cause in the log", 2 * PATIENCE)
