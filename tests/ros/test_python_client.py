"""The Python client against a real cluster."""

from __future__ import annotations

import pytest

from rosrm import Client, NoMaster
from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from tests.pages import PYTHON, blocks, run_examples
from tests.ros.clusters import host
from tests.waiting import quickest


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

    def connect() -> None:
        with pytest.raises(NoMaster, match=rf"no master answered within .*domain {domain}, "):
            Client(ros=settings_on_this_machine(domain), timeout=0.5)

    with claim:
        quickest(connect, 2.5)
