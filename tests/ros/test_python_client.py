"""The Python client against a real cluster."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from rosrm import Client, NoMaster
from rosrm.keys.key_files import key_home, make_secret
from rosrm.ros import master_socket
from rosrm.ros.master_connection import MasterClient
from rosrm.ros.participant import Participant
from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from tests.pages import PYTHON, blocks, run_examples
from tests.ros.clusters import host, service
from tests.waiting import PATIENCE, quickest


@pytest.mark.timeout(240)
def test_the_examples_of_the_page_do_what_the_page_shows(make_cluster, tmp_path, monkeypatch):
    """The client finds the master by the environment, as the commands do."""
    cluster = make_cluster(host("robot-1"), host("robot-2"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROSRM_CLUSTER", raising=False)
    for name, value in cluster.ros.environment().items():
        monkeypatch.setenv(name, value)
    for block in blocks(PYTHON):
        if block.title:
            (tmp_path / block.title).write_text(block.text, encoding="utf-8")
    run_examples(PYTHON, "cluster")


def test_a_client_without_a_master_says_so_within_its_time_out():
    """The error names the searched domain."""
    domain, claim = claim_domain()
    make_secret(key_home())

    def connect() -> None:
        with pytest.raises(NoMaster, match=rf"no master answered within .*domain {domain}, "):
            Client(ros=settings_on_this_machine(domain), timeout=0.5)

    with claim:
        quickest(connect, 2.5)


def test_a_client_repeats_the_handshake_with_the_same_ros_client(make_cluster, monkeypatch):
    """Otherwise DDS would take up to 0.1 s to discover a new ROS client for the handshake."""
    cluster = make_cluster(host("h0"))
    monkeypatch.setattr(master_socket, "connect", lambda _: None)
    with MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE) as client:
        services = []
        for number in range(3):
            client._last_contact = float("-inf")
            client.submit([service(f"p{number}")])
            services.append(list(client._participant.node.clients))
    assert services[1:] == services[:1] * 2


def test_several_threads_join_ros_at_the_same_time():
    """Fast DDS reads the environment, which the participants of all threads change and restore."""
    domain, claim = claim_domain()
    together = threading.Barrier(4)

    def join(number: int) -> None:
        together.wait(PATIENCE)
        Participant(settings_on_this_machine(domain), f"client_{number}").close()

    with claim, ThreadPoolExecutor(4) as threads:
        for _ in range(20):
            list(threads.map(join, range(4)))
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ
