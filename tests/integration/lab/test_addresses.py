"""Addresses of hosts that change or come late, as with DHCP, roaming and a boot.

DDS uses the addresses that an interface has when a participant joins. So these tests fail until the
control plane has connections of its own.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from pyroute2 import IPRoute

from rosrm_lab import MIB, HostPlan, Lab, uniform
from rosrm_lab.network import INTERFACE
from rosrm_lab.plan import host_namespace
from tests.integration.lab.test_cluster import MEMORY, PATIENCE, Cluster
from tests.waiting import wait_until

#: Seconds until the cluster must work again; lease and search take less together.
WITHIN = 30.0

on_dds = pytest.mark.xfail(
    strict=True, raises=AssertionError, reason="the control plane is on DDS: it keeps addresses"
)


@pytest.fixture
def cluster(name, tmp_path):
    """Yield a lab of a desk for the master and a host for a slave, without parts of rosrm."""
    hosts = uniform(1, memory=MEMORY, cpu=0.5, disk=64 * MIB)
    with Lab(name, [*hosts, HostPlan("desk", disk=64 * MIB)]) as lab:
        made = Cluster(lab, tmp_path)
        yield made
    for part in made.started:  # the lab has ended them
        part.wait(PATIENCE)


def set_address(lab: Lab, host: str, address: str) -> None:
    """Give the interface of a host this address alone; "": none."""
    with IPRoute(netns=host_namespace(lab.name, host)) as inside:
        (index,) = inside.link_lookup(ifname=INTERFACE)
        inside.flush_addr(index=index)
        if address:
            inside.addr("add", index=index, address=address, prefixlen=lab.plan.subnet.prefixlen)


def other_address(lab: Lab) -> str:
    """Return an address that no host of the lab has."""
    return str(lab.plan.subnet.broadcast_address - 1)


def runs_a_job(cluster: Cluster, job: str) -> None:
    cluster.submit({"name": job, "kind": "job", "command": "true"})
    wait_until(
        lambda: cluster.processes()[job]["state"] == "finished", f"{job} finishes", WITHIN,
        seen=cluster.said,
    )  # fmt: skip


@on_dds
@pytest.mark.timeout(300)
@pytest.mark.parametrize("host", ["host1", "desk"])
def test_a_host_whose_address_changes_stays_in_the_cluster(cluster, host) -> None:
    """Neither its slave nor the master is restarted."""
    cluster.start("desk", "master")
    cluster.start("host1", "slave")
    try:
        cluster.wait_for_hosts(host1=["up"])
        runs_a_job(cluster, "before")
    except AssertionError as error:
        pytest.fail(f"without a change: {error}")
    set_address(cluster.lab, host, other_address(cluster.lab))
    runs_a_job(cluster, "after")


@on_dds
@pytest.mark.timeout(300)
@pytest.mark.parametrize("host", ["host1", "desk"])
def test_a_part_that_starts_before_its_host_has_an_address_is_found(cluster, host) -> None:
    """As where systemd starts a part before DHCP has answered."""
    address = cluster.lab.address(host)
    set_address(cluster.lab, host, "")
    parts = {"desk": cluster.start("desk", "master"), "host1": cluster.start("host1", "slave")}
    sockets = Path(f"/proc/{parts['desk'].pid}/net/udp")
    log = cluster.logs / "host1-slave.log"
    try:
        wait_until(
            lambda: (
                "looking for a master" in log.read_text()
                and len(sockets.read_text().splitlines()) > 1
            ),
            "both parts have joined ROS", PATIENCE, seen=cluster.said,
        )  # fmt: skip
    except AssertionError as error:
        pytest.fail(str(error))
    assert parts[host].poll() is None
    set_address(cluster.lab, host, address)
    wait_until(
        lambda: cluster.hosts().get("host1", {}).get("state") == "up", "host1 is up", WITHIN,
        seen=cluster.said,
    )  # fmt: skip
    runs_a_job(cluster, "after")
