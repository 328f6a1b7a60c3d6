"""Migrations by CRIU between hosts with different addresses, and over a cut network."""

from __future__ import annotations

import threading
import time

import pytest

from benchmarks.criu import parts, play
from rosrm_criu.engine import restore_result
from rosrm_lab import DATA, GIB, HostPlan, Lab, uniform
from tests.waiting import PATIENCE

HOSTS = ("host1", "host2")


@pytest.fixture
def hosts(criu, name, tmp_path):
    """Yield a lab with master and observer on one host, and a slave on two others."""
    with (
        Lab(name, [*uniform(2, disk=GIB), HostPlan("desk")]) as lab,
        parts(lab, tmp_path),
    ):
        yield lab


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_node_keeps_its_state_at_another_address(hosts):
    """To and fro, no count is received twice, and the memory is the same.

    Then the destination is cut off during the transfer of the image: the source runs on.
    """
    slow = {"max_rate": 2_000_000, "transfer_timeout": 5.0}
    requests = [
        {"strategy": "criu", "mb": 1, "hops": 2},
        {"strategy": "criu", "mb": 1, "hops": 1, "options": slow},
    ]
    hops = play(hosts, requests)
    for _ in range(2):
        hop = next(hops)
        assert hop["end"] == "migrated", hop
        assert hop["repeated"] == 0
        assert len(hop["checksums"]) == 1
    cutter = threading.Thread(target=cut_off_who_fetches, args=(hosts,))
    cutter.start()
    hop = next(hops)
    cutter.join(PATIENCE)
    assert hop["end"] == "stayed", hop
    # On a busy machine the host counts as lost before the fetch has given up.
    assert "criu_fetch" in hop["why"] or "is lost" in hop["why"], hop
    assert hop["repeated"] == 0
    assert len(hop["checksums"]) == 1
    for host in HOSTS:
        hosts.heal(host)
    assert next(hops, None) is None
    for host in HOSTS:
        left = hosts.outside(host, f"{DATA}/slave/images").rglob("*")
        # The result of a restore stays as long as its instance.
        assert not [one.name for one in left if one.is_file() and one.name != restore_result.FILE]


def cut_off_who_fetches(lab: Lab) -> None:
    """Cut off the host that has received the first part of an image."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for host in HOSTS:
            images = lab.outside(host, f"{DATA}/slave/images")
            if any(images.glob(".rosrm-fetch-*/*/*")):
                lab.cut(host)
                return
        time.sleep(0.01)
