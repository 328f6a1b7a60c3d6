"""Requests through the socket of a master on this machine, in place of DDS."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.errors import Refused
from rosrm.keys import key_files
from rosrm.keys.finding import master_security
from rosrm.ros import master_socket
from rosrm.ros.master_connection import MasterClient
from tests.programs import require
from tests.ros.clusters import host, service
from tests.waiting import PATIENCE


def connected(cluster) -> MasterClient:
    return MasterClient.connect(cluster.ros, name="another", timeout=PATIENCE)


def rosrm(cluster, *words: str, within: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run a command; its standard error also lists the modules that it imports."""
    return subprocess.run(
        [*within, sys.executable, "-X", "importtime", "-m", "rosrm.cli", *words],
        env={**os.environ, **cluster.ros.environment()}, capture_output=True, text=True,
        check=False, timeout=PATIENCE,
    )  # fmt: skip


def outcome(request, *arguments) -> object:
    try:
        return request(*arguments)
    except Refused as refusal:
        return refusal.code, str(refusal)


def outcomes(cluster) -> tuple[list[object], bool]:
    """Return the results of some requests, and True if they used DDS."""
    with connected(cluster) as client:
        first = outcome(client.submit, [service("walk")])
        if isinstance(first, str):  # it was not refused
            cluster.wait("walk", "running")
        found = [
            first,
            outcome(client.submit, [service("walk")]),
            outcome(client.cancel, ["nothing"]),
            outcome(client.restart, ["walk"]),
            outcome(client.set_host_state, "h0", "cordon"),
            outcome(client.set_host_state, "h0", "uncordon"),
            outcome(client.cancel, ["n" * 70_000]),
            outcome(client.explain, "nothing"),
            [row.description.name for row in client.list(hosts=True).hosts],
            client.list(plugins=True).security,
        ]
        return found, client._joined is not None


@pytest.mark.parametrize("role", ["operator", "viewer"])
def test_the_socket_and_dds_give_the_same_results(
    make_cluster, monkeypatch, tmp_path: Path, role: str
) -> None:
    """Roles, bounds, refusals and results are the same through both."""
    key_files.make_secret(key_files.key_home())
    file = tmp_path / "eve.key"
    added = ["key", "add", "user:eve", "--role", role, "--out", str(file)]
    subprocess.run([sys.executable, "-m", "rosrm.cli", *added], check=True, timeout=PATIENCE)
    cluster = make_cluster(host("h0"))  # its master reads the new grant at its start
    monkeypatch.setenv("ROSRM_KEY", str(file))
    by_socket, used_dds = outcomes(cluster)
    assert not used_dds
    monkeypatch.delenv("ROSRM_KEY")
    if role == "operator":
        cluster.cancel("walk")
        cluster.client.prune(["walk"])
    monkeypatch.setenv("ROSRM_KEY", str(file))
    monkeypatch.setattr(master_socket, "connect", lambda _: None)
    over_dds, used_dds = outcomes(cluster)
    assert used_dds
    assert by_socket == over_dds
    assert len({str(one) for one in by_socket}) > 4


def test_a_command_on_the_machine_of_the_master_needs_no_dds(make_cluster) -> None:
    """`rosrm ps` then imports no rclpy; in another network namespace nothing listens."""
    cluster = make_cluster(host("h0"))
    cluster.submit(service("walk"))
    done = rosrm(cluster, "ps")
    assert "walk" in done.stdout, done.stderr
    assert "rclpy" not in done.stderr
    require("unshare")
    elsewhere = rosrm(cluster, "ps", within=("unshare", "--net"))
    if "Operation not permitted" in elsewhere.stderr:
        pytest.skip("a network namespace needs CAP_SYS_ADMIN")
    assert elsewhere.stdout == ""
    assert "rclpy" in elsewhere.stderr, "the command looked for a master over DDS"


def test_an_impostor_on_the_socket_only_costs_time(make_cluster) -> None:
    """A program that has bound the name before the master cannot answer; DDS remains."""
    cluster = make_cluster(started=False)
    cluster.is_attacked = True
    with socket.socket(socket.AF_UNIX) as impostor:
        impostor.bind(master_socket.address(cluster.ros, master_security("keys")))
        impostor.listen()
        cluster.start_master()
        with connected(cluster) as client:
            assert client._joined is not None
            assert client.list(hosts=True).hosts == []
            assert "the socket cannot be bound" in cluster.log_of("master")


def test_a_client_finds_the_socket_of_a_restarted_master(make_cluster) -> None:
    """A request to the former run is repeated after a new handshake, as over DDS."""
    cluster = make_cluster(host("h0"))
    with connected(cluster) as client:
        client.submit([service("first")])
        cluster.restart_master()
        cluster.wait_for_hosts()
        client.submit([service("second")])
        assert client._joined is None
    cluster.wait("second", "running")
